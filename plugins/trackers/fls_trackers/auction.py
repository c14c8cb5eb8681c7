"""Which measurement goes to which track: the most pairs, and among those the least total cost."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["Pairs", "auctioned", "solved"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

STEP = 1e-7  # costs are counted in whole steps, so that the auction ends with the exact least
SCALING = 5  # each round of an auction bids this much finer than the one before


class Pairs(NamedTuple):
    """The pairs that may be: track t owns the places start[t] to start[t + 1]."""

    start: IntArray  # (n + 1,)
    places: IntArray  # (pairs,) measurement, increasing within a track
    cost: FloatArray  # (pairs,) not negative


def auctioned(pairs: Pairs, m: int) -> IntArray:
    """The measurement of each track (n,), -1 for none, by auction; `m` is the number of measurements.

    Tracks that share measurements are one market. Its tracks and, so that everyone finds a place, a stand-in
    for each measurement bid for its measurements and for an empty place per track. A bid raises a price by
    the bidder's gain over its second choice plus eps; with whole costs, multiplied by the number of bidders
    plus one, and eps = 1 in the last round the result is exact. Of equally good results it gives one.

    Source: Bertsekas 1998, chapter 7 (auction with eps scaling); Abu 2024 (27), (28), in the reading of
    most pairs first, then least sum.
    """
    got: IntArray = _auctioned(pairs.start, pairs.places, pairs.cost, m)
    return got


def solved(pairs: Pairs, m: int) -> IntArray:
    """What `auctioned` gives, by scipy's shortest augmenting paths; a result of the same cost."""
    from scipy.optimize import linear_sum_assignment  # only if it is asked for: it loads slowly

    n = pairs.start.size - 1
    got = np.full(n, -1, np.int64)
    if not pairs.places.size:
        return got
    beyond = 1.0 + float(pairs.cost.max()) * (min(n, m) + 1)
    matrix = np.full((n, m), beyond)
    track = np.repeat(np.arange(n), np.diff(pairs.start))
    matrix[track, pairs.places] = pairs.cost
    rows, columns = linear_sum_assignment(matrix)
    taken = matrix[rows, columns] < beyond
    got[rows[taken]] = columns[taken]
    return got


@compiled
def _auctioned(start: IntArray, places: IntArray, cost: FloatArray, m: int) -> IntArray:
    n = start.size - 1
    got = np.full(n, -1)
    market = _markets(start, places, m)
    order = np.argsort(market, kind="mergesort")
    local = np.full(m, -1)
    first = 0
    while first < n:
        last = first
        while last < n and market[order[last]] == market[order[first]]:
            last += 1
        members = order[first:last]
        first = last
        if start[members[0] + 1] == start[members[0]]:
            continue  # a track without a measurement is a market of its own
        if members.size == 1:
            t = members[0]
            got[t] = places[start[t] + np.argmin(cost[start[t] : start[t + 1]])]
        else:
            _market(members, start, places, cost, local, got)
    return got


@compiled
def _markets(start: IntArray, places: IntArray, m: int) -> IntArray:
    """The lowest track that each track is linked with by shared measurements, (n,)."""
    n = start.size - 1
    parent, owner = np.arange(n), np.full(m, -1)
    for t in range(n):
        for e in range(start[t], start[t + 1]):
            if owner[places[e]] < 0:
                owner[places[e]] = t
                continue
            a, b = _root(parent, owner[places[e]]), _root(parent, t)
            parent[max(a, b)] = min(a, b)
    for t in range(n):
        parent[t] = _root(parent, t)
    return parent


@compiled
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def _market(
    members: IntArray, start: IntArray, places: IntArray, cost: FloatArray, local: IntArray, got: IntArray
) -> None:
    """Auction among the tracks `members`; `local` (m,) is -1 throughout before and after.

    Bidders are the k tracks, then a stand-in per measurement; objects are the measurements, then k empty
    places. A track may have its measurements or its own empty place, a stand-in its measurement or the empty
    place of a track that might have it.
    """
    k = members.size
    goods, pairs, most = _named(members, start, places, cost, local)
    # More than all costs together: one pair more is always better.
    pair_value = (min(k, goods.size) + 1) * (most + 1)
    size = k + goods.size
    first, objects = np.zeros(size + 1, np.int64), np.empty(2 * pairs + size, np.int64)
    value = np.zeros(objects.size, np.int64)
    count = 0
    for i in range(k):
        for e in range(start[members[i]], start[members[i] + 1]):
            objects[count] = local[places[e]]
            value[count] = (pair_value - int(cost[e] / STEP + 0.5)) * (size + 1)
            count += 1
        objects[count] = goods.size + i
        count += 1
        first[i + 1] = count
    for j in range(goods.size):
        objects[count] = j
        count += 1
        for i in range(k):
            if _may_have(members[i], goods[j], start, places):
                objects[count] = goods.size + i
                count += 1
        first[k + j + 1] = count
    won = _bidding(first, objects, value, size, pair_value * (size + 1))
    for i in range(k):
        got[members[i]] = goods[won[i]] if won[i] < goods.size else -1
    for j in goods:
        local[j] = -1


@compiled
def _named(
    members: IntArray, start: IntArray, places: IntArray, cost: FloatArray, local: IntArray
) -> tuple[IntArray, int, int]:
    """The measurements of a market, numbered in `local`; the number of its pairs; its largest whole cost."""
    pairs, most, count = 0, 0, 0
    for t in members:
        pairs += start[t + 1] - start[t]
    goods = np.empty(pairs, np.int64)
    for t in members:
        for e in range(start[t], start[t + 1]):
            most = max(most, int(cost[e] / STEP + 0.5))
            if local[places[e]] < 0:
                local[places[e]] = count
                goods[count] = places[e]
                count += 1
    return goods[:count].copy(), pairs, most


@compiled
def _may_have(t: int, j: int, start: IntArray, places: IntArray) -> bool:
    """Whether measurement j is among those of track t, which increase."""
    e = start[t] + np.searchsorted(places[start[t] : start[t + 1]], j)
    return bool(e < start[t + 1] and places[e] == j)


@compiled
def _bidding(first: IntArray, objects: IntArray, value: IntArray, size: int, largest: int) -> IntArray:
    """The object of each bidder when nobody can gain more than eps = 1 by another one."""
    price = np.zeros(size, np.int64)
    won, holder = np.full(size, -1), np.full(size, -1)
    waiting = np.empty(size, np.int64)
    eps = max(1, largest // SCALING)
    while True:
        won[:], holder[:] = -1, -1
        waiting[:] = np.arange(size)
        left = size
        while left:
            left -= 1
            i = waiting[left]
            best, second, chosen = -(1 << 62), -(1 << 62), -1
            for e in range(first[i], first[i + 1]):
                gain = value[e] - price[objects[e]]
                if gain > best:
                    best, second, chosen = gain, best, objects[e]
                elif gain > second:
                    second = gain
            price[chosen] += eps + (best - second if second > -(1 << 62) else largest)
            if holder[chosen] >= 0:
                won[holder[chosen]] = -1
                waiting[left] = holder[chosen]
                left += 1
            holder[chosen], won[i] = i, chosen
        if eps == 1:
            return won
        eps = max(1, eps // SCALING)
