"""Exact sums over all joint events of a cluster: tracks one by one, the state a set of taken measurements.

Arrays of a cluster: track i has the pairs first[i] to first[i + 1]; a pair has a `detection`, numbered from 0
in the cluster, and a `ratio`, its weight against a miss.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["all_events", "plan"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@compiled
def plan(
    first: IntArray, detection: IntArray, m: int, max_shared: int
) -> tuple[IntArray, IntArray, IntArray, int]:
    """An order of the tracks that keeps few measurements shared at a time.

    Gives the order (n,); the bit of each pair's measurement (-1 when no other track gates it); the bits that
    end with each track (n,), as a mask; and the number of bits, max_shared + 1 if max_shared don't do.
    """
    n = first.size - 1
    count, slot = np.zeros(m, np.int64), np.full(m, -1)
    for j in detection:
        count[j] += 1
    order, done, ends = np.empty(n, np.int64), np.zeros(n, np.bool_), np.zeros(n, np.int64)
    bit = np.full(detection.size, -1)
    used, width = 0, 0
    for i in range(n):
        t = _next_track(first, detection, done, count, slot, max_shared)
        if t < 0:
            return order, bit, ends, max_shared + 1
        order[i], done[t] = t, True
        for e in range(first[t], first[t + 1]):
            j = detection[e]
            if slot[j] < 0 and count[j] > 1:
                slot[j] = _lowest_free(used)
                used |= 1 << slot[j]
                width = max(width, slot[j] + 1)
            bit[e] = slot[j]
        if width > max_shared:
            return order, bit, ends, max_shared + 1
        for e in range(first[t], first[t + 1]):
            count[detection[e]] -= 1
            if bit[e] >= 0 and count[detection[e]] == 0:
                ends[t] |= 1 << bit[e]
        used &= ~ends[t]
    return order, bit, ends, width


@compiled
def _lowest_free(used: int) -> int:
    free = 0
    while used >> free & 1:
        free += 1
    return free


@compiled
def _next_track(
    first: IntArray, detection: IntArray, done: BoolArray, count: IntArray, slot: IntArray, max_shared: int
) -> int:
    """The track that adds the fewest bits, net of those it frees; -1 if one alone needs too many."""
    best, best_cost = -1, 1 << 40
    for t in range(done.size):
        if done[t]:
            continue
        new = freed = 0
        for e in range(first[t], first[t + 1]):
            j = detection[e]
            new += slot[j] < 0 and count[j] > 1
            freed += slot[j] >= 0 and count[j] == 1
        if new > max_shared:
            return -1
        cost = 64 * (new - freed) + new
        if cost < best_cost:
            best, best_cost = t, cost
    return best


@compiled
def all_events(
    order: IntArray, first: IntArray, bit: IntArray, ends: IntArray, ratio: FloatArray, width: int
) -> tuple[FloatArray, FloatArray]:
    """beta (pairs,) and beta_none (n,), from the events of the tracks before each one and after it.

    With a_i(S) the sum over the tracks before i that take the set S, b_i(S) that over those after it, given
    S is taken: beta_ij ~ ratio_ij sum_(S without j) a_i(S) b_i(S with j), beta_i0 ~ sum_S a_i(S) b_i(S).
    """
    n, states = order.size, 1 << width
    before = np.zeros((n, states))
    before[0, 0] = 1.0
    for i in range(n - 1):
        t = order[i]
        _take(before[i], before[i + 1], first[t], first[t + 1], bit, ratio)
        _forget(before[i + 1], ends[t])
    beta, beta_none = np.empty(ratio.size), np.empty(n)
    after, spare = np.ones(states), np.empty(states)
    for i in range(n - 1, -1, -1):
        t = order[i]
        for s in range(states if ends[t] else 0):
            after[s] = after[s & ~ends[t]]
        none = (before[i] * after).sum()
        total = none
        for e in range(first[t], first[t + 1]):
            beta[e] = ratio[e] * _joined(before[i], after, bit[e], none)
            total += beta[e]
        beta_none[t] = none / total
        for e in range(first[t], first[t + 1]):
            beta[e] /= total
        _give(after, spare, first[t], first[t + 1], bit, ratio)
        after, spare = spare, after
    return beta, beta_none


@compiled
def _take(
    before: FloatArray, after: FloatArray, low: int, high: int, bit: IntArray, ratio: FloatArray
) -> None:
    """The sums with one track more: it takes a measurement that is free, one of its own, or none."""
    own = 1.0
    for e in range(low, high):
        if bit[e] < 0:
            own += ratio[e]
    for s in range(before.size):
        after[s] = own * before[s]
    for e in range(low, high):
        b = 1 << max(bit[e], 0)
        for s in range(before.size if bit[e] >= 0 else 0):
            if not s & b:
                after[s | b] += ratio[e] * before[s]


@compiled
def _forget(sums: FloatArray, ends: int) -> None:
    """Fold the states that differ only in the bits `ends`, and scale the sums to 1."""
    for s in range(sums.size if ends else 0):
        if s & ends:
            sums[s & ~ends] += sums[s]
            sums[s] = 0.0
    sums /= sums.sum()


@compiled
def _joined(before: FloatArray, after: FloatArray, bit: int, none: float) -> float:
    """The events in which the measurement of `bit` is free for the track; all of them if none shares it."""
    if bit < 0:
        return none
    total, b = 0.0, 1 << bit
    for s in range(before.size):
        if not s & b:
            total += before[s] * after[s | b]
    return total


@compiled
def _give(
    after: FloatArray, before: FloatArray, low: int, high: int, bit: IntArray, ratio: FloatArray
) -> None:
    """`_take` the other way round: from the sums after a track to those that include it, scaled."""
    own = 1.0
    for e in range(low, high):
        if bit[e] < 0:
            own += ratio[e]
    for s in range(after.size):
        before[s] = own * after[s]
    for e in range(low, high):
        b = 1 << max(bit[e], 0)
        for s in range(after.size if bit[e] >= 0 else 0):
            if not s & b:
                before[s] += ratio[e] * after[s | b]
    before /= before.max()
