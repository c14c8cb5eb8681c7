import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import Mount, NavState, geometry

STEADY = settings(derandomize=True, database=None, deadline=None, max_examples=200)

angles = st.floats(-math.pi, math.pi)
far_angles = st.floats(-1e4, 1e4)
coordinates = st.floats(-1e4, 1e4)
positions = st.tuples(coordinates, coordinates, coordinates)
attitudes = st.tuples(angles, st.floats(-1.5, 1.5), angles)


def nav(position_m: tuple[float, float, float], attitude_rad: tuple[float, float, float]) -> NavState:
    return NavState(1, 2, position_m, attitude_rad)


# ---- angles, polar and Cartesian


@given(far_angles)
@STEADY
def test_wrap_gives_the_same_angle_within_half_a_turn(angle: float) -> None:
    wrapped = float(geometry.wrap(angle))
    assert -math.pi <= wrapped <= math.pi
    assert_allclose([math.cos(wrapped), math.sin(wrapped)], [math.cos(angle), math.sin(angle)], atol=1e-11)


@pytest.mark.parametrize(
    ("angle", "expected"),
    [
        (math.pi, math.pi),
        (-math.pi, math.pi),
        (3 * math.pi, math.pi),
        (2 * math.pi, 0.0),
        (-0.1, -0.1),
        (4.0, 4.0 - 2 * math.pi),
    ],
)
def test_wrap_at_the_seam(angle: float, expected: float) -> None:
    assert_allclose(geometry.wrap(angle), expected, atol=1e-15)


def test_wrap_keeps_shape_and_nan() -> None:
    assert geometry.wrap(np.zeros((2, 0, 3))).shape == (2, 0, 3)
    assert np.isnan(geometry.wrap(np.nan))


@given(st.floats(1e-3, 1e4), st.one_of(angles, st.sampled_from([math.pi, -math.pi, 0.0, -0.0, math.pi / 2])))
@STEADY
def test_polar_to_cartesian_and_back(range_m: float, bearing_rad: float) -> None:
    distance, bearing = geometry.to_polar(geometry.to_cartesian(range_m, bearing_rad))
    assert_allclose(distance, range_m, rtol=1e-14)
    assert abs(geometry.wrap(bearing - bearing_rad)) < 1e-14


def test_bearings_run_from_x_to_starboard() -> None:
    position = geometry.to_cartesian([2.0, 2.0, 2.0], [0.0, math.pi / 2, math.pi])
    assert_allclose(position, [[2, 0], [0, 2], [-2, 0]], atol=1e-15)
    assert_allclose(geometry.to_polar([[0.0, -3.0], [-4.0, 0.0]]), [[3.0, 4.0], [-math.pi / 2, math.pi]])


def test_conversions_of_nothing() -> None:
    assert geometry.to_cartesian([], []).shape == (0, 2)
    assert geometry.to_polar(np.zeros((0, 2)))[1].shape == (0,)
    position, covariance = geometry.debiased([], [], 0.1, 0.1)
    assert (position.shape, covariance.shape) == ((0, 2), (0, 2, 2))


# ---- the debiased conversion


