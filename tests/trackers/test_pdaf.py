"""`pdaf` and `nnkf`: beside enumeration and closed forms, in their life, and on divers that turn in clutter."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import Detections, NavState, Tracks, View
from fls_flow.geometry import Pose
from fls_flow.testing import check_node
from fls_trackers.adaptive_noise import NOISE_COLUMNS, PROCESS, SENSOR, learn, predict_each
from fls_trackers.conversion import noise_at
from fls_trackers.echo_strength import ANY, BROAD, agreeing, begun_strength, learned, strengths
from fls_trackers.fusion import Fusion, fused
from fls_trackers.grouping import grouped
from fls_trackers.life import CONFIRMED, LOST, TENTATIVE
from fls_trackers.nnkf import Nnkf
from fls_trackers.pdaf import Pdaf
from fls_trackers.single_target import follow, nearest, settle_by_score
from fls_trackers.track_bank import TrackBank, new_tracks

FloatArray = npt.NDArray[np.float64]
Make = Callable[..., Detections]
KINDS = pytest.mark.parametrize("kind", [Pdaf, Nnkf])
VIEW = View(2.0, 40.0, 0.1, np.deg2rad(np.arange(-32.0, 32.0, 0.5)), np.deg2rad(0.7))


def same(a: Tracks, b: Tracks) -> bool:
    names = ("id", "status", "state", "covariance", "hits", "age")
    return all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in names)


# --- the filter ---------------------------------------------------------------------------------------------


def one_track() -> TrackBank:
    bank = new_tracks(np.array([[20.0, 2.0]]), np.diag([0.4, 0.7])[None], (0.5, 0.5), CONFIRMED)
    bank.ledger["id"] = 1
    return bank


def followed(y: FloatArray, density: FloatArray, one_event: bool, joint: bool = True) -> tuple[Any, ...]:
    bank, p_g = one_track(), 1.0 - np.exp(-8.0)
    gains = (16.0, 0.65 / (1.0 - 0.65 * p_g), 1.0 - 0.65 * p_g)
    sensor, noise, strength = (0.1, 0.01, 0.0, 0.0, 0.0), np.zeros((1, NOISE_COLUMNS)), np.zeros((1, 2))
    return follow(
        bank.state, bank.covariance, bank.ledger, noise, strength, y, np.zeros(len(y)), density, (0.5, 0.25),
        sensor, (0.4, 0.0, 0.0), gains, (one_event, True, False, joint),
    )  # fmt: skip


def by_hand(y: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Brinkmann's filter event by event: betas and the moments of the mixture of Kalman updates."""
    bank, gamma, p_d = one_track(), 16.0, 0.65
    p_g = 1.0 - np.exp(-gamma / 2.0)
    x, P = (a[0] for a in predict_each(bank.state, bank.covariance, 0.5, 0.25, np.zeros((1, 5))))
    S = P[:2, :2] + noise_at(x[None], 0.1, 0.01, Pose())[0] + 0.16 * np.eye(2)
    K = P[:, :2] @ np.linalg.inv(S)
    d2 = np.array([(z - x[:2]) @ np.linalg.solve(S, z - x[:2]) for z in y])
    b = density * np.sqrt(np.linalg.det(2.0 * np.pi * S)) * (1.0 - p_d * p_g) / p_d
    e = np.where(d2 <= gamma, np.exp(-d2 / 2.0), 0.0) / b
    beta = np.concatenate([[1.0], e]) / (1.0 + e.sum())
    means = [x, *(x + K @ (z - x[:2]) for z in y)]
    parts = [P, *[P - K @ S @ K.T] * len(y)]
    mean = sum(w * m for w, m in zip(beta, means, strict=True))
    cov = sum(w * (C + np.outer(m - mean, m - mean)) for w, m, C in zip(beta, means, parts, strict=True))
    return beta, np.asarray(mean), np.asarray(cov)


