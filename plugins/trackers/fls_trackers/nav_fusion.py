"""Join navigation to pings by time."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from fls_flow import AltimeterBeams, Detections, NavState, Ping, hookimpl
from fls_flow.messages import Vector
from fls_trackers.ground_floor import FloorPlane, beam_points, plane_through, plane_to
from fls_trackers.ground_slope import Slopes, slope_of
from fls_trackers.nav_samples import (
    ALTITUDE,
    ATTITUDE,
    COLUMNS,
    POSITION,
    VELOCITY,
    interpolated,
    reckoned,
    row,
    state,
    velocity_ned,
)

__all__ = ["Fused", "NavFusion"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
T = TypeVar("T")
log = logging.getLogger(__name__)

KEPT = 2.0  # how many times max_age_s samples are kept


class Fused(NamedTuple):
    """Ping and detections with the navigation of their stamp, and the floor as far as altitudes tell it."""

    ping: Ping
    detections: Detections
    floor: FloorPlane


@dataclass
class NavFusion:
    """Pings (and detections, empty if unwired) that carry the vehicle's state at their own stamp.

    Navigation samples of any rate are interpolated, each quantity for itself; one that nobody has given
    within `max_age_s` is nan, and the log says when that begins and ends: who tracks then does not move
    tracks by a motion that is not so. Without samples the ping keeps the state it brought.
    `dead_reckon`: the position is the integral of velocity and attitude from the first sample (a DVL and an
    MRU are enough); else it is the one in the samples, carried on by the velocity where it is late.
    `ahead`: a second altimeter, its `altitude_m` the slant range along a beam `ahead_depression_deg` below
    the bow; with it the floor slopes along the line of the two. `beams`: those of a DVL, at least three; with
    them the floor has the median slope of the last `floor_memory_s`, and `ahead` is not needed. With neither,
    or as long as they find no bottom, it is level.

    State: the samples of the last pings.
    """

    max_age_s: float = 0.5
    dead_reckon: bool = False
    ahead_depression_deg: float = 30.0
    floor_memory_s: float = 2.0
    _samples: _Samples = field(init=False, repr=False)
    _ahead: _Samples = field(init=False, repr=False)
    _slopes: Slopes = field(init=False, repr=False)
    _missing: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("max_age_s", "floor_memory_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive and finite")
        if not 0.0 < self.ahead_depression_deg < 90.0:
            raise ValueError(
                f"ahead_depression_deg is {self.ahead_depression_deg}; it must lie between 0 and 90"
            )
        self._samples, self._ahead = _Samples(self.dead_reckon), _Samples()
        self._slopes = Slopes(self.floor_memory_s)

    def __call__(
        self,
        ping: Ping,
        nav: tuple[NavState, ...] = (),
        ahead: tuple[NavState, ...] = (),
        detections: Detections | None = None,
        beams: tuple[AltimeterBeams, ...] = (),
    ) -> Fused:
        """The ping and its detections with the navigation at the ping's stamp."""
        self._samples.add(nav)
        self._ahead.add(ahead)
        for one in beams:
            attitude = self._samples.attitude_at(one.stamp_ns, self.max_age_s)
            self._slopes.add(one.stamp_ns, slope_of(one, attitude))
        values = self._samples.at(ping.stamp_ns, self.max_age_s)
        sloped = self._ahead.at(ping.stamp_ns, self.max_age_s)
        brought = ping.nav is not None and not self._samples.any
        fused = ping.nav if brought else state(ping.seq, ping.stamp_ns, values)
        if not brought:
            self._tell(ping, values)
        floor = self._floor(ping, row(fused) if fused is not None else values, float(sloped[ALTITUDE]))
        found = Detections(ping.seq, ping.stamp_ns) if detections is None else _copied(detections)
        found = replace(found, view=replace(found.view, nav=fused))
        return Fused(replace(_copied(ping), nav=fused), found, floor)

    def snapshot(self) -> dict[str, Any]:
        """The samples still needed."""
        return {
            "samples": self._samples.snapshot(),
            "ahead": self._ahead.snapshot(),
            "slopes": self._slopes.snapshot(),
            "missing": self._missing,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._samples.restore(saved["samples"])
        self._ahead.restore(saved["ahead"])
        self._slopes.restore(saved["slopes"])
        self._missing = bool(saved["missing"])

    def _tell(self, ping: Ping, values: FloatArray) -> None:
        needed = {
            "velocity": values[VELOCITY][:2],
            "heading": values[ATTITUDE][2:],
            "altitude": values[ALTITUDE:],
        }
        missing = [name for name, group in needed.items() if not np.isfinite(group).all()]
        if missing and not self._missing:
            log.warning(
                "ping seq %d: no %s within %g s of it; check the navigation link", ping.seq,
                " and ".join(missing), self.max_age_s,
            )  # fmt: skip
        elif self._missing and not missing:
            log.warning("ping seq %d: navigation is back", ping.seq)
        self._missing = bool(missing)

    def _floor(self, ping: Ping, values: FloatArray, ahead_m: float) -> FloorPlane:
        """With the slope of the beams, else through the points below and ahead, else level below."""
        north, east = self._slopes.at(ping.stamp_ns).tolist()
        altitude = values[ALTITUDE]
        if not np.isfinite(altitude):
            return FloorPlane(ping.seq, ping.stamp_ns)
        if math.isfinite(north):
            return FloorPlane(ping.seq, ping.stamp_ns, *plane_to(-north, -east, float(altitude)))
        points = np.array([[0.0, 0.0, altitude]])
        if np.isfinite(ahead_m) and np.isfinite(values[ATTITUDE]).all():
            down = math.radians(self.ahead_depression_deg)
            attitude = (float(values[3]), float(values[4]), float(values[5]))
            beam = beam_points([[math.cos(down), 0.0, math.sin(down)]], [ahead_m], attitude)
            points = np.concatenate([points, beam])
        normal, height = plane_through(points)
        return FloorPlane(ping.seq, ping.stamp_ns, normal, height)


@dataclass
class _Samples:
    """The samples around the newest pings, their position reckoned if asked for."""

    dead_reckon: bool = False
    stamps_ns: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    rows: FloatArray = field(default_factory=lambda: np.zeros((0, COLUMNS)))
    speed: FloatArray = field(default_factory=lambda: np.full(3, np.nan))  # NED, the last known
    last: FloatArray = field(default_factory=lambda: np.full(COLUMNS, np.nan))  # number by number
    any: bool = False  # whether there has ever been one

    def add(self, samples: tuple[NavState, ...]) -> None:
        """Take new samples; stamps increase."""
        if not samples:
            return
        rows = [row(one) for one in samples]
        stamps = [one.stamp_ns for one in samples]
        if self.dead_reckon:
            self._reckon(stamps, rows)
        self.stamps_ns = np.concatenate([self.stamps_ns, np.array(stamps, np.int64)])
        self.rows = np.concatenate([self.rows, np.stack(rows)])
        self.any = True

    def at(self, stamp_ns: int, max_age_s: float) -> FloatArray:
        """The numbers at a ping; samples that no later ping needs are forgotten."""
        values = interpolated(self.stamps_ns, self.rows, stamp_ns, max_age_s)
        late = self.stamps_ns >= stamp_ns - int(KEPT * max_age_s * 1e9)
        late[-1:] = True  # dead reckoning goes on from the last
        self.stamps_ns, self.rows = self.stamps_ns[late], self.rows[late]
        return values

    def attitude_at(self, stamp_ns: int, max_age_s: float) -> Vector:
        """Roll, pitch and yaw at an instant; nan where not known."""
        angles = interpolated(self.stamps_ns, self.rows, stamp_ns, max_age_s)[ATTITUDE]
        return float(angles[0]), float(angles[1]), float(angles[2])

    def snapshot(self) -> dict[str, Any]:
        """Copies."""
        return {
            "stamps_ns": self.stamps_ns.copy(),
            "rows": self.rows.copy(),
            "speed": self.speed.copy(),
            "last": self.last.copy(),
            "any": self.any,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self.stamps_ns = np.array(saved["stamps_ns"], np.int64)
        self.rows = np.array(saved["rows"], float).reshape(-1, COLUMNS)
        self.speed = np.array(saved["speed"], float)
        self.last = np.array(saved["last"], float)
        self.any = bool(saved["any"])

    def _reckon(self, stamps: list[int], rows: list[FloatArray]) -> None:
        """Replace the positions; a velocity or attitude that is missing for a while stays as it was.

        Samples may tell one or the other: a log and a compass need not speak at once.
        """
        last = self.rows[-1] if len(self.rows) else None
        then = int(self.stamps_ns[-1]) if len(self.rows) else 0
        for stamp, now in zip(stamps, rows, strict=True):
            self.last = np.where(np.isfinite(now), now, self.last)
            speed = velocity_ned(self.last)
            speed = speed if np.isfinite(speed).all() else self.speed
            if last is None:
                now[POSITION] = np.nan_to_num(now[POSITION])
            else:
                mean = 0.5 * (self.speed + speed) if np.isfinite(self.speed).all() else speed
                now[POSITION] = reckoned(last[POSITION], (stamp - then) * 1e-9, mean, now)
            last, then, self.speed = now, stamp, speed


def _copied(message: T) -> T:
    """The message with arrays of its own, so that nothing downstream shares memory with the input."""
    changed: dict[str, Any] = {}
    for one in fields(message):  # type: ignore[arg-type]  # messages are dataclasses
        value = getattr(message, one.name)
        if isinstance(value, np.ndarray):
            changed[one.name] = value.copy()
        elif is_dataclass(value):
            changed[one.name] = _copied(value)
    return replace(message, **changed)  # type: ignore[type-var]  # messages are dataclasses


@hookimpl
def fls_node() -> type[NavFusion]:
    """The kind `nav-fusion`."""
    return NavFusion
