"""The simulated sea floor: geometry, images, truth, and the navigation beside it."""

from __future__ import annotations

import itertools
from typing import get_args

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_flow.geometry import rotation
from fls_flow.testing import check_node
from fls_sources.ground_nav import GroundNav
from fls_sources.ground_scenarios import Floor, GroundSequence, ground_scenario
from fls_sources.ground_scene import GroundScene

SEQUENCES = get_args(GroundSequence)


def first(count: int, **parameters: object) -> list:
    return list(itertools.islice(GroundScene(**parameters)(), count))


def states(**parameters: object) -> list:
    return [one.nav_state for one in GroundNav(**parameters)()]


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_the_motion_of_the_vehicle_is_consistent(sequence):
    """Velocity and rates are the derivatives of position and attitude."""
    vehicle, h = ground_scenario(sequence).vehicle, 1e-5
    for t in np.linspace(0.0, 18.0, 13):
        before, now, after = (vehicle.at(t + dt) for dt in (-h, 0.0, h))
        assert_allclose((after.position_m - before.position_m) / (2 * h), now.velocity_mps, atol=1e-8)
        rate = (np.array(after.attitude_rad) - before.attitude_rad) / (2 * h)
        assert_allclose(rate, now.attitude_rate_radps, atol=1e-8)
        assert_allclose(now.R @ now.nav(0, 0, 1.0).velocity_mps, now.velocity_mps, atol=1e-12)


def test_the_manoeuvre_changes_speed_heading_pitch_and_roll():
    states = [ground_scenario("two-targets").vehicle.at(t) for t in np.linspace(0.0, 13.0, 131)]
    speed = [np.linalg.norm(one.velocity_mps) for one in states]
    attitude = np.degrees([one.attitude_rad for one in states])
    assert np.ptp(speed) > 0.8
    assert (np.ptp(attitude, axis=0) > [7.0, 5.0, 12.0]).all()


def test_truth_in_both_frames_agrees():
    """The sensor's polar coordinates are the distance and the cone angle of the true place."""
    for view in first(30, nav=True)[::7]:
        nav, mount = view.ping.nav, view.ping.mount
        body = rotation(nav.attitude_rad)
        axes = body @ rotation(mount.attitude_rad)
        depth = nav.altitude_m + nav.position_m[2]
        for flat, ned in zip(view.truth.state[:, :2], view.truth_ned.state[:, :2], strict=True):
            m = axes.T @ (np.array([*ned, depth]) - nav.position_m)
            assert_allclose(np.hypot(*flat), np.linalg.norm(m), rtol=1e-9)
            assert_allclose(np.arctan2(flat[1], flat[0]), np.arcsin(m[1] / np.linalg.norm(m)), atol=1e-9)


def test_apparent_velocities_are_the_derivatives_of_apparent_places():
    views = first(3, ping_rate_hz=1000.0, mode="points")
    difference = (views[2].truth.state[:, :2] - views[0].truth.state[:, :2]) / 2e-3
    assert_allclose(views[1].truth.state[:, 2:], difference, atol=1e-6)


def test_the_floor_is_speckle_of_the_right_law():
    image = first(1, sequence="empty")[0].ping.amplitude
    block = image[500:560].astype(float)
    assert_allclose(block.std() / block.mean(), 0.5227, atol=0.02)
    assert image[:100].mean() < 0.1 * image[500:600].mean()  # nearer than the floor there is only noise


def test_echoes_lie_where_truth_says():
    for view in first(60, sequence="two-targets", seed=4)[::10]:
        d, angle = np.hypot(*view.truth.state[:, :2].T), np.arctan2(*view.truth.state[:, 1::-1].T)
        for distance, bearing in zip(d, angle, strict=True):
            row = int(distance / 0.05)
            beam = int(np.rint((bearing - view.ping.bearing_rad[0]) / np.deg2rad(1.5)))
            near = view.ping.amplitude[max(row - 1, 0) : row + 2, max(beam - 1, 0) : beam + 2].max()
            assert near > 4.0 * np.median(view.ping.amplitude[max(row - 40, 0) : row + 40])


