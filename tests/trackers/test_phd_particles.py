"""The particle form of the PHD: hand-worked weights, a slow reference, and where the mass goes."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_trackers.particle_phd import ParticlePhd
from fls_trackers.phd_births import born
from fls_trackers.phd_mixture import centres, fitted, local_mass
from fls_trackers.phd_particles import propagated, resampled, updated
from fls_trackers.phd_sector import Births, Measurements, Sector

SECTOR = Sector(20.0, 60.0, -math.radians(5.0), math.radians(5.0))
SD = (0.5, math.radians(0.5))
FAR_END = Births(0.1, 56.0, 60.0, (-1.0, 0.0), 0.5)


def measured(range_m, bearing_rad, sd=SD) -> Measurements:
    r = np.atleast_1d(np.asarray(range_m, float))
    b = np.atleast_1d(np.asarray(bearing_rad, float))
    return Measurements(r, b, np.full(r.size, sd[0]), np.full(r.size, sd[1]))


def cloud(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    r, b = rng.uniform(18.0, 62.0, n), rng.uniform(-0.1, 0.1, n)
    xy = np.stack([r * np.cos(b), r * np.sin(b)], axis=1)
    return np.concatenate([xy, rng.normal(0.0, 1.0, (n, 2))], axis=1), rng.uniform(0.0, 0.01, n)


def slow_update(state, weight, z, kappa, p_d):
    """Clark & Bell (13) as it stands, with pD inside the sums."""
    r, b = np.hypot(state[:, 0], state[:, 1]), np.arctan2(state[:, 1], state[:, 0])
    inside = (r >= 20.0) & (r <= 60.0) & (np.abs(b) <= math.radians(5.0))
    pd = np.where(inside, p_d, 0.0)
    u = (r[:, None] - z.range_m) / z.range_sd_m
    v = (b[:, None] - z.bearing_rad) / z.bearing_sd_rad
    g = np.exp(-0.5 * (u**2 + v**2)) / (2.0 * np.pi * z.range_sd_m * z.bearing_sd_rad)
    C = (pd * weight) @ g
    return ((1.0 - pd) + (pd[:, None] * g / (kappa + C)).sum(axis=1)) * weight


def test_a_hand_worked_update():
    # two particles on the axis at 40 and 41 m, one measurement at 40.5 m: both half a sigma off
    sb = math.radians(0.5)
    state = np.array([[40.0, 0.0, 0.0, 0.0], [41.0, 0.0, 0.0, 0.0]])
    g = math.exp(-0.5) / (2.0 * math.pi * 0.5 * sb)
    kappa = 2.0 * 0.1433
    C = 0.9 * g * (0.3 + 0.2)
    expected = [(0.1 + 0.9 * g / (kappa + C)) * 0.3, (0.1 + 0.9 * g / (kappa + C)) * 0.2]
    found = updated(state, np.array([0.3, 0.2]), measured(40.5, 0.0), kappa, 0.9, SECTOR)
    assert_allclose(found.weight, expected, rtol=1e-12)
    assert_allclose(found.taken, [C / (kappa + C)], rtol=1e-12)
    assert_allclose(found.mean[0], [40.4, 0.0, 0.0, 0.0], atol=1e-12)
    assert_allclose(found.missed, [0.03, 0.02], rtol=1e-12)


def test_the_kernel_equals_the_formula():
    rng = np.random.default_rng(1)
    state, weight = cloud(600, rng)
    z = measured(rng.uniform(20, 60, 12), rng.uniform(-0.08, 0.08, 12))
    found = updated(state, weight, z, 0.3, 0.9, SECTOR)
    # the gate drops likelihoods below exp(-18) of their peak
    assert_allclose(found.weight, slow_update(state, weight, z, 0.3, 0.9), rtol=1e-4, atol=1e-9)
    near = measured(rng.uniform(39.9, 40.1, 3), rng.uniform(-0.001, 0.001, 3))
    some = np.abs(np.hypot(state[:, 0], state[:, 1]) - 40.0) < 2.0
    some &= np.abs(np.arctan2(state[:, 1], state[:, 0])) < 0.04
    assert some.sum() > 10
    exact = updated(state[some], weight[some], near, 0.3, 0.9, SECTOR)
    assert_allclose(exact.weight, slow_update(state[some], weight[some], near, 0.3, 0.9), rtol=1e-12)


def test_the_mass_after_an_update_is_what_was_missed_and_what_is_explained():
    state, weight = cloud(500, np.random.default_rng(2))
    z = measured([30.0, 45.0, 45.2, 58.0], [0.0, 0.02, 0.021, -0.05])
    found = updated(state, weight, z, 0.3, 0.9, SECTOR)
    assert_allclose(found.weight.sum(), found.missed.sum() + found.taken.sum(), rtol=1e-12)


def test_outside_of_the_sector_nothing_is_detected_and_nothing_survives():
    state = np.array([[61.0, 0.0, 0.0, 0.0], [40.0, 10.0, 0.0, 0.0], [20.5, 0.0, -1.0, 0.0]])
    weight = np.array([0.5, 0.5, 0.5])
    found = updated(state[:2], weight[:2], measured(60.9, 0.0), 0.3, 0.9, SECTOR)
    assert_array_equal(found.weight, weight[:2])
    assert_array_equal(found.taken, [0.0])
    _, left = propagated(state, weight, 1.0, 0.1, 0.99, SECTOR, np.random.default_rng(0))
    assert_array_equal(left, [0.0, 0.0, 0.0])
    _, stay = propagated(state, weight, 1.0, 0.1, 0.99, None, np.random.default_rng(0))
    assert_array_equal(stay, weight)


def test_predicted_mass_is_what_survives_and_what_is_born():
    state, weight = np.tile([40.0, 0.0, -1.0, 0.0], (100, 1)), np.full(100, 0.02)
    rng = np.random.default_rng(3)
    moved, left = propagated(state, weight, 1.0, 0.1, 0.99, SECTOR, rng)
    assert_allclose(left.sum(), 0.99 * 2.0, rtol=1e-12)
    assert_allclose(moved[:, 0].mean(), 39.0, atol=0.02)
    new, mass, _ = born(500, SECTOR, FAR_END, None, rng)
    assert_allclose(mass.sum(), 0.1, rtol=1e-12)
    r, b = np.hypot(new[:, 0], new[:, 1]), np.arctan2(new[:, 1], new[:, 0])
    assert ((r >= 56.0) & (r <= 60.0) & (np.abs(b) <= math.radians(5.0))).all()
    assert_allclose(new[:, 2:].mean(axis=0), [-1.0, 0.0], atol=0.1)


def test_process_noise_moves_position_and_velocity_together():
    n, dt, sd = 40_000, 0.5, 0.8
    moved, _ = propagated(np.zeros((n, 4)), np.ones(n), dt, sd, 1.0, None, np.random.default_rng(4))
    G = np.array([[dt**2 / 2, 0], [0, dt**2 / 2], [dt, 0], [0, dt]])
    assert_allclose(np.cov(moved.T), sd**2 * G @ G.T, atol=4 * sd**2 * dt**2 / math.sqrt(n))


def test_births_near_measurements_have_the_density_of_births_everywhere():
    everywhere = FAR_END.everywhere(1.0, SECTOR)
    z = measured([30.0, 30.6, 50.0], [0.0, 0.005, 0.03])
    state, weight, which = born(200_000, SECTOR, everywhere, z, np.random.default_rng(5))
    r, b = np.hypot(state[:, 0], state[:, 1]), np.arctan2(state[:, 1], state[:, 0])
    for low, high, left, right in (
        (29.8, 30.3, -0.004, 0.004),
        (30.1, 30.9, 0.0, 0.01),
        (49.5, 50.5, 0.025, 0.035),
    ):
        cell = (r >= low) & (r < high) & (b >= left) & (b < right)
        area = 0.5 * (right - left) * (high**2 - low**2)
        assert_allclose(weight[cell].sum(), area / SECTOR.area_m2, rtol=0.04)
    assert weight.max() * weight.size < 60.0 * weight.sum()  # the cut bounds the weights
    assert (np.abs(r - z.range_m[which]) <= 3.0 * SD[0]).all()
    assert born(10, SECTOR, FAR_END, measured([], []), np.random.default_rng(0))[0].shape == (0, 4)


@pytest.mark.parametrize("n", [1, 7, 500])
@pytest.mark.parametrize("power", [1.0, 0.6])
def test_resampling_keeps_the_mass_and_draws_in_proportion(n, power):
    rng = np.random.default_rng(6)
    weight = rng.exponential(0.01, 300)
    weight[[0, 17, 299]] = 0.0
    of, each = resampled(weight, n, power, rng)
    assert_allclose(each.sum(), weight.sum(), rtol=1e-12)
    if power == 1.0:
        assert_array_equal(each, each[0])
    counts = np.bincount(of, minlength=300)
    expected = n * weight**power / (weight**power).sum()
    assert (counts >= np.floor(expected - 1e-9)).all()
    assert (counts <= np.ceil(expected + 1e-9)).all()


@pytest.mark.parametrize("power", [1.0, 0.6])
def test_on_average_resampling_leaves_each_particle_its_weight(power):
    rng = np.random.default_rng(9)
    weight = rng.exponential(0.01, 50)
    total, runs = np.zeros(50), 2000
    for _ in range(runs):
        drawn, each = resampled(weight, 100, power, rng)
        total += np.bincount(drawn, each, minlength=50)
    assert_allclose(total / runs, weight, rtol=0.1, atol=2e-4)


def test_nothing_is_left_of_no_mass():
    drawn, weight = resampled(np.zeros(4), 10, 1.0, np.random.default_rng(0))
    assert drawn.shape == (0,)
    assert weight.shape == (0,)


@pytest.mark.parametrize(
    ("proposal", "recursion"), [("uniform", "phd"), ("measured", "phd"), ("measured", "labelled")]
)
def test_a_weak_birth_grows_to_a_target(detections, view, proposal, recursion):
    # rounding the mass at each resampling would hold it at 0 (ALGORITHMS, E-C4)
    node = ParticlePhd(
        closing_mps=1.0, clutter_per_ping=20.0, prior_targets=1e-6, p_b=0.1, birth_depth_m=4.0,
        birth_proposal=proposal, recursion=recursion, sigma_range_m=0.5, sigma_bearing_deg=0.5, seed=1,
    )  # fmt: skip
    mass = [node(detections(0, [], [])).intensity.expected_targets]
    for k in range(1, 8):
        answer = node(detections(k, 49.0 - 0.5 * k, 0.0))
        mass.append(answer.intensity.expected_targets)
    assert mass[0] < 0.01
    assert 0.0 < mass[1] < 0.5  # not yet counted
    assert mass[-1] > 0.7
    assert all(later > earlier - 0.05 for earlier, later in pairwise(mass))
    assert len(answer.intensity) == 1
    assert_allclose(answer.intensity.state[0, :2], [45.5, 0.0], atol=0.5)


def test_the_mixture_finds_separate_clouds_and_ignores_what_is_scattered():
    rng = np.random.default_rng(7)
    a = np.concatenate([rng.normal([40.0, 0.0], 0.4, (900, 2)), np.tile([-1.0, 0.2], (900, 1))], axis=1)
    b = np.concatenate([rng.normal([30.0, 2.0], [0.2, 0.5], (900, 2)), np.tile([0.0, 1.0], (900, 1))], axis=1)
    far = np.concatenate([rng.uniform([20.0, -5.0], [60.0, 5.0], (600, 2)), np.zeros((600, 2))], axis=1)
    weight = np.concatenate([np.full(900, 1.0 / 900), np.full(900, 0.8 / 900), np.full(600, 0.3 / 600)])
    start = np.array([[40.5, 0.4], [30.2, 1.5]])
    mean, spread, mass = fitted(np.concatenate([a, b, far]), weight, start, 0.5, 0.05, 280.0)
    assert_allclose(mean[0], [40.0, 0.0, -1.0, 0.2], atol=0.06)
    assert_allclose(mean[1], [30.0, 2.0, 0.0, 1.0], atol=0.06)
    assert_allclose(mass, [1.0, 0.8], atol=0.05)
    assert_allclose(spread[0, :2, :2], 0.16 * np.eye(2), atol=0.05)
    assert_allclose(spread[1, :2, :2], np.diag([0.04, 0.25]), atol=0.05)
    for matrix in spread:
        assert np.linalg.eigvalsh(matrix).min() > 0.0


def test_one_component_is_the_weighted_mean_and_covariance():
    rng = np.random.default_rng(8)
    state, weight = rng.normal([40, 0, -1, 0], 0.3, (400, 4)), rng.random(400)
    mean, spread, mass = fitted(state, weight, np.array([[40.0, 0.0]]), 1.0, 1e-3, 1e12)
    assert_allclose(mass, [weight.sum()], rtol=1e-6)
    assert_allclose(mean[0], np.average(state, axis=0, weights=weight), atol=1e-6)
    apart = state - mean[0]
    expected = (weight[:, None] * apart).T @ apart / weight.sum() + 1e-6 * np.eye(4)
    assert_allclose(spread[0], expected, atol=1e-5)


def test_centres_count_a_shared_target_once_and_two_neighbours_twice():
    place = np.array([[40.0, 0.0], [40.3, 0.0], [30.0, 0.0]])
    reach = np.full(3, 1.0)
    shared = centres(place, np.array([0.6, 0.4, 0.5]), 2, reach)
    assert_array_equal(shared, [[40.0, 0.0], [30.0, 0.0]])
    neighbours = centres(place, np.array([1.0, 0.9, 0.5]), 2, reach)
    assert_array_equal(neighbours, [[40.0, 0.0], [40.3, 0.0]])
    assert centres(place, np.zeros(3), 2, reach).shape == (0, 2)
    assert len(centres(place, np.ones(3), 9, reach)) == 3


def test_local_mass_is_what_lies_within_reach():
    position = np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]])
    mass = local_mass(
        position, np.array([0.1, 0.2, 0.4]), np.array([[0.0, 0.0], [2.0, 0.0], [9.0, 9.0]]), 1.0
    )
    assert_allclose(mass, [0.3, 0.6, 0.0])
