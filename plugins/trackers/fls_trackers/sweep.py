"""In which order to sum over the pairs of a cluster, so that few of its tracks and measurements are open."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["Sweep", "plan"]

IntArray = npt.NDArray[np.int64]

NEVER = 1 << 40  # the cost of an end that cannot be next


class Sweep(NamedTuple):
    """An order in which the pairs of a cluster are summed, each at the one of its ends that comes first.

    An end is a track, or n plus the number of a measurement. It is open, and has a bit that tells whether it
    is taken, while some of its pairs are summed and some are not.
    """

    width: int  # bits; with more than were allowed there is no such sweep, and the rest means nothing
    end: IntArray  # (k,) the end whose remaining pairs a step sums
    own: IntArray  # (k,) the mask of its bit; 0: it is not open
    closed: IntArray  # (k,) the mask of the bits that are not needed after the step
    step: IntArray  # (k + 1,) a step's pairs are pair[step[i]:step[i + 1]]
    pair: IntArray  # (pairs,)
    bit: IntArray  # (pairs,) the mask of the bit of a pair's other end; 0: that has no other pair


class _Ends(NamedTuple):
    """Of each end, where its pairs begin; the pairs; the ends that these lead to."""

    start: IntArray  # (n + m + 1,)
    pair: IntArray  # (2 pairs,)
    other: IntArray  # (2 pairs,)


@compiled
def plan(first: IntArray, detection: IntArray, m: int, max_open: int) -> Sweep:
    """A sweep that keeps few ends open at a time; greedily, the one next to it that adds the fewest bits."""
    n, pairs = first.size - 1, detection.size
    ends = _ends(first, detection, m)
    left = ends.start[1:] - ends.start[:-1]
    mask, holder = np.zeros(n + m, np.int64), np.full(max_open + 1, -1)
    end, own, closed = np.empty(n + m, np.int64), np.empty(n + m, np.int64), np.zeros(n + m, np.int64)
    step, pair, bit = np.zeros(n + m + 1, np.int64), np.empty(pairs, np.int64), np.full(pairs, -1)
    k, summed, width = 0, 0, 0
    while summed < pairs and width <= max_open:
        v = _next_end(ends, left, mask, bit, holder)
        if v < 0:
            width = max_open + 1
            break
        end[k], own[k], closed[k] = v, mask[v], mask[v]
        for i in range(ends.start[v], ends.start[v + 1]):
            e, w = ends.pair[i], ends.other[i]
            if bit[e] >= 0:
                continue
            if mask[w] == 0 and left[w] > 1:
                width = max(width, _open(w, mask, holder))
                if width > max_open:
                    break
            pair[summed], bit[e] = e, mask[w]
            summed += 1
            left[w] -= 1
            if left[w] == 0:
                closed[k] |= mask[w]
        left[v] = 0
        for b in range(holder.size):
            if closed[k] >> b & 1:
                holder[b] = -1
        k += 1
        step[k] = summed
    return Sweep(width, end[:k].copy(), own[:k].copy(), closed[:k].copy(), step[: k + 1].copy(), pair, bit)


@compiled
def _ends(first: IntArray, detection: IntArray, m: int) -> _Ends:
    n, pairs = first.size - 1, detection.size
    start = np.zeros(n + m + 1, np.int64)
    start[: n + 1] = first
    for j in detection:
        start[n + j + 1] += 1
    for v in range(n, n + m):
        start[v + 1] += start[v]
    pair, other = np.empty(2 * pairs, np.int64), np.empty(2 * pairs, np.int64)
    place = start[n:].copy()
    for t in range(n):
        for e in range(first[t], first[t + 1]):
            pair[e], other[e] = e, n + detection[e]
            i = place[detection[e]]
            pair[i], other[i] = e, t
            place[detection[e]] += 1
    return _Ends(start, pair, other)


@compiled
def _open(w: int, mask: IntArray, holder: IntArray) -> int:
    """Give the end w the lowest free bit; the number of bits that this takes."""
    b = 0
    while b < holder.size - 1 and holder[b] >= 0:
        b += 1
    holder[b], mask[w] = w, 1 << b
    return b + 1


@compiled
def _next_end(ends: _Ends, left: IntArray, mask: IntArray, bit: IntArray, holder: IntArray) -> int:
    """The cheapest of the open ends and those that they lead to; of all, when none is open; -1: none."""
    best, least, some = -1, NEVER, False
    for v in holder:
        if v < 0:
            continue
        some = True
        cost = _cost(v, ends, left, mask, bit, holder.size - 1)
        if cost < least:
            best, least = v, cost
        for i in range(ends.start[v], ends.start[v + 1]):
            cost = (
                NEVER
                if bit[ends.pair[i]] >= 0
                else _cost(ends.other[i], ends, left, mask, bit, holder.size - 1)
            )
            if cost < least:
                best, least = ends.other[i], cost
    for v in range(0 if some else left.size):
        cost = _cost(v, ends, left, mask, bit, holder.size - 1)
        if cost < least:
            best, least = v, cost
    return best


@compiled
def _cost(v: int, ends: _Ends, left: IntArray, mask: IntArray, bit: IntArray, max_open: int) -> int:
    """How many bits the end would add, net of those it frees; a leaf waits for the end that it hangs on."""
    new, freed = 0, int(mask[v] != 0)
    for i in range(ends.start[v], ends.start[v + 1] if left[v] else 0):
        if bit[ends.pair[i]] >= 0:
            continue
        w = ends.other[i]
        if left[v] == 1 and left[w] > 1:
            return NEVER
        new += mask[w] == 0 and left[w] > 1
        freed += mask[w] != 0 and left[w] == 1
        if new > max_open:
            return NEVER
    return 64 * (new - freed) + new if left[v] else NEVER
