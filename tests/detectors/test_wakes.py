from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fls_detectors.wakes import ORIENTATIONS, STEP, Strips, wake_wedges, wedge_counts

PAPER = {"length_m": 15.0, "short_m": 7.5, "min_count": 50, "ratio": 5.0}


def slow_counts(centre, points, length):
    counts = np.zeros((len(centre), ORIENTATIONS), int)
    for i, c in enumerate(centre):
        dx, dy = (points - c).T
        distance = np.hypot(dx, dy)
        near = (distance > 0) & (distance <= length)
        for k in range(ORIENTATIONS):
            off = (np.arctan2(dy, dx) - k * STEP + np.pi) % (2 * np.pi) - np.pi
            counts[i, k] = np.count_nonzero(near & (np.abs(off) <= STEP))
    return counts


@pytest.mark.parametrize("spread", [10.0, 60.0])
def test_counts_equal_the_definition(spread):
    rng = np.random.default_rng(41)
    points = rng.uniform(-spread, spread, (500, 2))
    centre = np.concatenate([points[:5], rng.uniform(-2 * spread, 2 * spread, (60, 2))])
    counts = wedge_counts(centre, Strips.of(points, 15.0), 15.0, 7.5)
    assert_array_equal(counts[0], slow_counts(centre, points, 15.0))
    assert_array_equal(counts[1], slow_counts(centre, points, 7.5))


def test_each_point_lies_in_two_wedges():
    angle = np.deg2rad(np.arange(0, 360, 0.5) + 0.25)
    points = 5.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    counts = wedge_counts(np.zeros((1, 2)), Strips.of(points, 15.0), 15.0, 7.5)
    assert_array_equal(counts, np.full((2, 1, ORIENTATIONS), 40))


def row_of_points(n, length):
    return np.stack([np.linspace(0, length, n), 0.2 * np.sin(np.arange(n))], axis=1)


def test_mid_wake_qualifies_but_is_no_end():
    points = row_of_points(600, 30.0)
    centre = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [30.0, 0.0]])
    wedges = wake_wedges(centre, points, **PAPER)
    middle = np.isin(wedges.centre, [1, 2])
    assert middle.any()
    assert not wedges.is_end[middle].any()
    assert set(wedges.centre[wedges.is_end]) == {0, 3}
    assert_array_equal(wedges.covered, [False, True, True, False])
    assert_array_equal(np.unique(wedges.wake), [0])


def test_thin_rows_are_no_wake():
    assert wake_wedges(np.zeros((1, 2)), row_of_points(50, 14.0), **PAPER).centre.size == 0
    assert wake_wedges(np.zeros((1, 2)), row_of_points(90, 14.0), **PAPER).centre.size > 0


def test_a_row_far_from_the_centre_is_none_of_its_wakes():
    """The shorter strip is empty."""
    points = row_of_points(200, 6.0) + np.array([8.0, 0.0])
    assert wake_wedges(np.zeros((1, 2)), points, **PAPER).centre.size == 0


def test_separate_wakes_are_numbered_apart():
    one = row_of_points(400, 20.0)
    points = np.concatenate([one, one + np.array([0.0, 60.0])])
    centre = np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 60.0], [20.0, 60.0]])
    wedges = wake_wedges(centre, points, **PAPER)
    numbers = [set(wedges.wake[wedges.centre == i]) for i in range(4)]
    assert numbers[0] == numbers[1]
    assert numbers[2] == numbers[3]
    assert numbers[0] | numbers[2] == {0, 1}


def test_nothing_in_nothing_out():
    wedges = wake_wedges(np.zeros((0, 2)), np.zeros((0, 2)), **PAPER)
    assert wedges.centre.size == wedges.wake.size == wedges.covered.size == 0
