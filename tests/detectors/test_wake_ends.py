from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.wake_ends import WakeEnds
from fls_flow import DetectionKind, Detections
from fls_flow.geometry import turn


def wake(start, heading, length, seed=0, per_m=30, width=1.2):
    rng = np.random.default_rng(seed)
    n = int(per_m * length)
    along, across = rng.uniform(0, length, n), rng.uniform(-width / 2, width / 2, n)
    along[:2] = 0.0, length
    return np.stack([along, across], axis=1) @ turn(heading).T + start


def buoy(at, n=8, seed=1):
    return at + np.random.default_rng(seed).uniform(-0.4, 0.4, (n, 2))


def ends_of(detections):
    return detections.select(detections.kind == DetectionKind.WAKE_END)


def assert_same_places(found, expected, atol):
    off = np.linalg.norm(found[:, None] - np.asarray(expected)[None], axis=-1)
    assert len(found) == len(expected)
    assert (off.min(axis=0) <= atol).all()
    assert (off.min(axis=1) <= atol).all()


@pytest.mark.parametrize("length", [12.0, 35.0])
@pytest.mark.parametrize("heading", np.deg2rad([0.0, 5.0, 47.0, 90.0, 133.0, 268.0]))
def test_a_wake_has_exactly_two_ends_and_a_buoy_beside_it_is_kept(make_echoes, length, heading):
    start = np.array([40.0, -3.0])
    stop = start + length * np.array([np.cos(heading), np.sin(heading)])
    beside = 0.5 * (start + stop) + 10.0 * np.array([-np.sin(heading), np.cos(heading)])
    for seed in range(5):
        echoes = make_echoes(np.concatenate([wake(start, heading, length, seed), buoy(beside)]))
        detections, wakes = WakeEnds()(echoes)
        assert_same_places(ends_of(detections).position_m, [start, stop], 2.0)
        others = detections.select(detections.kind == DetectionKind.ECHO)
        assert_same_places(others.position_m, [beside], 0.5)
        assert_array_equal(np.unique(wakes.wake), [0])
        assert_same_places(np.unique(wakes.apex_m[wakes.is_end], axis=0), [start, stop], 2.0)
        assert (wakes.length_m == 15.0).all()
        assert_allclose(wakes.half_angle_rad, np.deg2rad(10.0))


def test_wedges_at_the_ends_lie_along_the_wake(make_echoes):
    heading = np.deg2rad(30.0)
    _, wakes = WakeEnds()(make_echoes(wake((30.0, 0.0), heading, 30.0)))
    first = np.linalg.norm(wakes.apex_m - [30.0, 0.0], axis=1) < 2.0
    off = np.abs((wakes.orientation_rad[first] - heading + np.pi) % (2 * np.pi) - np.pi)
    assert wakes.is_end[first].any()
    assert (off <= np.deg2rad(15.0)).all()


def test_permutation_of_detections_does_not_change_the_result(make_echoes):
    echoes = make_echoes(np.concatenate([wake((30.0, -8.0), 0.6, 25.0), buoy((25.0, 9.0))]))
    tied = replace(echoes, amplitude=np.full(len(echoes), 255.0))  # 8-bit data saturate
    for given in (echoes, tied):
        expected, expected_wakes = WakeEnds()(given)
        for seed in range(3):
            order = np.random.default_rng(seed).permutation(len(given))
            detections, wakes = WakeEnds()(given.select(order))
            for name in ("range_m", "bearing_rad", "amplitude", "extent", "covariance", "kind"):
                assert_array_equal(getattr(detections, name), getattr(expected, name))
            for name in ("apex_m", "orientation_rad", "wake", "is_end"):
                assert_array_equal(getattr(wakes, name), getattr(expected_wakes, name))


def test_rotation_of_the_scene_rotates_the_ends(make_echoes):
    points = wake((35.0, -5.0), 0.6, 25.0)
    expected = ends_of(WakeEnds()(make_echoes(points)).detections).position_m
    for angle in np.deg2rad([3.0, 40.0, 115.0, 179.0, 200.0, 301.0]):
        found = ends_of(WakeEnds()(make_echoes(points @ turn(angle).T)).detections).position_m
        assert_same_places(found @ turn(angle), expected, 1.5)


