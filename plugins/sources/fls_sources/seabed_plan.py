"""Who moves how in a simulated sea-floor scene: the vehicle, and the objects that come into its view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import Pose, turn
from fls_sources.scene_image import Sonar
from fls_sources.scene_motion import TimedPath
from fls_sources.scene_objects import SceneObject

__all__ = ["Vehicle", "apparent", "cylinder", "fish", "spheres"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

CANDIDATES_PER_M = 4  # of the way: places among which the plan chooses
APART_M = 3.0  # objects that are nearer may melt into one echo
LASTING_PINGS = 6  # shorter glimpses of an object are avoided where possible


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle on its way north, heading where it goes: east = sway sin(2 pi t / period) + drift t.

    The drift is sideways, without a change of heading.
    """

    speed_mps: float
    sway_m: float
    sway_period_s: float
    drift_mps: float = 0.0

    def pose(self, time_s: float) -> Pose:
        """The pose of vehicle and sonar; at time 0 they are at the origin."""
        w = 2.0 * np.pi / self.sway_period_s
        east = self.sway_m * np.sin(w * time_s) + self.drift_mps * time_s
        heading = np.arctan2(self.sway_m * w * np.cos(w * time_s), self.speed_mps)
        return Pose(self.speed_mps * time_s, float(east), float(heading))

    def velocity_mps(self, time_s: float) -> FloatArray:
        """[north, east]."""
        w = 2.0 * np.pi / self.sway_period_s
        return np.array([self.speed_mps, self.sway_m * w * np.cos(w * time_s) + self.drift_mps])

    def yaw_rate_radps(self, time_s: float) -> float:
        """The time derivative of the heading, rad/s."""
        w = 2.0 * np.pi / self.sway_period_s
        slope = self.sway_m * w * np.cos(w * time_s) / self.speed_mps
        return float(-self.sway_m * w * w * np.sin(w * time_s) / self.speed_mps / (1.0 + slope**2))


def apparent(vehicle: Vehicle, time_s: float, position_m: FloatArray, velocity_mps: FloatArray) -> FloatArray:
    """States (n, 4) [x, y, vx, vy] in the sonar's own frame of positions and velocities (n, 2) in NED.

    x = R^T (p - o), dx/dt = R^T (v - v_o) - yaw_rate [-x_2, x_1].
    """
    pose, rate = vehicle.pose(time_s), vehicle.yaw_rate_radps(time_s)
    xy = pose.to_sensor(position_m)
    relative = (velocity_mps - vehicle.velocity_mps(time_s)) @ turn(pose.heading_rad)
    return np.concatenate([xy, relative + rate * np.stack([xy[:, 1], -xy[:, 0]], axis=-1)], axis=1)


def spheres(
    sonar: Sonar,
    vehicle: Vehicle,
    time_s: FloatArray,
    in_view: tuple[int, int],
    diameter_m: float,
    snr_db: float,
    rng: np.random.Generator,
) -> list[SceneObject]:
    """Spheres on the floor, at any of the times (k,) at least and at most so many in view, where they can be.

    Places are drawn over the floor along the way and taken in that order while they fit: far from others, not
    only glimpsed, never too many in view. Then times with too few are served, glimpses allowed.
    """
    places, seen = _candidates(sonar, vehicle, time_s, rng)
    low, high = in_view
    wanted = np.minimum(high, np.maximum(low, rng.integers(low, high + 1, -(-time_s.size // 10))))
    wanted = np.repeat(wanted, 10)[: time_s.size]  # so that the number in view comes and goes
    chosen: list[int] = []
    count = np.zeros(time_s.size, np.int64)
    for limit, least in ((wanted, LASTING_PINGS), (np.full(time_s.size, low), 1)):
        for k in range(len(places)):
            lacking = bool((seen[k] & (count < limit)).sum() >= max(least, 1))
            fits = bool((count[seen[k]] < high).all()) and seen[k].sum() >= least
            far = not chosen or np.hypot(*(places[chosen] - places[k]).T).min() >= APART_M
            if lacking and fits and far:
                chosen.append(k)
                count += seen[k]
    order = sorted(chosen, key=lambda k: (int(np.argmax(seen[k])), k))
    return [
        SceneObject(n, "sphere", TimedPath.still(*places[k]), diameter_m, diameter_m, snr_db)
        for n, k in enumerate(order, 1)
    ]


def _candidates(
    sonar: Sonar, vehicle: Vehicle, time_s: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, BoolArray]:
    """Random places (n, 2) that come into view, and when they are in it (n, k)."""
    poses = [vehicle.pose(float(t)) for t in time_s]
    origins = np.array([pose.origin_m for pose in poses])
    far = sonar.range_max_m
    side = np.abs(origins[:, 1]).max() + far * np.sin(min(sonar.half_width_rad, np.pi / 2.0)) + 1.0
    south, north = origins[:, 0].min() + sonar.range_min_m, origins[:, 0].max() + far
    n = int(CANDIDATES_PER_M * (north - south + far))
    places = np.stack([rng.uniform(south, north, n), rng.uniform(-side, side, n)], axis=1)
    seen = np.stack([sonar.sees(pose.to_sensor(places)) for pose in poses], axis=1)
    shown = seen.any(axis=1)
    return places[shown], seen[shown]


def fish(
    n: int,
    sonar: Sonar,
    vehicle: Vehicle,
    time_s: FloatArray,
    speed_mps: float,
    snr_db: float,
    first_id: int,
    rng: np.random.Generator,
) -> list[SceneObject]:
    """`n` fish that swim straight, each across a random place of the sector at a random time."""
    found = []
    for number in range(n):
        at = float(rng.uniform(time_s.min(), time_s.max()))
        r = float(np.sqrt(rng.uniform(sonar.range_min_m**2, sonar.range_max_m**2)))
        b = rng.uniform(-sonar.half_width_rad, sonar.half_width_rad)
        place = vehicle.pose(at).to_ned(np.array([r * np.cos(b), r * np.sin(b)]))
        course = rng.uniform(-np.pi, np.pi)
        velocity = (speed_mps * float(np.cos(course)), speed_mps * float(np.sin(course)))
        path = TimedPath.straight(at, (float(place[0]), float(place[1])), velocity)
        found.append(SceneObject(first_id + number, "fish", path, 0.6, 0.2, snr_db, 0.3))
    return found


def cylinder(snr_db: float) -> SceneObject:
    """The cylinder of Clark & Bell's recording, 52 m ahead at the start, a little to starboard."""
    return SceneObject(1, "cylinder", TimedPath.still(52.0, 1.6), 2.0, 0.5, snr_db)
