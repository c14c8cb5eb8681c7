"""Simulate a forward-looking sonar over the sea floor: speckle, objects with shadows, a wreck."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from math import isfinite, radians, tan
from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Mount, Ping, Truth, hookimpl
from fls_sources.ground_image import FloorImage, Sight, parts_of
from fls_sources.ground_scenarios import Floor, GroundObject, GroundSequence, ground_scenario
from fls_sources.scene_clutter import AmplitudeArray, NumberFormat
from fls_sources.scene_image import Sonar
from fls_sources.scene_motion import even_stamps

__all__ = ["GroundScene", "GroundView"]

FloatArray = npt.NDArray[np.float64]
Mode = Literal["image", "points"]

SCENE_STREAM, PING_STREAM, POINT_STREAM = 0, 1, 2  # what the seed's random streams are for
STEP_S = 1e-3  # of the difference that gives apparent velocities


class GroundView(NamedTuple):
    """What a simulated sonar over the floor gives."""

    ping: Ping
    detections: Detections  # of the true targets, with noise
    truth: Truth  # sensor frame
    truth_ned: Truth


@dataclass
class GroundScene:
    """Pings of a simulated sonar over the sea floor and the truth in them, the same for the same parameters.

    `mode: points` leaves the image empty: what counts then are `detections`, one per target in sight with the
    probability `p_d`, its true range and cone angle with normal errors of `range_sd_m` and `bearing_sd_deg`,
    and `false_per_ping` false ones (Poisson, even over range and bearing). `mode: image` gives both.

    The image is amplitude: |floor + echo|. Modelled: the vehicle's place and attitude with all of roll, pitch
    and yaw; a plane floor, level or sloping; the vertical beam, tilted by `depression_deg`; Rayleigh speckle,
    new in each ping; boxes of partly coherent scatterers, which hide what is behind them on the floor and in
    themselves; beams as the cones of a horizontal array. Not modelled: a rough or patchy floor, the fall of
    the floor's echo with range and grazing angle (a perfect TVG), multipath, refraction, motion in a ping,
    shadows that bend over beams at short range.

    `Truth` holds targets in range, sector and vertical beam: the foot of each thing's middle; its velocities
    in the sensor frame are apparent. `nav`: whether pings carry the true state; else it comes as a stream,
    from `ground-nav` with the same `sequence`, `altitude_m`, slopes and `start_ns`. None means: what the
    sequence says.

    Source of sonar and sequences: Quidu, Bertholom & Dupas 2010, section 6; places and speeds are ours.
    Raises ValueError for bad parameters.
    """

    sequence: GroundSequence = "two-targets"
    mode: Mode = "image"
    pings: int | None = None
    n_ranges: int = 1000
    n_beams: int = 40
    cell_m: float = 0.05
    range_min_m: float = 0.0
    beam_spacing_deg: float = 1.5
    beamwidth_deg: float = 1.5  # -3 dB
    vertical_beamwidth_deg: float = 15.0
    depression_deg: float = 15.0  # of the sonar's axis below the vehicle's
    sonar_x_m: float = 0.0  # its place ahead of the vehicle's origin
    side_lobe_db: float = -28.0
    ping_rate_hz: float = 5.0
    frequency_hz: float = 240e3
    sound_speed_mps: float = 1500.0
    dtype: NumberFormat = "float32"
    altitude_m: float | None = None  # at the start
    slope_north_deg: float = 0.0  # deeper to the north where positive
    slope_east_deg: float = 0.0
    snr_offset_db: float = 0.0
    range_sd_m: float = 1.0
    bearing_sd_deg: float = 1.5
    p_d: float = 1.0
    false_per_ping: float = 0.0
    nav: bool = False
    seed: int = 0
    start_ns: int = 1_145_000_000_000_000_000  # 2006-04-14 07:33:20 UTC

    def __post_init__(self) -> None:
        for spec in fields(self):
            value = getattr(self, spec.name)
            self._require(spec.name, not isinstance(value, float) or isfinite(value), "finite")
        positive = ("cell_m", "beam_spacing_deg", "beamwidth_deg", "vertical_beamwidth_deg", "ping_rate_hz")
        for name in (*positive, "frequency_hz", "sound_speed_mps"):
            self._require(name, getattr(self, name) > 0.0, "positive")
        for name in ("range_min_m", "range_sd_m", "bearing_sd_deg", "false_per_ping", "seed", "start_ns"):
            self._require(name, getattr(self, name) >= 0, "0 or more")
        for name in ("pings", "n_ranges", "n_beams"):
            self._require(name, getattr(self, name) is None or getattr(self, name) >= 1, "1 or more")
        self._require("altitude_m", self.altitude_m is None or self.altitude_m > 0.0, "positive")
        self._require("p_d", 0.0 <= self.p_d <= 1.0, "between 0 and 1")
        self._require("side_lobe_db", self.side_lobe_db < 0.0, "negative")
        self._require("depression_deg", abs(self.depression_deg) < 90.0, "less than 90 either way")
        for name in ("slope_north_deg", "slope_east_deg"):
            self._require(name, abs(getattr(self, name)) <= 30.0, "at most 30 either way")
        for name, known in (("sequence", GroundSequence), ("mode", Mode), ("dtype", NumberFormat)):
            self._require(name, getattr(self, name) in get_args(known), f"one of {get_args(known)}")
        sector_deg = self.n_beams * self.beam_spacing_deg
        if sector_deg > 120.0:
            raise ValueError(
                f"n_beams times beam_spacing_deg is {sector_deg}; a sector has at most 120 degrees"
            )

    def __len__(self) -> int:
        return ground_scenario(self.sequence).pings if self.pings is None else self.pings

    def __call__(self) -> Iterator[GroundView]:
        """Every ping with its truth, from the first, each time it is called."""
        maker, stamps = self._maker(), even_stamps(self.start_ns, len(self), self.ping_rate_hz)
        for seq, stamp_ns in enumerate(stamps.tolist()):
            yield self._view(seq, stamp_ns, maker)

    @property
    def floor(self) -> Floor:
        """The plane of the floor."""
        depth = ground_scenario(self.sequence).altitude_m if self.altitude_m is None else self.altitude_m
        return Floor(depth, (tan(radians(self.slope_north_deg)), tan(radians(self.slope_east_deg))))

    @property
    def mount(self) -> Mount:
        """The sonar on the vehicle."""
        return Mount((self.sonar_x_m, 0.0, 0.0), (0.0, -radians(self.depression_deg), 0.0))

    def sight(self, time_s: float) -> Sight:
        """Where the sonar is and looks to."""
        vehicle = ground_scenario(self.sequence).vehicle
        return Sight.of(vehicle.at(time_s), self.mount, self.floor)

    def _view(self, seq: int, stamp_ns: int, maker: FloorImage) -> GroundView:
        time_s = (stamp_ns - self.start_ns) * 1e-9
        sight, sonar = self.sight(time_s), maker.sonar
        vehicle = ground_scenario(self.sequence).vehicle.at(time_s)
        altitude = float(self.floor.depth_at(*vehicle.position_m[:2])) - float(vehicle.position_m[2])
        ping = Ping(
            seq,
            stamp_ns,
            self._image(seq, sight, maker),
            sonar.range_m,
            sonar.beams_rad,
            beamwidth_rad=sonar.beamwidth_rad,
            sound_speed_mps=self.sound_speed_mps,
            frequency_hz=self.frequency_hz,
            mount=self.mount,
            nav=vehicle.nav(seq, stamp_ns, altitude) if self.nav else None,
        )
        feet = _feet(maker.things, self.floor)
        d, bearing, seen = self._seen(feet, sight, sonar)
        things = [maker.things[i] for i in np.flatnonzero(seen)]
        ids = np.array([thing.target_id for thing in things], np.int64)
        names = tuple(thing.class_name for thing in things)
        still = np.concatenate([feet[seen, :2], np.zeros((len(things), 2))], axis=1)
        return GroundView(
            ping,
            self._detections(ping, d[seen], bearing[seen]),
            Truth(seq, stamp_ns, ids, self._apparent(feet[seen], time_s), names),
            Truth(seq, stamp_ns, ids, still, names, "ned"),
        )

    def _maker(self) -> FloorImage:
        things = tuple(
            replace(thing, snr_db=thing.snr_db + self.snr_offset_db)
            for thing in ground_scenario(self.sequence).things
        )
        spacing, width = radians(self.beam_spacing_deg), radians(self.beamwidth_deg)
        beams = (np.arange(self.n_beams, dtype=float) - (self.n_beams - 1) / 2.0) * spacing
        sonar = Sonar(self.range_min_m, self.cell_m, self.n_ranges, beams, spacing, width, self.side_lobe_db)
        parts = parts_of(things, self.floor, self._rng(SCENE_STREAM))
        return FloorImage(sonar, radians(self.vertical_beamwidth_deg), things, parts, self.dtype)

    def _image(self, seq: int, sight: Sight, maker: FloorImage) -> AmplitudeArray:
        if self.mode == "points":
            return np.zeros((self.n_ranges, self.n_beams), np.uint8)
        return maker.image(sight, self._rng(PING_STREAM, seq))

    def _seen(
        self, feet: FloatArray, sight: Sight, sonar: Sonar
    ) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
        """Range and cone angle of feet (n, 3), and which lie in range, sector and vertical beam (-6 dB)."""
        d, bearing, below = sight.polar(feet)
        inside = (d >= sonar.range_min_m) & (d < sonar.range_max_m)
        inside &= np.abs(bearing) <= sonar.half_width_rad
        inside &= np.abs(below) <= 0.71 * radians(self.vertical_beamwidth_deg)
        return d, bearing, inside

    def _detections(self, ping: Ping, d: FloatArray, bearing: FloatArray) -> Detections:
        rng = self._rng(POINT_STREAM, ping.seq)
        sd = radians(self.bearing_sd_deg)
        found = rng.random(d.size) < self.p_d
        n = int(rng.poisson(self.false_per_ping))
        range_m = d + self.range_sd_m * rng.standard_normal(d.size)
        angle = bearing + sd * rng.standard_normal(d.size)
        false_m = rng.uniform(ping.range_m[0], ping.range_m[-1], n)
        false_rad = rng.uniform(ping.bearing_rad[0], ping.bearing_rad[-1], n)
        range_m = np.concatenate([np.maximum(range_m[found], ping.cell_m), false_m])
        noise = np.diag([max(self.range_sd_m, 1e-6) ** 2, max(sd, 1e-9) ** 2])
        return Detections.of(
            ping,
            range_m=range_m,
            bearing_rad=np.concatenate([angle[found], false_rad]),
            amplitude=np.ones(range_m.size),
            covariance=np.broadcast_to(noise, (range_m.size, 2, 2)),
        )

    def _apparent(self, feet: FloatArray, time_s: float) -> FloatArray:
        """States (n, 4) in the sensor frame; velocities by central differences."""
        before, now, after = (_flat(self.sight(time_s + dt), feet) for dt in (-STEP_S, 0.0, STEP_S))
        return np.concatenate([now, (after - before) / (2.0 * STEP_S)], axis=1)

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, *stream))

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(f"{name} is {getattr(self, name)!r}; it must be {what}")


def _feet(things: tuple[GroundObject, ...], floor: Floor) -> FloatArray:
    """NED positions (n, 3) of the feet of things."""
    plan = np.array([(thing.north_m, thing.east_m) for thing in things]).reshape(-1, 2)
    above = np.array([thing.above_m for thing in things])
    return np.column_stack([plan, floor.depth_at(plan[:, 0], plan[:, 1]) - above])


def _flat(sight: Sight, position_m: FloatArray) -> FloatArray:
    d, bearing, _ = sight.polar(position_m)
    return np.stack([d * np.cos(bearing), d * np.sin(bearing)], axis=-1)


@hookimpl
def fls_node() -> type[GroundScene]:
    """The simulated sonar over the sea floor."""
    return GroundScene
