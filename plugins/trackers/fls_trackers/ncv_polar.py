"""Blobs as polar measurements of Cartesian tracks: sharp in range, however wide their bearings."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import Pose, to_cartesian, to_polar, wrap

__all__ = ["along_arc", "axes", "polar_noise", "residuals", "robust_noise"]

FloatArray = npt.NDArray[np.float64]

CORE = 0.25  # variance of bearings in the main lobe, of that of all


def axes(position_m: FloatArray, pose: Pose) -> FloatArray:
    """Unit vectors (n, 2) from the sonar to positions (n, 2), in the frame of the tracks."""
    off = position_m - pose.origin_m
    distance = np.hypot(off[:, 0], off[:, 1])[:, None]
    ahead = to_cartesian(1.0, np.full(len(off), pose.heading_rad))
    unit: FloatArray = np.where(distance > 0.0, off / np.maximum(distance, 1e-300), ahead)
    return unit


def polar_noise(position_m: FloatArray, range_sd_m: float, bearing_sd_rad: float, pose: Pose) -> FloatArray:
    """R (n, 2, 2) = T diag(sd^2, (r sb)^2) T^T at predicted positions (n, 2), T the axes along and across."""
    along = axes(position_m, pose)
    across = _turned_left(along)
    distance = np.linalg.norm(position_m - pose.origin_m, axis=1)
    wide = np.square(distance * bearing_sd_rad)[:, None, None]
    noise: FloatArray = range_sd_m**2 * _outer(along) + wide * _outer(across)
    return noise


def residuals(position_m: FloatArray, polar: FloatArray, pose: Pose) -> FloatArray:
    """Innovations (n, 2) of blobs at `polar` (n, 2) against positions (n, 2): r_j - r along, r dtheta across.

    Differences of ranges and of bearings, turned into the frame of the tracks: an arc stays as thin as ranges
    are sharp.
    """
    range_m, bearing_rad = to_polar(pose.to_sensor(position_m))
    along = axes(position_m, pose)
    off_m = polar[:, 0] - range_m
    arc_m = range_m * wrap(polar[:, 1] - bearing_rad)
    return off_m[:, None] * along + arc_m[:, None] * _turned_left(along)


def robust_noise(
    nu: FloatArray, position_m: FloatArray, covariance: FloatArray, R: FloatArray, pose: Pose
) -> FloatArray:
    """R (n, 2, 2) for an update, with bearings that lie far off the less believed the farther: lobes.

    Across the line of sight the variance becomes b (1 + d^2 / (p + b)) / 2, with b a quarter of that of R, p
    that of the track, and d the innovation `nu` across: as for a measurement whose errors are Cauchy's.

    Source: Lange, Little & Taylor 1989, t with one degree of freedom, one step.
    """
    across = _turned_left(axes(position_m, pose))
    off = (nu * across).sum(axis=1)
    whole = np.einsum("ni,nij,nj->n", across, R, across)
    track = np.einsum("ni,nij,nj->n", across, covariance[:, :2, :2], across)
    core = CORE * whole
    wide = 0.5 * core * (1.0 + off * off / (track + core))
    noise: FloatArray = R + (wide - whole)[:, None, None] * _outer(across)
    return noise


def along_arc(
    before: FloatArray, after: FloatArray, covariance: FloatArray, pose: Pose
) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances of an update, moved along the arc and not along its tangent.

    The correction of the position, dr along and s across, becomes r + dr and theta + s / r; velocity and
    covariance turn by s / r with it, so that the sharp axis stays along the line of sight and corrections of
    a vague bearing change neither range nor range rate.
    """
    off = before[:, :2] - pose.origin_m
    distance = np.hypot(off[:, 0], off[:, 1])
    along = axes(before[:, :2], pose)
    moved = after[:, :2] - before[:, :2]
    reach = distance + (moved * along).sum(axis=1)
    angle = (moved * _turned_left(along)).sum(axis=1) / np.maximum(distance, 1e-9)
    angle = np.clip(angle, -np.pi, np.pi)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    state = after.copy()
    state[:, :2] = pose.origin_m + reach[:, None] * np.einsum("nij,nj->ni", turn, along)
    state[:, 2:] = np.einsum("nij,nj->ni", turn, after[:, 2:])
    whole = np.zeros((len(before), 4, 4))
    whole[:, :2, :2] = whole[:, 2:, 2:] = turn
    turned = whole @ covariance @ whole.transpose(0, 2, 1)
    return state, 0.5 * (turned + turned.transpose(0, 2, 1))


def _turned_left(unit: FloatArray) -> FloatArray:
    """Unit vectors a quarter turn on, towards greater bearings."""
    return np.stack([-unit[:, 1], unit[:, 0]], axis=1)


def _outer(unit: FloatArray) -> FloatArray:
    product: FloatArray = unit[:, :, None] * unit[:, None, :]
    return product
