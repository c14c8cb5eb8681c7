"""Where hydrophones are, from their distances; how fast sound goes through layers."""

from __future__ import annotations

from math import isfinite

import numpy as np
import numpy.typing as npt

__all__ = ["FLOATER_M", "effective_speed_mps", "positions_from_distances"]

FloatArray = npt.NDArray[np.float64]
# of the floater's four hydrophones, Abu et al. 2024, section VI-B
FLOATER_M = ((-0.385, 0.0, 0.0), (0.0, 0.395, 0.0), (0.405, 0.0, 0.0), (0.0, -0.405, 0.0))


def positions_from_distances(
    distances_m: npt.ArrayLike, first_bearing_rad: float = 0.0, *, clockwise: bool = True
) -> FloatArray:
    """Positions (n, 3) of the n >= 2 hydrophones of a planar array from their distances (n, n).

    Classical scaling: B = -J D^2 J / 2 with J = 1 - 11^T / n; its two largest eigenvalues and their vectors
    give the plane. What distances leave open is fixed by rule: the centroid is the origin, the array lies in
    z = 0, the first hydrophone lies at `first_bearing_rad`, and the next one that is not on a line with it
    lies `clockwise` of it seen from above, to starboard. A first hydrophone at the centroid gives way to the
    next one.

    Source: Torgerson 1952; Wickelmaier 2003. Raises ValueError for a table that is not square, symmetric,
    non-negative with a zero diagonal.
    """
    table = np.asarray(distances_m, float)
    _check_table(table)
    n = len(table)
    J = np.eye(n) - 1.0 / n
    value, vector = np.linalg.eigh(-0.5 * J @ np.square(table) @ J)
    plane = vector[:, -2:][:, ::-1] * np.sqrt(np.maximum(value[-2:][::-1], 0.0))
    off_centre = np.hypot(plane[:, 0], plane[:, 1])
    first = int(np.argmax(off_centre > 1e-6 * off_centre.max()))
    c, s = plane[first] / off_centre[first]
    turned = plane @ np.array([[c, -s], [s, c]])  # the first hydrophone to bearing 0
    beside = turned[first + 1 :, 1]
    beside = beside[np.abs(beside) > 1e-6 * off_centre.max()]
    if beside.size and (beside[0] > 0.0) != clockwise:
        turned[:, 1] *= -1.0
    c, s = np.cos(first_bearing_rad), np.sin(first_bearing_rad)
    placed = turned @ np.array([[c, s], [-s, c]])
    return np.concatenate([placed, np.zeros((n, 1))], axis=1)


def _check_table(table: FloatArray) -> None:
    if table.ndim != 2 or table.shape[0] != table.shape[1] or len(table) < 2:
        raise ValueError(f"distances_m has shape {table.shape}; it must be square, two hydrophones or more")
    if not (np.isfinite(table).all() and (table >= 0.0).all()):
        raise ValueError("distances_m has entries that are negative or not finite")
    apart = np.abs(table - table.T)
    if apart.max() > 1e-6 * max(table.max(), 1e-9):
        i, j = np.unravel_index(int(apart.argmax()), table.shape)
        raise ValueError(
            f"distances_m is {table[i, j]} from {i + 1} to {j + 1}, but {table[j, i]} back; "
            "it must be symmetric"
        )
    if np.diag(table).any() or not table.any():
        raise ValueError("distances_m must be 0 on its diagonal and positive somewhere else")


def effective_speed_mps(layers: npt.ArrayLike, source_depth_m: float, target_depth_m: float) -> float:
    """The speed that makes a straight path's length its travel time, through layers of constant speed.

    c = |z1 - z0| / integral of dz / c(z), the harmonic mean over the depths between; at equal depths the
    speed there. `layers` (n, 2): depth of the top and speed, downwards; the last has no end. Bending of the
    path is not modelled. Raises ValueError for layers that do not begin at the surface and go down.
    """
    table = np.asarray(layers, float)
    if table.ndim != 2 or table.shape[1] != 2 or not len(table):
        raise ValueError(f"layers has shape {table.shape}; it takes rows of [depth_m, speed_mps]")
    top, speed = table[:, 0], table[:, 1]
    if top[0] != 0.0 or not (np.diff(top) > 0.0).all() or not np.isfinite(table).all():
        raise ValueError(f"layers have tops at {top.tolist()}; they must begin at 0 and go down")
    if not (speed > 0.0).all():
        raise ValueError(f"layers have speeds {speed.tolist()}; they must be positive")
    if not all(isfinite(depth) and depth >= 0.0 for depth in (source_depth_m, target_depth_m)):
        raise ValueError(f"depths are {source_depth_m} and {target_depth_m}; they must be 0 or more")
    upper, lower = sorted((source_depth_m, target_depth_m))
    if upper == lower:
        return float(speed[np.searchsorted(top, upper, side="right") - 1])
    ends = np.append(top[1:], np.inf)
    thick = np.clip(np.minimum(ends, lower) - np.maximum(top, upper), 0.0, None)
    return float((lower - upper) / np.sum(thick / speed))
