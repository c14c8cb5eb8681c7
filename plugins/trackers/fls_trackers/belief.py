"""Loopy belief propagation: association probabilities of a cluster in bounded time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["propagate"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MAX_ROUNDS = 300
MIN_ROUNDS = 10


@compiled
def propagate(
    first: IntArray, detection: IntArray, ratio: FloatArray, m: int, budget: IntArray
) -> tuple[FloatArray, FloatArray]:
    """beta (pairs,) and beta_none (n,), approximately; the arrays of a cluster as in `events`.

    `budget` (1,) are the messages left for this scan; a cluster uses at most half of them, but ten rounds.

    mu = ratio / (1 + sum of ratio nu of the track's other pairs), nu = 1 / (1 + sum of mu of the
    measurement's other pairs), until nu changes by less than 1e-9.

    Source: Williams & Lau 2014.
    """
    pairs = ratio.size
    nu, mu, heard = np.ones(pairs), np.zeros(pairs), np.zeros(m)
    for _ in range(max(MIN_ROUNDS, min(MAX_ROUNDS, budget[0] // (2 * pairs)))):
        budget[0] = max(0, budget[0] - pairs)
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
    weight = ratio * nu
    beta_none = np.empty(first.size - 1)
    for t in range(first.size - 1):
        total = 1.0 + weight[first[t] : first[t + 1]].sum()
        beta_none[t] = 1.0 / total
        weight[first[t] : first[t + 1]] /= total
    return weight, beta_none


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
