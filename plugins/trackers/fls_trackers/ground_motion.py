"""How a still object on the sea floor moves in the polar coordinates of a moving sonar.

Symbols: x = (d, delta), range (m) and cone angle (rad) of a horizontal array; m (3,) the object in the sensor
frame; the floor is the plane normal . m = height. All functions are vectorised over their leading axes.

Source: Quidu, Bertholom & Dupas 2010 (1)-(6), for any mount and any plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Mount, NavState
from fls_flow.geometry import rotation
from fls_trackers.ground_floor import FloorPlane

__all__ = [
    "Located",
    "SensorMotion",
    "body_rates",
    "locate",
    "moved_euler",
    "moved_exact",
    "rates",
    "sensor_motion",
]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class SensorMotion:
    """Attitude, motion and height of the sonar at one instant; vectors in the sensor frame unless said."""

    R: FloatArray  # (3, 3), sensor to NED
    origin_m: FloatArray  # (3,) NED; nan where it is not known
    velocity_mps: FloatArray  # (3,) over ground
    omega_radps: FloatArray  # (3,) turn rate against NED
    normal: FloatArray  # (3,) unit, into the floor
    height_m: float  # distance to the floor, along its normal

    def packed(self) -> FloatArray:
        """All of it in one array (22,)."""
        parts = (self.R.ravel(), self.origin_m, self.velocity_mps, self.omega_radps, self.normal)
        return np.concatenate([*parts, [self.height_m]])

    @classmethod
    def unpacked(cls, values: FloatArray) -> SensorMotion:
        """The motion that gave the array (22,)."""
        R, origin, velocity, omega, normal, height = np.split(values, [9, 12, 15, 18, 21])
        return cls(R.reshape(3, 3), origin, velocity, omega, normal, float(height[0]))


class Located(NamedTuple):
    """Objects in the sensor frame."""

    m: FloatArray  # (..., 3)
    shortfall_m: FloatArray  # (...,) by how much an echo is nearer than the floor; 0 or less: none


def body_rates(attitude_rad: npt.ArrayLike, attitude_rate_radps: npt.ArrayLike) -> FloatArray:
    """omega (3,) in the body frame, rad/s: R^T R' = [omega]x for R = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll, pitch, _ = np.asarray(attitude_rad, float)
    droll, dpitch, dyaw = np.asarray(attitude_rate_radps, float)
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    return np.array([droll - sp * dyaw, cr * dpitch + sr * cp * dyaw, -sr * dpitch + cr * cp * dyaw])


def sensor_motion(nav: NavState, mount: Mount, floor: FloorPlane | None = None) -> SensorMotion | None:
    """The motion of the sonar on `mount`, above `floor` or else a level floor at the altitude of `nav`.

    None when forward or starboard velocity, roll rate to yaw rate or the height are not known. Roll, pitch,
    yaw and vertical velocity that are not known count as zero; a place that is not known is nan.
    """
    normal, height = np.array([0.0, 0.0, 1.0]), nav.altitude_m
    if floor is not None and floor.known:
        normal, height = np.array(floor.normal), floor.height_m
    needed = [*nav.velocity_mps[:2], *nav.attitude_rate_radps, height]
    if not np.isfinite(needed).all():
        return None
    attitude = np.nan_to_num(nav.attitude_rad, nan=0.0)
    body = rotation((attitude[0], attitude[1], attitude[2]))
    mounted = rotation(mount.attitude_rad)
    arm = np.array(mount.position_m)
    omega = body_rates(attitude, nav.attitude_rate_radps)
    velocity = np.nan_to_num(nav.velocity_mps, nan=0.0) + np.cross(omega, arm)
    R = body @ mounted
    return SensorMotion(
        R,
        np.array(nav.position_m) + body @ arm,
        mounted.T @ velocity,
        mounted.T @ omega,
        R.T @ normal,
        float(height - normal @ (body @ arm)),
    )


def locate(x: FloatArray, motion: SensorMotion, afloat: BoolArray | None = None) -> Located:
    """f_a: objects (..., 3) on the floor at the polar coordinates (..., 2).

    With normal = (A, B, C), m_y = d sin(delta), q = height - B m_y, N2 = A^2 + C^2 and
    s = sqrt(d^2 cos^2(delta) N2 - q^2): m_x = (A q + C s) / N2, m_z = (C q - A s) / N2, the forward one of
    two roots. Where the root is not real the echo is nearer than the floor by shortfall = |q| / sqrt(N2) -
    d cos(delta), and s = 0 stands in. Objects that are `afloat` (...,) lie in the sonar's own plane, m_z = 0.

    Source: Quidu 2010 (1), (2), solved; the paper does not write f_a out.
    """
    d, delta = x[..., 0], x[..., 1]
    A, B, C = motion.normal
    along, m_y = d * np.cos(delta), d * np.sin(delta)
    q, n2 = motion.height_m - B * m_y, A * A + C * C
    s = np.sqrt(np.maximum(along**2 * n2 - q * q, 0.0))
    m = np.stack([(A * q + C * s) / n2, m_y, (C * q - A * s) / n2], axis=-1)
    if afloat is not None and afloat.any():
        level = np.stack([along, m_y, np.zeros_like(m_y)], axis=-1)
        m = np.where(afloat[..., None], level, m)
    return Located(m, np.abs(q) / np.sqrt(n2) - along)


def rates(x: FloatArray, m: FloatArray, motion: SensorMotion) -> FloatArray:
    """f_c(f_b(m)): the time derivatives (..., 2) of d and delta of still objects.

    m' = -omega x m - v, d' = m . m' / d, delta' = (m'_y - sin(delta) d') / (d cos(delta)).

    Source: Quidu 2010 (3)-(6); f_c also needs m.
    """
    d, delta = np.maximum(x[..., 0], 1e-6), x[..., 1]
    change = np.cross(m, motion.omega_radps) - motion.velocity_mps
    d_dot = (m * change).sum(axis=-1) / d
    delta_dot = (change[..., 1] - np.sin(delta) * d_dot) / (d * np.cos(delta))
    return np.stack([d_dot, delta_dot], axis=-1)


def moved_euler(
    x: FloatArray, before: SensorMotion, dt_s: float, afloat: BoolArray | None = None
) -> FloatArray:
    """x + dt f(x, u), with the motion u at the start of the step.

    Source: Quidu 2010 (7), which gives rates as if they were states.
    """
    return x + dt_s * rates(x, locate(x, before, afloat).m, before)


def moved_exact(
    x: FloatArray,
    before: SensorMotion,
    after: SensorMotion,
    dt_s: float,
    afloat: BoolArray | None = None,
) -> FloatArray:
    """The polar coordinates after the rigid motion m = R_k^T (R_{k-1} m_{k-1} - travel).

    travel = dt (R_{k-1} v_{k-1} + R_k v_k) / 2: the attitude is exact, the path is that of even acceleration.
    """
    travel = 0.5 * dt_s * (before.R @ before.velocity_mps + after.R @ after.velocity_mps)
    m = (locate(x, before, afloat).m @ before.R.T - travel) @ after.R
    d = np.sqrt((m * m).sum(axis=-1))
    return np.stack([d, np.arcsin(np.clip(m[..., 1] / np.maximum(d, 1e-6), -1.0, 1.0))], axis=-1)
