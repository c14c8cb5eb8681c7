"""Wedges around cluster centres that are dense with detections, linked to wakes with two ends."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["ORIENTATIONS", "WakeWedges", "wake_wedges", "wedge_counts"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

ORIENTATIONS = 36  # wedges of 20 degrees every 10 degrees: a wake on the border of two is whole in a third
STEP = 2.0 * np.pi / ORIENTATIONS
TANGENTS = tuple(float(t) for t in np.tan(STEP * np.arange(1, 9)))


class Strips(NamedTuple):
    """Points by strips of y as wide as a wedge is long, in each by x: what is near is in three intervals."""

    key: FloatArray  # (n,) increasing: strip * pitch + x - origin
    position_m: FloatArray  # (n, 2)
    origin_m: float
    pitch_m: float

    @classmethod
    def of(cls, point_m: FloatArray, length_m: float) -> Strips:
        """The points (n, 2) in strips for wedges of `length_m`."""
        x, y = point_m[:, 0], point_m[:, 1]
        origin = float(x.min()) if x.size else 0.0
        pitch = (float(x.max()) - origin if x.size else 0.0) + 3.0 * length_m
        key = np.floor(y / length_m) * pitch + (x - origin)
        order = np.argsort(key, kind="stable")
        return cls(key[order], np.ascontiguousarray(point_m[order]), origin, pitch)


class WakeWedges(NamedTuple):
    """Wedges that hold a wake, and the points that they cover."""

    centre: IntArray  # (n,) which centre is the apex
    orientation: IntArray  # (n,) in steps of 10 degrees
    wake: IntArray  # (n,) which wake it belongs to, from 0
    is_end: BoolArray  # (n,) whether the apex is an end of that wake
    covered: BoolArray  # (n_centres,) centres to be removed: in a wedge, or an apex, and no end


def wake_wedges(
    centre_m: FloatArray,
    point_m: FloatArray,
    *,
    length_m: float,
    short_m: float,
    min_count: float,
    ratio: float,
) -> WakeWedges:
    """The wedges (c, phi) that qualify, linked.

    N_l1 > ratio mean_phi N_l1, N_l1 > n_w, N_l2 > ratio mean_phi N_l2 and N_l2 > 2 n_w / 3, where N_l counts
    the points in the wedge of length l and n_w is `min_count`. Wedges that share a point and differ by at
    most 20 degrees are of one component; its end is the apex farthest back along the circular mean of
    their orientations. Components that share a point and lie the other way round make one wake.

    Source: Karoui 2015, III-C; ends by projection, because the printed test holds in mid-wake too.
    """
    points = Strips.of(point_m, length_m)
    long, short = wedge_counts(centre_m, points, length_m, short_m)
    qualify = (
        (long > ratio * long.mean(axis=1, keepdims=True))
        & (long > min_count)
        & (short > ratio * short.mean(axis=1, keepdims=True))
        & (short > 2.0 * min_count / 3.0)
    )
    centre, orientation = (index.astype(np.int64) for index in np.nonzero(qualify))
    if not centre.size:
        return WakeWedges(centre, orientation, centre, centre > 0, np.zeros(len(centre_m), bool))
    component, wake = _link(centre_m, points, length_m, centre, orientation)
    is_end = _ends(centre_m, centre, orientation, component)
    covered = _covered(centre_m, length_m, centre, orientation)
    covered[centre] = True
    covered[centre[is_end]] = False
    return WakeWedges(centre, orientation, np.unique(wake, return_inverse=True)[1], is_end, covered)


def _ends(centre_m: FloatArray, centre: IntArray, orientation: IntArray, component: IntArray) -> BoolArray:
    """Whether the apex of each wedge is the end of its component."""
    _, group = np.unique(component, return_inverse=True)
    phi = orientation * STEP
    east = np.bincount(group, np.sin(phi))
    north = np.bincount(group, np.cos(phi))
    mean = np.arctan2(east, north)[group]
    along = centre_m[centre, 0] * np.cos(mean) + centre_m[centre, 1] * np.sin(mean)
    order = np.lexsort((centre, along, group))
    first = order[np.unique(group[order], return_index=True)[1]]
    end: BoolArray = centre == centre[first][group]
    return end


@compiled
def wedge_counts(centre_m: FloatArray, points: Strips, length_m: float, short_m: float) -> IntArray:
    """(2, n_centres, 36) how many points lie in the wedges of either length.

    The wedge k reaches from 10 (k - 1) up to 10 (k + 1) degrees, 0 < |p - c| <= length.
    """
    counts = np.zeros((2, centre_m.shape[0], ORIENTATIONS), np.int64)
    sector = np.zeros((2, ORIENTATIONS), np.int64)
    for i in range(centre_m.shape[0]):
        x, y = centre_m[i]
        sector[:] = 0
        for strip in range(-1, 2):
            for p in range(*_interval(points, x, y, length_m, strip)):
                dx, dy = points.position_m[p, 0] - x, points.position_m[p, 1] - y
                square = dx * dx + dy * dy
                if 0.0 < square <= length_m * length_m:
                    k = _sector(dx, dy)
                    sector[0, k] += 1
                    sector[1, k] += square <= short_m * short_m
        for k in range(ORIENTATIONS):
            counts[0, i, k] = sector[0, k] + sector[0, k - 1]
            counts[1, i, k] = sector[1, k] + sector[1, k - 1]
    return counts


@compiled
def _interval(points: Strips, x: float, y: float, length_m: float, strip: int) -> tuple[int, int]:
    """Which points can lie within `length_m` of (x, y) in its own strip (0), the one before or behind."""
    key = (np.floor(y / length_m) + strip) * points.pitch_m + (x - points.origin_m)
    first = np.searchsorted(points.key, key - length_m)
    return first, np.searchsorted(points.key, key + length_m, side="right")


@compiled
def _sector(dx: float, dy: float) -> int:
    """Which sector from 10 k to 10 (k + 1) degrees the direction lies in; much faster than arctan2."""
    across, along = abs(dy), abs(dx)
    k = 0
    for j in range(8):
        k += across > TANGENTS[j] * along
    if dy >= 0.0:
        return k if dx >= 0.0 else 17 - k
    return 18 + k if dx < 0.0 else 35 - k


@compiled
def _in_wedge(dx: float, dy: float, length_m: float, orientation: int) -> bool:
    if not 0.0 < dx * dx + dy * dy <= length_m * length_m:
        return False
    k = _sector(dx, dy)
    return k == orientation or (k + 1) % ORIENTATIONS == orientation


@compiled
def _covered(centre_m: FloatArray, length_m: float, centre: IntArray, orientation: IntArray) -> BoolArray:
    covered = np.zeros(centre_m.shape[0], np.bool_)
    for w in range(centre.size):
        x, y = centre_m[centre[w]]
        for i in range(centre_m.shape[0]):
            if not covered[i]:
                covered[i] = _in_wedge(centre_m[i, 0] - x, centre_m[i, 1] - y, length_m, orientation[w])
    return covered


@compiled
def _link(
    centre_m: FloatArray, points: Strips, length_m: float, centre: IntArray, orientation: IntArray
) -> tuple[IntArray, IntArray]:
    """Component and wake of each wedge: the smallest index of a wedge that it is linked to."""
    component, wake = np.arange(centre.size), np.arange(centre.size)
    holder = np.full((points.key.size, ORIENTATIONS), -1, np.int32)  # a wedge so orientated with the point
    for w in range(centre.size):
        x, y = centre_m[centre[w]]
        for strip in range(-1, 2):
            for p in range(*_interval(points, x, y, length_m, strip)):
                dx, dy = points.position_m[p, 0] - x, points.position_m[p, 1] - y
                if _in_wedge(dx, dy, length_m, orientation[w]):
                    if holder[p, orientation[w]] < 0:
                        holder[p, orientation[w]] = w
                    _join(component, holder[p, orientation[w]], w)
                    _join(wake, holder[p, orientation[w]], w)
    _link_turned(holder, component, wake)
    for w in range(centre.size):
        component[w], wake[w] = _root(component, w), _root(wake, w)
    return component, wake


@compiled
def _link_turned(holder: npt.NDArray[np.int32], component: IntArray, wake: IntArray) -> None:
    """Link wedges that hold the same point, up to 20 degrees apart or as near to opposite."""
    for p in range(holder.shape[0]):
        for k in range(ORIENTATIONS):
            if holder[p, k] < 0:
                continue
            for turn in (1, 2, 16, 17, 18, 19, 20):
                other = holder[p, (k + turn) % ORIENTATIONS]
                if other >= 0:
                    _join(wake, holder[p, k], other)
                if other >= 0 and turn <= 2:
                    _join(component, holder[p, k], other)


@compiled
def _join(parent: IntArray, a: int, b: int) -> None:
    a, b = _root(parent, a), _root(parent, b)
    if a != b:
        parent[max(a, b)] = min(a, b)


@compiled
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