@pytest.mark.parametrize("seed", range(20))
def test_pdaf_equals_enumeration_of_its_events(seed: int) -> None:
    rng = np.random.default_rng(seed)
    y = np.array([20.0, 2.0]) + 1.5 * rng.standard_normal((rng.integers(0, 6), 2))
    density = rng.uniform(0.01, 0.3, len(y))
    x, P, rows, _, _, event, *_ = followed(y, density, one_event=False, joint=bool(seed % 2))
    beta, mean, cov = by_hand(y, density)
    assert_allclose(x[0], mean, rtol=1e-12)
    assert_allclose(P[0], cov, rtol=1e-10, atol=1e-13)
    assert event[0] == beta.argmax() - 1
    p_g = 1.0 - np.exp(-8.0)
    assert rows["score"][0] == pytest.approx(np.log((1.0 - 0.65 * p_g) / beta[0]), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("seed", range(10))
def test_tracks_that_share_events_equal_enumeration_of_the_joint_events(seed: int) -> None:
    rng = np.random.default_rng(seed)
    at = np.array([[20.0, 2.0], [20.6, 2.4], [19.5, 1.8]])
    y = np.array([20.0, 2.0]) + 0.7 * rng.standard_normal((rng.integers(1, 4), 2))
    density = rng.uniform(0.02, 0.3, len(y))
    bank = new_tracks(at, np.tile(np.diag([0.4, 0.7]), (3, 1, 1)), (0.5, 0.5), CONFIRMED)
    bank.ledger["id"] = [1, 2, 3]
    sensor, gamma, p_d = (0.1, 0.01, 0.0, 0.0, 0.0), 50.0, 0.65
    x, _, _, _, _, _, none, *_ = follow(
        bank.state, bank.covariance, bank.ledger, np.zeros((3, NOISE_COLUMNS)), np.zeros((3, 2)), y,
        np.zeros(len(y)), density, (0.5, 0.25), sensor, (0.4, 0.0, 0.0),
        (gamma, p_d / (1.0 - p_d), 1.0 - p_d), (False, True, False, True),
    )  # fmt: skip
    before, P = predict_each(bank.state, bank.covariance, 0.5, 0.25, np.zeros((3, 5)))
    S = P[:, :2, :2] + noise_at(before, 0.1, 0.01, Pose()) + 0.16 * np.eye(2)
    ratio = np.zeros((3, len(y) + 1))
    ratio[:, 0] = 1.0 - p_d
    for t, j in itertools.product(range(3), range(len(y))):
        nu = y[j] - before[t, :2]
        peak = 1.0 / np.sqrt(np.linalg.det(2.0 * np.pi * S[t]))
        ratio[t, j + 1] = p_d * peak * np.exp(-0.5 * nu @ np.linalg.solve(S[t], nu)) / density[j]
    beta = np.zeros_like(ratio)
    for event in itertools.product(range(len(y) + 1), repeat=3):
        taken = [j for j in event if j]
        if len(set(taken)) == len(taken):
            beta[range(3), event] += ratio[range(3), event].prod()
    beta /= beta.sum(axis=1, keepdims=True)
    assert_allclose(none, beta[:, 0], rtol=1e-9)
    K = P[:, :, :2] @ np.linalg.inv(S)
    nu = np.einsum("tj,tja->ta", beta[:, 1:], y[None] - before[:, None, :2])
    assert_allclose(x, before + np.einsum("tab,tb->ta", K, nu), rtol=1e-9)


@pytest.mark.parametrize("levels", [(1.0, 1.0), (1.0, 2.0)])
def test_a_common_event_moves_the_mean_and_leaves_the_difference(levels: tuple[float, float]) -> None:
    bank = new_tracks(
        np.array([[20.0, 2.0], [20.8, 2.0]]), np.tile(np.eye(2), (2, 1, 1)), (0.5, 0.5), CONFIRMED
    )
    bank.ledger["id"] = [1, 2]
    strength = np.array([[level, 9.0] for level in levels])
    y, gains = np.array([[20.6, 2.3]]), (16.0, 9.0, 0.1)

    def after(resolution_m: float) -> tuple[FloatArray, FloatArray]:
        x, P, _, _, learnt, *_ = follow(
            bank.state, bank.covariance, bank.ledger, np.zeros((2, NOISE_COLUMNS)), strength, y, np.array([3.0]),
            np.full(1, 1e-9), (0.5, 0.25), (0.1, 1e-6, 0.0, 0.0, 0.0), (0.4, 0.0, resolution_m), gains,
            (False, True, False, True),
        )  # fmt: skip
        assert_array_equal(learnt == strength, resolution_m > 0.0)
        return x, P

    x, P = after(2.0)
    assert_allclose(x[1] - x[0], [0.8, 0.0, 0.0, 0.0], atol=1e-4)
    weight = np.exp(2.0 * np.array(levels))
    centre = weight @ bank.state[:, :2] / weight.sum()
    K = x[0, :2] - bank.state[0, :2]
    prior = predict_each(bank.state, bank.covariance, 0.5, 0.25, np.zeros((2, 5)))[1][0, 0, 0]
    R = np.array([0.17, 0.16])  # along and across
    assert_allclose(K, prior / (prior + R) * (y[0] - centre), rtol=5e-3)
    assert_allclose(np.diag(P[0])[:2], prior * R / (prior + R), rtol=1e-2)
    alone = after(0.0)[0]
    assert alone[1, 0] - alone[0, 0] < 0.75  # one event pulls two tracks together


def test_nnkf_is_the_kalman_update_by_the_nearest_event() -> None:
    y = np.array([[21.5, 2.5], [20.3, 2.2], [20.0, 0.5]])
    x, P, _, _, _, event, _, known, _ = followed(y, np.full(3, 0.01), one_event=True, joint=False)
    alone, P_alone, *_ = followed(y[1:2], np.full(1, 1e-12), one_event=False)  # no clutter: its beta is 1
    assert event[0] == 1
    assert_allclose(x, alone, rtol=1e-9)
    assert_allclose(P, P_alone, rtol=1e-9)
    assert known.all()


@pytest.mark.parametrize("one_event", [True, False])
def test_a_miss_keeps_the_predicted_state_and_covariance(one_event: bool) -> None:
    bank = one_track()
    x, P, rows, _, _, event, *_ = followed(np.array([[90.0, 2.0]]), np.full(1, 0.01), one_event)
    predicted = predict_each(bank.state, bank.covariance, 0.5, 0.25, np.zeros((1, 5)))
    assert_array_equal(x, predicted[0])
    assert_array_equal(P, predicted[1])
    assert (event[0], rows["hits"][0]) == (-1, 1)


def test_an_event_less_likely_than_none_is_not_taken() -> None:
    start, places = np.array([0, 2]), np.array([0, 1])
    beta, none = nearest(start, places, np.array([0.2, 0.1]), np.array([0.3, 0.05]))
    assert (beta.tolist(), none.tolist()) == ([0.0, 1.0], [0.0])
    assert nearest(start, places, np.array([0.2, 0.1]), np.full(2, 0.3))[1].tolist() == [1.0]


def test_prediction_does_not_depend_on_how_often_it_is_made() -> None:
    bank, noise = one_track(), np.zeros((1, NOISE_COLUMNS))
    x, P = bank.state + np.array([0.0, 0.0, 0.3, -0.2]), bank.covariance
    once = predict_each(x, P, 2.0, 0.3, noise)
    for _ in range(8):
        x, P = predict_each(x, P, 0.25, 0.3, noise)
    assert_allclose(x, once[0], rtol=1e-12)
    assert_allclose(P, once[1], rtol=1e-12)
    assert P[0, 2, 2] - bank.covariance[0, 2, 2] == pytest.approx(2.0 * 0.3**2)


# --- noise --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("true_q", "true_r"), [(1.0, 1.0), (9.0, 1.0), (0.3, 1.0), (1.0, 2.5), (4.0, 2.5)])
def test_noise_is_learnt_from_innovations(true_q: float, true_r: float) -> None:
    # A hundred targets that move and are measured with other noise than the filter was given.
    rng, n, walk, sd, dt = np.random.default_rng(1), 100, 0.2, 0.4, 0.5
    x = np.zeros((n, 4))
    state, P = x.copy(), np.tile(np.diag([sd**2, sd**2, 0.1, 0.1]), (n, 1, 1))
    noise = np.zeros((n, NOISE_COLUMNS))
    q = true_q * walk**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    logs = []
    for k in range(1200):
        w = rng.multivariate_normal([0.0, 0.0], q, (n, 2))
        x[:, :2] += dt * x[:, 2:] + w[:, :, 0]
        x[:, 2:] += w[:, :, 1]
        y = x[:, :2] + np.sqrt(true_r) * sd * rng.standard_normal((n, 2))
        state, P = predict_each(state, P, dt, walk, noise)
        R = sd**2 * np.exp(noise[:, SENSOR])[:, None, None] * np.eye(2)
        noise = learn(noise, state, P, R, y, np.arange(n))
        K = P[:, :, :2] @ np.linalg.inv(P[:, :2, :2] + R)
        state = state + np.einsum("nij,nj->ni", K, y - state[:, :2])
        P = P - K @ P[:, :2, :]
        P = 0.5 * (P + P.transpose(0, 2, 1))
        logs += [noise[:, [PROCESS, SENSOR]].mean(axis=0)] if k > 600 else []
    learnt = np.exp(np.mean(logs, axis=0))
    floor_q, floor_r = 0.25, 1.0
    assert learnt[0] == pytest.approx(max(true_q, floor_q), rel=0.5)
    assert learnt[1] == pytest.approx(max(true_r, floor_r), rel=0.2)


def test_a_track_without_event_learns_nothing() -> None:
    bank = one_track()
    noise = np.array([[0.3, 0.2, 1.0, -1.0, 1.0]])
    after = learn(noise, bank.state, bank.covariance, np.eye(2)[None], np.zeros((0, 2)), np.array([-1]))
    assert after[0].tolist() == [0.3, 0.2, 1.0, -1.0, 0.0]
    assert noise[0, 4] == 1.0


# --- strength of echoes -------------------------------------------------------------------------------------


def test_events_are_weighed_by_how_they_agree_with_the_track() -> None:
    start, places, table = np.array([0, 3, 4]), np.array([0, 1, 2, 1]), np.array([[2.0, 7.0], [0.0, 0.0]])
    ln_a = np.array([2.0, 3.0, np.nan])
    weighed = agreeing(np.ones(4), start, places, table, ln_a, 0.5)
    peak = (1.0 - ANY) / (np.sqrt(2.0 * np.pi) * 0.5 * BROAD)
    assert_allclose(weighed, [ANY + peak, ANY + peak * np.exp(-2.0), 1.0, 1.0])


def test_the_level_of_a_track_is_the_mean_of_its_first_events_and_follows_later_ones() -> None:
    start, places, beta = np.array([0, 2]), np.array([0, 1]), np.array([0.75, 0.25])
    table = begun_strength(np.array([1.0]))
    table = learned(table, start, places, beta, np.array([3.0, 3.0]), 0.25)
    assert_allclose(table, [[2.0, 2.0]])
    for _ in range(400):
        table = learned(table, start, places, beta, np.array([5.0, 9.0]), 0.25)
    assert_allclose(table[0, 0], 6.0)
    unseen = learned(table, start, places, np.zeros(2), np.array([5.0, 9.0]), 0.25)
    assert_array_equal(unseen, table)
    assert_array_equal(learned(table, start, places, beta, np.full(2, np.nan), 0.25), table)


def test_amplitudes_that_tell_nothing_are_unknown() -> None:
    assert_allclose(strengths(np.array([np.e, 1.0])), [1.0, 0.0])
    assert np.isnan(strengths(np.array([0.0, -1.0, np.nan, np.inf]))).all()
    assert begun_strength(np.array([np.nan])).tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize(("kind", "least"), [(Pdaf, 18), (Nnkf, 18)])
def test_a_track_stays_with_its_swimmer_when_it_turns_away_from_weaker_echoes(
    kind: type[Any], least: int
) -> None:
    # Every six seconds something is left behind that stays for ten; the swimmer makes a turn there.
    dt, stayed = 0.25, {None: 0, 0.4: 0}
    for seed, sd in itertools.product(range(20), stayed):
        rng = np.random.default_rng(seed)
        tracker = kind(group_m=0.0, p_d=0.9, amplitude_sd=sd, estimate_noise=False, extent_sd_m=0.3)
        xy, heading, left, first = np.array([20.0, -3.0]), rng.uniform(-np.pi, np.pi), [], 0
        for k in range(240):
            if k % 24 == 0:
                left.append((k, xy.copy()))
                turn = rng.choice([-1.0, 1.0])
            heading += dt * turn if k % 24 < 12 else 0.0
            xy = xy + dt * 0.5 * np.array([np.cos(heading), np.sin(heading)])
            places = [xy, *(at for born, at in left if 8 < k - born < 40)]
            level = [8.0, *[7.0] * (len(places) - 1)] + 0.3 * rng.standard_normal(len(places))
            there = np.array(places) + 0.15 * rng.standard_normal((len(places), 2))
            tracks = tracker(strong(k, there, np.exp(level), dt))
            on = tracks.select(tracks.status == CONFIRMED)
            near = np.hypot(*(on.state[:, :2] - xy).T) < 1.5
            first = first or int(on.id[near][0] if near.any() else 0)
        stayed[sd] += int(first in on.id[near])
    assert stayed[0.4] >= least
    assert stayed[0.4] > stayed[None]


def strong(k: int, xy: FloatArray, amplitude: FloatArray, dt: float) -> Detections:
    m = len(xy)
    return Detections(
        k, 10**9 + round(k * dt * 1e9), np.hypot(*xy.T), np.arctan2(xy[:, 1], xy[:, 0]), amplitude,
        np.zeros((m, 2)), np.zeros((m, 2, 2)), np.zeros(m, np.uint8), VIEW,
    )  # fmt: skip


# --- fusion and grouping ------------------------------------------------------------------------------------


def spread(rng: np.random.Generator) -> FloatArray:
    root = rng.standard_normal((4, 4))
    return root @ root.T + 0.1 * np.eye(4)


def test_algebraic_fusion_is_the_information_sum() -> None:
    rng = np.random.default_rng(2)
    x1, x2, P1, P2 = rng.standard_normal(4), rng.standard_normal(4), spread(rng), spread(rng)
    x, P = fused(x1, P1, x2, P2)
    assert_allclose(np.linalg.inv(P), np.linalg.inv(P1) + np.linalg.inv(P2), rtol=1e-8)
    assert_allclose(x, P2 @ np.linalg.solve(P1 + P2, x1) + P1 @ np.linalg.solve(P1 + P2, x2), rtol=1e-8)
    assert (P == P.T).all()


@pytest.mark.parametrize(("fusion", "honest"), [("algebraic", False), ("covariance-intersection", True)])
def test_only_intersection_is_honest_about_shared_events(fusion: Fusion, honest: bool) -> None:
    # Both tracks saw the same events: the second tells nothing new.
    P = np.diag([0.5, 0.8, 0.1, 0.1])
    x, fused_P = fused(np.ones(4), P, np.ones(4), P, fusion)
    assert_allclose(x, 1.0)
    assert_allclose(fused_P, P if honest else P / 2.0)


def test_intersection_takes_the_better_of_each() -> None:
    sharp, vague = np.diag([0.1, 0.1, 1.0, 1.0]), np.diag([9.0, 9.0, 4.0, 4.0])
    x, P = fused(np.zeros(4), sharp, np.ones(4), vague, "covariance-intersection")
    assert_allclose(P, sharp)
    assert_allclose(x, 0.0)


def test_events_of_one_object_become_one() -> None:
    r, b = np.array([20.0, 20.5, 30.0, 20.2, 30.4]), np.array([0.0, 0.02, 0.1, 0.03, 0.1])
    a = np.array([4.0, 1.0, 2.0, 3.0, 2.0])
    range_m, bearing, group = grouped(r, b, a, 2.0)
    assert group.tolist() == [0, 0, 1, 0, 1]
    assert_allclose(range_m, [(80.0 + 20.5 + 60.6) / 8.0, 30.2])
    assert_allclose(bearing, [(0.02 + 0.09) / 8.0, 0.1])


def test_groups_do_not_depend_on_order_nor_break_at_pi() -> None:
    rng = np.random.default_rng(3)
    r, b, a = rng.uniform(5.0, 40.0, 200), rng.uniform(-0.5, 0.5, 200), rng.random(200)
    order = rng.permutation(200)
    one, other = grouped(r, b, a, 2.0), grouped(r[order], b[order], a[order], 2.0)
    assert_allclose(one[0], other[0], rtol=1e-12)
    assert_array_equal(one[2][order], other[2])
    _, bearing, group = grouped(np.full(2, 20.0), np.array([3.13, -3.13]), np.array([1.0, 1.0]), 2.0)
    assert group.tolist() == [0, 0]
    assert abs(abs(bearing[0]) - np.pi) < 1e-9


@pytest.mark.parametrize("a", [0.0, -1.0, np.nan])
def test_groups_of_events_without_amplitude(a: float) -> None:
    range_m, _, group = grouped(np.array([20.0, 21.0]), np.zeros(2), np.full(2, a), 2.0)
    assert group.tolist() == [0, 0]
    assert range_m.tolist() == [20.5]
    assert grouped(np.zeros(0), np.zeros(0), np.zeros(0), 2.0)[0].size == 0


# --- life ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("max_propagate", [0, 5, 20])
@KINDS
def test_a_track_ends_after_its_score_and_one_miss(
    detections: Make, kind: type[Any], max_propagate: int
) -> None:
    tracker = kind(max_propagate=max_propagate, max_sd_m=1e3)
    for k in range(15):
        tracks = tracker(detections(k, 30.0, 0.1))
    assert tracks.status.tolist() == [CONFIRMED]
    after = [tracker(detections(15 + k, [], [])).status.tolist() for k in range(max_propagate + 2)]
    assert after == [[CONFIRMED]] * max_propagate + [[LOST], []]


@KINDS
def test_tracks_start_at_any_time_and_only_outside_gates(detections: Make, kind: type[Any]) -> None:
    tracker = kind()
    for k in range(60):
        late = k >= 30
        tracks = tracker(detections(k, [20.0, 35.0] if late else 20.0, [0.1, -0.2] if late else 0.1))
    assert tracks.id.tolist() == [1, 2]
    assert tracks.status.tolist() == [CONFIRMED, CONFIRMED]
    assert tracks.age.tolist() == [59, 29]


def pair(apart_m: float) -> TrackBank:
    bank = new_tracks(
        np.array([[20.0, 0.0], [20.0 + apart_m, 0.0]]), np.tile(np.eye(2), (2, 1, 1)), (1.0, 1.0), 1
    )
    bank.ledger["id"] = [1, 2]
    return bank


def parts_of(bank: TrackBank, events: list[list[int]], max_common: int = 3) -> list[int]:
    rows = bank.ledger
    for event in events:
        rows["history"] = 1
        rows, keep, part = settle_by_score(
            rows, bank.state, bank.covariance, np.array(event), np.zeros(2), (10, 5, 8.0), 20, 5.0, max_common,
            False,
        )  # fmt: skip
    assert keep.tolist() == [p < 0 for p in part]
    return [int(p) for p in part]


def test_tracks_with_three_common_events_in_a_row_are_one() -> None:
    assert parts_of(pair(0.5), [[4, 4]] * 2) == [-1, -1]
    assert parts_of(pair(0.5), [[4, 4]] * 3) == [-1, 0]
    assert parts_of(pair(0.5), [[4, 4], [1, 2], [4, 4], [4, 4]]) == [-1, -1]
    assert parts_of(pair(0.5), [[4, 4], [-1, 2], [4, 4], [4, 4]]) == [-1, 0]  # no common update between
    assert parts_of(pair(9.0), [[4, 4]] * 5) == [-1, -1]  # crossing, not one
    assert parts_of(pair(0.5), [[4, 4]] * 5, max_common=0) == [-1, -1]


def test_a_tentative_track_is_part_of_a_confirmed_one_however_old() -> None:
    bank = pair(0.5)
    bank.ledger["status"] = [TENTATIVE, CONFIRMED]
    bank.ledger["history"], bank.ledger["span"] = 0b111111, 6
    assert parts_of(bank, [[4, 4]] * 3) == [1, -1]


def pings_until_part_of(bank: TrackBank, none: list[float], max_common: int = 3) -> int:
    """How many pings like this two tracks that share events out go on as two; 200: for good."""
    rows = bank.ledger
    for k in range(200):
        rows["history"] = 1
        rows, keep, part = settle_by_score(
            rows, bank.state, bank.covariance, np.full(2, -1), np.array(none), (10, 5, 8.0), 20, 5.0, max_common,
            True,
        )  # fmt: skip
        rows["hits"] += 1
        if part.tolist() != [-1, -1]:
            assert (part.tolist(), keep.tolist()) == ([-1, 0], [True, False])
            return k
    return 200


def test_tracks_that_share_events_out_are_one_by_their_history() -> None:
    bank = pair(0.5)
    assert 2 <= pings_until_part_of(bank, [0.5, 0.5]) <= 10  # one event for both, and nothing before
    bank.ledger["hits"] = 500
    assert 35 <= pings_until_part_of(bank, [0.5, 0.5]) <= 45  # both long known
    assert pings_until_part_of(bank, [0.1, 0.1]) == 200  # an event each
    assert pings_until_part_of(bank, [1.0, 1.0]) == 200  # no event says nothing
    assert pings_until_part_of(bank, [0.5, 0.5], max_common=0) == 200
    far = pair(9.0)
    assert pings_until_part_of(far, [0.5, 0.5]) == 200


@KINDS
def test_swimmers_who_meet_in_one_echo_part_with_their_own_tracks(kind: type[Any]) -> None:
    dt, kept, seeds = 0.25, 0, 20
    for seed in range(seeds):
        rng, tracker = np.random.default_rng(seed), kind(group_m=0.0, p_d=0.9, extent_sd_m=0.2)
        ids: list[list[int]] = []
        for k in range(160):
            along = 0.45 * dt * (k - 80)
            both = np.array([[20.0 + along, 0.35 * along], [20.0 - 0.7 * along, 0.5 * along]])
            apart = np.hypot(*(both[0] - both[1]))
            there = both if apart > 0.8 else both.mean(axis=0, keepdims=True)
            there = there[rng.random(len(there)) < 0.95]
            there = there + 0.15 * rng.standard_normal(there.shape)
            tracks = tracker(strong(k, there, np.ones(len(there)), dt))
            on = tracks.select(tracks.status == CONFIRMED)
            if k in (40, 159):
                ids.append([int(on.id[np.hypot(*(on.state[:, :2] - one).T).argmin()]) for one in both])
        kept += int(ids[0] == ids[1])
    assert kept >= 0.85 * seeds


@KINDS
@pytest.mark.parametrize("fusion", ["algebraic", "covariance-intersection"])
def test_two_tracks_that_come_to_share_their_events_are_fused(
    detections: Make, kind: type[Any], fusion: str
) -> None:
    tracker, lost = kind(fusion=fusion, group_m=0.0), []
    for k in range(90):
        gap = max(4.0 - 0.1 * k, 0.0)
        r = [25.0, 25.0 + gap] if gap > 0.6 else [25.0 + gap / 2]
        tracks = tracker(detections(k, r, np.zeros(len(r))))
        lost += tracks.id[tracks.status == LOST].tolist()
    assert tracks.id.tolist() == [1]
    assert lost == [2]
    assert np.linalg.eigvalsh(tracks.covariance[0]).min() > 0.0


# --- as nodes -----------------------------------------------------------------------------------------------


def scene(observe: Make, seed: int, pings: int = 60, false: float = 6.0) -> list[Detections]:
    rng = np.random.default_rng(seed)
    start = np.array([[20.0, -6.0], [30.0, 5.0], [41.0, 0.0]])
    velocity = np.array([[0.1, 0.3], [0.0, 0.0], [-0.3, 0.1]])
    return [observe(rng, k, start + velocity * 0.5 * k, false=false) for k in range(pings)]


@KINDS
@pytest.mark.parametrize(
    "settings",
    [
        {"amplitude_sd": 0.4},
        {"frame": "ned"},
        {"group_m": 0.0, "estimate_noise": False},
        {"hit": "gated", "p_g": 1.0},
        {"sharing": "own"},
    ],
)
def test_the_contract_of_nodes(observe: Make, kind: type[Any], settings: dict[str, Any]) -> None:
    check_node(kind(**settings), [{"detections": ping} for ping in scene(observe, 1)])


@KINDS
@pytest.mark.parametrize("frame", ["sensor", "ned"])
@pytest.mark.parametrize("at", [0, 1, 25])
def test_snapshot_and_restore_go_on_bit_for_bit(observe: Make, kind: type[Any], frame: str, at: int) -> None:
    nav = NavState(0, 0, (1.0, 2.0, 0.0), (0.0, 0.0, 0.3))
    pings = [replace(p, view=replace(p.view, nav=nav)) for p in scene(observe, 5)]
    first, second = kind(frame=frame, amplitude_sd=0.5), kind(frame=frame, amplitude_sd=0.5)
    for ping in pings[:at]:
        first(ping)
    saved = first.snapshot()
    kept = {name: np.copy(value) if isinstance(value, np.ndarray) else value for name, value in saved.items()}
    expected = [first(ping) for ping in pings[at:]]
    for name, value in kept.items():
        assert np.array_equal(saved[name], value), name
        assert value is None or isinstance(value, (int, float, np.ndarray)), name
    second.restore(saved)
    assert all(same(e, second(ping)) for e, ping in zip(expected, pings[at:], strict=True))
    assert any(CONFIRMED in e.status for e in expected)


@KINDS
def test_the_order_of_detections_does_not_matter(observe: Make, kind: type[Any]) -> None:
    rng = np.random.default_rng(3)
    straight, shuffled = kind(group_m=0.0), kind(group_m=0.0)
    for ping in scene(observe, 2):
        a, b = straight(ping), shuffled(ping.select(rng.permutation(len(ping))))
        assert a.id.tolist() == b.id.tolist()
        assert_allclose(a.state, b.state, rtol=1e-8, atol=1e-8)


@KINDS
def test_a_ping_without_navigation_only_predicts(detections: Make, kind: type[Any]) -> None:
    def at(k: int, known: bool) -> Detections:
        ping = detections(k, 30.0, 0.0)
        nav = NavState(k, ping.stamp_ns, (0.0, 5.0, 1.0), (0.0, 0.0, 0.4)) if known else None
        return replace(ping, view=replace(ping.view, nav=nav))

    tracker = kind(frame="ned")
    for k in range(20):
        before = tracker(at(k, True))
    for k in range(20, 30):
        unseen = tracker(at(k, False))
    assert (unseen.status.tolist(), unseen.hits.tolist()) == ([CONFIRMED], before.hits.tolist())
    assert unseen.covariance[0, 0, 0] > before.covariance[0, 0, 0]
    assert tracker(at(30, True)).id.tolist() == [1]


@KINDS
def test_empty_and_bare_detections_are_answered(detections: Make, kind: type[Any]) -> None:
    tracker = kind()
    for k in range(3):
        tracks = tracker(detections(7 * k, [], []))
        assert (tracks.seq, len(tracks)) == (7 * k, 0)
    assert len(kind()(Detections(1, 2))) == 0


@KINDS
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_refused_and_changes_nothing(
    detections: Make, kind: type[Any], bad: float
) -> None:
    tracker = kind()
    for k in range(3):
        tracker(detections(k, [30.0, 20.0], [0.0, 0.1]))
    before = tracker.snapshot()
    with pytest.raises(ValueError, match="seq 3: 1 of 2 detections are not finite"):
        tracker(detections(3, [30.0, bad], [0.0, 0.1]))
    with pytest.raises(ValueError, match="not after the last ping"):
        tracker(detections(1, [30.0, 20.0], [0.0, 0.1]))
    assert all(np.array_equal(value, before[name]) for name, value in tracker.snapshot().items())


@KINDS
def test_a_huge_ping_is_bounded(observe: Make, kind: type[Any]) -> None:
    rng, tracker = np.random.default_rng(9), kind(max_tracks=100)
    for k in range(5):
        tracks = tracker(observe(rng, k, np.zeros((0, 2)), false=3000.0))
        assert len(tracks) <= 100 + np.count_nonzero(tracks.status == LOST)
        assert np.isfinite(tracks.state).all()


@KINDS
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("frame", "enu"),
        ("velocity_walk_mps", 0.0),
        ("sigma_d_m", -0.1),
        ("gamma", 0.0),
        ("p_d", 1.0),
        ("p_fa", 0.0),
        ("clutter", "none"),
        ("hit", "maybe"),
        ("sharing", "all"),
        ("amplitude_sd", 0.0),
        ("resolution_m", -1.0),
        ("n1", 11),
        ("max_propagate", 62),
        ("max_propagate", -1),
        ("max_common_events", -1),
        ("fusion", "mean"),
        ("group_m", -1.0),
        ("extent_sd_m", np.nan),
        ("speed_sd_mps", 0.0),
        ("max_sd_m", 0.0),
        ("max_tracks", 0),
    ],
)
def test_bad_parameters_are_named_with_their_value(kind: type[Any], name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name} = '?{value}"):
        kind(**{name: value})


