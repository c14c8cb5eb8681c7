"""Conversion, prediction, gate and update beside the plain formulas."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_flow import geometry
from fls_flow.geometry import Pose
from fls_trackers.conversion import convert, noise_at
from fls_trackers.gating import gate
from fls_trackers.kalman import predict, update

SD, SB = 0.3, np.deg2rad(1.5)
POSES = [Pose(), Pose(12.0, -7.0, 2.1)]


def covariances(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.standard_normal((n, 4, 4))
    return root @ root.transpose(0, 2, 1) + 0.1 * np.eye(4)


@pytest.mark.parametrize("pose", POSES)
def test_conversion_equals_the_geometry_module(pose: Pose) -> None:
    rng = np.random.default_rng(1)
    r, b = rng.uniform(0.0, 200.0, 50), rng.uniform(-np.pi, np.pi, 50)
    y, R = convert(r, b, SD, SB, pose)
    expected, noise = geometry.debiased(r, b, SD, SB)
    turn = geometry.turn(pose.heading_rad)
    assert_allclose(y, pose.to_ned(expected), rtol=1e-12, atol=1e-12)
    assert_allclose(R, turn @ noise @ turn.T, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("pose", POSES)
def test_noise_of_a_track_is_that_of_its_polar_position(pose: Pose) -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(-60.0, 60.0, (20, 2))
    state = np.concatenate([pose.to_ned(xy), rng.standard_normal((20, 2))], axis=1)
    turn = geometry.turn(pose.heading_rad)
    expected = turn @ geometry.debiased_covariance(*geometry.to_polar(xy), SD, SB) @ turn.T
    assert_allclose(noise_at(state, SD, SB, pose), expected, rtol=1e-9, atol=1e-12)


def test_converted_measurements_are_consistent() -> None:
    rng = np.random.default_rng(3)
    n, d, delta, sd, sb = 40_000, 50.0, np.deg2rad(22.5), 0.05, np.deg2rad(1.5)
    y, R = convert(d + sd * rng.standard_normal(n), delta + sb * rng.standard_normal(n), sd, sb, Pose())
    truth = geometry.to_cartesian(d, delta)
    error = y - truth
    nees = np.einsum("ij,ijk,ik->i", error, np.linalg.inv(R), error)
    assert nees.mean() == pytest.approx(2.0, abs=5 * 2.0 / np.sqrt(n))
    assert_allclose(error.mean(axis=0), 0.0, atol=5 * np.sqrt(R.max() / n))


def test_prediction_equals_the_geometry_module() -> None:
    rng = np.random.default_rng(4)
    state, P = rng.standard_normal((7, 4)), covariances(rng, 7)
    for dt in (0.5, 3.7):
        x, predicted = predict(state, P, dt, 0.3)
        expected = geometry.predict(state, P, dt, 0.3)
        assert_allclose(x, expected[0], rtol=1e-12)
        assert_allclose(predicted, expected[1], rtol=1e-12)


def test_gate_equals_the_plain_formula() -> None:
    rng = np.random.default_rng(5)
    state, P = 3.0 * rng.standard_normal((12, 4)), covariances(rng, 12)
    R, y = np.broadcast_to(np.eye(2), (12, 2, 2)).copy(), 3.0 * rng.standard_normal((30, 2))
    found = gate(state, P, R, y, 4.0)
    for t in range(12):
        S = P[t, :2, :2] + R[t]
        nu = y - state[t, :2]
        d2 = np.einsum("ij,jk,ik->i", nu, np.linalg.inv(S), nu)
        places = found.places[found.start[t] : found.start[t + 1]]
        assert places.tolist() == np.flatnonzero(d2 <= 4.0).tolist()
        expected = np.exp(-d2[places] / 2) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
        assert_allclose(found.likelihood[found.start[t] : found.start[t + 1]], expected, rtol=1e-11)


def test_gate_of_everything_grows_its_rows() -> None:
    y = np.zeros((100, 2))
    found = gate(np.zeros((50, 4)), np.tile(np.eye(4), (50, 1, 1)), np.tile(np.eye(2), (50, 1, 1)), y, 9.0)
    assert found.start.tolist() == list(range(0, 5001, 100))
    assert found.places.tolist() == list(range(100)) * 50


def test_update_equals_the_moments_of_the_mixture() -> None:
    # The exact mean and covariance of the Gaussian mixture whose components are the Kalman updates.
    rng = np.random.default_rng(6)
    P = covariances(rng, 1)
    state, R, y = (
        rng.standard_normal((1, 4)),
        np.array([[[0.5, 0.1], [0.1, 0.3]]]),
        rng.standard_normal((3, 2)),
    )
    beta, none = np.array([0.5, 0.2, 0.1]), 0.2
    x, updated = update(state, P, R, y, np.array([0, 3]), np.array([0, 1, 2]), beta, np.array([none]))
    S = P[0, :2, :2] + R[0]
    K = P[0, :, :2] @ np.linalg.inv(S)
    means = [state[0], *(state[0] + K @ (z - state[0, :2]) for z in y)]
    parts = [P[0], *[P[0] - K @ S @ K.T] * 3]
    weights = [none, *beta]
    mean = sum(w * m for w, m in zip(weights, means, strict=True))
    cov = sum(w * (C + np.outer(m - mean, m - mean)) for w, m, C in zip(weights, means, parts, strict=True))
    assert_allclose(x[0], mean, rtol=1e-12)
    assert_allclose(updated[0], cov, rtol=1e-11, atol=1e-13)


def test_a_track_without_measurement_stays_as_predicted() -> None:
    rng = np.random.default_rng(7)
    state, P = rng.standard_normal((2, 4)), covariances(rng, 2)
    none = np.zeros(0, np.int64)
    x, updated = update(
        state,
        P,
        np.tile(np.eye(2), (2, 1, 1)),
        np.zeros((0, 2)),
        np.zeros(3, np.int64),
        none,
        np.zeros(0),
        np.ones(2),
    )
    assert_allclose(x, state)
    assert_allclose(updated, P)


def test_covariances_stay_symmetric_and_positive() -> None:
    rng = np.random.default_rng(8)
    state, P = np.zeros((1, 4)), np.diag([1.0, 1.0, 25.0, 25.0])[None]
    for _ in range(500):
        state, P = predict(state, P, float(rng.uniform(0.01, 3.0)), 1e-3)
        R = noise_at(state + 50.0, 1e-3, 1e-3, Pose())
        y = state[:, :2] + 0.01 * rng.standard_normal((2, 2))
        state, P = update(
            state, P, R, y, np.array([0, 2]), np.array([0, 1]), np.array([0.6, 0.39]), np.array([0.01])
        )
        assert (P.transpose(0, 2, 1) == P).all()
        assert np.linalg.eigvalsh(P[0]).min() >= -1e-12 * np.linalg.eigvalsh(P[0]).max()
