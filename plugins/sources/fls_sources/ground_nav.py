"""The navigation of the simulated AUV as a stream of its own: DVL, attitude sensor, altimeter, position."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from math import cos, floor, isfinite, radians, sin, sqrt, tan
from typing import NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import AltimeterBeams, NavState, hookimpl
from fls_flow.messages import UNKNOWN, Vector
from fls_sources.ground_scenarios import Floor, GroundSequence, ground_scenario
from fls_sources.ground_vehicle import Instant

__all__ = ["GroundNav", "NavAndBeams"]

FloatArray = npt.NDArray[np.float64]

NAV_STREAM, BIAS_STREAM = 10, 11  # what the seed's random streams are for


class NavAndBeams(NamedTuple):
    """What the vehicle's instruments say at one instant."""

    nav_state: NavState
    beams: AltimeterBeams  # of the DVL


@dataclass
class GroundNav:
    """Navigation samples of the vehicle of `ground-scene`, for the same sequence, altitude, slopes and start.

    Errors are normal, independent from sample to sample, and a constant bias of velocity and heading, drawn
    once. `dvl_loss` is the chance that a sample lacks velocity and altitude; between `silent_from_s` and
    `silent_to_s` no sample comes at all. `position: false` leaves the position out, as with a DVL and an MRU
    alone. `beams` are the slant ranges of a Janus DVL, four beams tilted by `dvl_tilt_deg` from below; nan
    where the DVL is lost. With `ahead_depression_deg` the stream is that of an altimeter that looks so far
    below the bow: only `altitude_m`, its slant range to the floor, and no beams.

    Raises ValueError for bad parameters.
    """

    sequence: GroundSequence = "two-targets"
    rate_hz: float = 20.0
    duration_s: float = 60.0
    altitude_m: float | None = None
    slope_north_deg: float = 0.0
    slope_east_deg: float = 0.0
    velocity_sd_mps: float = 0.01
    attitude_sd_deg: float = 0.05
    rate_sd_dps: float = 0.05
    altitude_sd_m: float = 0.02
    beam_sd_m: float = 0.05
    dvl_tilt_deg: float = 30.0
    position: bool = True
    position_sd_m: float = 0.0
    velocity_bias_sd_mps: float = 0.0
    heading_bias_sd_deg: float = 0.0
    dvl_loss: float = 0.0
    silent_from_s: float = 0.0
    silent_to_s: float = 0.0
    ahead_depression_deg: float | None = None
    seed: int = 0
    start_ns: int = 1_145_000_000_000_000_000

    def __post_init__(self) -> None:
        unsigned = ("_sd_mps", "_sd_deg", "_sd_dps", "_sd_m", "_s", "seed", "_ns")
        for spec in fields(self):
            value = getattr(self, spec.name)
            self._require(spec.name, not isinstance(value, float) or isfinite(value), "finite")
            self._require(spec.name, not spec.name.endswith(unsigned) or value >= 0, "0 or more")
        names = get_args(GroundSequence)
        self._require("sequence", self.sequence in names, f"one of {names}")
        self._require("rate_hz", 0.0 < self.rate_hz <= 1000.0, "above 0 and at most 1000")
        self._require("altitude_m", self.altitude_m is None or self.altitude_m > 0.0, "positive")
        self._require("dvl_loss", 0.0 <= self.dvl_loss <= 1.0, "between 0 and 1")
        ahead = self.ahead_depression_deg
        self._require("ahead_depression_deg", ahead is None or 0.0 < ahead < 90.0, "between 0 and 90")
        self._require("dvl_tilt_deg", 0.0 < self.dvl_tilt_deg <= 60.0, "above 0 and at most 60")
        for name in ("slope_north_deg", "slope_east_deg"):
            self._require(name, abs(getattr(self, name)) <= 30.0, "at most 30 either way")

    def __call__(self) -> Iterator[NavAndBeams]:
        """Every sample, from the first, each time it is called."""
        vehicle, ground, biases = ground_scenario(self.sequence).vehicle, self._floor(), self._biases()
        for seq in range(floor(self.duration_s * self.rate_hz) + 1):
            time_s = seq / self.rate_hz
            rng = np.random.default_rng((self.seed, NAV_STREAM, seq))
            if self.silent_from_s <= time_s < self.silent_to_s:
                continue
            stamp_ns = self.start_ns + round(time_s * 1e9)
            yield self._sample(seq, stamp_ns, vehicle.at(time_s), ground, biases, rng)

    def _sample(
        self,
        seq: int,
        stamp_ns: int,
        vehicle: Instant,
        ground: Floor,
        biases: FloatArray,
        rng: np.random.Generator,
    ) -> NavAndBeams:
        north, east, down = vehicle.position_m
        error = rng.standard_normal(13)
        lost = bool(rng.random() < self.dvl_loss)
        if self.ahead_depression_deg is not None:
            down = radians(self.ahead_depression_deg)
            slant = float(_slants_m(vehicle, ground, np.array([[cos(down), 0.0, sin(down)]]))[0])
            ahead = NavState(seq, stamp_ns, altitude_m=slant + self.altitude_sd_m * float(error[12]))
            return NavAndBeams(ahead, AltimeterBeams(seq, stamp_ns))
        true = vehicle.nav(seq, stamp_ns, float(ground.depth_at(north, east)) - float(down))
        heading_bias = np.array([0.0, 0.0, biases[3]])
        state = NavState(
            seq,
            stamp_ns,
            _off(true.position_m, self.position_sd_m * error[0:3]) if self.position else UNKNOWN,
            _off(true.attitude_rad, radians(self.attitude_sd_deg) * error[3:6] + heading_bias),
            _off(true.attitude_rate_radps, radians(self.rate_sd_dps) * error[6:9]),
            UNKNOWN if lost else _off(true.velocity_mps, self.velocity_sd_mps * error[9:12] + biases[:3]),
            float("nan") if lost else true.altitude_m + self.altitude_sd_m * float(error[12]),
        )
        directions = _janus(radians(self.dvl_tilt_deg))
        slants = _slants_m(vehicle, ground, directions) + self.beam_sd_m * rng.standard_normal(4)
        return NavAndBeams(
            state, AltimeterBeams(seq, stamp_ns, directions, np.full(4, np.nan) if lost else slants)
        )

    def _floor(self) -> Floor:
        depth = ground_scenario(self.sequence).altitude_m if self.altitude_m is None else self.altitude_m
        return Floor(depth, (tan(radians(self.slope_north_deg)), tan(radians(self.slope_east_deg))))

    def _biases(self) -> FloatArray:
        """Of velocity (3) and heading, for the whole run."""
        draw = np.random.default_rng((self.seed, BIAS_STREAM)).standard_normal(4)
        scale = [self.velocity_bias_sd_mps] * 3 + [radians(self.heading_bias_sd_deg)]
        biases: FloatArray = draw * np.array(scale)
        return biases

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(f"{name} is {getattr(self, name)!r}; it must be {what}")


def _slants_m(vehicle: Instant, ground: Floor, direction: FloatArray) -> FloatArray:
    """Slant ranges (n,) to the floor along body directions (n, 3); nan where one never meets it."""
    north, east, down = vehicle.position_m
    height = (float(ground.depth_at(north, east)) - float(down)) * float(ground.normal[2])
    towards = direction @ vehicle.R.T @ ground.normal
    return np.where(towards > 0.0, height / np.where(towards > 0.0, towards, 1.0), np.nan)


def _janus(tilt_rad: float) -> FloatArray:
    """Body directions (4, 3): fore starboard, aft starboard, aft port, fore port, tilted from z."""
    side = sin(tilt_rad) / sqrt(2.0)
    plan = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) * side
    return np.column_stack([plan, np.full(4, cos(tilt_rad))])


def _off(true: Vector, error: FloatArray) -> Vector:
    a, b, c = np.array(true) + error
    return float(a), float(b), float(c)


@hookimpl
def fls_node() -> type[GroundNav]:
    """The simulated navigation."""
    return GroundNav