def measured(
    range_m: float, bearing_rad: float, range_sd_m: float, bearing_sd_rad: float, n: int, seed: int = 1
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    return range_m + range_sd_m * rng.standard_normal(n), bearing_rad + bearing_sd_rad * rng.standard_normal(
        n
    )


SETTINGS = [  # range, bearing in degrees, range sd, bearing sd in degrees
    (50.0, 22.5, 0.05, 1.5),
    (50.0, -22.5, 0.05, 1.5),
    (20.0, 0.0, 0.05, 1.5),
    (100.0, 60.0, 1.0, 3.0),
    (200.0, 45.0, 0.05, 5.0),
    (30.0, 179.0, 0.5, 2.0),
]


@pytest.mark.parametrize(("range_m", "bearing_deg", "range_sd_m", "bearing_sd_deg"), SETTINGS)
def test_the_conversion_is_consistent(
    range_m: float, bearing_deg: float, range_sd_m: float, bearing_sd_deg: float
) -> None:
    n, theta, sd = 200_000, math.radians(bearing_deg), math.radians(bearing_sd_deg)
    position, covariance = geometry.debiased(*measured(range_m, theta, range_sd_m, sd, n), range_sd_m, sd)
    error = position - geometry.to_cartesian(range_m, theta)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    # chi-square of 2 degrees of freedom: mean 2, so the mean of n has standard deviation 2 / sqrt(n) = 0.0045
    assert abs(nees.mean() - 2.0) < 0.04


@pytest.mark.parametrize(("range_m", "bearing_deg", "range_sd_m", "bearing_sd_deg"), SETTINGS)
def test_the_covariance_is_that_of_a_conversion_averaged_over_the_truths(
    range_m: float, bearing_deg: float, range_sd_m: float, bearing_sd_deg: float
) -> None:
    # Lerro & Bar-Shalom: truths scatter around the measurement, conversions around the mean of each truth
    n, delta, sd = 400_000, math.radians(bearing_deg), math.radians(bearing_sd_deg)
    truth = measured(range_m, delta, range_sd_m, sd, n)
    again = measured(0.0, 0.0, range_sd_m, sd, n, seed=2)
    mean = geometry.to_cartesian(*truth) * math.exp(-(sd**2) / 2)
    scatter = geometry.to_cartesian(truth[0] + again[0], truth[1] + again[1]) - mean
    sampled = scatter.T @ scatter / n
    scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
    covariance = geometry.debiased_covariance(range_m, delta, range_sd_m, sd)
    assert np.all(np.abs(covariance - sampled) < 0.012 * scale)


@pytest.mark.parametrize(("range_m", "bearing_deg", "range_sd_m", "bearing_sd_deg"), SETTINGS)
def test_the_bias_is_removed(
    range_m: float, bearing_deg: float, range_sd_m: float, bearing_sd_deg: float
) -> None:
    n, theta, sd = 200_000, math.radians(bearing_deg), math.radians(bearing_sd_deg)
    d, delta = measured(range_m, theta, range_sd_m, sd, n)
    along = np.array([math.cos(theta), math.sin(theta)])
    truth = geometry.to_cartesian(range_m, theta)
    bias = (geometry.debiased(d, delta, range_sd_m, sd)[0] - truth).mean(axis=0) @ along
    spread = math.hypot(range_sd_m, range_m * sd**2)  # along the line of sight
    assert abs(bias) < range_m * sd**4 + 5 * spread / math.sqrt(n)  # E[y] = r (1 - s^2 / 2 + ...)
    if range_m * sd**2 > 0.2 * range_sd_m:
        raw = (geometry.to_cartesian(d, delta) - truth).mean(axis=0) @ along
        assert abs(raw + range_m * sd**2 / 2) < 0.1 * range_m * sd**2
        assert abs(bias) < 0.2 * abs(raw)


def test_the_cross_term_has_the_sign_of_lerro_and_bar_shalom() -> None:
    # E-K1: the printed (11) gives +0.605, an ellipse that is long in range instead of across
    covariance = geometry.debiased_covariance(50.0, math.radians(22.5), 0.05, math.radians(1.5))
    assert_allclose(covariance[0, 1], -0.603, atol=5e-4)
    assert covariance[0, 1] == covariance[1, 0]
    long_axis = np.linalg.eigh(covariance)[1][:, 1]
    assert abs(long_axis @ [math.cos(math.radians(22.5)), math.sin(math.radians(22.5))]) < 0.01


@given(st.floats(1.0, 500.0), angles, st.floats(0.01, 1.0), st.floats(1e-5, 1e-4))
@STEADY
def test_small_angles_give_the_linear_covariance(d: float, delta: float, sd: float, sb: float) -> None:
    c, n = math.cos(delta), math.sin(delta)
    J = np.array([[c, -d * n], [n, d * c]])
    linear = J @ np.diag([sd**2, sb**2]) @ J.T
    position, covariance = geometry.debiased(d, delta, sd, sb)
    assert_allclose(covariance, linear, rtol=1e-5, atol=1e-6 * (sd**2 + (d * sb) ** 2))
    assert_allclose(position, geometry.to_cartesian(d, delta), atol=d * sb**2)


@given(st.floats(0.1, 1000.0), angles, st.floats(1e-3, 2.0), st.floats(1e-3, 0.2))
@STEADY
def test_covariances_are_symmetric_and_positive(d: float, delta: float, sd: float, sb: float) -> None:
    covariance = geometry.debiased_covariance(d, delta, sd, sb)
    assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0


@given(st.floats(0.1, 1000.0), angles, st.floats(1e-3, 2.0), st.floats(1e-3, 0.2))
@STEADY
def test_a_quarter_turn_swaps_the_axes(d: float, delta: float, sd: float, sb: float) -> None:
    at = geometry.debiased_covariance(d, delta, sd, sb)
    turned = geometry.debiased_covariance(d, delta + math.pi / 2, sd, sb)
    assert_allclose(
        turned, [[at[1, 1], -at[0, 1]], [-at[0, 1], at[0, 0]]], rtol=1e-9, atol=1e-9 * np.trace(at)
    )


def test_the_conversion_takes_a_deviation_per_measurement() -> None:
    d, delta, sd, sb = (
        np.array([10.0, 80.0]),
        np.array([0.1, -2.0]),
        np.array([0.1, 0.3]),
        np.array([0.01, 0.05]),
    )
    position, covariance = geometry.debiased(d, delta, sd, sb)
    for i in range(2):
        one, spread = geometry.debiased(d[i], delta[i], sd[i], sb[i])
        assert_allclose(position[i], one, rtol=1e-15)
        assert_allclose(covariance[i], spread, rtol=1e-14)


# ---- rotations and poses


@given(st.tuples(angles, angles, angles))
@STEADY
def test_rotations_are_orthonormal(attitude_rad: tuple[float, float, float]) -> None:
    R = geometry.rotation(attitude_rad)
    assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert_allclose(np.linalg.det(R), 1.0, rtol=1e-13)
    phi, theta, _ = attitude_rad
    third = [-math.sin(theta), math.cos(theta) * math.sin(phi), math.cos(theta) * math.cos(phi)]
    assert_allclose(R[2], third, atol=1e-15)


@given(st.tuples(angles, angles, angles))
@STEADY
def test_rotations_are_yaw_after_pitch_after_roll(attitude_rad: tuple[float, float, float]) -> None:
    (cr, cp, cy), (sr, sp, sy) = np.cos(attitude_rad), np.sin(attitude_rad)
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    assert_allclose(geometry.rotation(attitude_rad), yaw @ pitch @ roll, atol=1e-15)


@pytest.mark.parametrize(
    ("attitude_rad", "body", "world"),
    [
        ((0, 0, math.pi / 2), [1, 0, 0], [0, 1, 0]),  # bow to the east
        ((0, math.pi / 2, 0), [1, 0, 0], [0, 0, -1]),  # bow up
        ((math.pi / 2, 0, 0), [0, 1, 0], [0, 0, 1]),  # starboard down
    ],
)
def test_positive_angles_turn_as_in_ned(attitude_rad: Any, body: list[float], world: list[float]) -> None:
    assert_allclose(geometry.rotation(attitude_rad) @ body, world, atol=1e-15)


@given(positions, attitudes, positions, attitudes, st.lists(st.tuples(coordinates, coordinates), max_size=4))
@STEADY
def test_what_a_pose_maps_out_it_maps_back(
    place: Any, attitude: Any, at: Any, looking: Any, points: Any
) -> None:
    pose = geometry.sensor_pose(nav(place, attitude), Mount(at, looking))
    given_points = np.reshape(np.array(points, float), (-1, 2))
    assert_allclose(pose.to_sensor(pose.to_ned(given_points)), given_points, atol=1e-9)
    assert_allclose(pose.to_ned(pose.to_sensor(given_points)), given_points, atol=1e-9)


@given(positions, angles, positions, angles, st.floats(0.1, 100.0), angles)
@STEADY
def test_level_vehicles_add_yaw_and_mount(
    place: Any, yaw: float, at: Any, mount_yaw: float, range_m: float, bearing_rad: float
) -> None:
    pose = geometry.sensor_pose(nav(place, (0.0, 0.0, yaw)), Mount(at, (0.0, 0.0, mount_yaw)))
    assert abs(geometry.wrap(pose.heading_rad - yaw - mount_yaw)) < 1e-12
    north = place[0] + at[0] * math.cos(yaw) - at[1] * math.sin(yaw)
    east = place[1] + at[0] * math.sin(yaw) + at[1] * math.cos(yaw)
    assert_allclose(pose.origin_m, [north, east], atol=1e-8)
    course = yaw + mount_yaw + bearing_rad
    seen = pose.to_ned(geometry.to_cartesian(range_m, bearing_rad))
    assert_allclose(seen, [north + range_m * math.cos(course), east + range_m * math.sin(course)], atol=1e-8)


@given(positions, attitudes, positions, attitudes)
@STEADY
def test_poses_are_the_level_part_of_the_whole_transform(
    place: Any, attitude: Any, at: Any, looking: Any
) -> None:
    pose = geometry.sensor_pose(nav(place, attitude), Mount(at, looking))
    body = geometry.rotation(attitude)
    ahead = np.array(place) + body @ (np.array(at) + geometry.rotation(looking) @ [1.0, 0.0, 0.0])
    origin = np.array(place) + body @ np.array(at)
    assert_allclose(pose.origin_m, origin[:2], atol=1e-8)
    level = (ahead - origin)[:2]
    assert_allclose(
        level,
        np.hypot(*level) * np.array([math.cos(pose.heading_rad), math.sin(pose.heading_rad)]),
        atol=1e-8,
    )


def test_a_pitched_vehicle_carries_its_sensor_along() -> None:
    # bow 30 degrees up: a sensor 2 m ahead is cos(30) x 2 m ahead of the origin, and still looks north
    pose = geometry.sensor_pose(nav((10.0, 5.0, 3.0), (0.0, math.radians(30), 0.0)), Mount((2.0, 0.0, 0.0)))
    assert_allclose(pose.origin_m, [10.0 + math.sqrt(3.0), 5.0])
    assert_allclose(pose.heading_rad, 0.0, atol=1e-15)


def test_roll_pitch_and_depth_may_be_unknown() -> None:
    nan = math.nan
    known = geometry.sensor_pose(nav((1.0, 2.0, 0.0), (0.0, 0.0, 0.3)), Mount((1.0, 1.0, 1.0)))
    assert geometry.sensor_pose(nav((1.0, 2.0, nan), (nan, nan, 0.3)), Mount((1.0, 1.0, 1.0))) == known


@pytest.mark.parametrize(
    ("place", "attitude"),
    [((math.nan, 0, 0), (0, 0, 0)), ((0, math.inf, 0), (0, 0, 0)), ((0, 0, 0), (0, 0, math.nan))],
)
def test_position_and_heading_must_be_known(place: Any, attitude: Any) -> None:
    with pytest.raises(ValueError, match="navigation at 2 ns lacks position or heading"):
        geometry.sensor_pose(nav(place, attitude), Mount())


@given(angles)
@STEADY
def test_turn_is_the_level_rotation(angle: float) -> None:
    assert_allclose(geometry.turn(angle), geometry.rotation((0.0, 0.0, angle))[:2, :2], atol=1e-15)


@given(st.lists(positions, max_size=5))
@STEADY
def test_flu_and_frd_change_back_and_forth(vectors: Any) -> None:
    flu = np.reshape(np.array(vectors, float), (-1, 3))
    assert_array_equal(geometry.flu_to_frd(geometry.flu_to_frd(flu)), flu)


def test_left_is_minus_starboard_and_up_is_minus_down() -> None:
    assert_array_equal(geometry.flu_to_frd([1.0, 2.0, 3.0]), [1.0, -2.0, -3.0])


# ---- motion


def random_tracks(n: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    rng = np.random.default_rng(3)
    half = rng.standard_normal((n, 4, 4))
    return rng.standard_normal((n, 4)), half @ half.transpose(0, 2, 1)


@pytest.mark.parametrize("n", [0, 1, 7])
@pytest.mark.parametrize("dt_s", [0.0, 0.5, -2.0])
def test_predict_is_the_filter_step_of_each_track(n: int, dt_s: float) -> None:
    state, covariance = random_tracks(n)
    ahead, spread = geometry.predict(state, covariance, dt_s, acceleration_sd_mps2=0.3)
    assert (ahead.shape, spread.shape) == ((n, 4), (n, 4, 4))
    G = np.array([[dt_s**2 / 2, 0], [0, dt_s**2 / 2], [dt_s, 0], [0, dt_s]])
    for i in range(n):
        x, y, vx, vy = state[i]
        assert_allclose(ahead[i], [x + dt_s * vx, y + dt_s * vy, vx, vy], rtol=1e-14, atol=1e-14)
        F = np.array([[1, 0, dt_s, 0], [0, 1, 0, dt_s], [0, 0, 1, 0], [0, 0, 0, 1]])
        assert_allclose(spread[i], F @ covariance[i] @ F.T + 0.09 * G @ G.T, rtol=1e-12, atol=1e-12)


def test_predict_without_noise_goes_on_and_back() -> None:
    state, covariance = random_tracks(5)
    once = geometry.predict(state, covariance, 1.5)
    twice = geometry.predict(*geometry.predict(state, covariance, 1.0), 0.5)
    for a, b in zip(once, twice, strict=True):
        assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    back = geometry.predict(*once, -1.5)
    for a, b in zip(back, (state, covariance), strict=True):
        assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dt_s", [0.1, 0.5, 3.0])
def test_process_noise_has_rank_two(dt_s: float) -> None:
    Q = geometry.cv_noise(dt_s, 0.7)
    assert np.linalg.matrix_rank(Q) == 2
    assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q)[0] > -1e-15
    assert_allclose(Q[2, 2], (0.7 * dt_s) ** 2)
    assert_allclose(Q[0, 2], 0.49 * dt_s**3 / 2)


def test_process_noise_is_that_of_random_accelerations() -> None:
    dt_s, sigma, n = 0.5, 0.7, 200_000
    a = sigma * np.random.default_rng(2).standard_normal((n, 2))
    moved = np.concatenate([a * dt_s**2 / 2, a * dt_s], axis=1)
    assert_allclose(np.cov(moved.T), geometry.cv_noise(dt_s, sigma), atol=0.02 * (sigma * dt_s) ** 2)