def test_a_wake_across_the_backward_bearing_has_two_ends(make_echoes):
    detections, _ = WakeEnds()(make_echoes(wake((-40.0, -12.0), np.pi / 2, 24.0)))
    assert_same_places(ends_of(detections).position_m, [(-40.0, -12.0), (-40.0, 12.0)], 2.0)


def test_extent_of_a_cluster_across_the_backward_bearing_is_small(make_echoes):
    detections, _ = WakeEnds()(make_echoes([(-40.0, 0.5), (-40.0, -0.5)]))
    assert len(detections) == 1
    assert_allclose(detections.extent[0], [0.0, 1.0 / 40.0], atol=1e-5)


def test_a_cluster_is_the_mean_of_its_members(make_echoes):
    detections, wakes = WakeEnds()(
        make_echoes([(30.0, 0.0), (30.4, 0.2), (30.2, 0.4)], amplitude=[5.0, 9.0, 7.0])
    )
    assert_allclose(detections.position_m, [[30.2, 0.2]])
    assert_allclose(detections.amplitude, [9.0])
    assert_allclose(detections.covariance[0], np.diag([0.05**2, np.deg2rad(1.5) ** 2]))
    assert_allclose(detections.extent[0], [0.4, 0.4 / 30.2], rtol=0.01)
    assert detections.kind[0] == DetectionKind.ECHO
    assert len(wakes) == 0


def test_without_a_wake_all_clusters_pass_in_order_of_range(make_echoes):
    places = np.array([(50.0, 9.0), (20.0, 0.0), (31.0, -7.0), (20.0, 6.0)])
    echoes = make_echoes(np.concatenate([buoy(p, seed=i) for i, p in enumerate(places)]))
    detections, wakes = WakeEnds()(echoes)
    assert_same_places(detections.position_m, places, 0.5)
    assert (np.diff(detections.range_m) >= 0).all()
    assert len(wakes) == 0


def test_an_echo_that_fills_neighbouring_beams_far_off_is_one_cluster(make_echoes):
    bearing = np.deg2rad([-1.5, 0.0, 1.5])
    for distance in (20.0, 90.0):
        points = distance * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        echoes = make_echoes(points, amplitude=[5.0, 9.0, 5.0])
        assert len(WakeEnds()(echoes).detections) == 1
    assert len(WakeEnds(cluster_radius_beams=0.0)(echoes).detections) == 3


def test_detections_that_are_not_finite_are_dropped(make_echoes):
    points = wake((40.0, -3.0), 0.6, 20.0)
    amplitude = np.arange(len(points) + 2)
    echoes = make_echoes(np.concatenate([points, [(np.nan, 1.0), (np.inf, 2.0)]]), amplitude)
    sound = make_echoes(points, amplitude[:-2])
    detections, _ = WakeEnds()(echoes)
    assert_array_equal(detections.range_m, WakeEnds()(sound).detections.range_m)
    assert len(ends_of(detections)) == 2


def test_two_crossing_wakes_have_four_ends(make_echoes):
    points = np.concatenate([wake((30.0, -15.0), np.pi / 2, 30.0), wake((15.0, 2.0), 0.0, 40.0, seed=3)])
    found = ends_of(WakeEnds()(make_echoes(points)).detections).position_m
    assert_same_places(found, [(30.0, -15.0), (30.0, 15.0), (15.0, 2.0), (55.0, 2.0)], 2.0)


def ship_at(echoes, range_m, bearing_deg, width_deg=3.0):
    n = len(range_m)
    return Detections(
        echoes.seq,
        echoes.stamp_ns,
        np.asarray(range_m, float),
        np.full(n, np.deg2rad(bearing_deg)),
        np.full(n, 50.0),
        np.tile([0.0, np.deg2rad(width_deg)], (n, 1)),
        np.tile(np.diag([0.05**2, 0.026**2]), (n, 1, 1)),
        np.full(n, DetectionKind.SELF_NOISE),
        echoes.view,
    )


def ships_of(detections):
    return detections.select(detections.kind == DetectionKind.SELF_NOISE)