# --- divers -------------------------------------------------------------------------------------------------


def swim(rng: np.random.Generator, pings: int, dt: float) -> FloatArray:
    """Positions (pings, 2) of a diver at 0.3 to 0.6 m/s who turns now and then and stays in the sector."""
    x, speed = np.array([rng.uniform(12.0, 30.0), rng.uniform(-6.0, 6.0)]), rng.uniform(0.3, 0.6)
    heading, rate, path = rng.uniform(-np.pi, np.pi), 0.0, []
    for _ in range(pings):
        rate += -0.2 * rate * dt + 0.12 * np.sqrt(dt) * rng.standard_normal()
        home = np.array([20.0, 0.0]) - x
        turn = (np.arctan2(home[1], home[0]) - heading + np.pi) % (2.0 * np.pi) - np.pi
        heading += dt * (np.clip(turn, -0.25, 0.25) if np.hypot(*home) > 11.0 else rate)
        x = x + dt * speed * np.array([np.cos(heading), np.sin(heading)])
        path.append(x)
    return np.array(path)


def seen(rng: np.random.Generator, k: int, xy: FloatArray, dt: float, false: float, cells: int) -> Detections:
    there = np.repeat(xy[None], cells if rng.random() < 0.65 else 0, axis=0)
    there = there + (0.3 * rng.standard_normal(there.shape) if cells > 1 else 0.0)
    n = int(rng.poisson(false))
    r = np.hypot(*there.T) + 0.2 * rng.standard_normal(len(there))
    b = np.arctan2(there[:, 1], there[:, 0]) + 0.01 * rng.standard_normal(len(there))
    r = np.concatenate([r, np.sqrt(rng.uniform(4.0, 1600.0, n))])
    b = np.concatenate([b, rng.uniform(VIEW.bearing_rad[0], VIEW.bearing_rad[-1], n)])
    m = r.size
    stamp = 10**9 + round(k * dt * 1e9)
    return Detections(
        k, stamp, r, b, 1.0 + rng.random(m), np.zeros((m, 2)), np.zeros((m, 2, 2)), np.zeros(m, np.uint8), VIEW
    )  # fmt: skip


