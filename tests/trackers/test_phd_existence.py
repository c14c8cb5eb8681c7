"""Identities within a PHD filter: existence by Bayes' rule, joining, and estimates that outlive a miss."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_trackers.gm_phd import GmPhd
from fls_trackers.particle_phd import ParticlePhd
from fls_trackers.phd_clouds import clouds
from fls_trackers.phd_existence import MOST_CERTAIN, Labelled, existing, reduced_by_label, strongest
from fls_trackers.phd_gaussian import Mixture, explained
from fls_trackers.phd_particles import updated, updated_by_label
from fls_trackers.phd_sector import Births, Measurements, Sector

SECTOR = Sector(20.0, 60.0, -math.radians(5.0), math.radians(5.0))
SD = (0.25, math.radians(0.5))
NOWHERE = Births(1e-300, 59.0, 60.0, (0.0, 0.0), 0.5)


def measured(*places: tuple[float, float]) -> Measurements:
    r, b = np.array(places, float).reshape(-1, 2).T
    return Measurements(r.copy(), b.copy(), np.full(r.size, SD[0]), np.full(r.size, SD[1]))


def components(*parts: tuple[float, float, float]) -> Mixture:
    """Weight, x, y of each; at rest."""
    w, x, y = np.array(parts, float).reshape(-1, 3).T
    state = np.stack([x, y, 0.0 * x, 0.0 * x], axis=1)
    return Mixture(w.copy(), state, np.broadcast_to(0.04 * np.eye(4), (w.size, 4, 4)).copy())


def by_label(found: Labelled) -> dict[int, float]:
    return {int(one): float(found.mixture.weight[found.label == one].sum()) for one in np.unique(found.label)}


@pytest.mark.parametrize("r", [0.1, 0.5, 0.9])
def test_one_target_in_clutter_is_exactly_bayes(r):
    """Over all ways that the target made one of the measurements, or none, with Poisson clutter."""
    z, kappa, p_d = measured((40.1, 0.002), (39.8, -0.001), (55.0, 0.05)), 2.0, 0.8
    before = Labelled(components((0.7 * r, 40.0, 0.0), (0.3 * r, 40.3, 0.1)), np.zeros(2, np.int64))
    found = explained(before.mixture, NOWHERE, z, p_d, SECTOR)
    g = np.bincount(found.measurement, found.pairs.weight, 3) / (p_d * r)  # a measurement's density
    there = r * ((1.0 - p_d) + p_d * sum(g[i] / kappa for i in range(3)))
    after = by_label(existing(before, found, kappa, 1))
    assert_allclose(after[0], there / (there + 1.0 - r), rtol=1e-12)


def test_a_miss_takes_existence_away_by_bayes_not_the_mass():
    before = Labelled(components((0.95, 40.0, 0.0)), np.zeros(1, np.int64))
    found = explained(before.mixture, NOWHERE, measured(), 0.9, SECTOR)
    after = existing(before, found, 2.0, 1)
    assert_allclose(after.mixture.weight, [0.095 / (0.095 + 0.05)], rtol=1e-12)


def test_a_birth_exists_with_its_share_of_what_may_have_made_the_measurement():
    births = Births(0.1, 56.0, 60.0, (-1.0, 0.0), 0.5)
    z = measured((58.0, 0.0), (58.5, 0.03))
    found = explained(Mixture.empty(), births, z, 0.9, SECTOR)
    after = existing(Labelled.empty(), found, 3.0, 7)
    assert by_label(after) == pytest.approx({7: found.total[0] / (3.0 + found.total[0]), 8: found.total[1] / (3.0 + found.total[1])}, rel=1e-12)  # fmt: skip


def test_a_hand_worked_pair_that_shares_a_measurement():
    """Each has the other, and the clutter, as a rival."""
    z, kappa, p_d, w = measured((40.0, 0.0)), 2.0, 0.9, (0.6, 0.8)
    before = Labelled(components((w[0], 39.9, 0.0), (w[1], 40.2, 0.0)), np.array([3, 5]))
    found = explained(before.mixture, NOWHERE, z, p_d, SECTOR)
    own = found.pairs.weight[:2]
    after = by_label(existing(before, found, kappa, 9))
    for name, r, mine, rival in ((3, w[0], own[0], own[1]), (5, w[1], own[1], own[0])):
        there = r * (1.0 - p_d) + mine / (kappa + rival)
        assert_allclose(after[name], there / (1.0 - r + there), rtol=1e-9)


def test_two_targets_and_their_two_measurements_come_near_the_joint_answer():
    """Against all joint assignments of two targets that exist for sure: the linear form is close, not equal."""
    z, kappa, p_d = measured((40.0, 0.0), (42.0, 0.0)), 1.0, 0.9
    before = Labelled(components((0.9, 40.1, 0.0), (0.9, 42.1, 0.0)), np.array([0, 1]))
    found = explained(before.mixture, NOWHERE, z, p_d, SECTOR)
    g = np.zeros((2, 2))
    np.add.at(g, (found.parent[:-2], found.measurement[:-2]), found.pairs.weight[:-2] / (p_d * 0.9))
    there = np.zeros((2, 2))  # [target, exists]: weight of all joint events
    for exists in itertools.product((0, 1), repeat=2):
        prior = math.prod(0.9 if one else 0.1 for one in exists)
        for taken in itertools.product((-1, 0, 1), repeat=2):
            used = [i for i in taken if i >= 0]
            if len(set(used)) < len(used) or any(
                i >= 0 and not e for i, e in zip(taken, exists, strict=True)
            ):
                continue
            weight = prior
            for t, i in enumerate(taken):
                if exists[t]:
                    weight *= (1.0 - p_d) if i < 0 else p_d * g[t, i] / kappa
            for t in range(2):
                there[t, exists[t]] += weight
    exact = there[:, 1] / there.sum(axis=1)
    after = by_label(existing(before, found, kappa, 9))
    assert_allclose([after[0], after[1]], exact, atol=0.01)


def test_existence_stays_a_probability_and_does_not_depend_on_the_order():
    rng = np.random.default_rng(1)
    for _ in range(50):
        n, m = int(rng.integers(1, 12)), int(rng.integers(0, 8))
        r, b = rng.uniform(30, 34, n), rng.uniform(-0.02, 0.02, n)
        weight = rng.random(n)
        label = np.sort(rng.integers(0, 4, n))
        weight *= (rng.random(4) / np.maximum(np.bincount(label, weight, 4), 1e-9))[label]
        mixture = components(*zip(weight, r * np.cos(b), r * np.sin(b), strict=True))
        z = measured(*zip(rng.uniform(30, 34, m), rng.uniform(-0.02, 0.02, m), strict=True))
        found = explained(mixture, NOWHERE, z, 0.9, SECTOR)
        after = by_label(existing(Labelled(mixture, label), found, 0.5, 100))
        assert all(0.0 <= one <= 1.0 for one in after.values())
        turned = Measurements(z.range_m[::-1], z.bearing_rad[::-1], z.range_sd_m, z.bearing_sd_rad)
        again = explained(mixture, NOWHERE, turned, 0.9, SECTOR)
        other = by_label(existing(Labelled(mixture, label), again, 0.5, 100))
        assert [other[one] for one in range(4) if one in other] == pytest.approx(
            [after[one] for one in range(4) if one in after], rel=1e-9
        )


def test_labels_of_one_target_are_joined_and_those_of_two_are_not():
    near = components((0.5, 40.0, 0.0), (0.3, 40.1, 0.0), (0.2, 50.0, 0.0))
    after = reduced_by_label(Labelled(near, np.array([4, 6, 6])), 1e-5, 4.0, 10)
    assert by_label(after) == pytest.approx({4: 0.8, 6: 0.2})
    two = components((0.9, 40.0, 0.0), (0.8, 40.1, 0.0))
    after = reduced_by_label(Labelled(two, np.array([4, 6])), 1e-5, 4.0, 10)
    assert by_label(after) == pytest.approx({4: 0.9, 6: 0.8})
    sure = components((0.8, 40.0, 0.0), (0.7, 45.0, 0.0))
    after = reduced_by_label(Labelled(sure, np.array([4, 4])), 1e-5, 4.0, 10)
    assert by_label(after) == pytest.approx({4: MOST_CERTAIN})
    assert reduced_by_label(Labelled.empty(), 1e-5, 4.0, 10).label.shape == (0,)


def test_estimates_are_the_moments_of_the_likeliest_labels():
    mixture = components((0.3, 40.0, 0.0), (0.6, 50.0, 1.0), (0.1, 41.0, 2.0))
    state, covariance, r = strongest(Labelled(mixture, np.array([0, 1, 0])), 5)
    assert_allclose(r, [0.6, 0.4])
    assert_allclose(state[:, :2], [[50.0, 1.0], [40.25, 0.5]])
    assert_allclose(covariance[1, :2, :2], 0.04 * np.eye(2) + 0.1875 * np.array([[1.0, 2.0], [2.0, 4.0]]))
    assert len(strongest(Labelled(mixture, np.array([0, 1, 0])), 1)[2]) == 1


def slow_by_label(state, weight, label, z, kappa, p_d):
    """The update as its formula says, particle by particle."""
    r, b = np.hypot(state[:, 0], state[:, 1]), np.arctan2(state[:, 1], state[:, 0])
    u = (r[:, None] - z.range_m) / z.range_sd_m
    v = (b[:, None] - z.bearing_rad) / z.bearing_sd_rad
    g = p_d * np.exp(-0.5 * (u**2 + v**2)) / (2.0 * np.pi * z.range_sd_m * z.bearing_sd_rad)
    own = np.array(
        [[(weight * g[:, i])[label == one].sum() for i in range(len(z))] for one in range(label.max() + 1)]
    )
    w = weight * (1.0 - p_d + (g / (kappa + own.sum(axis=0) - own[label])).sum(axis=1))
    before, after = np.bincount(label, weight), np.bincount(label, w)
    return w / (1.0 - before + after)[label]


def test_particles_with_labels_follow_the_formula():
    rng = np.random.default_rng(3)
    label = np.repeat([0, 1, 2], 40)
    centre = np.array([[40.0, 0.0], [40.6, 0.3], [50.0, -1.0]])[label]
    state = np.concatenate([centre + rng.normal(0.0, 0.2, (120, 2)), np.zeros((120, 2))], axis=1)
    weight = rng.random(120) * 0.02
    z = measured((40.0, 0.0), (40.4, 0.004), (50.1, -0.02))
    found = updated_by_label(state, weight, label, 3, z, 0.7, 0.9, SECTOR)
    assert_allclose(found.weight, slow_by_label(state, weight, label, z, 0.7, 0.9), rtol=1e-6)
    plain = updated(state, weight, z, 0.7, 0.9, SECTOR)
    assert_allclose(found.taken, plain.taken, rtol=1e-12)


def test_particles_of_a_cloud_and_the_same_gaussian_agree():
    """A label as 200,000 particles or as one component: the same existence."""
    rng = np.random.default_rng(4)
    mixture = components((0.6, 40.0, 0.0), (0.7, 40.9, 0.2))
    z = measured((40.2, 0.003), (41.0, 0.004))
    expected = by_label(
        existing(Labelled(mixture, np.arange(2)), explained(mixture, NOWHERE, z, 0.9, SECTOR), 1.5, 5)
    )
    n = 200_000
    label = np.repeat([0, 1], n)
    state = mixture.state[label] + np.concatenate([rng.normal(0.0, 0.2, (2 * n, 4))])
    found = updated_by_label(state, mixture.weight[label] / n, label, 2, z, 1.5, 0.9, SECTOR)
    assert_allclose(np.bincount(label, found.weight), [expected[0], expected[1]], rtol=0.01)


def test_clouds_have_the_moments_of_their_particles():
    rng = np.random.default_rng(5)
    state, weight, label = rng.normal(0.0, 1.0, (300, 4)), rng.random(300) * 0.004, np.repeat([0, 1, 2], 100)
    state[:, 0] += 20.0 * label
    found = clouds(state, weight, label, 1e-6, 4.0, 0.1)
    assert_array_equal(found.label, label)
    for one in range(3):
        mine = label == one
        mean = np.average(state[mine], axis=0, weights=weight[mine])
        apart = state[mine] - mean
        spread = (weight[mine, None] * apart).T @ apart / weight[mine].sum() + 0.01 * np.eye(4)
        assert_allclose(found.mean[one], mean, rtol=1e-9)
        assert_allclose(found.covariance[one], spread, rtol=1e-9, atol=1e-12)
        assert_allclose(found.existence[one], weight[mine].sum(), rtol=1e-12)


def test_clouds_of_one_target_are_joined_weak_ones_go_and_labels_close_up():
    rng = np.random.default_rng(6)
    label = np.repeat([0, 1, 2, 3], 50)
    state = rng.normal(0.0, 0.3, (200, 4)) + np.array([0.0, 30.0, 0.0, 60.0])[label, None] * [
        1.0,
        0.0,
        0.0,
        0.0,
    ]
    weight = np.array([0.5, 1e-8, 0.3, 0.9])[label] / 50
    found = clouds(state, weight, label, 1e-5, 4.0, 0.05)
    assert_allclose(found.existence, [0.8, 0.9])
    assert_array_equal(found.label[label == 2], 0)
    assert_array_equal(found.label[label == 3], 1)
    assert (found.weight[label == 1] == 0.0).all()
    both = clouds(state, np.array([0.7, 0.0, 0.6, 0.9])[label] / 50, label, 1e-5, 4.0, 0.05)
    assert_allclose(np.sort(both.existence), [0.6, 0.7, 0.9])
    nothing = clouds(np.zeros((0, 4)), np.zeros(0), np.zeros(0, np.int64), 1e-5, 4.0, 0.05)
    assert nothing.existence.shape == (0,)
    gone = clouds(state, np.zeros(200), label, 1e-5, 4.0, 0.05)
    assert gone.existence.shape == (0,)
    assert not gone.weight.any()


SCENE: dict[str, Any] = {"births": "anywhere", "sigma_range_m": 0.1, "sigma_bearing_deg": 0.5, "p_b": 0.05}


@pytest.mark.parametrize("kind", [GmPhd, ParticlePhd])
def test_an_estimate_outlives_one_miss_and_in_the_plain_filter_it_does_not(kind, detections):
    shown = {}
    for recursion in ("labelled", "phd"):
        node = kind(recursion=recursion, clutter_per_ping=1.0, p_d=0.9, **SCENE)
        for k in range(8):
            node(detections(k, [30.0, 40.0], [0.0, 0.2]))
        shown[recursion] = len(node(detections(8, [30.0], [0.0])).intensity)
    assert shown == {"labelled": 2, "phd": 1}


@pytest.mark.parametrize("kind", [GmPhd, ParticlePhd])
def test_a_target_missed_in_the_first_ping_is_found_though_births_are_at_the_far_end(kind, detections):
    node = kind(clutter_per_ping=1.0, p_d=0.8, sigma_range_m=0.1, sigma_bearing_deg=0.5, prior_targets=1.0)
    for k in range(10):
        answer = node(detections(k, [] if k == 0 else [20.0], [] if k == 0 else [0.0]))
    assert len(answer.intensity) == 1
    assert answer.intensity.expected_targets > 0.9
