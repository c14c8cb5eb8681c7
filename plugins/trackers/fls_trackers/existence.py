"""Tentative tracks weigh by how probable it is that their objects exist; compiled."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.track_bank import Ledger

__all__ = ["chances", "given_existence", "weighted"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

TENTATIVE = 0  # TrackStatus, as the compiler takes it
SURE = 3.0  # log odds of existence at the score that confirms: 20 to 1
LEAST = 1e-9


@compiled
def chances(ledger: Ledger, start_score: float) -> FloatArray:
    """How probable each track's object is, (n,): 1 of a confirmed track, of a tentative one by its score.

    The odds are e^(score - start_score + SURE); without a score to reach (-inf) all are 1.
    """
    chance = np.ones(ledger.size)
    for t in range(ledger.size):
        if ledger[t].status == TENTATIVE:
            chance[t] = max(LEAST, 1.0 / (1.0 + math.exp(start_score - SURE - ledger[t].score)))
    return chance


@compiled
def weighted(start: IntArray, likelihood: FloatArray, chance: FloatArray, miss: float) -> FloatArray:
    """Likelihoods (pairs,), those of track t times chance miss / (1 - chance (1 - miss)).

    With them a pair's weight against none is chance p_d N / (density (1 - chance p_d p_g)), so that a track
    that hardly exists takes nothing from another. miss = 1 - p_d p_g.

    Source: Musicki & Evans 2004 (joint integrated probabilistic data association).
    """
    weight = likelihood.copy()
    for t in range(chance.size):
        if chance[t] < 1.0:
            weight[start[t] : start[t + 1]] *= _unseen(chance[t], miss)
    return weight


@compiled
def given_existence(
    start: IntArray,
    places: IntArray,
    beta: FloatArray,
    beta_none: FloatArray,
    taken: FloatArray,
    chance: FloatArray,
    miss: float,
) -> None:
    """Turns the probabilities that come of `weighted` likelihoods into those of tracks that exist.

    beta_none (n,) counts that an object is missed, and that there is none: only the first part of it is left,
    chance miss / (1 - chance (1 - miss)), and beta (pairs,) grows as much; so does taken (m,), the sum of a
    measurement's beta. miss / beta_none is then the odds of existence after the ping over those before.
    """
    for t in range(chance.size):
        if chance[t] < 1.0:
            missed = beta_none[t] * _unseen(chance[t], miss)
            there = beta[start[t] : start[t + 1]].sum() + missed
            beta_none[t] = missed / there
            for e in range(start[t], start[t + 1]):
                taken[places[e]] += beta[e] * (1.0 / there - 1.0)
                beta[e] /= there


@compiled
def _unseen(chance: float, miss: float) -> float:
    """The probability that an object is there, of which nothing is seen."""
    return chance * miss / (1.0 - chance * (1.0 - miss))
