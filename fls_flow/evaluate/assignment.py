"""Pairs of rows within a distance, and the best one-to-one choice among them, for all pings at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from fls_flow.evaluate.scene import Points

__all__ = ["Contest", "Pairs", "best", "contests", "pairs_within"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

PAIRS_AT_ONCE = 2_000_000  # candidates in memory at a time


@dataclass(frozen=True, eq=False)
class Pairs:
    """Rows of two sets of points in the same ping, in order of ping."""

    ping: IntArray  # (n,)
    left: IntArray  # (n,) row of the targets
    right: IntArray  # (n,) row of the tracks
    distance_m: FloatArray  # (n,)

    def select(self, which: BoolArray) -> Pairs:
        """Those that a mask selects."""
        return Pairs(self.ping[which], self.left[which], self.right[which], self.distance_m[which])


def pairs_within(left: Points, right: Points, limit_m: float) -> Pairs:
    """All pairs of one ping that are at most `limit_m` apart; both sets in order of ping."""
    first = np.searchsorted(right.ping, left.ping, side="left")
    count = np.searchsorted(right.ping, left.ping, side="right") - first
    total = np.concatenate([[0], np.cumsum(count)])
    found = []
    begin = 0
    while begin < len(left):
        end = int(np.searchsorted(total, total[begin] + PAIRS_AT_ONCE, side="right")) - 1
        end = max(end, begin + 1)
        rows = np.repeat(np.arange(begin, end), count[begin:end])
        others = np.arange(rows.size) - (total[rows] - total[begin]) + first[rows]
        gap = left.position_m[rows] - right.position_m[others]
        distance = np.hypot(gap[:, 0], gap[:, 1])
        near = distance <= limit_m
        found.append((rows[near], others[near], distance[near]))
        begin = end
    rows, others, distance = (
        (np.concatenate(part) for part in zip(*found, strict=True))
        if found
        else (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    )
    return Pairs(left.ping[rows], rows, others, distance)


def best(group: IntArray, left: IntArray, right: IntArray, gain: FloatArray) -> BoolArray:
    """(n,) the one-to-one choice of greatest gain in each group.

    `group` does not decrease, and left and right numbers of a later group are greater. Pairs without gain are
    not chosen. Pairs that share neither side with another need no search.
    """
    chosen = gain > 0.0
    for contest in contests(group, left, right, chosen):
        chosen[contest.rows] = contest.choose(gain[contest.rows])
    return chosen


@dataclass(frozen=True, slots=True)
class Contest:
    """Pairs of one group that share their left or right with another."""

    rows: IntArray  # (n,)
    place: tuple[IntArray, IntArray]  # of each in the table of gains
    shape: tuple[int, int]

    def choose(self, gain: FloatArray) -> BoolArray:
        """(n,) the one-to-one choice of greatest gain."""
        chosen = np.zeros(gain.size, bool)
        if 1 in self.shape:
            chosen[np.argmax(gain)] = True
            return chosen
        table = np.zeros(self.shape)
        table[self.place] = gain
        taken = np.zeros(self.shape, bool)
        taken[linear_sum_assignment(table, maximize=True)] = True
        return np.asarray(taken[self.place])


def contests(group: IntArray, left: IntArray, right: IntArray, among: BoolArray) -> Iterator[Contest]:
    """The contested pairs `among` all, group by group; the other pairs of them can be taken as they are."""
    open_ = among & ~_uncontested(left, right, among)
    rows = np.flatnonzero(open_)
    if not rows.size:
        return
    begin = np.concatenate([[0], np.flatnonzero(np.diff(group[rows])) + 1])
    end = np.append(begin[1:], rows.size)
    places, sizes = zip(*(_within(side[rows], begin, end) for side in (left, right)), strict=True)
    for a, b, m, n in zip(begin.tolist(), end.tolist(), *(size.tolist() for size in sizes), strict=True):
        yield Contest(rows[a:b], (places[0][a:b], places[1][a:b]), (m, n))


def _within(side: IntArray, begin: IntArray, end: IntArray) -> tuple[IntArray, IntArray]:
    """The rank of each number among those of its group, and how many each group has."""
    _, rank = np.unique(side, return_inverse=True)
    least, most = np.minimum.reduceat(rank, begin), np.maximum.reduceat(rank, begin)
    return rank - np.repeat(least, end - begin), most - least + 1


def _uncontested(left: IntArray, right: IntArray, among: BoolArray) -> BoolArray:
    """(n,) whether no other pair `among` them has the same left or right."""
    sides = []
    for side in (left, right):
        _, inverse = np.unique(side, return_inverse=True)
        count = np.bincount(inverse, weights=among, minlength=1)
        sides.append(count[inverse] <= 1)
    return np.asarray(sides[0] & sides[1])