def test_a_box_hides_the_floor_behind_it_as_far_as_its_height_says():
    """Shadow from ground range r to r h / (h - height)."""
    view = first(1, sequence="wreck", n_ranges=2600)[0]
    thing = ground_scenario("wreck").things[0]
    h = 8.0
    x, y = view.truth.state[0, :2]
    column = int(np.rint((np.arctan2(y, x) - view.ping.bearing_rad[0]) / np.deg2rad(1.5)))
    power = (view.ping.amplitude.astype(float) ** 2)[:, column - 1 : column + 2].mean(axis=1)
    smooth = np.convolve(power, np.ones(20) / 20, "same")
    far = np.hypot(48.0 * h / (h - thing.height_m), h)
    level = smooth[int(40.0 / 0.05)]
    assert smooth[int(0.5 * (52.0 + far) / 0.05)] < 0.1 * level
    assert smooth[int((far + 4.0) / 0.05)] > 0.3 * level


def test_points_have_the_chosen_noise():
    views = first(65, mode="points", range_sd_m=0.8, bearing_sd_deg=2.0, seed=1)
    d, angle = [], []
    for view in views:
        assert not view.ping.amplitude.any()
        assert len(view.detections) == len(view.truth)
        d.append(view.detections.range_m - np.hypot(*view.truth.state[:, :2].T))
        angle.append(view.detections.bearing_rad - np.arctan2(*view.truth.state[:, 1::-1].T))
    assert_allclose(np.concatenate(d).std(), 0.8, rtol=0.25)
    assert_allclose(np.concatenate(angle).std(), np.deg2rad(2.0), rtol=0.25)


def test_detections_are_missed_and_false_ones_added_at_their_rates():
    views = first(
        400, mode="points", pings=400, n_ranges=4000, ping_rate_hz=50.0, p_d=0.6, false_per_ping=3.0
    )
    targets = sum(len(view.truth) for view in views)
    assert targets > 700
    assert_allclose(sum(len(view.detections) for view in views), 0.6 * targets + 1200, rtol=0.06)


def test_every_ping_depends_on_parameters_and_its_number_alone():
    long, short = first(6, pings=90, seed=2), first(6, pings=6, seed=2)
    other = first(6, pings=6, seed=3)
    for a, b, c in zip(long, short, other, strict=True):
        assert (a.ping.amplitude == b.ping.amplitude).all()
        assert (a.detections.range_m == b.detections.range_m).all()
        assert (a.ping.amplitude != c.ping.amplitude).any()


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_number_formats(dtype):
    view = first(1, sequence="objects", dtype=dtype)[0]
    assert view.ping.amplitude.dtype == dtype
    assert view.ping.amplitude.any()


def test_a_slope_moves_the_floor():
    floor = Floor(6.0, (0.1, 0.0))
    assert_allclose(floor.depth_at(20.0, 5.0), 8.0)
    assert_allclose(floor.normal @ [1.0, 0.0, 0.1], 0.0, atol=1e-15)
    level, sloped = first(1)[0], first(1, slope_north_deg=2.0)[0]
    ahead = [np.hypot(*view.truth.state[0, :2]) for view in (level, sloped)]
    assert ahead[1] > ahead[0] + 0.2


def test_navigation_has_the_truth_and_its_errors():
    scene = GroundScene(mode="points", nav=True, ping_rate_hz=20.0, pings=200)
    noise = {"velocity_sd_mps": 0.1, "attitude_sd_deg": 1.0, "rate_sd_dps": 0.5, "altitude_sd_m": 0.3}
    apart = []
    for view, (sample, _) in zip(scene(), GroundNav(**noise, seed=5)(), strict=False):
        true = view.ping.nav
        assert sample.stamp_ns == true.stamp_ns
        assert_allclose(sample.position_m, true.position_m)
        apart.append(
            np.concatenate(
                [
                    np.subtract(sample.velocity_mps, true.velocity_mps),
                    np.degrees(np.subtract(sample.attitude_rad, true.attitude_rad)),
                    np.degrees(np.subtract(sample.attitude_rate_radps, true.attitude_rate_radps)),
                    [sample.altitude_m - true.altitude_m],
                ]
            )
        )
    assert_allclose(np.std(apart, axis=0), [0.1] * 3 + [1.0] * 3 + [0.5] * 3 + [0.3], rtol=0.2)


def test_biases_stay_and_losses_come_at_their_rate():
    biased = states(heading_bias_sd_deg=5.0, attitude_sd_deg=0.0, duration_s=2.0, seed=1)
    straight = states(attitude_sd_deg=0.0, duration_s=2.0, seed=1)
    apart = [a.attitude_rad[2] - b.attitude_rad[2] for a, b in zip(biased, straight, strict=True)]
    assert_allclose(apart, apart[0], atol=1e-12)
    assert abs(apart[0]) > 1e-3
    lossy = states(dvl_loss=0.3, duration_s=50.0)
    lost = [np.isnan(one.velocity_mps).all() and np.isnan(one.altitude_m) for one in lossy]
    assert_allclose(np.mean(lost), 0.3, atol=0.05)
    assert not any(np.isnan(one.attitude_rad).any() for one in lossy)


