"""What the tracker promises on average: calibrated probabilities, honest covariances, few false tracks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from fls_flow import Detections, Tracks
from fls_trackers.association import associate
from fls_trackers.gating import gate
from fls_trackers.jpda import Jpda

Observe = Callable[..., Detections]
FloatArray = npt.NDArray[np.float64]
SD, SB = 0.3, float(np.deg2rad(1.5))


def _joint_trial(
    rng: np.random.Generator, gamma: float, p_g: float
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Probabilities of pairs, and whether each is right, for two close tracks in clutter."""
    p_d, density, half = 0.8, 0.05, 12.0
    state = np.array([[0.0, 0.0, 0.0, 0.0], [1.5, 1.0, 0.0, 0.0]])
    P = np.tile(np.diag([0.6, 0.4, 1.0, 1.0]), (2, 1, 1))
    R = np.tile(np.diag([0.3, 0.5]), (2, 1, 1))
    truth = state[:, :2] + rng.standard_normal((2, 2)) * np.sqrt([0.6, 0.4])
    echoes = truth + rng.standard_normal((2, 2)) * np.sqrt([0.3, 0.5])
    seen = np.flatnonzero(rng.random(2) < p_d)
    false = rng.uniform(-half, half, (rng.poisson(density * 4 * half**2), 2))
    y = np.concatenate([echoes[seen], false])
    gated = gate(state, P, R, y, gamma)
    found = associate(gated, np.full(len(y), density), np.zeros(2, np.int64), p_d=p_d, p_g=p_g)
    track = np.repeat([0, 1], np.diff(gated.start))
    origin = np.concatenate([seen, np.full(len(false), -1)])
    return found.beta, origin[gated.places] == track


def _worst_bin(gamma: float, p_g: float) -> float:
    """The largest difference between the mean probability of pairs and how often they are right."""
    rng = np.random.default_rng(1)
    trials = [_joint_trial(rng, gamma, p_g) for _ in range(12_000)]
    beta, right = (np.concatenate(parts) for parts in zip(*trials, strict=True))
    which = np.digitize(beta, np.linspace(0.0, 1.0, 11)[1:-1])
    bins = [which == i for i in range(10) if np.count_nonzero(which == i) > 400]
    assert len(bins) >= 8
    return max(abs(float(right[i].mean() - beta[i].mean())) for i in bins)


def test_probabilities_are_frequencies() -> None:
    # A wide gate leaves sampling errors only; a narrow one adds echoes that fall into the other track's gate.
    assert _worst_bin(9.0, 1.0 - np.exp(-4.5)) < 0.025
    assert _worst_bin(4.0, 1.0 - np.exp(-2.0)) < 0.035


def test_probabilities_as_printed_are_too_sure() -> None:
    assert _worst_bin(4.0, 1.0) > 0.06


def nearest(tracks: Tracks, xy: FloatArray) -> int:
    return int(np.argmin(np.hypot(*(tracks.state[:, :2] - xy).T)))


def test_errors_match_covariances_over_100_runs(observe: Observe) -> None:
    # Targets move and are measured as the tracker believes; 3 false detections per ping, p_d 0.9.
    runs, pings, burn_in, q, v_sd = 100, 70, 25, 0.03, 0.3
    full, position = np.empty((runs, pings - burn_in)), np.empty((runs, pings - burn_in))
    for run in range(runs):
        rng = np.random.default_rng(run)
        x = np.array([32.0, rng.uniform(-4.0, 4.0), *(v_sd * rng.standard_normal(2))])
        tracker = Jpda(sigma_d_m=SD, sigma_delta_deg=1.5, sigma_v_mps2=q, speed_sd_mps=v_sd)
        for k in range(pings):
            if k:
                a = q * rng.standard_normal(2)
                x = np.concatenate([x[:2] + 0.5 * x[2:] + 0.125 * a, x[2:] + 0.5 * a])
            tracks = tracker(observe(rng, k, x[:2], sd=(SD, SB), false=3.0))
            if k >= burn_in:
                t = nearest(tracks, x[:2])
                e, P = tracks.state[t] - x, tracks.covariance[t]
                full[run, k - burn_in] = e @ np.linalg.solve(P, e)
                position[run, k - burn_in] = e[:2] @ np.linalg.solve(P[:2, :2], e[:2])
    for nees, dof in ((position, 2), (full, 4)):
        low, high = chi2.ppf([0.025, 0.975], dof * runs) / runs
        over_time = nees.mean(axis=0)
        assert low < over_time[-1] < high, dof
        assert low < over_time.mean() < high, dof
        assert np.mean((over_time > low) & (over_time < high)) > 0.85, dof


