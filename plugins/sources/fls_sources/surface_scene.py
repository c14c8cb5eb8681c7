"""Simulate a forward-looking sonar at the sea surface: buoys, boats and their wakes, self-noise, a pier."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from math import isfinite
from typing import NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import NavState, Ping, Truth, hookimpl
from fls_flow.messages import Frame
from fls_sources.scene_clutter import Law, NumberFormat, background
from fls_sources.scene_image import Sonar, Stage
from fls_sources.scene_motion import OwnShip, even_stamps, uneven_stamps
from fls_sources.scene_objects import SceneObject, scatterers
from fls_sources.scene_scenarios import Sector, SequenceName, random_things, scenario
from fls_sources.scene_wake import bubbles

__all__ = ["PingAndTruth", "SurfaceScene"]

SCENE_STREAM, PING_STREAM, CLOCK_STREAM = 0, 1, 2  # what the seed's random streams are for
_CHOICES = {"sequence": SequenceName, "clutter": Law, "dtype": NumberFormat, "truth_frame": Frame}


class PingAndTruth(NamedTuple):
    """What a simulated sonar gives: the image, and what is in it."""

    ping: Ping
    truth: Truth


@dataclass
class SurfaceScene:
    """Pings of a simulated sea-surface sonar and the truth in them, the same for the same parameters.

    The image is amplitude: |clutter + echo| times a gain over range. Modelled: speckle that is independent
    from cell to cell (`clutter`: Rayleigh, K, or the 8-bit amplitudes measured on a real sonar with a spike
    at zero, a heavy tail, a gain per beam and pings at uneven intervals); a beam pattern with side lobes;
    extended things of many scatterers, partly coherent from ping to ping, brighter on their near side;
    wakes of world-fixed bubbles that widen and fade; the broad-band noise of a propeller, which rises with
    range by the TVG; an own ship that makes way and yaws. Not modelled: depth (all lies in the sensor's
    plane), refraction, multipath, shadows, waves, roll and pitch, motion during a ping, Doppler, speckle
    that is correlated between cells, beams or pings, and the sonar's own ringing at the first metres.

    Signal-to-noise ratios hold against the local clutter, at every range. `Truth` is in `truth_frame`: that
    of the moving, yawing sensor, where velocities are apparent, the derivative of the position; or `ned`,
    beside tracks in the world. It holds what lies inside the sector at the ping; a boat's position is where
    its wake ends. Ping `k` depends on the parameters and `k` alone, the number of pings only in `random`.
    None means: what the sequence says.

    Source of the sequences: Karoui, Quidu & Legris 2015, Sec. II and V. Raises ValueError for bad parameters.
    """

    sequence: SequenceName = "inflatable-and-buoy"
    pings: int | None = None
    n_ranges: int | None = None
    n_beams: int = 39
    cell_m: float = 0.05
    range_min_m: float = 0.0
    beam_spacing_deg: float = 1.5
    beamwidth_deg: float = 1.5  # -3 dB
    side_lobe_db: float = -28.0
    ping_rate_hz: float = 2.0
    frequency_hz: float = 240e3
    sound_speed_mps: float = 1500.0
    clutter: Law = "rayleigh"
    k_shape: float = 2.0  # of the K law: small is spiky
    dtype: NumberFormat | None = None  # None: uint8 for measured clutter, else float32
    uneven_pings: bool | None = None  # None: with measured clutter
    snr_offset_db: float = 0.0  # added to the echoes of all things, wakes and noise
    speed_mps: float | None = None  # of the own ship
    yaw_deg: float | None = None  # amplitude
    yaw_period_s: float | None = None
    nav: bool = True  # whether pings carry the own ship's state
    truth_frame: Frame = "sensor"
    n_objects: int = 4  # of `random`
    n_boats: int = 1  # of `random`
    seed: int = 0
    start_ns: int = 1_371_024_000_000_000_000  # 2013-06-12 08:00 UTC

    def __post_init__(self) -> None:
        for spec in fields(self):
            value = getattr(self, spec.name)
            self._require(spec.name, not isinstance(value, float) or isfinite(value), "finite")
        for name in ("cell_m", "beam_spacing_deg", "beamwidth_deg", "ping_rate_hz", "yaw_period_s"):
            self._require(name, getattr(self, name) is None or getattr(self, name) > 0.0, "positive")
        for name in ("frequency_hz", "sound_speed_mps", "k_shape"):
            self._require(name, getattr(self, name) > 0.0, "positive")
        for name in ("range_min_m", "n_objects", "n_boats", "seed", "start_ns"):
            self._require(name, getattr(self, name) >= 0, "0 or more")
        for name in ("pings", "n_ranges", "n_beams"):
            self._require(name, getattr(self, name) is None or getattr(self, name) >= 1, "1 or more")
        self._require("side_lobe_db", self.side_lobe_db < 0.0, "negative")
        for name, known in _CHOICES.items():
            value, open_ = getattr(self, name), name == "dtype"
            known_value = value in get_args(known) or (open_ and value is None)
            self._require(name, known_value, f"one of {get_args(known)}")
        sector_deg = self.n_beams * self.beam_spacing_deg
        if sector_deg > 180.0:
            raise ValueError(
                f"n_beams times beam_spacing_deg is {sector_deg}; a sector has at most 180 degrees"
            )

    def __len__(self) -> int:
        return scenario(self.sequence).pings if self.pings is None else self.pings

    def __call__(self) -> Iterator[PingAndTruth]:
        """Every ping of the sequence with its truth, from the first, each time it is called."""
        stage, stamps = self._stage(), self._stamps()
        range_m, bearing_rad = stage.sonar.range_m, stage.sonar.beams_rad
        for seq, stamp_ns in enumerate(stamps.tolist()):
            time_s = (stamp_ns - self.start_ns) * 1e-9
            ping = Ping(
                seq,
                stamp_ns,
                stage.image(time_s, self._rng(PING_STREAM, seq)),
                range_m,
                bearing_rad,
                beamwidth_rad=stage.sonar.beamwidth_rad,
                sound_speed_mps=self.sound_speed_mps,
                frequency_hz=self.frequency_hz,
                nav=_nav(seq, stamp_ns, stage.own, time_s) if self.nav else None,
            )
            yield PingAndTruth(ping, _truth(seq, stamp_ns, stage, time_s, self.truth_frame))

    def _stage(self) -> Stage:
        plan, rng = scenario(self.sequence), self._rng(SCENE_STREAM)
        sonar = self._sonar(plan.n_ranges if self.n_ranges is None else self.n_ranges)
        things = plan.things
        if self.sequence == "random":
            sector = Sector(sonar.range_min_m, sonar.range_max_m, sonar.half_width_rad)
            things = random_things(sector, self.n_objects, self.n_boats, len(self) / self.ping_rate_hz, rng)
        things = tuple(_louder(thing, self.snr_offset_db) for thing in things)
        number_format = self._number_format
        shape = (sonar.n_ranges, self.n_beams)
        return Stage(
            sonar,
            self._own_ship(plan.own, rng),
            things,
            scatterers(things, self.cell_m, rng),
            tuple((thing, bubbles(thing.wake, rng)) for thing in things if thing.wake is not None),
            background(self.clutter, self.k_shape, number_format, shape, rng),
            number_format,
        )

    def _sonar(self, n_ranges: int) -> Sonar:
        spacing = np.deg2rad(self.beam_spacing_deg)
        beams = (np.arange(self.n_beams) - (self.n_beams - 1) / 2.0) * spacing
        width = np.deg2rad(self.beamwidth_deg)
        return Sonar(self.range_min_m, self.cell_m, n_ranges, beams, spacing, width, self.side_lobe_db)

    @property
    def _number_format(self) -> NumberFormat:
        if self.dtype is not None:
            return self.dtype
        return "uint8" if self.clutter == "measured" else "float32"

    def _own_ship(self, planned: OwnShip, rng: np.random.Generator) -> OwnShip:
        return OwnShip(
            planned.speed_mps if self.speed_mps is None else self.speed_mps,
            planned.yaw_rad if self.yaw_deg is None else np.deg2rad(self.yaw_deg),
            planned.yaw_period_s if self.yaw_period_s is None else self.yaw_period_s,
            float(rng.uniform(0.0, 2.0 * np.pi)),
        )

    def _stamps(self) -> npt.NDArray[np.int64]:
        uneven = self.clutter == "measured" if self.uneven_pings is None else self.uneven_pings
        if uneven:
            return uneven_stamps(self.start_ns, len(self), self.ping_rate_hz, self._rng(CLOCK_STREAM))
        return even_stamps(self.start_ns, len(self), self.ping_rate_hz)

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, *stream))

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(f"{name} is {getattr(self, name)!r}; it must be {what}")


def _louder(thing: SceneObject, offset_db: float) -> SceneObject:
    wake, noise_db = thing.wake, thing.noise_db
    return replace(
        thing,
        snr_db=thing.snr_db + offset_db,
        wake=None if wake is None else replace(wake, snr_db=wake.snr_db + offset_db),
        noise_db=None if noise_db is None else noise_db + offset_db,
    )


def _nav(seq: int, stamp_ns: int, own: OwnShip, time_s: float) -> NavState:
    pose = own.pose(time_s)
    yaw, rate = pose.heading_rad, own.yaw_rate_radps(time_s)
    ahead, starboard = own.speed_mps * float(np.cos(yaw)), -own.speed_mps * float(np.sin(yaw))
    return NavState(
        seq,
        stamp_ns,
        position_m=(pose.north_m, pose.east_m, 0.0),
        attitude_rad=(0.0, 0.0, yaw),
        attitude_rate_radps=(0.0, 0.0, rate),
        velocity_mps=(ahead, starboard, 0.0),
    )


def _truth(seq: int, stamp_ns: int, stage: Stage, time_s: float, frame: Frame) -> Truth:
    state = stage.states(time_s)
    seen = np.flatnonzero(stage.sonar.sees(state[:, :2]))
    if frame == "ned":
        state = stage.ned_states(time_s)
    things = [stage.things[i] for i in seen]
    ids = np.array([thing.target_id for thing in things], np.int64)
    return Truth(seq, stamp_ns, ids, state[seen], tuple(thing.class_name for thing in things), frame)


@hookimpl
def fls_node() -> type[SurfaceScene]:
    """The simulated sea-surface sonar."""
    return SurfaceScene
