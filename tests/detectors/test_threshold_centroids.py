"""Threshold, connected regions, centroids: hand-worked regions, gaps, thresholds, number formats."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.threshold_centroids import ThresholdCentroids, bright_regions, fls_node
from fls_flow import Ping
from fls_flow.testing import check_node

RANGE_M = 20.0 + 0.1 * (np.arange(80) + 0.5)
BEARING_RAD = np.radians(np.linspace(-4.75, 4.75, 20))


def ping_of(amplitude: np.ndarray, **fields) -> Ping:
    return Ping(3, 500, amplitude, RANGE_M, BEARING_RAD, **fields)


def dark(dtype=np.float32) -> np.ndarray:
    return np.ones((80, 20), dtype)


def test_kind_and_contract() -> None:
    assert fls_node() is ThresholdCentroids
    check_node("threshold-centroids")


def test_a_hand_worked_centroid() -> None:
    image = dark()
    image[10, 5], image[11, 5], image[11, 6] = 20.0, 20.0, 40.0
    (found,) = [ThresholdCentroids()(ping_of(image))]
    assert len(found) == 1
    # powers 400, 400, 1600: rows 10, 11, 11 and columns 5, 5, 6
    assert_allclose(found.range_m, [20.0 + 0.1 * (10 + 2000 / 2400 + 0.5)], rtol=1e-9)
    assert_allclose(found.bearing_rad, [math.radians(-4.75 + 0.5 * (5 + 1600 / 2400))], rtol=1e-9)
    assert_allclose(found.amplitude, [40.0])
    assert_allclose(found.extent[0], [0.1, math.radians(0.5)], rtol=1e-6)
    assert_allclose(found.covariance[0], np.diag([0.15**2, math.radians(0.25) ** 2]), rtol=1e-6)
    assert (found.seq, found.stamp_ns) == (3, 500)


def test_gaps_of_so_many_cells_are_bridged_and_no_more() -> None:
    bright = np.zeros((40, 20), bool)
    bright[[5, 9], 4] = True  # three dark rows between
    bright[[20, 20], [3, 6]] = True  # two dark columns between
    amplitude = np.ones((40, 20), np.float32)
    for gap, regions in (((0, 0), 4), ((2, 1), 4), ((3, 1), 3), ((3, 2), 2), ((9, 2), 2), ((10, 2), 1)):
        assert len(bright_regions(amplitude, bright, gap).cells) == regions, gap


def test_regions_touch_by_corners_without_a_gap() -> None:
    bright = np.zeros((6, 6), bool)
    bright[[1, 2, 3], [1, 2, 1]] = True
    found = bright_regions(np.ones((6, 6), np.float32), bright)
    assert_array_equal(found.cells, [3.0])
    assert_array_equal(found.size, [[3.0, 2.0]])
    assert_allclose(found.spread, [[math.sqrt(2 / 3), math.sqrt(2 / 9)]])


def test_regions_against_a_slow_flood_fill() -> None:
    rng = np.random.default_rng(3)
    bright = rng.random((30, 20)) < 0.3
    amplitude = rng.random((30, 20)).astype(np.float32) + 0.5
    left, sizes = bright.copy(), []
    for start in np.argwhere(bright):
        stack, n = [tuple(start)], 0
        while stack:
            r, c = stack.pop()
            if not (0 <= r < 30 and 0 <= c < 20 and left[r, c]):
                continue
            left[r, c] = False
            n += 1
            stack += [(r + i, c + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        if n:
            sizes.append(float(n))
    assert_array_equal(bright_regions(amplitude, bright).cells, sizes)


def test_the_threshold_follows_the_median_and_is_strict() -> None:
    image = 3.0 * dark()
    image[10:12, 5], image[30:32, 5] = 3.0 * 10.01, 3.0 * 9.99
    assert_allclose(ThresholdCentroids(threshold_db=20.0)(ping_of(image)).amplitude, [30.03], rtol=1e-5)
    assert len(ThresholdCentroids(threshold=29.0)(ping_of(image))) == 2
    flat = np.where(np.arange(20) == 4, np.float32(5.0), dark())
    assert len(ThresholdCentroids(threshold=5.0)(ping_of(flat))) == 0


def test_small_and_large_regions_are_left_out() -> None:
    image = dark()
    image[5, 3] = image[20:22, 3] = image[40:60, 10] = 50.0
    assert len(ThresholdCentroids(min_cells=1)(ping_of(image))) == 3
    assert len(ThresholdCentroids()(ping_of(image))) == 2
    assert len(ThresholdCentroids(max_cells=10)(ping_of(image))) == 1


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_number_formats(dtype) -> None:
    image = (2 * dark()).astype(dtype)
    image[10:13, 5:7] = 200
    found = ThresholdCentroids()(ping_of(image))
    assert_allclose(found.range_m, [21.15])
    assert_allclose(np.degrees(found.bearing_rad), [-2.0])


def test_cells_without_data_do_not_count() -> None:
    image = dark()
    image[10:12, 5], image[30:32, 8], image[50, 3] = 50.0, np.nan, np.inf
    valid = np.ones(image.shape, bool)
    valid[10, 5] = False
    found = ThresholdCentroids(min_cells=1)(ping_of(image, valid=valid))
    assert_allclose(found.range_m, [RANGE_M[11]])
    assert len(ThresholdCentroids()(ping_of(image, valid=np.zeros(image.shape, bool)))) == 0


def test_the_strongest_are_kept() -> None:
    image = dark()
    for k, level in enumerate([50.0, 90.0, 70.0]):
        image[10 + 20 * k : 12 + 20 * k, 5] = level
    found = ThresholdCentroids(max_detections=2)(ping_of(image))
    assert_array_equal(found.amplitude, [90.0, 70.0])


def test_what_only_the_border_beams_see_is_left_out_if_asked() -> None:
    """A region in the last beam alone, one half in it, one with a tenth outside of the first, one inside."""
    image = dark()
    image[10:13, -1] = 50.0
    image[25:28, -2:] = 50.0
    image[40:43, 0], image[40:43, 1] = 50.0 * math.sqrt(9.0), 50.0
    image[60:63, 5] = 50.0
    everything = ThresholdCentroids()(ping_of(image))
    assert len(everything) == 4
    for share, kept in ((0.95, [1, 2, 3]), (0.85, [1, 3]), (0.45, [3])):
        found = ThresholdCentroids(max_border_share=share)(ping_of(image))
        assert_array_equal(found.range_m, everything.range_m[kept])
        assert_array_equal(found.bearing_rad, everything.bearing_rad[kept])


def test_nothing_in_one_cell_one_beam_or_no_image() -> None:
    node = ThresholdCentroids()
    assert len(node(Ping(0, 0))) == 0
    assert len(node(Ping(1, 1, np.ones((1, 1), np.float32), np.ones(1), np.zeros(1)))) == 0
    column = np.ones((30, 1), np.float32)
    column[10:12] = 99.0
    one_beam = Ping(2, 2, column, 0.1 * np.arange(1, 31), np.zeros(1), beamwidth_rad=0.02)
    assert_allclose(node(one_beam).range_m, [1.15])
    assert len(node(ping_of(np.zeros((80, 20), np.float32)))) == 0


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"threshold_db": math.nan}, "threshold_db is nan"),
        ({"threshold": -1.0}, "threshold is -1.0"),
        ({"gap_m": -0.1}, "gap_m -0.1"),
        ({"min_cells": 0}, "min_cells 0"),
        ({"min_cells": 9, "max_cells": 3}, "min_cells 9 to max_cells 3"),
        ({"min_sd_m": 0.0}, "min_sd_m is 0.0"),
        ({"max_border_share": 0.0}, "max_border_share is 0.0"),
        ({"max_border_share": 1.1}, "max_border_share is 1.1"),
        ({"max_detections": 0}, "max_detections is 0"),
    ],
)
def test_bad_parameters(settings, what) -> None:
    with pytest.raises(ValueError, match=what):
        ThresholdCentroids(**settings)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_images_that_are_mostly_zeros_have_objects_and_no_noise(dtype) -> None:
    """The median of a dark 8-bit image is 0: 20 dB above that would be every cell that is not."""
    faint = np.random.default_rng(5).rayleigh(0.4, (80, 20))
    image = np.rint(faint).astype(dtype)
    assert np.median(image) == 0
    assert len(ThresholdCentroids(gap_m=0.0, gap_beams=0)(ping_of(image))) == 0
    image[40:42, 10:12] = 30
    found = ThresholdCentroids(gap_m=0.0, gap_beams=0)(ping_of(image))
    assert_allclose(found.range_m, [RANGE_M[40:42].mean()])