def test_a_wake_that_ends_beside_the_noisy_beams_gives_the_ship_its_range(make_echoes):
    """The ship at 45 m dead ahead; its wake lies to starboard, from the edge of the noisy beams on."""
    echoes = make_echoes(wake((45.0, 2.5), np.pi / 2, 20.0))
    detections, _ = WakeEnds()(echoes, ship_at(echoes, [8.0, 20.0, 45.3, 60.0], 0.0))
    ship = ships_of(detections)
    assert_allclose(ship.range_m, [45.3])
    assert_allclose(ship.bearing_rad, [0.0])
    assert_same_places(ends_of(detections).position_m, [(45.0, 22.5)], 2.0)


def test_without_a_candidate_near_the_end_the_ship_has_its_range(make_echoes):
    echoes = make_echoes(wake((45.0, 2.5), np.pi / 2, 20.0))
    ship = ships_of(WakeEnds()(echoes, ship_at(echoes, [8.0, 20.0, 60.0], 0.0)).detections)
    assert len(ship) == 1
    assert_allclose(ship.range_m, 45.0, atol=2.0)


def test_without_an_end_in_the_bearing_all_candidates_are_measurements(make_echoes):
    ranges = [8.0, 20.0, 45.3, 60.0]
    for points in (wake((45.0, 12.0), np.pi / 2, 20.0), buoy((45.0, 1.0)), np.zeros((0, 2))):
        echoes = make_echoes(points)
        detections, _ = WakeEnds()(echoes, ship_at(echoes, ranges, 0.0))
        assert_allclose(ships_of(detections).range_m, ranges)
        assert len(detections) == 4 + len(WakeEnds()(echoes).detections)


def test_each_of_two_ships_takes_its_own_end(make_echoes):
    echoes = make_echoes(wake((45.0, -10.0), np.pi / 2, 20.0))
    bearing = np.rad2deg(np.arctan2(12.0, 45.0))
    parts = [ship_at(echoes, [30.0, 46.5], -bearing), ship_at(echoes, [46.0, 70.0], bearing)]
    both = replace(
        parts[0],
        **{
            name: np.concatenate([getattr(p, name) for p in parts])
            for name in ("range_m", "bearing_rad", "amplitude", "extent", "covariance", "kind")
        },
    )
    detections, _ = WakeEnds()(echoes, both)
    assert_allclose(ships_of(detections).range_m, [46.5, 46.0])
    assert len(ends_of(detections)) == 0


def test_empty_answers_keep_number_and_stamp(make_echoes):
    detections, wakes = WakeEnds()(make_echoes(np.zeros((0, 2))))
    assert (len(detections), len(wakes)) == (0, 0)
    assert (detections.seq, detections.stamp_ns, wakes.seq, wakes.stamp_ns) == (7, 1_000, 7, 1_000)
    detections, _ = WakeEnds()(Detections(3, 5), Detections(3, 5))
    assert (detections.seq, detections.stamp_ns, len(detections)) == (3, 5, 0)


def test_outputs_hold_no_memory_of_the_inputs(make_echoes):
    echoes = make_echoes(np.concatenate([wake((45.0, 2.5), np.pi / 2, 20.0), buoy((25.0, 3.0))]))
    ship = ship_at(echoes, [45.0], 0.0)
    detections, wakes = WakeEnds()(echoes, ship)
    names = ("range_m", "bearing_rad", "amplitude", "extent", "covariance", "kind")
    given = [getattr(m, name) for m in (echoes, ship) for name in names]
    given += [echoes.view.bearing_rad, ship.view.bearing_rad]
    out = [getattr(detections, name) for name in names] + [detections.view.bearing_rad, wakes.apex_m]
    assert not any(np.shares_memory(a, b) for a in given for b in out)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"cluster_radius_m": 0.0}, "cluster_radius_m must be positive and finite, not 0.0"),
        ({"strip_length_m": float("inf")}, "strip_length_m .* not inf"),
        ({"min_count": 0}, "min_count must be at least 1, not 0"),
        ({"ratio": 18.0}, "ratio must lie between 0 and 18, not 18.0"),
        ({"bearing_tolerance_beams": -1.0}, "bearing_tolerance_beams .* not -1.0"),
        ({"range_tolerance_m": float("nan")}, "range_tolerance_m .* not nan"),
    ],
)
def test_bad_parameters_are_named(parameters, text):
    with pytest.raises(ValueError, match=text):
        WakeEnds(**parameters)
