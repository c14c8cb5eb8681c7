"""Simulate a narrow forward-looking sonar over a textured sea floor with objects on it and fish above it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from math import isfinite
from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import NavState, Ping, Truth, hookimpl
from fls_sources.scene_clutter import NumberFormat, background
from fls_sources.scene_image import Sonar
from fls_sources.scene_motion import even_stamps
from fls_sources.scene_objects import SceneObject, scatterers
from fls_sources.seabed_floor import Patch, floor
from fls_sources.seabed_image import SeabedStage
from fls_sources.seabed_plan import Vehicle, cylinder, fish, spheres

__all__ = ["SeabedPing", "SeabedScene"]

FloatArray = npt.NDArray[np.float64]
Sequence = Literal["spheres", "cylinder"]
Way = Literal["straight", "sinusoidal"]
SeabedLaw = Literal["rayleigh", "k"]

SCENE_STREAM, PING_STREAM = 0, 1  # what the seed's random streams are for
SWAY = {"straight": (0.15, 40.0), "sinusoidal": (1.0, 60.0)}  # m, s
CYLINDER_PINGS, SPHERES_PINGS = 18, 100
CYLINDER_PATCH = Patch(20.0, 30.0)  # out of sight after ten pings
CYLINDER_DRIFT_MPS = 0.15


class SeabedPing(NamedTuple):
    """What a simulated sonar gives: the image, and what is in it."""

    ping: Ping
    truth: Truth


@dataclass
class SeabedScene:
    """Pings of a simulated sonar over the sea floor and the truth in them, the same for the same parameters.

    `spheres`: spheres on a floor of two sediments, `min_in_view` to `max_in_view` of them at a time, coming
    into view mostly at the far end as the vehicle goes north, nearly straight or along a sine. `cylinder`: 18
    pings towards one cylinder that drifts to port, over bright sediment before it in the first ten.
    `backward` plays a sequence from its end; stamps increase all the same.

    The image is amplitude: |speckle on the floor's mean power + echoes| times a gain over range. Modelled:
    a floor fixed to the world, echoes brighter on the near side with a beam pattern, shadows, fish that swim
    straight, echoes from nothing (`false_echoes` per ping, as strong as objects but for `false_offset_db`).
    Not modelled: depth and tilt (all lies in the sonar's plane but for shadows), multipath, motion during a
    ping. Signal-to-noise ratios hold against the dark sediment. `Truth` is in the frame of the moving sonar,
    its velocities are apparent; it holds what lies inside the sector. Ping `k` depends on the parameters and
    `k`; the objects' places also on the number of pings.

    Source: Clark & Bell 2005, section III. Raises ValueError for bad parameters.
    """

    sequence: Sequence = "spheres"
    path: Way = "straight"
    pings: int | None = None
    backward: bool = False
    range_min_m: float = 20.0
    range_max_m: float = 60.0
    cell_m: float = 0.1
    sector_deg: float = 10.0
    n_beams: int = 20
    beamwidth_deg: float = 0.5  # -3 dB
    side_lobe_db: float = -28.0
    min_in_view: int = 1
    max_in_view: int = 4
    diameter_m: float = 1.0  # of the spheres
    snr_db: float = 27.0
    bright_db: float | None = None  # of the second sediment; None: 6, of the cylinder's patch 14
    n_fish: int = 0
    fish_speed_mps: float = 0.8
    false_echoes: float = 0.0
    false_offset_db: float = -3.0
    clutter: SeabedLaw = "rayleigh"
    k_shape: float = 2.0  # of the K law: small is spiky
    dtype: NumberFormat = "float32"
    speed_mps: float = 1.0
    sway_m: float | None = None  # None: what the path says
    sway_period_s: float | None = None
    altitude_m: float = 8.0
    ping_rate_hz: float = 1.0
    frequency_hz: float = 600e3
    sound_speed_mps: float = 1500.0
    nav: bool = False  # whether pings carry the vehicle's state
    seed: int = 0
    start_ns: int = 1_104_537_600_000_000_000  # 2005-01-01

    def __post_init__(self) -> None:
        for spec in fields(self):
            value = getattr(self, spec.name)
            self._require(spec.name, not isinstance(value, float) or isfinite(value), "finite")
        choices = (("sequence", Sequence), ("path", Way), ("clutter", SeabedLaw), ("dtype", NumberFormat))
        for name, known in choices:
            self._require(name, getattr(self, name) in get_args(known), f"one of {get_args(known)}")
        for name in ("cell_m", "sector_deg", "beamwidth_deg", "diameter_m", "k_shape", "speed_mps"):
            self._require(name, getattr(self, name) > 0.0, "positive")
        for name in ("altitude_m", "ping_rate_hz", "frequency_hz", "sound_speed_mps"):
            self._require(name, getattr(self, name) > 0.0, "positive")
        for name in (
            "range_min_m",
            "false_echoes",
            "fish_speed_mps",
            "min_in_view",
            "n_fish",
            "seed",
            "start_ns",
        ):
            self._require(name, getattr(self, name) >= 0, "0 or more")
        self._require("pings", self.pings is None or self.pings >= 1, "1 or more")
        self._require("n_beams", self.n_beams >= 1, "1 or more")
        self._require("sway_period_s", self.sway_period_s is None or self.sway_period_s > 0.0, "positive")
        self._require("sector_deg", self.sector_deg <= 180.0, "at most 180")
        self._require("side_lobe_db", self.side_lobe_db < 0.0, "negative")
        self._require("max_in_view", self.max_in_view >= self.min_in_view, f"{self.min_in_view} or more")
        reach = self.range_max_m - self.range_min_m
        self._require("range_max_m", reach >= 2.0 * self.cell_m, "two cells beyond range_min_m or more")

    def __len__(self) -> int:
        if self.pings is not None:
            return self.pings
        return CYLINDER_PINGS if self.sequence == "cylinder" else SPHERES_PINGS

    def __call__(self) -> Iterator[SeabedPing]:
        """Every ping of the sequence with its truth, from the first, each time it is called."""
        stage, last = self._stage(), len(self) - 1
        stamps = even_stamps(self.start_ns, len(self), self.ping_rate_hz)
        range_m, bearing_rad = stage.sonar.range_m, stage.sonar.beams_rad
        for seq, stamp_ns in enumerate(stamps.tolist()):
            place = last - seq if self.backward else seq
            time_s = place / self.ping_rate_hz
            ping = Ping(
                seq,
                stamp_ns,
                stage.image(time_s, self._rng(PING_STREAM, place)),
                range_m,
                bearing_rad,
                beamwidth_rad=stage.sonar.beamwidth_rad,
                sound_speed_mps=self.sound_speed_mps,
                frequency_hz=self.frequency_hz,
                nav=self._nav(seq, stamp_ns, stage.vehicle, time_s) if self.nav else None,
            )
            yield SeabedPing(ping, self._truth(seq, stamp_ns, stage, time_s))

    def _stage(self) -> SeabedStage:
        rng, sonar, vehicle = self._rng(SCENE_STREAM), self._sonar(), self._vehicle()
        time_s = np.arange(len(self)) / self.ping_rate_hz
        things: list[SceneObject] = [cylinder(self.snr_db)]
        if self.sequence == "spheres":
            in_view = (self.min_in_view, self.max_in_view)
            things = spheres(sonar, vehicle, time_s, in_view, self.diameter_m, self.snr_db, rng)
        swim = (self.fish_speed_mps, self.snr_db - 3.0, len(things) + 1)
        things += fish(self.n_fish, sonar, vehicle, time_s, *swim, rng)
        patch = CYLINDER_PATCH if self.sequence == "cylinder" else None
        bright = self.bright_db if self.bright_db is not None else 14.0 if patch else 6.0
        shape = (sonar.n_ranges, self.n_beams)
        return SeabedStage(
            sonar,
            vehicle,
            tuple(things),
            scatterers(things, self.cell_m, rng),
            floor(bright, patch, rng),
            background(self.clutter, self.k_shape, self.dtype, shape, rng),
            self.dtype,
            self.altitude_m,
            self.false_echoes,
            self.snr_db + self.false_offset_db,
        )

    def _sonar(self) -> Sonar:
        n_ranges = int((self.range_max_m - self.range_min_m) / self.cell_m + 0.5)
        spacing = np.deg2rad(self.sector_deg / self.n_beams)
        beams = (np.arange(self.n_beams) - (self.n_beams - 1) / 2.0) * spacing
        width = np.deg2rad(self.beamwidth_deg)
        return Sonar(self.range_min_m, self.cell_m, n_ranges, beams, spacing, width, self.side_lobe_db)

    def _vehicle(self) -> Vehicle:
        sway, period = SWAY[self.path]
        sway = sway if self.sway_m is None else self.sway_m
        period = period if self.sway_period_s is None else self.sway_period_s
        if self.sequence == "cylinder":
            return Vehicle(self.speed_mps, self.sway_m or 0.0, period, CYLINDER_DRIFT_MPS)
        return Vehicle(self.speed_mps, sway, period)

    def _nav(self, seq: int, stamp_ns: int, vehicle: Vehicle, time_s: float) -> NavState:
        sign = -1.0 if self.backward else 1.0
        pose, (north, east) = vehicle.pose(time_s), sign * vehicle.velocity_mps(time_s)
        yaw, rate = pose.heading_rad, sign * vehicle.yaw_rate_radps(time_s)
        c, s = float(np.cos(yaw)), float(np.sin(yaw))
        return NavState(
            seq,
            stamp_ns,
            position_m=(pose.north_m, pose.east_m, 0.0),
            attitude_rad=(0.0, 0.0, yaw),
            attitude_rate_radps=(0.0, 0.0, rate),
            velocity_mps=(float(c * north + s * east), float(c * east - s * north), 0.0),
            altitude_m=self.altitude_m,
        )

    def _truth(self, seq: int, stamp_ns: int, stage: SeabedStage, time_s: float) -> Truth:
        state = stage.states(time_s)
        if self.backward:
            state[:, 2:] *= -1.0
        seen = np.flatnonzero(stage.sonar.sees(state[:, :2]))
        things = [stage.things[i] for i in seen]
        ids = np.array([thing.target_id for thing in things], np.int64)
        return Truth(seq, stamp_ns, ids, state[seen], tuple(thing.class_name for thing in things))

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, *stream))

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(f"{name} is {getattr(self, name)!r}; it must be {what}")


@hookimpl
def fls_node() -> type[SeabedScene]:
    """The simulated sonar over the sea floor."""
    return SeabedScene