def test_a_silent_link_sends_nothing():
    stamps = [one.stamp_ns for one in states(silent_from_s=1.0, silent_to_s=3.0, duration_s=4.0)]
    gaps = np.diff(stamps) * 1e-9
    assert_allclose(gaps.max(), 2.05)
    assert len(stamps) == 81 - 40


def test_the_altimeter_ahead_measures_the_slant_range():
    exact = {"altitude_sd_m": 0.0, "attitude_sd_deg": 0.0, "duration_s": 0.0, "sequence": "empty"}
    (ahead,) = states(ahead_depression_deg=30.0, **exact)
    (state,) = states(**exact)
    beam = rotation(state.attitude_rad) @ [np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6)]
    assert_allclose(ahead.altitude_m * beam[2], state.altitude_m, rtol=1e-3)
    assert np.isnan(ahead.velocity_mps).all()


def test_the_beams_of_the_dvl_measure_the_floor_that_the_vehicle_sees():
    """On a slope, the feet of the beams lie on it; lost, they say nothing."""
    slopes = {"slope_north_deg": 4.0, "slope_east_deg": -6.0}
    exact = {"attitude_sd_deg": 0.0, "altitude_sd_m": 0.0, "beam_sd_m": 0.0, "duration_s": 5.0}
    floor = GroundScene(**slopes).floor
    for state, beams in GroundNav(**slopes, **exact)():
        feet = state.position_m + (beams.direction * beams.range_m[:, None]) @ rotation(state.attitude_rad).T
        assert_allclose(feet[:, 2], floor.depth_at(feet[:, 0], feet[:, 1]), atol=1e-9)
        assert_allclose(beams.direction[:, 2], np.cos(np.deg2rad(30.0)))
    noisy = np.array([b.range_m for _, b in GroundNav(dvl_loss=0.2, duration_s=50.0, beam_sd_m=0.2)()])
    true = np.array([b.range_m for _, b in GroundNav(duration_s=50.0, beam_sd_m=0.0)()])
    lost = np.isnan(noisy).all(axis=1)
    assert (lost == np.isnan(noisy).any(axis=1)).all()
    assert_allclose(lost.mean(), 0.2, atol=0.05)
    assert_allclose(np.nanstd(noisy - true), 0.2, rtol=0.1)


@pytest.mark.parametrize(
    ("cls", "parameters", "text"),
    [
        (GroundScene, {"sequence": "moon"}, "sequence is 'moon'"),
        (GroundScene, {"mode": "film"}, "mode is 'film'"),
        (GroundScene, {"cell_m": 0.0}, "cell_m is 0.0"),
        (GroundScene, {"p_d": 1.5}, "p_d is 1.5"),
        (GroundScene, {"n_beams": 200}, "300.0"),
        (GroundScene, {"slope_east_deg": 80.0}, "slope_east_deg is 80.0"),
        (GroundScene, {"range_sd_m": float("nan")}, "range_sd_m is nan"),
        (GroundNav, {"rate_hz": 0.0}, "rate_hz is 0.0"),
        (GroundNav, {"dvl_loss": 2.0}, "dvl_loss is 2.0"),
        (GroundNav, {"altitude_m": -1.0}, "altitude_m is -1.0"),
        (GroundNav, {"dvl_tilt_deg": 0.0}, "dvl_tilt_deg is 0.0"),
        (GroundNav, {"beam_sd_m": -1.0}, "beam_sd_m is -1.0"),
        (GroundNav, {"velocity_sd_mps": -0.1}, "velocity_sd_mps is -0.1"),
        (GroundNav, {"ahead_depression_deg": 95.0}, "ahead_depression_deg is 95.0"),
    ],
)
def test_bad_parameters_are_named(cls, parameters, text):
    with pytest.raises(ValueError, match=text):
        cls(**parameters)


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_the_sources_keep_the_contract(sequence):
    check_node(GroundScene(sequence=sequence, n_ranges=300))
    check_node(GroundNav(sequence=sequence))
    assert len(GroundScene(sequence=sequence)) == ground_scenario(sequence).pings
