"""Paths, the own ship and ping instants of simulated scenes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_sources.scene_motion import OwnShip, TimedPath, apparent, coasting, even_stamps, uneven_stamps

WAY = [(30.0, -10.0), (33.0, -4.0), (32.0, 3.0), (36.0, 9.0)]


def test_a_still_path_stays():
    position, velocity = TimedPath.still(3.0, -4.0).at(np.array([-5.0, 0.0, 70.0]))
    assert_allclose(position, [[3.0, -4.0]] * 3)
    assert_allclose(velocity, 0.0)


def test_a_straight_path_goes_on_for_ever_in_both_directions():
    position, velocity = TimedPath.straight(10.0, (1.0, 2.0), (0.5, -1.0)).at(np.array([-90.0, 10.0, 110.0]))
    assert_allclose(position, [[-49.0, 102.0], [1.0, 2.0], [51.0, -98.0]])
    assert_allclose(velocity, [[0.5, -1.0]] * 3)


def test_a_path_passes_its_waypoints_in_time():
    path = TimedPath(np.array([0.0, 7.0, 12.0, 30.0]), np.array(WAY))
    assert_allclose(path.at(path.time_s)[0], WAY, atol=1e-12)


def test_velocity_is_the_derivative_of_position_and_is_continuous():
    path = TimedPath(np.array([0.0, 7.0, 12.0, 30.0]), np.array(WAY))
    t, h = np.linspace(-4.0, 35.0, 400), 1e-5
    slope = (path.at(t + h)[0] - path.at(t - h)[0]) / (2.0 * h)
    assert_allclose(path.at(t)[1], slope, atol=1e-4)
    for knot in path.time_s:
        assert_allclose(path.at(knot - 1e-9)[1], path.at(knot + 1e-9)[1], atol=1e-7)


def test_a_coasting_boat_starts_with_its_speed_and_slows_down():
    path = coasting([(0.0, 0.0), (0.0, 1.0), (0.0, 5.0), (0.0, 20.0)], 3.0, 0.5, 60.0)
    way = path.at(path.time_s)[0][:, 1]
    assert_allclose(way, 0.5 * 60.0 * (1.0 - np.exp(-(path.time_s - 3.0) / 60.0)), atol=1e-9)
    assert (np.diff(np.diff(way) / np.diff(path.time_s)) < 0.0).all()


def test_a_boat_cannot_coast_further_than_its_way():
    with pytest.raises(ValueError, match=r"coasts 10\.0 m cannot make 20\.0 m"):
        coasting([(0.0, 0.0), (20.0, 0.0)], 0.0, 0.5, 20.0)


def test_yaw_rate_is_the_derivative_of_the_heading_and_yaw_is_bounded():
    own = OwnShip(0.3, 0.05, 14.0, 1.1)
    for t in np.linspace(0.0, 60.0, 31):
        slope = (own.pose(t + 1e-5).heading_rad - own.pose(t - 1e-5).heading_rad) / 2e-5
        assert own.yaw_rate_radps(t) == pytest.approx(slope, abs=1e-8)
    heading = [own.pose(t).heading_rad for t in np.linspace(0.0, 300.0, 3000)]
    assert 0.9 * 0.05 < np.max(np.abs(heading)) <= 0.05


def test_apparent_states_of_one_thing_by_hand():
    # heading 0, rate w: a thing 10 m ahead moves to port with w 10 m/s, and comes nearer with our speed
    own = OwnShip(0.4, 0.1, 15.0, 0.0)
    state = apparent(own, 0.0, np.array([[10.0, 0.0]]), np.zeros((1, 2)))
    assert_allclose(state, [[10.0, 0.0, -0.4, -10.0 * own.yaw_rate_radps(0.0)]], atol=1e-12)


def test_apparent_velocity_is_the_derivative_of_apparent_position():
    own = OwnShip(0.4, 0.1, 12.0, 0.7)
    path = coasting(WAY, 0.0, 0.4, 100.0)
    for t in (0.5, 11.0, 30.0):
        before, now, after = (
            apparent(own, s, *(value[None] for value in path.at(s))) for s in (t - 1e-4, t, t + 1e-4)
        )
        assert_allclose(now[:, 2:], (after - before)[:, :2] / 2e-4, atol=1e-6)


def test_even_stamps_do_not_drift():
    stamps = even_stamps(5, 601, 3.0)
    assert stamps[0] == 5
    assert stamps[600] == 5 + 200 * 10**9


def test_uneven_stamps_grow_and_have_gaps_of_up_to_eight_intervals():
    interval = np.diff(uneven_stamps(1_000, 5000, 10.0, np.random.default_rng(2))) * 1e-8
    assert interval.min() > 0.89
    assert 7.0 < interval.max() < 8.2
    assert np.median(interval) == pytest.approx(1.0, abs=0.01)
    assert 0.02 < (interval > 1.5).mean() < 0.05


@pytest.mark.parametrize("pings", [1, 2])
def test_stamps_of_short_sequences(pings):
    assert uneven_stamps(7, pings, 2.0, np.random.default_rng(0))[0] == 7
    assert uneven_stamps(7, pings, 2.0, np.random.default_rng(0)).shape == even_stamps(7, pings, 2.0).shape
