"""Association probabilities of a cluster in bounded time, by loopy belief propagation in part or in all."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.events import all_events
from fls_trackers.sweep import plan

__all__ = ["bounded", "propagate"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MAX_ROUNDS = 300
MIN_ROUNDS = 10
# Beliefs up to which pairs count by their messages alone: the first that leaves the others narrow enough.
WEAK = (1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 3e-2, 5e-2, 7e-2, 0.1, 0.15, 0.2)


@compiled
def bounded(
    first: IntArray, detection: IntArray, ratio: FloatArray, m: int, max_open: int, budget: IntArray
) -> tuple[FloatArray, FloatArray]:
    """beta (pairs,) and beta_none (n,) of a cluster that is too wide to be summed; its arrays as in `events`.

    Only the messages of weak pairs count: by them, the weight of a track that has none of the other pairs
    grows by ratio nu, that of a measurement that no other pair takes by mu. The others are summed exactly,
    with their ratios divided by the weights at both ends. `budget` (2,) are steps and messages left for the
    scan; without steps enough, beta is what belief propagation gives.
    """
    nu, mu = _messages(first, detection, ratio, m, budget)
    beta, beta_none = _beliefs(first, ratio, nu)
    n = first.size - 1
    for least in WEAK:
        weak = beta <= least
        kept, start = np.flatnonzero(~weak), np.zeros(n + 1, np.int64)
        for t in range(n):
            start[t + 1] = start[t] + (first[t + 1] - first[t]) - weak[first[t] : first[t + 1]].sum()
        sweep = plan(start, detection[kept], m, max_open)
        steps = (kept.size + n) << min(sweep.width, 32)
        if sweep.width <= max_open and steps <= budget[0]:
            budget[0] -= steps
            track = np.repeat(np.arange(n), first[1:] - first[:-1])
            none, free = np.ones(n), np.ones(m)
            for e in np.flatnonzero(weak):
                none[track[e]] += ratio[e] * nu[e]
                free[detection[e]] += mu[e]
            some, left = all_events(start, ratio[kept] / (none[track[kept]] * free[detection[kept]]), sweep)
            beta_none = left / none
            beta = np.where(weak, ratio * nu * beta_none[track], 0.0)
            beta[kept] = some
            break
    return beta, beta_none


@compiled
def propagate(
    first: IntArray, detection: IntArray, ratio: FloatArray, m: int, budget: IntArray
) -> tuple[FloatArray, FloatArray]:
    """beta (pairs,) and beta_none (n,), approximately, from belief propagation alone.

    `budget` (2,): its second number are the messages left for this scan; a cluster uses at most half of them,
    but ten rounds.

    mu = ratio / (1 + sum of ratio nu of the track's other pairs), nu = 1 / (1 + sum of mu of the
    measurement's other pairs), until nu changes by less than 1e-9.

    Source: Williams & Lau 2014.
    """
    nu, _ = _messages(first, detection, ratio, m, budget)
    return _beliefs(first, ratio, nu)


@compiled
def _messages(
    first: IntArray, detection: IntArray, ratio: FloatArray, m: int, budget: IntArray
) -> tuple[FloatArray, FloatArray]:
    pairs = ratio.size
    nu, mu, heard = np.ones(pairs), np.zeros(pairs), np.zeros(m)
    for _ in range(max(MIN_ROUNDS, min(MAX_ROUNDS, budget[1] // (2 * pairs)))):
        budget[1] = max(0, budget[1] - pairs)
        heard[:] = 0.0
        for t in range(first.size - 1):
            _tell(first[t], first[t + 1], detection, ratio, nu, mu, heard)
        change = 0.0
        for e in range(pairs):
            new = 1.0 / (1.0 + max(0.0, heard[detection[e]] - mu[e]))
            change = max(change, abs(new - nu[e]))
            nu[e] = new
        if change < 1e-9:
            break
    return nu, mu


@compiled
def _beliefs(first: IntArray, ratio: FloatArray, nu: FloatArray) -> tuple[FloatArray, FloatArray]:
    beta = ratio * nu
    beta_none = np.empty(first.size - 1)
    for t in range(first.size - 1):
        total = 1.0 + beta[first[t] : first[t + 1]].sum()
        beta_none[t] = 1.0 / total
        beta[first[t] : first[t + 1]] /= total
    return beta, beta_none


@compiled
def _tell(
    low: int,
    high: int,
    detection: IntArray,
    ratio: FloatArray,
    nu: FloatArray,
    mu: FloatArray,
    heard: FloatArray,
) -> None:
    total = 1.0
    for e in range(low, high):
        total += ratio[e] * nu[e]
    for e in range(low, high):
        # At least 1: rounding of a large sum must not take it lower.
        mu[e] = ratio[e] / max(1.0, total - ratio[e] * nu[e])
        heard[detection[e]] += mu[e]
