from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.beams import (
    adjacent_groups,
    beam_medians,
    guard_beams,
    loud_beams,
    median_normalised,
    strongest_peaks,
)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("n_ranges", [1, 2, 3, 10, 101])
@pytest.mark.parametrize("top", [3, 200])
def test_medians_equal_numpy(dtype, n_ranges, top):
    rng = np.random.default_rng(n_ranges)
    amplitude = rng.integers(0, top, (n_ranges, 7), endpoint=True).astype(dtype)
    assert_array_equal(beam_medians(amplitude), np.median(amplitude, axis=0))
    valid = rng.random(amplitude.shape) < 0.6
    valid[:, 2] = False
    expected = [np.median(a[v]) if v.any() else np.nan for a, v in zip(amplitude.T, valid.T, strict=True)]
    assert_array_equal(beam_medians(amplitude, valid), expected)


def test_medians_leave_out_what_is_not_finite():
    amplitude = np.array([[1, np.nan], [np.inf, np.nan], [3, np.nan]], np.float32)
    assert_array_equal(beam_medians(amplitude), [2.0, np.nan])
    assert np.isnan(beam_medians(np.zeros((0, 2), np.uint8))).all()


def test_guard_is_three_beamwidths():
    assert guard_beams(0.3, 0.1) == 9  # 0.3 / 0.1 = 2.9999...
    assert guard_beams(1.5, 1.5) == 3
    assert guard_beams(0.5, 1.5) == 0
    assert guard_beams(float("nan"), 1.5) == 3
    assert guard_beams(1.5, float("nan")) == 3


def slow_loud(median, xi, window, guard):
    loud = []
    for j in range(median.size):
        reference = [median[i] for i in range(median.size) if guard < abs(i - j) <= window]
        loud.append(bool(reference) and median[j] > xi * np.mean(reference))
    return np.array(loud)


@pytest.mark.parametrize("n_beams", [1, 2, 5, 9, 39])
def test_loud_beams_equal_the_definition(n_beams):
    for seed in range(20):
        median = np.random.default_rng(seed).gamma(3.0, size=n_beams)
        assert_array_equal(loud_beams(median, 1.2, 8, 3), slow_loud(median, 1.2, 8, 3))


def test_zeros_are_never_loud():
    assert not loud_beams(np.zeros(39), 1.5, 8, 3).any()
    median = np.zeros(39)
    median[20] = 1.0
    assert not loud_beams(median, 1.5, 8, 3).any()  # nothing to compare with
    assert not loud_beams(median, 1.5, 8, 3, floor=1.0).any()
    assert loud_beams(2.0 * median, 1.5, 8, 3, floor=1.0)[20]


def test_beams_without_median_are_neither_loud_nor_reference():
    median = np.ones(39)
    median[10] = np.nan
    median[14] = 2.0
    assert_array_equal(np.flatnonzero(loud_beams(median, 1.5, 8, 3)), [14])
    assert not loud_beams(np.full(39, np.nan), 1.5, 8, 3).any()


def test_adjacent_flags_are_one_group():
    assert adjacent_groups(np.array([1, 1, 0, 1, 0, 0, 1], bool)) == [slice(0, 2), slice(3, 4), slice(6, 7)]
    assert adjacent_groups(np.zeros(0, bool)) == []


def slow_normalised(beam, half):
    out = np.zeros(beam.size)
    for m in range(beam.size):
        window = beam[max(m - half, 0) : m + half + 1]
        median = np.median(window[np.isfinite(window)]) if np.isfinite(window).any() else 0.0
        out[m] = beam[m] / median if median > 0 and np.isfinite(beam[m]) else 0.0
    return out


@pytest.mark.parametrize("n", [0, 1, 2, 7, 100, 400])
@pytest.mark.parametrize("half", [1, 3, 50])
def test_moving_median_equals_the_definition(n, half):
    rng = np.random.default_rng(n)
    for beam in (rng.rayleigh(5.0, n), rng.integers(0, 4, n).astype(np.uint8)):
        assert_allclose(median_normalised(beam, half), slow_normalised(beam.astype(float), half), rtol=1e-15)
    holes = np.where(rng.random(n) < 0.3, np.nan, rng.rayleigh(5.0, n))
    assert_allclose(median_normalised(holes, half), slow_normalised(holes, half), rtol=1e-15)


def test_peaks_are_the_strongest_maxima_in_order_of_range():
    beam = np.array([9.0, 0, 5, 0, 7, 7, 0, 6, 0, 9])
    assert_array_equal(strongest_peaks(beam, 10, 1), [2, 4, 7])  # a flat top counts once; the ends are none
    assert_array_equal(strongest_peaks(beam, 2, 1), [4, 7])
    assert_array_equal(strongest_peaks(beam, 10, 3), [4, 7])
    assert_array_equal(strongest_peaks(beam, 10, 4), [4])
    for short in (np.zeros(0), np.ones(1), np.ones(2), np.zeros(50)):
        assert strongest_peaks(short, 10, 1).size == 0
