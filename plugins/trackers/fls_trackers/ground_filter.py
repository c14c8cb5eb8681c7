"""The filter of still objects on the floor: unscented prediction, linear correction in pixels.

All functions run over n tracks at once: states x (n, 2) of range (m) and bearing (rad), their covariances
(n, 2, 2).

Source: Quidu, Bertholom & Dupas 2010, section 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import numpy.typing as npt

from fls_flow import View

__all__ = [
    "FixedNoise",
    "cell_of",
    "correct",
    "flat",
    "means_by_group",
    "measurement_noise",
    "nearest_tracks",
    "process_noise",
    "sigma_points",
    "start_groups",
    "unscented",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
FixedNoise = Literal["paper", "huber", "fixed"]

UNKNOWN_CELL_M, UNKNOWN_SPACING_RAD = 0.05, math.radians(1.5)
KAPPA = 1.0  # 3 - n: all weights positive, so that P stays positive semidefinite


def sigma_points(x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (5, n, 2) and weights (5,) with mean x and covariance P.

    x, x +- sqrt(n + kappa) L_i with L L^T = P; W_0 = kappa / (n + kappa), W_i = 1 / (2 (n + kappa)).

    Source: Julier & Uhlmann 1997.
    """
    spread = np.sqrt(2.0 + KAPPA)
    a = np.sqrt(np.maximum(P[:, 0, 0], 0.0))
    b = P[:, 1, 0] / np.where(a > 0.0, a, 1.0)
    c = np.sqrt(np.maximum(P[:, 1, 1] - b * b, 0.0))
    first = spread * np.stack([a, b], axis=-1)
    second = spread * np.stack([np.zeros_like(c), c], axis=-1)
    weights = np.array([2.0 * KAPPA, 1.0, 1.0, 1.0, 1.0]) / (2.0 * (2.0 + KAPPA))
    return np.stack([x, x + first, x - first, x + second, x - second]), weights


def unscented(
    x: FloatArray, P: FloatArray, function: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Mean (n, k) and covariance (n, k, k) of `function` (5, n, 2) -> (5, n, k) of Gaussians."""
    points, W = sigma_points(x, P)
    moved = function(points)
    mean = np.einsum("i,ina->na", W, moved)
    apart = moved - mean
    return mean, np.einsum("i,ina,inb->nab", W, apart, apart)


def process_noise(
    x: FloatArray, dt_s: float, q: tuple[float, float], speed_mps: float, turn_dps: float
) -> FloatArray:
    """Q (n, 2, 2): q plus (dt speed)^2 in range, (dt speed / d)^2 + (dt turn)^2 in bearing."""
    moved = (speed_mps * dt_s) ** 2
    Q = np.zeros((len(x), 2, 2))
    Q[:, 0, 0] = q[0] + moved
    Q[:, 1, 1] = q[1] + moved / np.maximum(x[:, 0], 1.0) ** 2
    Q[:, 1, 1] += math.radians(turn_dps * dt_s) ** 2
    return Q


def cell_of(view: View) -> FloatArray:
    """Size of a pixel (2,): a range cell (m) and a beam spacing (rad), usual ones of a mute view."""
    cell, spacing = view.cell_m, view.beam_spacing_rad
    return np.array(
        [cell if cell > 0.0 else UNKNOWN_CELL_M, spacing if spacing > 0.0 else UNKNOWN_SPACING_RAD]
    )


def measurement_noise(innovation_px: FloatArray, floor_px: FloatArray, noise: FixedNoise) -> FloatArray:
    """Variances (n, 2) of the measurements, px^2, by their innovations nu (n, 2) alone.

    `paper`: max(|nu|, floor)^2; `huber`: floor max(|nu|, floor); `fixed`: floor^2. The paper gives no
    formula: nu^2 alone lets a small innovation collapse P, hence the floor. With the square, a measurement
    counts the less the farther off it is, and a track that is off stays so for long; with the first power,
    far ones pull alike (Huber 1964).
    """
    nu = np.maximum(np.abs(innovation_px), floor_px)
    if noise == "fixed":
        return np.broadcast_to(floor_px**2, innovation_px.shape)
    return nu * (nu if noise == "paper" else floor_px)


def correct(
    x: FloatArray, P: FloatArray, y_px: FloatArray, cell: FloatArray, variance_px2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States and covariances after one measurement (n, 2) each, in pixels of size `cell` (m, rad).

    H = diag(1 / cell), R = diag(variance), nu = y - H x, S = H P H^T + R, K = P H^T S^-1, x + K nu,
    P - K S K^T.

    Source: Quidu 2010 (8), (9), with H of 2 x 2.
    """
    scale = 1.0 / cell
    nu = y_px - x * scale
    S = P * scale[:, None] * scale
    s11, s12, s22 = S[:, 0, 0] + variance_px2[:, 0], S[:, 0, 1], S[:, 1, 1] + variance_px2[:, 1]
    inverse = np.stack([np.stack([s22, -s12], -1), np.stack([-s12, s11], -1)], -2)
    inverse /= (s11 * s22 - s12 * s12)[:, None, None]
    PH = P * scale  # P H^T
    K = PH @ inverse
    updated = P - K @ PH.transpose(0, 2, 1)
    return x + (K @ nu[..., None])[..., 0], 0.5 * (updated + updated.transpose(0, 2, 1))


def nearest_tracks(tracks_m: FloatArray, y_m: FloatArray, limit_m: float) -> IntArray:
    """The nearest track of each measurement, (m,), -1 where none of (n, 2) lies within `limit_m`."""
    if not len(tracks_m) or not len(y_m):
        return np.full(len(y_m), -1, np.int64)
    apart = np.square(y_m[:, None, :] - tracks_m).sum(axis=-1)
    nearest = apart.argmin(axis=1)
    near = apart[np.arange(len(y_m)), nearest] <= limit_m**2
    return np.where(near, nearest, -1).astype(np.int64)


def start_groups(y_m: FloatArray, limit_m: float) -> IntArray:
    """The group of each point (m, 2), from 0: it joins the first leader within `limit_m`, else it leads."""
    group = np.full(len(y_m), -1, np.int64)
    count = 0
    while (left := np.flatnonzero(group < 0)).size:  # once per group, not per point
        apart = np.square(y_m[left] - y_m[left[0]]).sum(axis=-1)
        group[left[apart <= limit_m**2]] = count
        count += 1
    return group


def flat(x: FloatArray) -> FloatArray:
    """[d cos(delta), d sin(delta)] of polar coordinates (..., 2)."""
    return np.stack([x[..., 0] * np.cos(x[..., 1]), x[..., 0] * np.sin(x[..., 1])], axis=-1)


def means_by_group(y: FloatArray, group: IntArray, groups: int) -> FloatArray:
    """Means (groups, 2) of the rows of y (m, 2) by group; 0 for a group without any."""
    number = np.maximum(np.bincount(group, minlength=groups), 1)
    sums = [np.bincount(group, weights=column, minlength=groups) for column in y.T]
    return np.stack(sums, axis=-1) / number[:, None]
