"""Who swims where around an active array: targets that are given or drawn, the array's own drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import Pose, cv_transition, turn

__all__ = ["Drift", "Swimmers", "apparent_states", "drawn_starts", "trajectories"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Drift:
    """A platform that drifts straight and swings about its heading, north, as a sine."""

    velocity_mps: tuple[float, float] = (0.0, 0.0)  # north, east
    yaw_rad: float = 0.0  # amplitude
    yaw_period_s: float = 60.0

    def pose(self, time_s: float) -> Pose:
        """Where the sensor is."""
        north, east = self.velocity_mps
        return Pose(north * time_s, east * time_s, self.yaw_rad * float(np.sin(self._rate * time_s)))

    def yaw_rate_radps(self, time_s: float) -> float:
        """The heading's derivative."""
        return self.yaw_rad * self._rate * float(np.cos(self._rate * time_s))

    @property
    def _rate(self) -> float:
        return 2.0 * np.pi / self.yaw_period_s


@dataclass(frozen=True, slots=True)
class Swimmers:
    """From what targets are drawn: uniform in range, bearing, speed and course."""

    count: int
    range_m: tuple[float, float]
    speed_mps: tuple[float, float]


def drawn_starts(swimmers: Swimmers, rng: np.random.Generator) -> FloatArray:
    """States (count, 4) at the first ping; the first of two draws are those of one draw."""
    draws = rng.random((swimmers.count, 4))
    r = swimmers.range_m[0] + draws[:, 0] * np.ptp(swimmers.range_m)
    v = swimmers.speed_mps[0] + draws[:, 1] * np.ptp(swimmers.speed_mps)
    bearing, course = 2.0 * np.pi * draws[:, 2], 2.0 * np.pi * draws[:, 3]
    along = np.stack([r * np.cos(bearing), r * np.sin(bearing)], axis=1)
    return np.concatenate([along, np.stack([v * np.cos(course), v * np.sin(course)], axis=1)], axis=1)


def trajectories(
    start: FloatArray, pings: int, interval_s: float, acceleration_sd_mps2: float, rng: np.random.Generator
) -> FloatArray:
    """States (pings, n, 4), NED: nearly constant velocity with white acceleration between pings."""
    F = cv_transition(interval_s)
    states = np.empty((pings, *start.shape))
    states[0] = start
    for ping in range(1, pings):
        kick = acceleration_sd_mps2 * rng.standard_normal((len(start), 2))
        states[ping] = states[ping - 1] @ F.T
        states[ping, :, :2] += 0.5 * interval_s**2 * kick
        states[ping, :, 2:] += interval_s * kick
    return states


def apparent_states(state: FloatArray, drift: Drift, time_s: float) -> FloatArray:
    """NED states (n, 4) as the moving, turning sensor sees them: its velocities are those of its frame."""
    pose, rate = drift.pose(time_s), drift.yaw_rate_radps(time_s)
    position = pose.to_sensor(state[:, :2])
    velocity = (state[:, 2:] - np.array(drift.velocity_mps)) @ turn(pose.heading_rad)
    velocity = velocity + rate * np.stack([position[:, 1], -position[:, 0]], axis=1)
    return np.concatenate([position, velocity], axis=1)
