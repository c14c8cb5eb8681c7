"""The auction finds assignments of the same cost as scipy, and as trying all of them."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest

from fls_trackers.auction import Pairs, auctioned, solved

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


def pairs_of(cost: FloatArray) -> Pairs:
    """The finite entries of a cost matrix."""
    rows = [np.flatnonzero(np.isfinite(row)) for row in cost]
    start = np.concatenate([[0], np.cumsum([row.size for row in rows], dtype=np.int64)])
    return Pairs(
        start.astype(np.int64), np.concatenate([*rows, np.zeros(0, np.int64)]), cost[np.isfinite(cost)]
    )


def worth(cost: FloatArray, got: IntArray) -> tuple[int, float]:
    """Pairs and their cost; fails unless each measurement is had once and only by tracks that may."""
    tracks = np.flatnonzero(got >= 0)
    assert np.unique(got[tracks]).size == tracks.size
    assert np.isfinite(cost[tracks, got[tracks]]).all()
    return tracks.size, float(cost[tracks, got[tracks]].sum())


def draw(seed: int, most: int, ties: bool) -> FloatArray:
    rng = np.random.default_rng(seed)
    n, m = rng.integers(0, most + 1, 2)
    cost = rng.random((n, m)) * 4.6
    cost = np.round(cost) if ties else cost
    return np.where(rng.random((n, m)) < rng.uniform(0.1, 1.0), cost, np.inf)


@pytest.mark.parametrize("ties", [False, True])
def test_auction_equals_scipy(ties: bool):
    for seed in range(400):
        cost = draw(seed, 12, ties)
        one = worth(cost, auctioned(pairs_of(cost), cost.shape[1]))
        other = worth(cost, solved(pairs_of(cost), cost.shape[1]))
        assert one[0] == other[0]
        assert one[1] == pytest.approx(other[1], abs=1e-6)


def test_both_equal_trying_everything():
    for seed in range(60):
        cost = draw(seed, 4, ties=False)
        n, m = cost.shape
        best = (0, 0.0)
        for choice in itertools.product(range(-1, m), repeat=n):
            taken = [(t, j) for t, j in enumerate(choice) if j >= 0]
            if len({j for _, j in taken}) == len(taken) and all(np.isfinite(cost[t, j]) for t, j in taken):
                total = float(sum(cost[t, j] for t, j in taken))
                if (-len(taken), total) < (-best[0], best[1]):
                    best = (len(taken), total)
        for method in (auctioned, solved):
            assert worth(cost, method(pairs_of(cost), m)) == (best[0], pytest.approx(best[1], abs=1e-6))


def test_a_pair_more_is_better_than_any_cost():
    # Track 0 may have both, track 1 only the one that track 0 likes.
    cost = np.array([[0.0, 4.6], [4.6, np.inf]])
    assert auctioned(pairs_of(cost), 2).tolist() == [1, 0]
    assert solved(pairs_of(cost), 2).tolist() == [1, 0]


def test_many_tracks_that_want_the_same_few_end_soon():
    cost = np.tile(np.array([[1.0, 1.0, 1.0]]), (60, 1))
    assert worth(cost, auctioned(pairs_of(cost), 3)) == (3, 3.0)


def test_a_large_market_is_exact():
    cost = np.random.default_rng(1).random((120, 150))
    one, other = (worth(cost, method(pairs_of(cost), 150)) for method in (auctioned, solved))
    assert one == (120, pytest.approx(other[1], abs=1e-5))
