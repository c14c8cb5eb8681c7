"""Groups of blobs that lie near each other in range and bearing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import wrap
from fls_flow.kernels import compiled

__all__ = ["circular_mean", "components", "stars"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


def components(
    range_m: FloatArray, bearing_rad: FloatArray, within_m: float, within_rad: float
) -> tuple[IntArray, int]:
    """The group of each blob and the number of groups: chains of blobs, each near the next.

    Two are near when |r_p - r_q| <= within_m and |wrap(theta_p - theta_q)| <= within_rad. Groups are
    numbered in the order of their nearest blobs in range; the order of the blobs does not matter.

    Source: Abu 2024 (12), closed transitively.
    """
    order = np.argsort(range_m, kind="stable")
    of_sorted, n = _chained(range_m[order], bearing_rad[order], within_m, within_rad)
    of = np.empty(range_m.size, np.int64)
    of[order] = of_sorted
    return of, int(n)


def stars(
    range_m: FloatArray, bearing_rad: FloatArray, amplitude: FloatArray, within_m: float, within_rad: float
) -> tuple[IntArray, int]:
    """The group of each blob and the number of groups: a strongest blob with all those near it.

    The strongest blob takes those near it that are free, then the strongest that is left, and so on; groups
    are numbered in that order, and of equally strong blobs the nearer one in range, then bearing, is first.
    """
    order = np.lexsort((bearing_rad, range_m, -amplitude))
    of_sorted, n = _led(range_m[order], bearing_rad[order], within_m, within_rad)
    of = np.empty(range_m.size, np.int64)
    of[order] = of_sorted
    return of, int(n)


def circular_mean(bearing_rad: FloatArray, of: IntArray, n: int) -> FloatArray:
    """atan2(sum sin, sum cos) of the bearings of each group, (n,), in (-pi, pi]."""
    y, x = np.bincount(of, np.sin(bearing_rad), n), np.bincount(of, np.cos(bearing_rad), n)
    return wrap(np.arctan2(y, x))


@compiled
def _near(one: float, other: float, within_rad: float) -> bool:
    off = abs(one - other) % (2.0 * np.pi)
    return min(off, 2.0 * np.pi - off) <= within_rad


@compiled
def _chained(
    range_m: FloatArray, bearing_rad: FloatArray, within_m: float, within_rad: float
) -> tuple[IntArray, int]:
    n = range_m.size
    parent = np.arange(n)
    for i in range(n):
        for j in range(i + 1, n):
            if range_m[j] - range_m[i] > within_m:
                break
            if _near(bearing_rad[i], bearing_rad[j], within_rad):
                a, b = _root(parent, i), _root(parent, j)
                parent[max(a, b)] = min(a, b)
    of, count = np.empty(n, np.int64), 0
    for i in range(n):
        root = _root(parent, i)
        if root == i:
            of[i] = count
            count += 1
        else:
            of[i] = of[root]
    return of, count


@compiled
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def _led(
    range_m: FloatArray, bearing_rad: FloatArray, within_m: float, within_rad: float
) -> tuple[IntArray, int]:
    n = range_m.size
    of, count = np.full(n, -1), 0
    by_range = np.argsort(range_m, kind="mergesort")
    sorted_m = range_m[by_range]
    for i in range(n):
        if of[i] >= 0:
            continue
        k = np.searchsorted(sorted_m, range_m[i] - within_m)
        while k < n and sorted_m[k] - range_m[i] <= within_m:
            j = by_range[k]
            if of[j] < 0 and _near(bearing_rad[i], bearing_rad[j], within_rad):
                of[j] = count
            k += 1
        of[i] = count
        count += 1
    return of, count
