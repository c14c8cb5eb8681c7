"""JPDA probabilities beside brute-force enumeration, and what lies beyond it."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose

from fls_trackers.association import Association, associate
from fls_trackers.belief import propagate
from fls_trackers.events import all_events
from fls_trackers.gating import Gated, gate
from fls_trackers.sweep import plan

P_D, P_G = 0.9, 0.98
MISS = 1.0 - P_D * P_G
FloatArray = npt.NDArray[np.float64]


def gated(likelihood: FloatArray) -> Gated:
    """All pairs with a likelihood above zero."""
    inside = likelihood > 0.0
    start = np.concatenate([[0], np.cumsum(inside.sum(axis=1))]).astype(np.int64)
    return Gated(start, np.nonzero(inside)[1].astype(np.int64), likelihood[inside])


def table(found: Association, likelihood: FloatArray) -> FloatArray:
    """(n, 1 + m) with the probability of no measurement in column 0."""
    beta = np.zeros((likelihood.shape[0], likelihood.shape[1] + 1))
    beta[:, 0] = found.beta_none
    beta[:, 1:][likelihood > 0.0] = found.beta
    return beta


def ours(
    likelihood: FloatArray, density: FloatArray, rank: npt.ArrayLike | None = None, max_shared: int = 14
) -> tuple[FloatArray, Association]:
    ranks = np.zeros(likelihood.shape[0], np.int64) if rank is None else np.asarray(rank, np.int64)
    found = associate(gated(likelihood), density, ranks, p_d=P_D, p_g=P_G, max_shared=max_shared)
    return table(found, likelihood), found


def enumerated(likelihood: FloatArray, density: FloatArray) -> FloatArray:
    """The same table, event by event as Karoui 2015 (20)-(22) define it."""
    n, m = likelihood.shape
    beta, total = np.zeros((n, m + 1)), 0.0
    choices = [[-1, *np.flatnonzero(row > 0.0)] for row in likelihood]
    for event in itertools.product(*choices):
        taken = [j for j in event if j >= 0]
        if len(set(taken)) < len(taken):
            continue
        weight = 1.0
        for t, j in enumerate(event):
            weight *= MISS if j < 0 else P_D * likelihood[t, j] / density[j]
        total += weight
        for t, j in enumerate(event):
            beta[t, j + 1] += weight
    return beta / total


@pytest.mark.parametrize("seed", range(300))
def test_betas_equal_enumeration(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 5), rng.integers(0, 6)
    likelihood = 10.0 ** rng.uniform(-4, 2, (n, m)) * (rng.random((n, m)) < rng.choice([0.3, 0.6, 1.0]))
    density = 10.0 ** rng.uniform(-6, -1, m)
    beta, found = ours(likelihood, density)
    assert found.approximate == 0
    assert_allclose(beta, enumerated(likelihood, density), rtol=0, atol=1e-12)


@pytest.mark.parametrize("fill", [0.0, 1.0])
def test_ties_and_empty_gates(fill: float) -> None:
    likelihood, density = np.full((4, 5), fill), np.full(5, 1e-3)
    beta, _ = ours(likelihood, density)
    assert_allclose(beta, enumerated(likelihood, density), rtol=0, atol=1e-12)


def test_many_tracks_in_a_row_stay_exact() -> None:
    # 14 tracks, each sharing two measurements with the next: 28 shared in all, but few at a time.
    rng = np.random.default_rng(5)
    n = 8
    likelihood = np.zeros((n, 2 * n + 2))
    for t in range(n):
        likelihood[t, 2 * t : 2 * t + 4] = rng.uniform(0.1, 2.0, 4)
    shuffled = likelihood[rng.permutation(n)][:, rng.permutation(2 * n + 2)]
    density = np.full(2 * n + 2, 0.3)
    beta, found = ours(shuffled, density, max_shared=4)
    assert found.approximate == 0
    assert_allclose(beta, enumerated(shuffled, density), rtol=0, atol=1e-12)


def test_betas_sum_to_one_and_no_measurement_is_taken_twice() -> None:
    rng = np.random.default_rng(6)
    likelihood = rng.uniform(0.0, 5.0, (9, 9)) * (rng.random((9, 9)) < 0.7)
    for max_shared in (2, 12):
        beta, found = ours(likelihood, np.full(9, 1e-4), max_shared=max_shared)
        assert_allclose(beta.sum(axis=1), 1.0, rtol=1e-12)
        assert (beta >= 0.0).all()
        assert_allclose(found.taken, beta[:, 1:].sum(axis=0), atol=1e-12)
        # Belief propagation keeps a measurement's total only roughly below 1.
        assert (found.taken <= 1.0 + (1e-12 if max_shared == 12 else 0.1)).all()


def test_permuted_measurements_give_permuted_betas() -> None:
    rng = np.random.default_rng(7)
    likelihood, density = rng.uniform(0.1, 2.0, (4, 6)), rng.uniform(0.01, 0.1, 6)
    order, tracks = rng.permutation(6), rng.permutation(4)
    beta, _ = ours(likelihood, density)
    permuted, _ = ours(likelihood[np.ix_(tracks, order)], density[order])
    assert_allclose(permuted[:, 1:], beta[np.ix_(tracks, order + 1)], rtol=1e-12)


def test_one_track_one_measurement_is_worked_by_hand() -> None:
    beta, _ = ours(np.array([[0.2]]), np.array([0.05]))
    ratio = 0.9 * 0.2 / 0.05  # 3.6
    assert_allclose(beta, [[0.118 / (0.118 + ratio), ratio / (0.118 + ratio)]])


def test_a_wide_cluster_falls_back_and_is_nearly_right() -> None:
    rng = np.random.default_rng(8)
    worst = 0.0
    for _ in range(20):
        likelihood, density = rng.uniform(0.01, 2.0, (5, 7)), np.full(7, 0.1)
        beta, found = ours(likelihood, density, max_shared=3)
        assert found.approximate == 1
        worst = max(worst, np.abs(beta - enumerated(likelihood, density)).max())
    assert worst < 0.05


def test_extreme_ratios_stay_finite() -> None:
    rng = np.random.default_rng(9)
    likelihood = 10.0 ** rng.uniform(-300, 5, (60, 60)) * (rng.random((60, 60)) < 0.08)
    for max_shared in (1, 12):
        beta, _ = ours(likelihood, np.full(60, 1e-12), max_shared=max_shared)
        assert np.isfinite(beta).all()
        assert_allclose(beta.sum(axis=1), 1.0, rtol=1e-9)


def test_a_later_rank_gets_what_is_left() -> None:
    likelihood = np.array([[5.0, 0.0], [5.0, 5.0]])
    beta, found = ours(likelihood, np.full(2, 1e-3), rank=[0, 1])
    alone, _ = ours(likelihood[:1], np.full(2, 1e-3))
    assert_allclose(beta[0], alone[0])
    assert beta[1, 1] == 0.0
    assert beta[1, 2] > 0.99
    assert found.claimed.tolist() == [True, False]
    assert found.in_gate.tolist() == [True, True]


def test_nothing_to_associate() -> None:
    for n, m in ((0, 0), (0, 3), (3, 0)):
        beta, found = ours(np.zeros((n, m)), np.ones(m))
        assert beta.shape == (n, m + 1)
        assert found.beta_none.tolist() == [1.0] * n
        assert found.taken.tolist() == [0.0] * m


def test_the_sum_over_events_is_bounded() -> None:
    # 200 tracks that all gate the same 4,000 measurements: no exact sum, few rounds of belief propagation.
    likelihood = np.random.default_rng(10).uniform(0.1, 1.0, (200, 4000))
    beta, found = ours(likelihood, np.full(4000, 0.1))
    assert found.approximate == 1
    assert_allclose(beta.sum(axis=1), 1.0, rtol=1e-9)


def exact(found: Gated, density: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The sum over all events of the pairs as one cluster, however wide."""
    ratio = P_D / MISS * found.likelihood / density[found.places]
    sweep = plan(found.start, found.places, density.size, 20)
    assert sweep.width <= 20
    return all_events(found.start, ratio, sweep)