@pytest.mark.parametrize(("kind", "false", "cells"), [(Pdaf, 5.0, 1), (Pdaf, 3.0, 6), (Nnkf, 2.0, 1)])
def test_one_track_per_diver_for_1200_pings_in_clutter(kind: type[Any], false: float, cells: int) -> None:
    dt, pings, divers = 0.25, 1200, 5
    held, covered, doubled, strangers = 0, 0, 0, 0
    for seed in range(divers):
        rng, tracker = np.random.default_rng(seed), kind()
        path, first = swim(rng, pings, dt), 0
        for k in range(pings):
            tracks = tracker(seen(rng, k, path[k], dt, false, cells))
            on = tracks.select(tracks.status == CONFIRMED)
            near = np.hypot(*(on.state[:, :2] - path[k]).T) < 3.0
            first = first or int(on.id[near][0] if near.any() else 0)
            held += int(first in on.id[near])
            covered += bool(near.any())
            doubled += int(np.count_nonzero(near) > 1)
            strangers += int(np.count_nonzero(~near))
    total = divers * pings
    assert held > 0.95 * total  # by the track that was there first
    assert covered > 0.98 * total
    assert doubled < 0.01 * total
    assert strangers < 0.03 * total


@pytest.mark.parametrize("amplitude", [np.nan, np.inf, -np.inf, 1e308])
def test_amplitudes_that_are_no_sensible_numbers_leave_tracks_finite(amplitude: float) -> None:
    places = np.array([[10.0, 0.0], [10.1, 0.0], [20.0, 3.0]])
    for node in (Pdaf(), Nnkf()):
        for k in range(8):
            tracks = node(strong(k, places, np.array([amplitude, 2.0, 3.0]), 0.1))
            assert len(tracks)
            assert np.isfinite(tracks.state).all()
            assert np.isfinite(tracks.covariance).all()
