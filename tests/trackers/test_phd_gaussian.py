"""The Gaussian-mixture forms of the PHD: weights and updates against slow references, and the cardinality."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import multivariate_normal, poisson

from fls_trackers.phd_cardinality import cardinality_predicted, cardinality_updated, elementary_symmetric
from fls_trackers.phd_gaussian import Mixture, explained, predicted
from fls_trackers.phd_reduction import reduced
from fls_trackers.phd_sector import Births, Measurements, Sector

SECTOR = Sector(20.0, 60.0, -math.radians(5.0), math.radians(5.0), 3.0, -2.0, 0.7)
SD = (0.25, math.radians(0.5))
NOWHERE = Births(1e-300, 59.0, 60.0, (0.0, 0.0), 0.5)


def measured(range_m, bearing_rad, sd=SD) -> Measurements:
    r, b = np.atleast_1d(np.asarray(range_m, float)), np.atleast_1d(np.asarray(bearing_rad, float))
    return Measurements(r, b, np.full(r.size, sd[0]), np.full(r.size, sd[1]))


def mixture(n: int, seed: int) -> Mixture:
    rng = np.random.default_rng(seed)
    r, b = rng.uniform(25, 55, n), rng.uniform(-0.06, 0.06, n)
    xy = SECTOR.pose.to_ned(np.stack([r * np.cos(b), r * np.sin(b)], axis=1))
    root = rng.normal(0.0, 0.2, (n, 4, 4))
    state = np.concatenate([xy, rng.normal(0.0, 1.0, (n, 2))], axis=1)
    return Mixture(rng.random(n), state, root @ root.transpose(0, 2, 1) + 0.01 * np.eye(4))


def seen_from(x: np.ndarray) -> np.ndarray:
    dx, dy = x[0] - SECTOR.north_m, x[1] - SECTOR.east_m
    return np.array([math.hypot(dx, dy), math.atan2(dy, dx) - SECTOR.heading_rad])


def jacobian(x: np.ndarray) -> np.ndarray:
    H = np.zeros((2, 4))
    for a in range(2):
        step = np.zeros(4)
        step[a] = 1e-5
        H[:, a] = (seen_from(x + step) - seen_from(x - step)) / 2e-5
    return H


def test_pairs_are_extended_kalman_updates_with_their_likelihoods():
    before = mixture(5, 1)
    polar = np.array([seen_from(x) for x in before.state])
    z = measured(polar[:, 0] + 0.1, polar[:, 1] - 0.004)
    found = explained(before, NOWHERE, z, 0.9, SECTOR)
    R = np.diag([z.range_sd_m[0] ** 2, z.bearing_sd_rad[0] ** 2])
    k = 0
    for x, P, w, missed in zip(before.state, before.covariance, before.weight, found.missed, strict=True):
        H = jacobian(x)
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        for i in range(5):
            nu = np.array([z.range_m[i], z.bearing_rad[i]]) - seen_from(x)
            if nu @ np.linalg.solve(S, nu) > 25.0:
                continue
            q = multivariate_normal.pdf(nu, cov=S)
            assert found.measurement[k] == i
            assert_allclose(found.pairs.weight[k], (1.0 - missed) * w * q, rtol=1e-6)
            assert_allclose(found.pairs.state[k], x + K @ nu, atol=1e-7)
            assert_allclose(found.pairs.covariance[k], P - K @ S @ K.T, atol=1e-7)
            k += 1
    assert k >= 5
    assert len(found.pairs.weight) == k + len(z)  # and a birth at each
    assert_allclose(found.total, np.bincount(found.measurement, found.pairs.weight, len(z)))


def test_detection_counts_the_part_of_a_component_inside_the_sector():
    border = SECTOR.pose.to_ned(np.array([[60.0, 0.0], [40.0, 0.0], [80.0, 0.0]]))
    state = np.concatenate([border, np.zeros((3, 2))], axis=1)
    before = Mixture(np.ones(3), state, np.broadcast_to(0.01 * np.eye(4), (3, 4, 4)).copy())
    found = explained(before, NOWHERE, measured([], []), 0.9, SECTOR)
    assert_allclose(found.missed, [0.55, 0.1, 1.0], atol=1e-9)
    after = predicted(before, 1e-3, 0.1, 0.99, SECTOR)
    assert_allclose(after.weight, [0.495, 0.99, 0.0], atol=1e-3)
    assert_allclose(predicted(before, 1.0, 0.1, 0.99, None).weight, 1.0)


@pytest.mark.parametrize(("r", "b"), [(58.0, 0.0), (55.9, 0.0), (60.2, 0.01), (57.0, 0.086)])
def test_the_birth_at_a_measurement_is_the_integral_over_the_far_end(r, b):
    births = Births(0.1, 56.0, 60.0, (-1.0, 0.2), 0.5)
    z = measured(r, b)
    found = explained(Mixture.empty(), births, z, 0.9, SECTOR)
    ranges = 56.0 + (np.arange(2000) + 0.5) * 0.002
    bearings = -math.radians(5.0) + (np.arange(2000) + 0.5) * math.radians(10.0) / 2000
    g_r = np.exp(-0.5 * ((ranges - r) / 0.25) ** 2) / (0.25 * math.sqrt(2 * math.pi))
    sb = math.radians(0.5)
    g_b = np.exp(-0.5 * ((bearings - b) / sb) ** 2) / (sb * math.sqrt(2 * math.pi))
    density = 0.1 / (0.5 * math.radians(10.0) * (60.0**2 - 56.0**2))
    C = 0.9 * density * (g_r * ranges).sum() * 0.002 * g_b.sum() * math.radians(10.0) / 2000
    assert_allclose(found.total, [C], rtol=0.01)
    assert_allclose(found.pairs.state[0, 2:], [-1.0, 0.2])
    H = jacobian(found.pairs.state[0])
    assert_allclose(seen_from(found.pairs.state[0]), [r, b], atol=1e-9)
    assert_allclose(H @ found.pairs.covariance[0] @ H.T, np.diag([0.0625, sb**2]), atol=1e-6)


def test_reduction_keeps_the_mass_and_the_moments_of_what_it_merges():
    near = mixture(3, 2)
    state = near.state[:1] + np.array([[0.0] * 4, [0.05] * 4, [-0.05] * 4])
    other = mixture(1, 5)
    whole = Mixture(np.array([0.5, 0.3, 0.1]), state, near.covariance).joined(
        other._replace(state=other.state + 5.0, weight=np.array([0.95]))
    )
    after, _ = reduced(whole, 1e-5, 4.0, 100)
    assert_allclose(after.weight, [0.95, 0.9])
    w = np.array([0.5, 0.3, 0.1]) / 0.9
    mean = w @ state
    spread = sum(
        part * (P + np.outer(x - mean, x - mean))
        for part, P, x in zip(w, near.covariance, state, strict=True)
    )
    assert_allclose(after.state[1], mean, rtol=1e-12)
    assert_allclose(after.covariance[1], spread, rtol=1e-9)
    assert_allclose(reduced(whole, 0.2, 0.0, 100)[0].weight, [0.95, 0.5, 0.3])
    assert_allclose(reduced(whole, 0.2, 0.0, 2)[0].weight, [0.95, 0.5])
    assert reduced(Mixture.empty(), 1e-5, 4.0, 10)[0].weight.shape == (0,)


def test_elementary_symmetric_functions_are_sums_over_subsets():
    values = np.array([0.3, 2.0, 5.0, 0.7])
    expected = [sum(math.prod(c) for c in itertools.combinations(values, j)) for j in range(5)]
    assert_allclose(elementary_symmetric(values, 30, -1), expected)
    assert_allclose(elementary_symmetric(values, 2, -1), expected[:3])
    rest = [sum(math.prod(c) for c in itertools.combinations(values[[0, 2, 3]], j)) for j in range(4)]
    assert_allclose(elementary_symmetric(values, 30, 1), rest)


def test_the_cardinality_of_survivors_and_births():
    p = np.zeros(31)
    p[2] = 1.0
    after = cardinality_predicted(p, 0.9, 0.3)
    for n in range(6):
        expected = sum(math.comb(2, k) * 0.9**k * 0.1 ** (2 - k) * poisson.pmf(n - k, 0.3) for k in range(3))
        assert_allclose(after[n], expected, rtol=1e-9)
    assert_allclose(after.sum(), 1.0, rtol=1e-12)


def test_a_poisson_number_of_targets_makes_it_the_plain_filter():
    """With a Poisson prior the cardinalised weights are 1 on missed and 1 / (1 + ratio) on detected ones."""
    mass, detected = 2.5, 0.9 * 2.5
    ratio = np.array([4.0, 0.01, 30.0, 1.0])
    p, missed, each = cardinality_updated(poisson.pmf(np.arange(80), mass), ratio, detected, mass)
    assert_allclose(missed, 1.0, rtol=1e-9)
    assert_allclose(each, 1.0 / (1.0 + ratio), rtol=1e-9)
    assert_allclose(p @ np.arange(80), (mass - detected) + (ratio / (1.0 + ratio)).sum(), rtol=1e-9)


def test_the_number_after_a_ping_equals_enumeration():
    """One spatial cell: n targets, each detected with p_d, as the measurement or none; Poisson clutter."""
    p, p_d, ratio = np.array([0.2, 0.5, 0.2, 0.1]), 0.8, np.array([3.0, 0.5])
    mass = float(p @ np.arange(4))
    # ratio_i = p_d mass g_i / kappa: a target gives measurement i with p_d g_i = ratio_i kappa / mass
    likelihood = np.zeros(4)
    for n in range(4):
        for k in range(min(n, 2) + 1):
            for chosen in itertools.combinations(range(2), k):
                ways = math.perm(n, k) * (1.0 - p_d) ** (n - k)
                likelihood[n] += ways * math.prod(ratio[i] / mass for i in chosen)
    expected = likelihood * p / (likelihood @ p)
    after, missed, each = cardinality_updated(p, ratio, p_d * mass, mass)
    assert_allclose(after, expected, rtol=1e-12)
    # the mass of the intensity is the mean number
    total = missed * (1.0 - p_d) * mass + (each * ratio).sum()
    assert_allclose(total, after @ np.arange(4), rtol=1e-12)


def test_no_measurement_and_no_component():
    p, missed, each = cardinality_updated(np.array([0.5, 0.5]), np.zeros(0), 0.45, 0.5)
    assert_allclose(p, [0.5 / 0.55, 0.05 / 0.55])
    assert each.shape == (0,)
    assert missed > 0.0
    found = explained(Mixture.empty(), NOWHERE, measured([], []), 0.9, SECTOR)
    assert_array_equal(found.total, [])


def test_many_targets_and_large_ratios_stay_finite():
    p = np.full(201, 1.0 / 201)
    after, missed, each = cardinality_updated(p, np.full(400, 1e6), 150.0, 160.0)
    assert_allclose(after.sum(), 1.0)
    assert np.isfinite([missed, *each]).all()
    assert after.argmax() == 200
