"""The motion of still objects in sonar coordinates, against finite differences of the true motion."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_flow import Mount, NavState
from fls_flow.geometry import rotation
from fls_trackers.ground_filter import sigma_points, unscented
from fls_trackers.ground_floor import FloorPlane, beam_points, four_beams, plane_through
from fls_trackers.ground_motion import (
    SensorMotion,
    body_rates,
    locate,
    moved_euler,
    moved_exact,
    rates,
    sensor_motion,
)

MOUNT = Mount((1.2, 0.1, 0.3), (0.0, -np.deg2rad(15.0), 0.0))
LEVEL = Mount()


def attitude(t: float) -> np.ndarray:
    return np.array([0.1 * np.sin(0.9 * t), 0.08 * np.sin(0.7 * t + 1.0), 0.4 * np.sin(0.5 * t) + 0.3])


def attitude_rate(t: float) -> np.ndarray:
    return np.array([0.09 * np.cos(0.9 * t), 0.056 * np.cos(0.7 * t + 1.0), 0.2 * np.cos(0.5 * t)])


def place(t: float) -> np.ndarray:
    return np.array([1.5 * t + 0.4 * np.sin(0.8 * t), 0.5 * np.sin(0.6 * t), 0.3 * np.sin(0.4 * t)])


def speed(t: float) -> np.ndarray:
    return np.array([1.5 + 0.32 * np.cos(0.8 * t), 0.3 * np.cos(0.6 * t), 0.12 * np.cos(0.4 * t)])


DEPTH, SLOPE = 7.0, np.array([0.05, -0.08])


def normal() -> np.ndarray:
    raw = np.array([-SLOPE[0], -SLOPE[1], 1.0])
    return raw / np.linalg.norm(raw)


def nav(t: float) -> NavState:
    R = rotation(tuple(attitude(t)))
    p = place(t)
    altitude = DEPTH + SLOPE @ p[:2] - p[2]
    return NavState(
        0, 0, tuple(p), tuple(attitude(t)), tuple(attitude_rate(t)), tuple(R.T @ speed(t)), float(altitude)
    )


def motion(t: float, mount: Mount = MOUNT) -> SensorMotion:
    state = nav(t)
    floor = FloorPlane(0, 0, normal(), state.altitude_m * normal()[2])
    found = sensor_motion(state, mount, floor)
    assert found is not None
    return found


def on_floor(north: float, east: float) -> np.ndarray:
    return np.array([north, east, DEPTH + SLOPE @ [north, east]])


def true_m(t: float, point: np.ndarray, mount: Mount = MOUNT) -> np.ndarray:
    body = rotation(tuple(attitude(t)))
    origin = place(t) + body @ np.array(mount.position_m)
    return (body @ rotation(mount.attitude_rad)).T @ (point - origin)


def polar(m: np.ndarray) -> np.ndarray:
    d = np.linalg.norm(m)
    return np.array([d, np.arcsin(m[1] / d)])


POINTS = [(30.0, 4.0), (22.0, -8.0), (45.0, 1.0)]


@pytest.mark.parametrize("mount", [LEVEL, MOUNT])
@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("t", [0.0, 1.3, 4.0])
def test_f_a_finds_the_true_place(t, point, mount):
    """With all of roll, pitch and yaw, any mount, a sloping floor."""
    m = true_m(t, on_floor(*point), mount)
    found = locate(polar(m), motion(t, mount))
    assert_allclose(found.m, m, atol=1e-9)
    assert found.shortfall_m < 0.0


@pytest.mark.parametrize("mount", [LEVEL, MOUNT])
@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("t", [0.0, 1.3, 4.0])
def test_f_b_equals_finite_differences_of_the_true_motion(t, point, mount):
    target, h = on_floor(*point), 1e-5
    difference = (true_m(t + h, target, mount) - true_m(t - h, target, mount)) / (2 * h)
    u = motion(t, mount)
    m_dot = np.cross(true_m(t, target, mount), u.omega_radps) - u.velocity_mps
    assert_allclose(m_dot, difference, atol=1e-6)


@pytest.mark.parametrize("mount", [LEVEL, MOUNT])
@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("t", [0.0, 1.3, 4.0])
def test_f_c_of_f_b_equals_finite_differences_of_range_and_bearing(t, point, mount):
    target, h = on_floor(*point), 1e-5
    difference = (polar(true_m(t + h, target, mount)) - polar(true_m(t - h, target, mount))) / (2 * h)
    m = true_m(t, target, mount)
    assert_allclose(rates(polar(m), m, motion(t, mount)), difference, atol=1e-6)


def test_the_turn_rate_is_that_of_the_rotation():
    t, h = 1.7, 1e-6
    dR = (rotation(tuple(attitude(t + h))) - rotation(tuple(attitude(t - h)))) / (2 * h)
    cross = rotation(tuple(attitude(t))).T @ dR
    p, q, r = body_rates(attitude(t), attitude_rate(t))
    assert_allclose(cross, [[0, -r, q], [r, 0, -p], [-q, p, 0]], atol=1e-8)


def test_worked_case_level_flight():
    """h = 6, x = 8, v = 1: d = 10 and d' = -8/10."""
    state = NavState(0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 6.0)
    u = sensor_motion(state, LEVEL)
    x = np.array([10.0, 0.0])
    assert_allclose(locate(x, u).m, [8.0, 0.0, 6.0])
    assert_allclose(rates(x, locate(x, u).m, u), [-0.8, 0.0], atol=1e-12)


