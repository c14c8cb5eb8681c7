"""Smoothing, seeds, thresholds and regions, beside scipy and OpenCV."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import wiener
from scipy.sparse.csgraph import connected_components

from fls_features.growing import central, grown, reach, seeds, smoothed, thresholds, within


def slow_wiener(chip, height, width):
    """The definition, cell by cell, with zeros outside."""
    rows, columns = chip.shape
    padded = np.zeros((rows + height, columns + width))
    before, left = (height - 1) // 2, (width - 1) // 2
    padded[before : before + rows, left : left + columns] = chip
    mean, variance = np.zeros(chip.shape), np.zeros(chip.shape)
    for i in range(rows):
        for j in range(columns):
            window = padded[i : i + height, j : j + width]
            mean[i, j], variance[i, j] = window.mean(), window.var()
    noise = variance.mean()
    gain = np.maximum(variance - noise, 0.0) / np.maximum(np.maximum(variance, noise), 1e-300)
    return mean + gain * (chip - mean)


@pytest.mark.parametrize("size", [(20, 2), (21, 3), (1, 1), (4, 4), (2, 7)])
@pytest.mark.parametrize("shape", [(64, 21), (7, 3), (1, 1), (30, 1)])
def test_the_filter_is_the_definition(rng, size, shape):
    chips = rng.rayleigh(2.0, (3, *shape)).astype(np.float32)
    expected = [slow_wiener(one.astype(float), *size) for one in chips]
    assert_allclose(smoothed(chips, size), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("size", [(21, 3), (5, 5), (3, 1)])
def test_odd_windows_are_those_of_scipy(rng, size):
    chip = rng.rayleigh(2.0, (64, 21)).astype(np.float32)
    assert_allclose(smoothed(chip[None], size)[0], wiener(chip.astype(float), size), rtol=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_whole_numbers_are_filtered_exactly_as_floats(rng, dtype):
    chips = rng.integers(0, np.iinfo(dtype).max, (2, 30, 12)).astype(dtype)
    assert_array_equal(smoothed(chips, (20, 2)), smoothed(chips.astype(np.float32), (20, 2)))


def test_a_loud_cell_leaves_no_trace_behind_it():
    """Running sums that lose digits would show it in the quiet rows after the loud one."""
    chips = np.full((1, 200, 3), 1e-3, np.float32)
    chips[0, 20] = 1e6
    assert_allclose(smoothed(chips, (5, 1))[0, 60:195], 1e-3, rtol=1e-3)


def test_an_even_chip_keeps_its_level_away_from_the_border():
    flat = smoothed(np.full((1, 60, 20), 7.0, np.float32), (20, 2))[0]
    assert_allclose(flat[9:-10, :-1], 7.0)


def test_the_central_part_reaches_from_10_to_90_percent():
    rows, columns = central((100, 21)).nonzero()
    assert (rows.min() + 1, rows.max() + 1) == (10, 90)  # counted from 1, as the source does
    assert (columns.min() + 1, columns.max() + 1) == (2, 19)


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (3, 5), (1, 40)])
def test_a_small_chip_has_a_central_part(shape):
    assert central(shape).any()


def test_the_seed_is_the_brightest_central_cell(rng):
    filtered = rng.random((4, 50, 20))
    filtered[:, 0, 0] = 9.0  # not central
    filtered[:, 25, [3, 7, 11, 15]] += np.diag([2.0, 2.0, 2.0, 2.0])
    candidate = np.broadcast_to(central((50, 20)), filtered.shape)
    assert seeds(filtered, candidate).tolist() == [[25, 3], [25, 7], [25, 11], [25, 15]]


def test_near_the_track_is_a_circle_in_metres():
    range_m, bearing_rad = 10.0 + np.arange(5.0)[None], np.radians([[-10.0, 0.0, 10.0]])
    near = within(1.9, range_m, bearing_rad, np.array([[2, 1]]))[0]
    place = np.stack([range_m[0][:, None] * f(bearing_rad[0]) for f in (np.cos, np.sin)], -1)
    assert_array_equal(near, np.hypot(*(place - [12.0, 0.0]).T).T <= 1.9)
    assert within(1e-9, range_m, bearing_rad, np.array([[0, 2]]))[0].sum() == 1


def test_three_thresholds_by_hand():
    """A chip of 1 ... 100 in steps of 1, the seed at 90."""
    filtered = np.arange(1.0, 101.0).reshape(1, 10, 10)
    seed = np.array([[8, 9]])
    assert_allclose(thresholds(filtered, seed, "seed", 0.78), [0.78 * 90])
    assert_allclose(thresholds(filtered, seed, "histogram", 0.78), [1 + 0.775 * 99])  # hist(., 100), bin 78
    assert_allclose(thresholds(filtered, seed, "percentile", 0.78), [np.percentile(filtered, 78)])


def slow_region(chip, seed, threshold):
    """Dilate by 3 x 3 inside the bright cells until nothing changes, as the source does."""
    bright = (chip > threshold).astype(np.uint8)
    mask = np.zeros(chip.shape, np.uint8)
    mask[tuple(seed)] = bright[tuple(seed)]
    while True:
        larger = cv2.dilate(mask, np.ones((3, 3), np.uint8)) * bright
        if np.array_equal(larger, mask):
            return mask.astype(bool)
        mask = larger


def test_regions_are_those_of_the_dilation(rng):
    chips = rng.random((40, 24, 15))
    candidate = np.broadcast_to(central((24, 15)), chips.shape)
    seed = seeds(chips, candidate)
    threshold = rng.uniform(0.3, 0.9, 40)
    expected = [slow_region(*one) for one in zip(chips, seed, threshold, strict=True)]
    assert_array_equal(grown(chips, seed, threshold), expected)


def test_regions_are_the_8_connected_components_of_opencv(rng):
    chips = rng.random((20, 30, 30))
    seed = seeds(chips, np.ones(chips.shape, bool))
    for chip, start, mask in zip(chips, seed, grown(chips, seed, np.full(20, 0.6)), strict=True):
        _, label = cv2.connectedComponents((chip > 0.6).astype(np.uint8), connectivity=8)
        assert_array_equal(mask, label == label[tuple(start)])


def test_diagonal_cells_belong_together_and_a_gap_parts():
    chip = np.zeros((1, 7, 7))
    chip[0, [1, 2, 3, 5], [1, 2, 3, 5]] = 1.0
    assert grown(chip, np.array([[2, 2]]), np.array([0.5]))[0].sum() == 3


def test_the_threshold_itself_is_not_exceeded():
    chip = np.full((1, 3, 3), 0.5)
    assert not grown(chip, np.array([[1, 1]]), np.array([0.5])).any()


def test_a_region_may_fill_the_whole_chip():
    assert grown(np.ones((1, 300, 40)), np.array([[150, 20]]), np.array([0.5])).all()


def joined_by_pairs(image, seed, threshold, high, wide):
    """Every pair of bright cells, and the component of the seed."""
    cells = np.argwhere(image > threshold)
    apart = np.abs(cells[:, None] - cells[None])
    near = (apart[..., 0] / max(high, 1)) ** 2 + (apart[..., 1] / max(wide, 1)) ** 2 <= 1.0
    near |= apart.max(axis=2) <= 1
    _, part = connected_components(near)
    mask = np.zeros(image.shape, bool)
    mine = part == part[np.flatnonzero((cells == seed).all(axis=1))[0]]
    mask[tuple(cells[mine].T)] = True
    return mask


@pytest.mark.parametrize("span", [(0.0, 0.0), (1.0, 1.0), (3.0, 2.0), (2.6, 4.9), (0.4, 3.2), (1e9, 1e9)])
def test_regions_leap_over_gaps_as_pairs_of_cells_do(rng, span):
    chips = rng.random((5, 24, 15))
    seed = seeds(chips, np.ones(chips.shape, bool))
    threshold = np.full(5, 0.9)
    found = grown(chips, seed, threshold, np.tile(span, (5, 1)))
    for chip, mask, one in zip(chips, found, seed, strict=True):
        assert_array_equal(mask, joined_by_pairs(chip, one, 0.9, *span))


def test_without_reach_neighbours_alone_are_joined(rng):
    chips = rng.random((8, 24, 15))
    seed = seeds(chips, np.ones(chips.shape, bool))
    assert_array_equal(
        grown(chips, seed, np.full(8, 0.7), np.zeros((8, 2))), grown(chips, seed, np.full(8, 0.7))
    )


def test_a_gap_spans_fewer_beams_farther_out():
    found = reach(0.6, np.array([10.0, 40.0]), 0.1, 0.005)
    assert_allclose(found, [[6.0, 12.0], [6.0, 3.0]])
    assert_array_equal(reach(0.6, np.array([10.0]), np.nan, np.nan), [[0.0, 0.0]])  # one row of one beam