def crowd(rng: np.random.Generator, n: int) -> tuple[Gated, FloatArray]:
    """Tracks 1.5 m apart on average, a metre uncertain, in clutter."""
    density, side = 0.1, 1.5 * np.sqrt(n)
    state = np.zeros((n, 4))
    state[:, :2] = rng.uniform(0.0, side, (n, 2))
    P, R = np.tile(np.diag([0.5, 0.5, 1.0, 1.0]), (n, 1, 1)), np.tile(np.diag([0.05, 1.0]), (n, 1, 1))
    echoes = state[rng.random(n) < P_D, :2]
    echoes = echoes + rng.standard_normal(echoes.shape) * np.sqrt([0.55, 1.5])
    false = rng.uniform(-3.0, side + 3.0, (rng.poisson(density * (side + 6.0) ** 2), 2))
    y = np.concatenate([echoes, false])
    return gate(state, P, R, y, 9.0), np.full(len(y), density)


@pytest.mark.parametrize(("n", "trials"), [(13, 40), (20, 15)])
def test_wide_clusters_are_right_to_two_hundredths(n: int, trials: int) -> None:
    # Up to 17 tracks and measurements open at a time; exact up to 14, and beyond with weak pairs' messages.
    rng, widths, errors = np.random.default_rng(11), [], []
    for _ in range(trials):
        found, density = crowd(rng, n)
        widths.append(plan(found.start, found.places, density.size, 17).width)
        if widths[-1] > 17:
            continue
        beta, none = exact(found, density)
        got = associate(found, density, np.zeros(n, np.int64), p_d=P_D, p_g=P_G)
        errors.append(max(np.abs(got.beta - beta).max(), np.abs(got.beta_none - none).max()))
    assert max(widths) > (14 if n == 20 else 12)
    assert len(errors) > 0.6 * trials
    assert max(errors) <= 0.02


