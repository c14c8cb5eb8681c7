"""Join the cells that one object covers to one detection."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = ["Objects", "around", "linked", "objects"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

SQRT2 = 1.4142136  # a hair more than the root: squares of side link / SQRT2 have a shorter diagonal


class Objects(NamedTuple):
    """The n objects of a ping, in order of range."""

    range_m: FloatArray
    bearing_rad: FloatArray
    amplitude: FloatArray  # of the strongest cell, or the root of all cells' energy
    extent: FloatArray  # (n, 2): m, rad, from the first to the last cell
    covariance: FloatArray  # (n, 2, 2) of the cells about their mean, with one cell and one beam added


def objects(
    range_m: FloatArray,
    bearing_rad: FloatArray,
    strength: FloatArray,
    weight: FloatArray,
    member: IntArray,
    *,
    cell_sd: tuple[float, float],
    counted: BoolArray,
    min_cells: int,
    energy: bool,
) -> Objects:
    """The groups of cells (n,) that `member` numbers, those with at least `min_cells` `counted` (n,) ones.

    Mean and covariance are weighted by `weight` (positive); `cell_sd` squared (m, rad) is added to the
    variances. The amplitude is the largest `strength`, or the root of the sum of weights (`energy`).
    """
    n = int(member.max(initial=-1)) + 1
    r, b, w = range_m, bearing_rad, weight
    total = np.bincount(member, w, n)
    mean = np.stack([np.bincount(member, w * x, n) / total for x in (r, b)], axis=1)
    off = np.stack([r, b], axis=1) - mean[member]
    covariance = np.empty((n, 2, 2))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        covariance[:, i, j] = np.bincount(member, w * off[:, i] * off[:, j], n) / total
    covariance[:, [0, 1], [0, 1]] += np.square(np.nan_to_num(cell_sd))
    extent = np.stack([_spread(x, member, n) for x in (r, b)], axis=1)
    strongest = np.full(n, -np.inf)
    np.maximum.at(strongest, member, strength)
    if energy:
        strongest = np.sqrt(total)
    kept = np.flatnonzero(np.bincount(member, counted, n) >= min_cells)
    kept = kept[np.lexsort((mean[kept, 1], mean[kept, 0]))]
    return Objects(mean[kept, 0], mean[kept, 1], strongest[kept], extent[kept], covariance[kept])


def _spread(values: FloatArray, member: IntArray, n: int) -> FloatArray:
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, member, values)
    np.maximum.at(high, member, values)
    return np.asarray(high - low)


def around(position_m: FloatArray, weight: FloatArray, reach_m: float) -> IntArray:
    """(n,) the group of each point (n, 2): the heaviest one that is in none leads the next, of all in reach.

    Those within `reach_m` of the leader that are in no group join it, so that no group is wider than twice
    that. Groups are numbered by their weights, heaviest leader first.
    """
    order = np.argsort(-weight, kind="stable")
    group = np.empty(order.size, np.int64)
    group[order] = _around(frozen(position_m[order]), reach_m)
    return group


@compiled
def _around(position_m: FloatArray, reach_m: float) -> IntArray:
    """The groups of points in order of weight; each joins the first leader in reach."""
    n = position_m.shape[0]
    group, leader = np.empty(n, np.int64), np.empty(n, np.int64)
    k = 0
    for i in range(n):
        group[i] = k
        for g in range(k):
            dx = position_m[i, 0] - position_m[leader[g], 0]
            dy = position_m[i, 1] - position_m[leader[g], 1]
            if dx * dx + dy * dy <= reach_m * reach_m:
                group[i] = g
                break
        if group[i] == k:
            leader[k] = i
            k += 1
    return group


def linked(position_m: FloatArray, link_m: float) -> IntArray:
    """(n,) the group of each point (n, 2): those nearer than `link_m` are in one, and so on (single linkage).

    Groups are numbered by their first points.
    """
    square = np.floor(position_m / (link_m / SQRT2)).astype(np.int64)
    square -= square.min(axis=0, initial=0)
    width = int(square[:, 1].max(initial=0)) + 5  # so that no neighbour's key is that of another row
    key = (square[:, 0] + 2) * width + square[:, 1] + 2
    order = np.argsort(key, kind="stable")
    keys, start = np.unique(key[order], return_index=True)
    bounds = np.append(start, order.size).astype(np.int64)
    group = _link(frozen(position_m[order]), frozen(keys), frozen(bounds), width, link_m)
    root = np.empty(order.size, np.int64)
    root[order] = group
    _, first, member = np.unique(root, return_index=True, return_inverse=True)
    rank = np.empty(first.size, np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(first.size)
    return np.asarray(rank[member.reshape(-1)], np.int64)


@compiled
def _link(position_m: FloatArray, keys: IntArray, bounds: IntArray, width: int, link_m: float) -> IntArray:
    """The roots of the points, sorted by square; points in one square are near enough by its diagonal."""
    n_squares = keys.size
    parent = np.arange(n_squares)
    for a in range(n_squares):
        for dc in range(3):
            for dr in range(-2, 3):
                if dc == 0 and dr <= 0:
                    continue
                b = int(np.searchsorted(keys, keys[a] + dc * width + dr))
                if b == n_squares or keys[b] != keys[a] + dc * width + dr:
                    continue
                one, other = _root(parent, a), _root(parent, b)
                if one != other and _touch(position_m, bounds, a, b, link_m):
                    parent[max(one, other)] = min(one, other)
    root = np.empty(position_m.shape[0], np.int64)
    for a in range(n_squares):
        root[bounds[a] : bounds[a + 1]] = _root(parent, a)
    return root


@compiled
def _root(parent: IntArray, a: int) -> int:
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@compiled
def _touch(position_m: FloatArray, bounds: IntArray, a: int, b: int, link_m: float) -> bool:
    """Whether a point of one square is nearer than `link_m` to a point of the other."""
    for i in range(bounds[a], bounds[a + 1]):
        for j in range(bounds[b], bounds[b + 1]):
            dx, dy = position_m[i, 0] - position_m[j, 0], position_m[i, 1] - position_m[j, 1]
            if dx * dx + dy * dy < link_m * link_m:
                return True
    return False
