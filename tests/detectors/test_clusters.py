from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.clusters import gathered, leader_clusters
from fls_flow.geometry import turn


def distance_to_leader(point, leader, radius, angle):
    bearing = np.arctan2(leader[1], leader[0])
    along, across = (point - leader) @ turn(bearing)
    return float(np.hypot(along, across * radius / max(radius, angle * np.hypot(*leader))))


def slow_clusters(position, radius, angle):
    leaders, member_of = [], []
    for i, p in enumerate(position):
        off = [distance_to_leader(p, position[k], radius, angle) for k in leaders]
        if not off or min(off) > radius:
            leaders.append(i)
            off.append(0.0)
        member_of.append(int(np.argmin(off)))
    member_of = np.array(member_of, int)
    return member_of, leaders, np.array([position[member_of == k].mean(axis=0) for k in range(len(leaders))])


@pytest.mark.parametrize("spread", [3.0, 30.0, 3000.0])
@pytest.mark.parametrize("n", [1, 2, 50, 300])
@pytest.mark.parametrize("angle", [0.0, 0.04, 0.3])
def test_clusters_equal_the_definition(spread, n, angle):
    position = np.random.default_rng(n).uniform(-spread, spread, (n, 2))
    clusters = leader_clusters(position, 2.0, angle)
    member_of, leader, centre = slow_clusters(position, 2.0, angle)
    assert_array_equal(clusters.member_of, member_of)
    assert_array_equal(clusters.leader, leader)
    assert_allclose(clusters.centre_m, centre, atol=1e-9)


def test_points_join_the_nearest_leader_not_the_first():
    clusters = leader_clusters(np.array([[0.0, 0.0], [3.0, 0.0], [1.9, 0.0]]), 2.0)
    assert_array_equal(clusters.member_of, [0, 1, 1])


def test_a_point_at_the_radius_joins_and_a_long_row_is_no_single_cluster():
    assert_array_equal(leader_clusters(np.array([[0.0, 0.0], [2.0, 0.0]]), 2.0).member_of, [0, 0])
    row = np.stack([np.arange(0.0, 15.0, 0.1), np.zeros(150)], axis=1)
    assert len(leader_clusters(row, 2.0).leader) >= 4


def test_no_points_no_clusters():
    clusters = leader_clusters(np.zeros((0, 2)), 2.0)
    assert clusters.member_of.size == clusters.leader.size == 0
    assert clusters.centre_m.shape == (0, 2)


@pytest.mark.parametrize("strongest", range(31))
def test_an_object_one_and_a_half_radii_wide_is_one_wherever_it_is_brightest(strongest):
    row = np.stack([np.arange(0.0, 3.05, 0.1), np.full(31, 20.0)], axis=1)
    position = row[[strongest, *(i for i in range(31) if i != strongest)]]
    objects, object_of = gathered(leader_clusters(position, 2.0), position, 2.0)
    assert_array_equal(objects.leader, [0])
    assert_array_equal(objects.member_of, np.zeros(31))
    assert_allclose(objects.centre_m, [[1.5, 20.0]])
    assert not object_of.any()


def test_two_small_objects_more_than_the_radius_apart_stay_two():
    position = np.array([[0.0, 0.0], [2.1, 0.0], [0.0, 0.1], [2.1, 0.1]])
    objects, object_of = gathered(leader_clusters(position, 2.0), position, 2.0)
    assert_array_equal(objects.leader, [0, 1])
    assert_array_equal(objects.member_of, [0, 1, 0, 1])
    assert_array_equal(object_of, [0, 1])


def test_gathering_nothing_gives_nothing():
    objects, object_of = gathered(leader_clusters(np.zeros((0, 2)), 2.0), np.zeros((0, 2)), 2.0)
    assert objects.member_of.size == objects.leader.size == object_of.size == 0
    assert objects.centre_m.shape == (0, 2)


def test_selected_clusters_keep_their_points_leaders_and_centres():
    position = np.random.default_rng(3).uniform(-10.0, 10.0, (60, 2))
    clusters = leader_clusters(position, 2.0)
    which = np.arange(clusters.leader.size) % 3 != 1
    chosen, points = clusters.select(which)
    assert_array_equal(points, which[clusters.member_of])
    assert_allclose(position[points][chosen.leader], position[clusters.leader[which]])
    assert_allclose(chosen.centre_m, clusters.centre_m[which])
    means = [position[points][chosen.member_of == k].mean(axis=0) for k in range(which.sum())]
    assert_allclose(chosen.centre_m, means)