@pytest.mark.parametrize("per_ping", [1.0, 10.0])
def test_clutter_alone_starts_no_track(observe: Observe, per_ping: float) -> None:
    confirmed = 0
    for seed in range(5):
        rng, tracker = np.random.default_rng(seed), Jpda()
        for k in range(300):
            tracks = tracker(observe(rng, k, [], false=per_ping))
            confirmed += np.count_nonzero((tracks.status == 1) & (tracks.hits == tracks.age + 1))
            confirmed += np.count_nonzero(tracks.status == 2)
    assert confirmed <= 1


def test_the_printed_start_rule_presumes_few_false_detections(observe: Observe) -> None:
    ends = {}
    for per_ping in (1.0, 10.0):
        rng, tracker = np.random.default_rng(1), Jpda(preset="paper")
        ids = set[int]()
        for k in range(150):
            ids |= set(tracker(observe(rng, k, [], false=per_ping)).id.tolist())
        ends[per_ping] = len(ids)
    assert ends[1.0] == 0
    assert ends[10.0] > 5


def _ospa(truth: FloatArray, found: FloatArray, cutoff: float = 10.0) -> float:
    if not len(found):
        return cutoff
    gap = np.minimum(np.linalg.norm(truth[:, None] - found[None], axis=2), cutoff)
    i, j = linear_sum_assignment(gap)
    return float((gap[i, j].sum() + cutoff * abs(len(truth) - len(found))) / max(len(truth), len(found)))


@pytest.mark.parametrize(
    ("settings", "seeds"),
    [({"preset": "points"}, range(10)), ({"sigma_d_m": 0.05, "sigma_delta_deg": 1.5}, range(3))],
)
def test_five_targets_in_ten_false_detections(
    observe: Observe, settings: dict[str, Any], seeds: range
) -> None:
    start = np.array([[15.0, 3.0], [22.0, -5.0], [30.0, 8.0], [36.0, -12.0], [44.0, 2.0]])
    velocity = np.array([[0.05, 0.02], [0.1, 0.0], [-0.05, -0.05], [0.0, 0.1], [-0.1, 0.02]])
    for seed in seeds:
        rng = np.random.default_rng(seed)
        tracker = Jpda(**settings)
        ospa, followed, ids = [], 0, set[int]()
        owner: list[set[int]] = [set() for _ in start]
        for k in range(300):
            xy = start + 0.5 * k * velocity
            tracks = tracker(observe(rng, k, xy, false=10.0))
            on = tracks.select(tracks.status == 1)
            ospa.append(_ospa(xy, on.state[:, :2]))
            ids |= set(on.id.tolist())
            for target in range(5):
                if len(on) and np.linalg.norm(on.state[nearest(on, xy[target]), :2] - xy[target]) < 4.0:
                    followed += 1
                    owner[target].add(int(on.id[nearest(on, xy[target])]))
        assert np.mean(ospa) <= 0.52
        assert followed / 1500 >= 0.975
        assert len(ids) == 5
        assert [len(one) for one in owner] == [1] * 5


def test_crossing_targets_keep_their_ids(observe: Observe) -> None:
    swaps = 0
    for seed in range(10):
        rng, tracker = np.random.default_rng(seed), Jpda(sigma_d_m=0.05, sigma_delta_deg=1.5)
        for k in range(120):
            xy = np.array([[20.0 + 0.15 * k, -6.0 + 0.1 * k], [38.0 - 0.15 * k, -6.0 + 0.1 * k]])
            tracks = tracker(observe(rng, k, xy, false=2.0))
            if k == 30:
                before = [int(tracks.id[nearest(tracks, p)]) for p in xy]
        swaps += [int(tracks.id[nearest(tracks, p)]) for p in xy] != before
    assert swaps == 0
