from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.cfar import REFERENCE, TEST
from fls_detectors.exclusion import (
    all_finite,
    cell_flags,
    gate_shapes,
    mark_ellipses,
    mark_wedges,
    no_marks,
)
from fls_flow.kernels import frozen

RANGE_M = frozen(3.0 + 0.1 * np.arange(600))
BEARING_RAD = frozen(np.deg2rad(0.5 * np.arange(-60, 61)))
X_M = RANGE_M[:, None] * np.cos(BEARING_RAD)
Y_M = RANGE_M[:, None] * np.sin(BEARING_RAD)


def covered(marks):
    return np.cumsum(marks, axis=0)[:-1] > 0


def inside_wedge(apex, orientation, length, half_angle):
    dx, dy = X_M - apex[0], Y_M - apex[1]
    off = (np.arctan2(dy, dx) - orientation + np.pi) % (2 * np.pi) - np.pi
    return (np.hypot(dx, dy) <= length) & (np.abs(off) <= half_angle)


def mark_wedge(apex, orientation, length, half_angle, bearing=BEARING_RAD, half_width=0.0):
    marks = no_marks(RANGE_M.size, bearing.size)
    wedge = (np.array([apex], float), np.array([orientation]), np.array([length]), np.array([half_angle]))
    mark_wedges(marks, RANGE_M, bearing, half_width, *map(frozen, wedge))
    return covered(marks)


def test_ellipses_cover_the_cells_inside():
    rng = np.random.default_rng(1)
    marks = no_marks(*X_M.shape)
    expected = np.zeros(X_M.shape, bool)
    centre = np.stack([rng.uniform(-5, 60, 30), rng.uniform(-30, 30, 30)], axis=1)
    root = rng.normal(size=(30, 2, 2))
    shape = gate_shapes(root @ root.transpose(0, 2, 1), 4.0, 1.0, 50.0)
    mark_ellipses(marks, RANGE_M, BEARING_RAD, 0.0, frozen(centre), frozen(shape))
    for (x, y), M in zip(centre, shape, strict=True):
        e = np.stack([X_M - x, Y_M - y], axis=-1)
        expected |= np.einsum("...i,ij,...j->...", e, M, e) <= 1.0
    assert expected.any()
    assert_array_equal(covered(marks), expected)


def test_gates_have_half_axes_of_the_gate_within_bounds():
    shapes = gate_shapes(np.array([np.diag([9.0, 0.01]), np.diag([1e4, 4.0])]), 4.0, 2.0, 10.0)
    assert_allclose(1 / np.sqrt(np.diagonal(shapes, axis1=1, axis2=2)), [[6.0, 2.0], [10.0, 4.0]])


@pytest.mark.parametrize("half_angle", [np.deg2rad(10), np.deg2rad(60), np.deg2rad(89)])
def test_wedges_cover_the_cells_inside(half_angle):
    rng = np.random.default_rng(2)
    for _ in range(40):
        apex, phi = rng.uniform([-5, -30], [60, 30]), rng.uniform(-np.pi, np.pi)
        assert_array_equal(mark_wedge(apex, phi, 15.0, half_angle), inside_wedge(apex, phi, 15.0, half_angle))


def test_a_wedge_of_half_a_circle_or_more_covers_the_disc():
    disc = np.hypot(X_M - 30.0, Y_M) <= 8.0
    assert_array_equal(mark_wedge((30.0, 0.0), 1.0, 8.0, np.pi), disc)


def test_a_beam_table_in_falling_order_gives_the_mirrored_cells():
    expected = mark_wedge((30.0, -5.0), 0.5, 15.0, 0.3)
    assert_array_equal(
        mark_wedge((30.0, -5.0), 0.5, 15.0, 0.3, bearing=frozen(BEARING_RAD[::-1])), expected[:, ::-1]
    )


def test_a_disc_narrower_than_the_beams_is_not_lost_between_them():
    bearing = frozen(np.deg2rad([-1.5, 0.0, 1.5]))
    centre = 55.0 * np.array([[np.cos(np.deg2rad(0.7)), np.sin(np.deg2rad(0.7))]])
    marks = no_marks(RANGE_M.size, 3)
    shape = gate_shapes(np.zeros((1, 2, 2)), 4.0, 0.5, 10.0)
    mark_ellipses(marks, RANGE_M, bearing, np.deg2rad(0.75), frozen(centre), frozen(shape))
    rows, beams = np.nonzero(covered(marks))
    assert set(beams) == {1, 2}  # 0.7 degrees lie in beam 1, and 0.5 m reach over into beam 2
    assert_allclose([RANGE_M[rows].min(), RANGE_M[rows].max()], [54.5, 55.5], atol=0.11)


def test_every_cell_whose_centre_lies_in_a_shape_is_marked_however_wide_the_beams():
    rng = np.random.default_rng(2)
    half_width = 0.5 * np.deg2rad(0.5)
    for _ in range(20):
        apex, orientation = (rng.uniform(5, 60), rng.uniform(-20, 20)), rng.uniform(-np.pi, np.pi)
        marked = mark_wedge(apex, orientation, 15.0, np.deg2rad(10.0), half_width=half_width)
        assert not (inside_wedge(apex, orientation, 15.0, np.deg2rad(10.0)) & ~marked).any()


def test_shapes_behind_the_sonar_or_out_of_range_mark_nothing():
    for apex in ((-30.0, 0.0), (200.0, 0.0), (0.0, 60.0)):
        assert not mark_wedge(apex, 0.0, 5.0, 0.2).any()


def test_flags_tell_what_is_reference_and_what_is_tested():
    amplitude = np.ones((6, 5), np.float32)
    amplitude[0, 0], amplitude[1, 0] = np.nan, np.inf
    marks = no_marks(6, 5)
    marks[2, 1], marks[4, 1] = 1, -1
    valid = np.ones((6, 5), bool)
    valid[5] = False
    noisy = np.array([False, False, False, True, False])
    expected = np.full((6, 5), TEST | REFERENCE)
    expected[2:4, 1] = TEST
    expected[:, 3] = expected[5] = 0
    expected[:2, 0] = 0
    assert_array_equal(cell_flags(amplitude, marks, noisy, valid), expected)
    expected[5] = [3, 3, 3, 0, 3]
    assert_array_equal(cell_flags(amplitude, marks, noisy, None), expected)


def test_integers_are_always_finite():
    assert all_finite(np.zeros((2, 2), np.uint16))
    assert all_finite(np.zeros((2, 2), np.float32))
    assert not all_finite(np.array([[1.0, np.nan]], np.float32))
