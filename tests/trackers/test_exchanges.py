"""Assignments and their exchanges: beside enumeration, and for tracks of objects that cross."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import Detections, TrackStatus, View
from fls_trackers.association import ASSIGNED, associate
from fls_trackers.exchanges import exchanged
from fls_trackers.gating import Gated
from fls_trackers.gnn import Gnn
from fls_trackers.nnkf import Nnkf

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
P_D, P_G = 0.9, 0.99
FACTOR = P_D / (1.0 - P_D * P_G)


def gated_of(likelihood: FloatArray) -> Gated:
    """The pairs of a table (n, m), 0 where a pair is not gated."""
    inside = likelihood > 0.0
    start = np.concatenate([[0], np.cumsum(inside.sum(axis=1))]).astype(np.int64)
    return Gated(start, np.nonzero(inside)[1].astype(np.int64), likelihood[inside])


def both_ways(
    likelihood: FloatArray, density: FloatArray, rank: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The assignment (n, m), and beta (n, m) and beta_none (n,) with its exchanges."""
    gated = gated_of(likelihood)
    found = associate(gated, density, rank, p_d=P_D, p_g=P_G, sharing=ASSIGNED)
    given = (gated.likelihood, density, FACTOR, rank, found.beta, found.beta_none)
    shares, rest = exchanged(gated.start, gated.places, *given)
    tables = np.zeros((2, *likelihood.shape))
    tables[:, likelihood > 0.0] = found.beta, shares
    return tables[0], tables[1], rest


def enumerated(ratio: FloatArray, assigned: FloatArray, rank: IntArray) -> tuple[FloatArray, FloatArray]:
    """The mean over the assignment and all joint events in which two tracks of a rank exchange; per track."""
    n = len(ratio)
    own = [int(np.argmax(row)) if row.any() else -1 for row in assigned]

    def weight(taken: list[int]) -> float:
        return float(np.prod([ratio[t, j] if j >= 0 else 1.0 for t, j in enumerate(taken)]))

    total, beta, none = np.ones(n), assigned.copy(), np.array([float(j < 0) for j in own])
    for s, t in itertools.combinations(range(n), 2):
        ways = {(own[t], own[s]), (own[t], -1), (-1, own[s])} if rank[s] == rank[t] else set()
        for one, other in ways:
            if (one, other) == (-1, -1) or one == own[s] or other == own[t]:
                continue
            changed = list(own)
            changed[s], changed[t] = one, other
            odds = weight(changed) / weight(own)
            for track, j in ((s, one), (t, other)):
                total[track] += odds
                if j >= 0:
                    beta[track, j] += odds
                else:
                    none[track] += odds
    return beta / total[:, None], none / total


@pytest.mark.parametrize("seed", range(60))
def test_it_is_the_mean_over_the_exchanges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 6)), int(rng.integers(1, 6))
    likelihood = 10.0 ** rng.uniform(-3, 1, (n, m)) * (rng.random((n, m)) < 0.8)
    density, rank = 10.0 ** rng.uniform(-3, 0, m), np.zeros(n, np.int64)
    assigned, beta, none = both_ways(likelihood, density, rank)
    expected_beta, expected_none = enumerated(FACTOR * likelihood / density, assigned, rank)
    assert_allclose(beta, expected_beta, rtol=1e-9, atol=1e-12)
    assert_allclose(none, expected_none, rtol=1e-9, atol=1e-12)
    assert_allclose(beta.sum(axis=1) + none, 1.0, rtol=1e-12)


def test_two_tracks_in_one_place_are_weighed_alike() -> None:
    _, beta, none = both_ways(np.full((2, 2), 2.0), np.full(2, 0.01), np.zeros(2, np.int64))
    assert_allclose(beta, 0.5, atol=1e-3)
    assert_allclose(none, 0.0, atol=1e-3)


def test_a_measurement_that_one_track_alone_gates_is_its_own() -> None:
    likelihood = np.array([[3.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
    assigned, beta, none = both_ways(likelihood, np.full(3, 0.1), np.zeros(2, np.int64))
    assert_array_equal(beta, assigned)
    assert_array_equal(none, [0.0, 0.0])


def test_a_tentative_track_takes_nothing_from_a_confirmed_one() -> None:
    likelihood = np.array([[3.0, 0.0], [3.0, 2.0]])
    assigned, beta, _ = both_ways(likelihood, np.full(2, 0.1), np.array([0, 1]))
    assert_array_equal(beta, assigned)


@pytest.mark.parametrize("kind", [Gnn, Nnkf])
def test_tracks_of_objects_that_cross_go_on_as_they_came(
    kind: type[Gnn] | type[Nnkf], observe: Callable[..., Detections]
) -> None:
    """24 crossings at 33 m and 0.16 m/s: by single assignments nine or ten part with each other's id."""
    view = View(1.0, 50.0, 0.05, np.deg2rad(np.arange(-40, 40.1, 1.5)), np.deg2rad(1.5))
    kept = 0
    for seed in range(24):
        rng = np.random.default_rng(700 + seed)
        if kind is Gnn:
            node: Gnn | Nnkf = Gnn(preset="points")
        else:
            node = Nnkf(
                p_d=0.9, velocity_walk_mps=0.02, extent_sd_m=0.0, group_m=0.0, gamma=9.0, speed_sd_mps=0.3
            )
        nearest = []
        for k in range(200):
            s = 0.5 * k - 50.0
            xy = np.array([[33.0 + 0.08 * s, 4.0 + 0.08 * s], [33.0 + 0.08 * s, 4.0 - 0.08 * s]])
            tracks = node(observe(rng, k, xy, false=5.0, view=view))
            sure = tracks.select(tracks.status == TrackStatus.CONFIRMED)
            if k in (60, 199):
                apart = np.hypot(*(sure.state[:, None, :2] - xy[None]).transpose(2, 0, 1))
                nearest.append([int(sure.id[i]) for i in apart.argmin(axis=0)])
        kept += nearest[0] == nearest[1]
    assert kept >= 20
