"""The cheapest assignment of tracks to measurements: shortest augmenting paths, compiled."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["cheapest", "most_probable"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@compiled
def cheapest(cost: FloatArray, miss: FloatArray) -> IntArray:
    """The column of each row (n,), -1 for none, such that the sum of costs is least.

    `cost` (n, m), inf where a pair is forbidden; a row without a column costs `miss` (n,), which is finite:
    so there always is an assignment. Each column goes to at most one row. Among equal sums the choice is
    always the same.

    Source: Jonker & Volgenant 1987, without its start heuristics; each row has a column of its own to miss.
    """
    n, m = cost.shape
    u, v = np.zeros(n), np.zeros(m + n)
    row_of, column_of = np.full(m + n, -1), np.full(n, -1)
    shortest, came_from, done = np.empty(m + n), np.empty(m + n, np.int64), np.empty(m + n, np.bool_)
    for start in range(n):
        shortest[:], done[:] = np.inf, False
        i, base, end = start, 0.0, -1
        while end < 0:
            j = _nearest(i, base, cost, miss, u, v, shortest, came_from, done)
            base, done[j] = shortest[j], True
            i, end = (row_of[j], -1) if row_of[j] >= 0 else (i, j)
        u[start] += base
        for j in range(m + n):
            if done[j] and j != end:
                u[row_of[j]] += base - shortest[j]
                v[j] -= base - shortest[j]
        while end >= 0:
            i = came_from[end]
            row_of[end] = i
            column_of[i], end = end, column_of[i]
    for i in range(n):
        if column_of[i] >= m:
            column_of[i] = -1
    return column_of


@compiled
def _nearest(
    i: int,
    base: float,
    cost: FloatArray,
    miss: FloatArray,
    u: FloatArray,
    v: FloatArray,
    shortest: FloatArray,
    came_from: IntArray,
    done: npt.NDArray[np.bool_],
) -> int:
    """Extend the paths by row i, which lies `base` away; gives the nearest column that is not done."""
    n, m = cost.shape
    best, nearest = np.inf, -1
    for j in range(m + n):
        if done[j]:
            continue
        if j < m or j == m + i:
            step = base + (cost[i, j] if j < m else miss[i]) - u[i] - v[j]
            if step < shortest[j]:
                shortest[j], came_from[j] = step, i
        if shortest[j] < best:
            best, nearest = shortest[j], j
    return nearest


@compiled
def most_probable(
    first: IntArray, detection: IntArray, ratio: FloatArray, m: int
) -> tuple[FloatArray, FloatArray]:
    """1 for the pairs (pairs,) of a cluster's most probable joint event, and for its tracks (n,) with none.

    Arrays of a cluster as in `events`: the event with the largest product of `ratio`, in which a miss counts
    1. So a pair that is less likely than a miss is never chosen.
    """
    n = first.size - 1
    cost = np.full((n, m), np.inf)
    for t in range(n):
        for e in range(first[t], first[t + 1]):
            if ratio[e] > 0.0:
                cost[t, detection[e]] = -np.log(ratio[e])
    chosen = cheapest(cost, np.zeros(n))
    beta, none = np.zeros(ratio.size), np.ones(n)
    for t in range(n):
        for e in range(first[t], first[t + 1]):
            if detection[e] == chosen[t]:
                beta[e], none[t] = 1.0, 0.0
    return beta, none
