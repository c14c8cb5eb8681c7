"""Angles, frames, polar and Cartesian coordinates, and constant-velocity motion.

Sensor and body frame: x forward, y starboard, z down. World: local NED. Metres, radians, seconds. All
functions take arrays and are vectorised over their first axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.messages import Mount, NavState, Vector

__all__ = [
    "Pose",
    "cv_noise",
    "cv_transition",
    "debiased",
    "debiased_covariance",
    "flu_to_frd",
    "predict",
    "rotation",
    "sensor_pose",
    "to_cartesian",
    "to_polar",
    "turn",
    "wrap",
]

FloatArray = npt.NDArray[np.float64]


def wrap(angle_rad: npt.ArrayLike) -> FloatArray:
    """The same angles in (-pi, pi]."""
    wrapped = np.pi - np.mod(np.pi - np.asarray(angle_rad, float), 2.0 * np.pi)
    return np.where(wrapped <= -np.pi, np.pi, wrapped)  # rounding may land on the open end


def to_cartesian(range_m: npt.ArrayLike, bearing_rad: npt.ArrayLike) -> FloatArray:
    """Positions (..., 2) of [range cos, range sin], m."""
    distance, bearing = np.asarray(range_m, float), np.asarray(bearing_rad, float)
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)


def to_polar(position_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Range (m) and bearing (rad, in (-pi, pi]) of positions (..., 2)."""
    xy = np.asarray(position_m, float)
    return np.hypot(xy[..., 0], xy[..., 1]), wrap(np.arctan2(xy[..., 1], xy[..., 0]))


def debiased(
    range_m: npt.ArrayLike,
    bearing_rad: npt.ArrayLike,
    range_sd_m: npt.ArrayLike,
    bearing_sd_rad: npt.ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """Debiased Cartesian positions (n, 2) of polar measurements, and their covariances (n, 2, 2).

    y = raw (1 - exp(-s) + exp(-s/2)), s = bearing_sd^2; the covariance is `debiased_covariance`.

    Source: Lerro & Bar-Shalom 1993; Karoui 2015 (7)-(11).
    """
    s = np.square(np.asarray(bearing_sd_rad, float))
    raw = to_cartesian(range_m, bearing_rad)
    position = raw * np.asarray(1.0 - np.exp(-s) + np.exp(-s / 2.0))[..., None]
    return position, debiased_covariance(range_m, bearing_rad, range_sd_m, bearing_sd_rad)


def debiased_covariance(
    range_m: npt.ArrayLike,
    bearing_rad: npt.ArrayLike,
    range_sd_m: npt.ArrayLike,
    bearing_sd_rad: npt.ArrayLike,
) -> FloatArray:
    """Covariances (n, 2, 2) of debiased converted measurements, m^2.

    Source: Karoui 2015 (9)-(11); (11) with the sign of Lerro & Bar-Shalom 1993.
    """
    d2 = np.square(np.asarray(range_m, float))
    bearing = np.asarray(bearing_rad, float)
    v, s = np.square(np.asarray(range_sd_m, float)), np.square(np.asarray(bearing_sd_rad, float))
    c, n = np.cos(bearing), np.sin(bearing)
    along, across = np.cosh(2 * s) - np.cosh(s), np.sinh(2 * s) - np.sinh(s)
    along_v, across_v = 2 * np.cosh(2 * s) - np.cosh(s), 2 * np.sinh(2 * s) - np.sinh(s)
    common = np.exp(-2.0 * s)
    r11 = common * (d2 * (c * c * along + n * n * across) + v * (c * c * along_v + n * n * across_v))
    r22 = common * (d2 * (n * n * along + c * c * across) + v * (n * n * along_v + c * c * across_v))
    r12 = n * c * np.exp(-4.0 * s) * (v - (d2 + v) * np.expm1(s))
    return np.stack([np.stack([r11, r12], axis=-1), np.stack([r12, r22], axis=-1)], axis=-2)


def rotation(attitude_rad: Vector) -> FloatArray:
    """R = Rz(yaw) Ry(pitch) Rx(roll), (3, 3): from the body to the frame that the attitude refers to."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(attitude_rad), np.sin(attitude_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def turn(angle_rad: float) -> FloatArray:
    """The (2, 2) rotation by `angle_rad`, from x to y."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


@dataclass(frozen=True, slots=True)
class Pose:
    """A sensor's place and heading in the horizontal plane of the NED frame."""

    north_m: float = 0.0
    east_m: float = 0.0
    heading_rad: float = 0.0

    @property
    def origin_m(self) -> FloatArray:
        """[north, east], m."""
        return np.array([self.north_m, self.east_m])

    def to_ned(self, position_m: npt.ArrayLike) -> FloatArray:
        """Positions (..., 2) of the sensor frame as [north, east]."""
        return np.asarray(position_m, float) @ turn(self.heading_rad).T + self.origin_m

    def to_sensor(self, position_m: npt.ArrayLike) -> FloatArray:
        """Positions (..., 2) of [north, east] in the sensor frame."""
        return (np.asarray(position_m, float) - self.origin_m) @ turn(self.heading_rad)


def sensor_pose(nav: NavState, mount: Mount) -> Pose:
    """The horizontal pose of a sensor mounted at `mount` on a vehicle at `nav`.

    Raises ValueError when the vehicle's horizontal position or its heading is not known (nan). Roll, pitch
    and depth that are not known count as zero.
    """
    north, east, down = nav.position_m
    roll, pitch, yaw = nav.attitude_rad
    if not np.isfinite([north, east, yaw]).all():
        raise ValueError(f"navigation at {nav.stamp_ns} ns lacks position or heading: {nav}")
    body = rotation((_known(roll), _known(pitch), yaw))
    place = np.array([north, east, _known(down)]) + body @ np.array(mount.position_m)
    forward = (body @ rotation(mount.attitude_rad))[:, 0]
    return Pose(float(place[0]), float(place[1]), float(np.arctan2(forward[1], forward[0])))


def _known(value: float) -> float:
    return value if np.isfinite(value) else 0.0


def flu_to_frd(vectors: npt.ArrayLike) -> FloatArray:
    """Vectors (..., 3) of a forward-left-up frame (ROS) in forward-right-down, and back again."""
    frd: FloatArray = np.asarray(vectors, float) * np.array([1.0, -1.0, -1.0])
    return frd


def cv_transition(dt_s: float) -> FloatArray:
    """F (4, 4) of nearly constant velocity, state [x, y, vx, vy]."""
    F = np.eye(4)
    F[0, 2] = F[1, 3] = dt_s
    return F


def cv_noise(dt_s: float, acceleration_sd_mps2: float) -> FloatArray:
    """Q = sigma^2 G G^T (4, 4), G = [dt^2/2, dt]: white acceleration, constant over a step; of rank 2."""
    G = np.zeros((4, 2))
    G[0, 0] = G[1, 1] = dt_s**2 / 2.0
    G[2, 0] = G[3, 1] = dt_s
    return acceleration_sd_mps2**2 * (G @ G.T)


def predict(
    state: FloatArray, covariance: FloatArray, dt_s: float, acceleration_sd_mps2: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) after `dt_s` of nearly constant velocity."""
    F = cv_transition(dt_s)
    return state @ F.T, F @ covariance @ F.T + cv_noise(dt_s, acceleration_sd_mps2)