def test_the_heading_itself_has_no_influence_but_its_rate_has():
    x = np.array([25.0, 0.3])

    def at(yaw: float, rate: float) -> np.ndarray:
        state = NavState(0, 0, (0, 0, 0), (0.1, -0.1, yaw), (0.0, 0.0, rate), (1.0, 0.1, 0.0), 6.0)
        u = sensor_motion(state, MOUNT)
        return rates(x, locate(x, u).m, u)

    assert_allclose(at(0.0, 0.1), at(2.0, 0.1), atol=1e-12)
    assert abs(at(0.0, 0.1)[1] - at(0.0, 0.0)[1]) > 0.05


def test_the_exact_step_is_exact_for_turns_and_the_euler_error_falls_with_the_square_of_dt():
    target = on_floor(30.0, 4.0)
    errors = []
    for dt in (0.4, 0.2, 0.1):
        x0, x1 = polar(true_m(1.0, target)), polar(true_m(1.0 + dt, target))
        exact = moved_exact(x0, motion(1.0), motion(1.0 + dt), dt) - x1
        euler = moved_euler(x0, motion(1.0), dt) - x1
        errors.append((np.abs(exact).max(), np.abs(euler).max()))
    exact, euler = np.array(errors).T
    assert (exact < 0.05 * euler).all()
    assert 3.5 < euler[0] / euler[1] < 4.6
    assert 3.5 < euler[1] / euler[2] < 4.6
    assert 6.0 < exact[0] / exact[1] < 10.0  # trapezoid: third order per step


def test_echo_nearer_than_the_floor_has_no_root_and_says_by_how_much():
    state = NavState(0, 0, (0, 0, 0), (0, 0, 0), (0, 0, 0), (1.0, 0, 0), 6.0)
    u = sensor_motion(state, LEVEL)
    found = locate(np.array([[4.0, 0.0], [6.0, 0.0], [10.0, 0.0]]), u)
    assert_allclose(found.shortfall_m, [2.0, 0.0, -4.0], atol=1e-12)
    assert np.isfinite(found.m).all()
    afloat = locate(np.array([[4.0, 0.2]]), u, np.array([True]))
    assert_allclose(afloat.m, [[4.0 * np.cos(0.2), 4.0 * np.sin(0.2), 0.0]])


@pytest.mark.parametrize("missing", ["velocity_mps", "attitude_rate_radps", "altitude_m"])
def test_without_velocity_rates_or_altitude_there_is_no_motion(missing):
    from dataclasses import replace

    empty = float("nan") if missing == "altitude_m" else (float("nan"),) * 3
    assert sensor_motion(replace(nav(0.0), **{missing: empty}), MOUNT) is None


def test_unknown_roll_pitch_and_heave_count_as_zero():
    state = NavState(
        0, 0, (0, 0, 0), (float("nan"), float("nan"), 0.3), (0, 0, 0.1), (1.0, 0.0, float("nan")), 6.0
    )
    u = sensor_motion(state, LEVEL)
    assert_allclose(u.R, rotation((0.0, 0.0, 0.3)))
    assert_allclose(u.velocity_mps, [1.0, 0.0, 0.0])


def test_sigma_points_have_the_mean_and_covariance():
    x = np.array([[30.0, 0.2], [12.0, -0.4]])
    P = np.array([[[25.0, 0.1], [0.1, 0.006]], [[0.04, 0.0], [0.0, 0.0]]])
    points, W = sigma_points(x, P)
    assert_allclose(W.sum(), 1.0)
    assert_allclose(np.einsum("i,ina->na", W, points), x)
    apart = points - x
    assert_allclose(np.einsum("i,ina,inb->nab", W, apart, apart), P, atol=1e-12)


@pytest.mark.parametrize("step", ["exact", "euler"])
def test_unscented_prediction_equals_monte_carlo(step):
    """Mean and covariance of a million samples, within the transform's own error (third order)."""
    dt = 0.5
    x = np.array([[32.0, 0.15]])
    P = np.array([[[1.0, 0.01], [0.01, 0.0007]]])
    before, after = motion(1.0), motion(1.0 + dt)

    def move(z: np.ndarray) -> np.ndarray:
        return moved_exact(z, before, after, dt) if step == "exact" else moved_euler(z, before, dt)

    mean, cov = unscented(x, P, move)
    rng = np.random.default_rng(0)
    samples = move(rng.multivariate_normal(x[0], P[0], 1_000_000))
    sd = samples.std(axis=0)
    assert (np.abs(mean[0] - samples.mean(axis=0)) < 5.0 * sd / 1000.0).all()
    scale = np.sqrt(np.outer(np.diag(cov[0]), np.diag(cov[0])))
    assert (np.abs(cov[0] - np.cov(samples.T)) / scale < 5.0 * np.sqrt(2.0) / 1000.0).all()


def test_four_beams_of_a_dvl_give_the_slope():
    directions = four_beams(np.deg2rad(20.0))
    pitched = (0.1, -0.15, 0.7)
    towards = (directions @ rotation(pitched).T) @ normal()
    ranges = 9.0 * normal()[2] / towards
    found, height = plane_through(beam_points(directions, ranges, pitched))
    assert_allclose(found, normal(), atol=1e-12)
    assert_allclose(height, 9.0 * normal()[2])


def test_two_altitudes_give_the_slope_along_their_line_and_one_a_level_floor():
    slope = 0.1
    points = np.array([[0.0, 0.0, 6.0], [20.0, 0.0, 8.0]])
    found, height = plane_through(points)
    assert_allclose(found, np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1.0), atol=1e-12)
    assert_allclose(height, 6.0 / np.hypot(slope, 1.0))
    level, height = plane_through([[0.0, 0.0, 6.0], [np.nan, 0.0, 1.0]])
    assert_allclose(level, [0.0, 0.0, 1.0])
    assert height == 6.0
    with pytest.raises(ValueError, match="no finite point"):
        plane_through([[np.nan, 0.0, 1.0]])
