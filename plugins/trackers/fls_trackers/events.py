"""Exact sums over all joint events of a cluster: its tracks and measurements swept one by one.

Arrays of a cluster: track t has the pairs first[t] to first[t + 1]; a pair has a `ratio`, its weight against
a miss. The state between two steps of a sweep is the set of open tracks and measurements that are taken.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.sweep import Sweep

__all__ = ["all_events"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@compiled
def all_events(first: IntArray, ratio: FloatArray, sweep: Sweep) -> tuple[FloatArray, FloatArray]:
    """beta (pairs,) and beta_none (n,), from the events of the pairs before each step and after it.

    With a_i(S) the sum over the pairs before step i that take the open ends S, b_i(S) that over those from
    the step on, given S is taken: beta_e ~ ratio_e sum_(S without the ends of e) a_i(S) b_(i+1)(S with them).
    """
    n, steps, states = first.size - 1, sweep.end.size, 1 << sweep.width
    track = np.repeat(np.arange(n), first[1:] - first[:-1])
    before = np.zeros((steps, states))
    beta, beta_none = np.empty(ratio.size), np.ones(n)
    if steps == 0:
        return beta, beta_none
    before[0, 0] = 1.0
    for i in range(steps - 1):
        _take(before[i], before[i + 1], sweep, i, ratio)
        _forget(before[i + 1], sweep.closed[i])
    after, spare = np.ones(states), np.empty(states)
    for i in range(steps - 1, -1, -1):
        for s in range(states if sweep.closed[i] else 0):
            after[s] = after[s & ~sweep.closed[i]]
        none, used = _shares(before[i], after, sweep, i, ratio, beta)
        total = none + used + _but(-1, sweep, i, beta)
        if sweep.end[i] < n:
            beta_none[sweep.end[i]] = none / total
        else:
            _take(before[i], spare, sweep, i, ratio)
            _leave(spare, after, sweep, i, track, beta, none + used, total, beta_none)
        for e in sweep.pair[sweep.step[i] : sweep.step[i + 1]]:
            beta[e] /= total
        _give(after, spare, sweep, i, ratio)
        after, spare = spare, after
    return beta, beta_none


@compiled
def _take(before: FloatArray, after: FloatArray, sweep: Sweep, i: int, ratio: FloatArray) -> None:
    """The sums with step i: its end, if it is free, takes a pair whose other end is free, or none."""
    own, alone = sweep.own[i], _alone(sweep, i, ratio)
    for s in range(before.size):
        after[s] = before[s] if s & own else alone * before[s]
    for e in sweep.pair[sweep.step[i] : sweep.step[i + 1]]:
        b = sweep.bit[e]
        for s in range(before.size if b else 0):
            if not s & (b | own):
                after[s | b] += ratio[e] * before[s]


@compiled
def _alone(sweep: Sweep, i: int, ratio: FloatArray) -> float:
    """The weight of the events in which step i takes nothing, or what nothing else can take."""
    weight = 1.0
    for e in sweep.pair[sweep.step[i] : sweep.step[i + 1]]:
        if not sweep.bit[e]:
            weight += ratio[e]
    return weight


@compiled
def _forget(sums: FloatArray, closed: int) -> None:
    """Fold the states that differ only in the bits `closed`, and scale the sums to 1."""
    for s in range(sums.size if closed else 0):
        if s & closed:
            sums[s & ~closed] += sums[s]
            sums[s] = 0.0
    sums /= sums.sum()


@compiled
def _shares(
    before: FloatArray, after: FloatArray, sweep: Sweep, i: int, ratio: FloatArray, beta: FloatArray
) -> tuple[float, float]:
    """Fills the beta of step i, not yet normalised.

    Gives the weights of the events in which its end takes none of its pairs, and took one before.
    """
    own = sweep.own[i]
    none = used = 0.0
    for s in range(before.size):
        if s & own:
            used += before[s] * after[s]
        else:
            none += before[s] * after[s]
    for e in sweep.pair[sweep.step[i] : sweep.step[i + 1]]:
        b, joined = sweep.bit[e], 0.0
        for s in range(before.size if b else 0):
            if not s & (b | own):
                joined += before[s] * after[s | b]
        beta[e] = ratio[e] * (joined if b else none)
    return none, used


@compiled
def _leave(
    taken: FloatArray,
    after: FloatArray,
    sweep: Sweep,
    i: int,
    track: IntArray,
    beta: FloatArray,
    none: float,
    total: float,
    beta_none: FloatArray,
) -> None:
    """Fills beta_none of the tracks whose last pair is in step i, at whose end is a measurement.

    As a sum, not as a difference from 1, it is right however small it is. `taken` are the sums with step i,
    `none` is the weight of the events in which it takes nothing.
    """
    for e in sweep.pair[sweep.step[i] : sweep.step[i + 1]]:
        b = sweep.bit[e]
        if b == 0:
            beta_none[track[e]] = (none + _but(e, sweep, i, beta)) / total
        elif b & sweep.closed[i]:
            weight = 0.0
            for s in range(taken.size):
                weight += 0.0 if s & b else taken[s] * after[s]
            beta_none[track[e]] = weight / total


@compiled
def _but(pair: int, sweep: Sweep, i: int, beta: FloatArray) -> float:
    """The weight of the events in which step i takes another pair than this."""
    weight = 0.0
    for e in sweep.pair[sweep.step[i] : sweep.step[i + 1]]:
        weight += beta[e] if e != pair else 0.0
    return weight


@compiled
def _give(after: FloatArray, before: FloatArray, sweep: Sweep, i: int, ratio: FloatArray) -> None:
    """`_take` the other way round: from the sums after a step to those that include it, scaled."""
    own, alone = sweep.own[i], _alone(sweep, i, ratio)
    for s in range(after.size):
        before[s] = after[s] if s & own else alone * after[s]
    for e in sweep.pair[sweep.step[i] : sweep.step[i + 1]]:
        b = sweep.bit[e]
        for s in range(after.size if b else 0):
            if not s & (b | own):
                before[s] += ratio[e] * after[s | b]
    before /= before.max()
