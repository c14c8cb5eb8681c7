"""What may be another track's counts as clutter: beside its formula, and for tracks that cross."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose

from fls_flow import Detections, TrackStatus, View
from fls_trackers.linear import against_others
from fls_trackers.pda import Pda

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
P_SEEN = 0.88


def weighed(
    likelihood: FloatArray, density: FloatArray, rank: npt.ArrayLike, chance: npt.ArrayLike
) -> FloatArray:
    """`against_others` of a table (n, m), 0 where a pair is not gated."""
    inside = likelihood > 0.0
    start = np.concatenate([[0], np.cumsum(inside.sum(axis=1))]).astype(np.int64)
    places, ranks = np.nonzero(inside)[1].astype(np.int64), np.asarray(rank, np.int64)
    table = np.zeros(likelihood.shape)
    table[inside] = against_others(
        start, places, likelihood[inside], density, ranks, np.asarray(chance, float), P_SEEN
    )
    return table


def slow(likelihood: FloatArray, density: FloatArray, rank: IntArray, chance: FloatArray) -> FloatArray:
    """The formula, pair by pair."""
    ratio = likelihood / density
    table = np.zeros(likelihood.shape)
    for t, j in np.argwhere(likelihood > 0.0):
        clutter = density[j]
        for s in range(len(likelihood)):
            if s != t and rank[s] <= rank[t] and ratio[s].sum() > 0.0:
                p = chance[s] * P_SEEN * ratio[s, j] / ratio[s].sum()
                clutter += likelihood[s, j] * p / (1.0 - p)
        table[t, j] = likelihood[t, j] * density[j] / clutter
    return table


@pytest.mark.parametrize("seed", range(40))
def test_it_is_the_formula(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 7), rng.integers(1, 9)
    likelihood = 10.0 ** rng.uniform(-4, 2, (n, m)) * (rng.random((n, m)) < 0.6)
    density, rank = 10.0 ** rng.uniform(-3, 1, m), rng.integers(0, 2, n)
    chance = np.where(rank == 1, rng.random(n), 1.0)
    expected = slow(likelihood, density, rank, chance)
    assert_allclose(weighed(likelihood, density, rank, chance), expected, rtol=1e-9)


def test_a_measurement_that_one_track_alone_gates_is_weighed_as_it_was() -> None:
    likelihood = np.array([[3.0, 0.2, 0.0], [0.0, 0.0, 5.0]])
    assert_allclose(weighed(likelihood, np.full(3, 0.1), [0, 1], [1.0, 0.3]), likelihood, rtol=1e-15)


def test_two_tracks_between_two_measurements_by_hand() -> None:
    """P = 0.88 * 4/5 of its own: at its own, 1 / (1 + 1 * 0.176/0.824); at the other, 4 * 0.704/0.296."""
    likelihood = np.array([[4.0, 1.0], [1.0, 4.0]])
    found = weighed(likelihood, np.ones(2), [0, 0], [1.0, 1.0])
    own, other = 4.0 / (1.0 + 0.176 / 0.824), 1.0 / (1.0 + 4.0 * 0.704 / 0.296)
    assert_allclose(found, [[own, other], [other, own]], rtol=1e-12)
    assert own / other > 8.0 * likelihood[0, 0] / likelihood[0, 1]


def test_a_newcomer_takes_nothing_from_a_confirmed_track_which_takes_from_it() -> None:
    found = weighed(np.full((2, 1), 2.0), np.ones(1), [0, 1], [1.0, 0.9])
    assert found[0, 0] == 2.0
    assert_allclose(found[1, 0], 2.0 / (1.0 + 2.0 * 0.88 / 0.12))


def test_nothing_to_weigh() -> None:
    assert weighed(np.zeros((0, 3)), np.ones(3), [], []).size == 0
    assert weighed(np.zeros((2, 0)), np.ones(0), [0, 1], [1.0, 1.0]).size == 0
    assert not weighed(np.zeros((2, 3)), np.ones(3), [0, 1], [1.0, 1.0]).any()


def keep_their_objects(detections: Callable[..., Detections], view: View, seed: int) -> bool:
    """Whether two tracks of objects whose ways cross have the same objects before and after."""
    rng = np.random.default_rng(seed)
    start, velocity = np.array([[36.0, -4.0], [36.0, 4.0]]), np.array([[0.08, 0.08], [0.08, -0.08]])
    tracker, at = Pda(preset="points"), {}
    for k in range(200):
        where = start + velocity * 0.5 * k
        xy = where[rng.random(2) < 0.9]
        r = np.hypot(*xy.T) + view.cell_m * rng.standard_normal(len(xy))
        b = np.arctan2(xy[:, 1], xy[:, 0]) + view.beam_spacing_rad * rng.standard_normal(len(xy))
        tracks = tracker(detections(k, r, b))
        if k in (30, 199):
            shown = tracks.status == TrackStatus.CONFIRMED
            near = np.hypot(*(tracks.state[shown, None, :2] - where).T)
            at[k] = tracks.id[shown][near.argmin(axis=1)].tolist()
    return at[30] == at[199] and len(set(at[30])) == 2


def test_tracks_of_objects_that_cross_keep_their_objects(
    detections: Callable[..., Detections], view: View
) -> None:
    """As if each were alone, one of the two is always merged into the other, and a new one begins."""
    assert sum(keep_their_objects(detections, view, seed) for seed in range(41, 51)) >= 7
