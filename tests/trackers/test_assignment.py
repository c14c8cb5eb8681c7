"""The compiled assignment beside scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.optimize import linear_sum_assignment

from fls_trackers.assignment import cheapest, most_probable

FORBIDDEN = 1e7


@pytest.mark.parametrize("gated", [0.0, 0.4, 0.8, 1.0])
@pytest.mark.parametrize("whole", [False, True])
def test_sums_equal_scipys_on_random_cases(gated: float, whole: bool) -> None:
    rng = np.random.default_rng(round(10 * gated) + 100 * whole)
    for _ in range(500):
        n, m = rng.integers(0, 10, 2)
        cost, miss = rng.normal(0.0, 3.0, (n, m)), rng.normal(0.0, 2.0, n)
        if whole:  # many ties
            cost, miss = np.round(cost), np.round(miss)
        cost[rng.random((n, m)) < gated] = np.inf
        padded = np.full((n, m + n), FORBIDDEN)
        padded[:, :m] = np.where(np.isfinite(cost), cost, FORBIDDEN)
        padded[np.arange(n), m + np.arange(n)] = miss
        expected = padded[linear_sum_assignment(padded)].sum()
        chosen = cheapest(cost, miss)
        own = chosen[chosen >= 0]
        assert np.unique(own).size == own.size
        total = sum(cost[t, j] if j >= 0 else miss[t] for t, j in enumerate(chosen))
        assert total == pytest.approx(expected, abs=1e-9)


def test_a_wide_case_equals_scipys() -> None:
    cost = np.random.default_rng(1).normal(0.0, 3.0, (60, 200))
    chosen = cheapest(cost, np.full(60, 100.0))
    assert_array_equal(chosen, linear_sum_assignment(cost)[1])


def test_nothing_to_assign() -> None:
    assert cheapest(np.zeros((0, 4)), np.zeros(0)).size == 0
    assert cheapest(np.zeros((3, 0)), np.zeros(3)).tolist() == [-1, -1, -1]
    assert cheapest(np.full((2, 2), np.inf), np.zeros(2)).tolist() == [-1, -1]


def test_the_sum_counts_not_the_nearest() -> None:
    # Greedy takes 9 for the first track and leaves 1 / 9 for the second; together 4 * 8 is more.
    beta, none = most_probable(np.array([0, 2, 3]), np.array([0, 1, 0]), np.array([9.0, 4.0, 8.0]), 2)
    assert beta.tolist() == [0.0, 1.0, 1.0]
    assert none.tolist() == [0.0, 0.0]


def test_a_pair_less_likely_than_a_miss_is_not_made() -> None:
    beta, none = most_probable(np.array([0, 1, 2]), np.array([0, 1]), np.array([0.9, 1.1]), 2)
    assert beta.tolist() == [0.0, 1.0]
    assert none.tolist() == [1.0, 0.0]
