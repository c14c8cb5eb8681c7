from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.clusters import leader_clusters
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
