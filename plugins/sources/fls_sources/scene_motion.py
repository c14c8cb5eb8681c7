"""Where things are in a simulated scene: paths through timed waypoints, the own ship, the ping instants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import Pose, turn

__all__ = ["OwnShip", "TimedPath", "apparent", "coasting", "even_stamps", "uneven_stamps"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Point = tuple[float, float]

LONGEST_GAP = 8  # ping intervals; the longest that was measured on a real sonar


@dataclass(frozen=True, eq=False)
class TimedPath:
    """A smooth way through waypoints [north, east] (k, 2), m, passed at `time_s` (k,), increasing.

    Cubic Hermite pieces with the tangents (p[k+1] - p[k-1]) / (t[k+1] - t[k-1]): position and velocity are
    continuous; straight on before the first and after the last waypoint. One waypoint: it lies still.
    """

    time_s: FloatArray
    waypoint_m: FloatArray

    @classmethod
    def still(cls, north_m: float, east_m: float) -> TimedPath:
        """The path of a thing that does not move."""
        return cls(np.zeros(1), np.array([[north_m, east_m]]))

    @classmethod
    def straight(cls, start_s: float, start_m: Point, velocity_mps: Point) -> TimedPath:
        """The path of constant velocity that passes `start_m` at `start_s`."""
        first = np.array(start_m)
        return cls(np.array([start_s, start_s + 1.0]), np.stack([first, first + np.array(velocity_mps)]))

    def at(self, time_s: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Positions (..., 2) in m and velocities (..., 2) in m/s at the times (...)."""
        t = np.asarray(time_s, float)
        if self.time_s.size == 1:
            return np.broadcast_to(self.waypoint_m[0], (*t.shape, 2)), np.zeros((*t.shape, 2))
        inside = np.clip(t, self.time_s[0], self.time_s[-1])
        position, velocity = self._between(inside)
        return position + velocity * (t - inside)[..., None], velocity

    def _between(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        T, p = self.time_s, self.waypoint_m
        tangent = np.empty_like(p)
        tangent[1:-1] = (p[2:] - p[:-2]) / (T[2:] - T[:-2])[:, None]
        tangent[0], tangent[-1] = (p[1] - p[0]) / (T[1] - T[0]), (p[-1] - p[-2]) / (T[-1] - T[-2])
        i = np.clip(np.searchsorted(T, t, side="right") - 1, 0, T.size - 2)
        h = (T[i + 1] - T[i])[..., None]
        s = (t[..., None] - T[i][..., None]) / h
        step, m0, m1 = p[i + 1] - p[i], tangent[i] * h, tangent[i + 1] * h
        quadratic, cubic = 3.0 * step - 2.0 * m0 - m1, m0 + m1 - 2.0 * step
        position = p[i] + s * (m0 + s * (quadratic + s * cubic))
        return position, (m0 + s * (2.0 * quadratic + 3.0 * s * cubic)) / h


def coasting(waypoints_m: list[Point], start_s: float, speed_mps: float, decay_s: float) -> TimedPath:
    """The path of a boat that starts with `speed_mps` and coasts: the speed falls as exp(-t / decay).

    Way made good s(t) = speed decay (1 - exp(-t / decay)), measured along the chords. Raises ValueError when
    the boat would stop before the last waypoint.
    """
    p = np.array(waypoints_m)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T))])
    reach = speed_mps * decay_s
    if way[-1] >= reach:
        raise ValueError(f"a boat that coasts {reach:.1f} m cannot make {way[-1]:.1f} m")
    return TimedPath(start_s - decay_s * np.log1p(-way / reach), p)


@dataclass(frozen=True, slots=True)
class OwnShip:
    """A survey boat that makes way to the north and yaws around that course.

    yaw(t) = yaw_rad (0.75 sin(w t + phase) + 0.25 sin(w t / 2.7)), w = 2 pi / yaw_period_s.
    """

    speed_mps: float = 0.0
    yaw_rad: float = 0.0
    yaw_period_s: float = 15.0
    phase_rad: float = 0.0

    def pose(self, time_s: float) -> Pose:
        """The pose of boat and sensor; at time 0 the position is the origin."""
        w = 2.0 * np.pi / self.yaw_period_s
        sway = 0.75 * np.sin(w * time_s + self.phase_rad) + 0.25 * np.sin(w * time_s / 2.7)
        return Pose(self.speed_mps * time_s, 0.0, float(self.yaw_rad * sway))

    def yaw_rate_radps(self, time_s: float) -> float:
        """The time derivative of the heading, rad/s."""
        w = 2.0 * np.pi / self.yaw_period_s
        sway = 0.75 * np.cos(w * time_s + self.phase_rad) + 0.25 / 2.7 * np.cos(w * time_s / 2.7)
        return float(self.yaw_rad * w * sway)


def apparent(own: OwnShip, time_s: float, position_m: FloatArray, velocity_mps: FloatArray) -> FloatArray:
    """States (n, 4) [x, y, vx, vy] in the sensor's own frame of NED positions and velocities (n, 2).

    x = R^T (p - o), dx/dt = R^T (v - v_o) - yaw_rate [-x_2, x_1]: the derivative of the position in the
    sensor's frame.
    """
    pose, rate = own.pose(time_s), own.yaw_rate_radps(time_s)
    xy = pose.to_sensor(position_m)
    relative = (velocity_mps - np.array([own.speed_mps, 0.0])) @ turn(pose.heading_rad)
    swing = rate * np.stack([xy[:, 1], -xy[:, 0]], axis=-1)
    return np.concatenate([xy, relative + swing], axis=1)


def even_stamps(start_ns: int, pings: int, rate_hz: float) -> IntArray:
    """Instants (pings,) of a sonar that keeps time, ns."""
    stamps: IntArray = start_ns + np.rint(np.arange(pings) * (1e9 / rate_hz)).astype(np.int64)
    return stamps


def uneven_stamps(start_ns: int, pings: int, rate_hz: float, rng: np.random.Generator) -> IntArray:
    """Instants (pings,) with 2 % of jitter, and before one ping in thirty a gap of 2 to 8 intervals, ns."""
    interval = 1.0 + np.clip(0.02 * rng.standard_normal(pings), -0.1, 0.1)
    gap = rng.random(pings) < 1.0 / 30.0
    interval += gap * rng.integers(1, LONGEST_GAP, pings)
    elapsed = np.concatenate([[0.0], np.cumsum(interval[1:])])[:pings]
    return start_ns + np.rint(elapsed * (1e9 / rate_hz)).astype(np.int64)