@pytest.mark.parametrize("max_shared", [6, 8, 10])
def test_messages_of_weak_pairs_are_right_to_two_hundredths(max_shared: int) -> None:
    rng, fallen = np.random.default_rng(12), 0
    for _ in range(40):
        found, density = crowd(rng, 10)
        beta, none = exact(found, density)
        got = associate(found, density, np.zeros(10, np.int64), p_d=P_D, p_g=P_G, max_shared=max_shared)
        fallen += got.approximate
        assert np.abs(got.beta - beta).max() <= 0.02
        assert np.abs(got.beta_none - none).max() <= 0.02
    assert fallen > 5


@pytest.mark.parametrize(("n", "m"), [(11, 13), (12, 14), (13, 11)])
def test_propagation_alone_is_right_to_two_hundredths_when_all_share_all(n: int, m: int) -> None:
    rng = np.random.default_rng(12)
    likelihood = rng.uniform(0.01, 1.0, (n, m))
    found, density = gated(likelihood), np.full(m, 0.1)
    beta, none = exact(found, density)
    ratio = P_D / MISS * found.likelihood / 0.1
    b, b_none = propagate(found.start, found.places, ratio, m, np.array([0, 10**9]))
    assert np.abs(b - beta).max() <= 0.02
    assert np.abs(b_none - none).max() <= 0.02


@pytest.mark.parametrize("shape", [(10, 12), (12, 10), (3, 30), (30, 3)])
def test_all_sharing_all_takes_a_bit_for_each_of_the_fewer(shape: tuple[int, int]) -> None:
    n, m = shape
    found = gated(np.ones(shape))
    sweep = plan(found.start, found.places, m, 14)
    assert sweep.width <= min(n, m)
    assert sorted(sweep.pair) == list(range(n * m))


def test_a_sweep_that_needs_more_bits_than_allowed_says_so() -> None:
    found = gated(np.ones((9, 9)))
    assert plan(found.start, found.places, 9, 8).width == 9
    assert plan(found.start, found.places, 9, 9).width == 9


def test_what_is_left_of_a_track_is_right_however_small() -> None:
    # More tracks than measurements, so that steps end at measurements: none is 1 - beta to no digit.
    likelihood, density = np.array([[1.0, 1.0], [1.0, 1e-9], [1e-9, 1.0], [1e-9, 1e-9]]), np.full(2, 1e-12)
    for order in itertools.permutations(range(4)):
        beta, _ = ours(likelihood[list(order)], density)
        assert_allclose(beta, enumerated(likelihood[list(order)], density), rtol=1e-9)
    alone, _ = ours(np.full((1, 3), 1e-3), np.full(3, 1e-25))
    assert_allclose(alone[0, 0], MISS / (3 * P_D * 1e22), rtol=1e-6)
