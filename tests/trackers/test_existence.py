"""Tracks that may not exist: probabilities beside an enumeration over existence and joint events."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose

from fls_trackers.association import associate
from fls_trackers.existence import SURE, chances, given_existence, weighted
from fls_trackers.gating import Gated
from fls_trackers.track_bank import new_tracks

P_D, P_G = 0.9, 0.98
MISS = 1.0 - P_D * P_G
FloatArray = npt.NDArray[np.float64]


def enumerated(
    likelihood: FloatArray, density: FloatArray, chance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(n, 1 + m) probabilities of a miss and of each measurement given existence, and of existence (n,)."""
    n, m = likelihood.shape
    joint, total = np.zeros((n, m + 1)), 0.0
    for event in itertools.product(range(-2, m), repeat=n):  # -2: not there, -1: missed
        taken = [j for j in event if j >= 0]
        if len(set(taken)) < len(taken):
            continue
        weight = 1.0
        for t, j in enumerate(event):
            if j < 0:
                weight *= chance[t] * MISS if j == -1 else 1.0 - chance[t]
            else:
                weight *= chance[t] * P_D * likelihood[t, j] / density[j]
        total += weight
        for t, j in enumerate(event):
            if j >= -1:
                joint[t, j + 1] += weight
    exists = joint.sum(axis=1)
    return joint / exists[:, None], exists / total


def ours(likelihood: FloatArray, density: FloatArray, chance: FloatArray) -> tuple[FloatArray, FloatArray]:
    n, m = likelihood.shape
    start = m * np.arange(n + 1)
    gated = Gated(start, np.tile(np.arange(m), n), weighted(start, likelihood.ravel(), chance, MISS))
    found = associate(gated, density, np.zeros(n, np.int64), p_d=P_D, p_g=P_G)
    beta, none = found.beta.copy(), found.beta_none.copy()
    given_existence(start, gated.places, beta, none, found.taken.copy(), chance, MISS)
    return np.column_stack([none, beta.reshape(n, m)]), none


@pytest.mark.parametrize("seed", range(40))
def test_probabilities_given_existence_equal_enumeration(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    likelihood, density = 10.0 ** rng.uniform(-3, 1, (n, m)), 10.0 ** rng.uniform(-3, -1, m)
    chance = np.where(rng.random(n) < 0.3, 1.0, rng.uniform(0.001, 0.999, n))
    expected, exists = enumerated(likelihood, density, chance)
    table, none = ours(likelihood, density, chance)
    assert_allclose(table, expected, rtol=1e-9)
    # The score, log(miss / none), is the growth of the log odds of existence.
    unsure = chance < 1.0
    odds = chance[unsure] / (1.0 - chance[unsure])
    grown = exists[unsure] / (1.0 - exists[unsure]) / odds
    assert_allclose(MISS / none[unsure], grown, rtol=1e-6)


def test_alone_a_track_does_not_care_how_probable_it_is() -> None:
    likelihood, density = np.array([[0.3, 2.0]]), np.array([0.1, 0.2])
    sure, _ = ours(likelihood, density, np.ones(1))
    unsure, _ = ours(likelihood, density, np.array([1e-6]))
    assert_allclose(unsure, sure, rtol=1e-9)


def test_a_newcomer_takes_nothing_from_a_track_that_is_nearly_sure() -> None:
    likelihood, density = np.full((2, 1), 2.0), np.array([0.01])
    equal, _ = ours(likelihood, density, np.array([0.9, 0.9]))
    apart, _ = ours(likelihood, density, np.array([0.9, 0.01]))
    alone, _ = ours(likelihood[:1], density, np.array([0.9]))
    assert equal[0, 1] < 0.7
    assert apart[0, 1] > 0.99 * alone[0, 1]


def test_chances_follow_the_score_of_tentative_tracks_alone() -> None:
    bank = new_tracks(np.zeros((3, 2)), np.tile(np.eye(2), (3, 1, 1)), (1.0, 1.0), 0)
    bank.ledger["status"], bank.ledger["score"] = [0, 0, 1], [8.0, 8.0 - SURE, -50.0]
    assert_allclose(chances(bank.ledger, 8.0), [1.0 / (1.0 + np.exp(-SURE)), 0.5, 1.0])
    assert chances(bank.ledger, -np.inf).tolist() == [1.0, 1.0, 1.0]
