from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.cfar import (
    NO_FLAGS,
    REFERENCE,
    TEST,
    Window,
    rayleigh_factors,
    rayleigh_hits,
)
from fls_detectors.cfar_ratio import rayleigh_ratio

# (guard, stride, levels, beams, widest) and J far from the edges
WINDOWS = [
    (Window(3, 2, 2, 0, 0), 8),
    (Window(2, 3, 1, 1, 0), 12),
    (Window(4, 1, 3, 0, 0), 16),
    (Window(5, 2, 2, 1, 0), 24),
    (Window(0, 1, 2, 2, 0), 40),
    (Window(20, 5, 3, 1, 0), 48),
]
BOTH = REFERENCE | TEST


def slow_hits(amplitude, window, pfa, min_ref, floor=0.0, flags=None, scale=1.0):
    """The definition, cell by cell, in float64."""
    return np.nan_to_num(slow_ratio(amplitude, window, pfa, min_ref, floor, flags), nan=-1.0) > scale


def slow_ratio(amplitude, window, pfa, min_ref, floor=0.0, flags=None):
    n_ranges, n_beams = amplitude.shape
    flags = np.full(amplitude.shape, BOTH) if flags is None else flags
    x = amplitude.astype(float)
    ratio = np.full(amplitude.shape, np.nan)
    for m in range(n_ranges):
        for n in range(n_beams):
            reference = []
            for k in range(max(2**window.levels, window.widest)):
                if k >= 2**window.levels:
                    enough = min_ref if k == 2**window.levels else window.size
                    if len(reference) >= enough:
                        break
                for i in (m - window.guard - 1 - k * window.stride, m + window.guard + 1 + k * window.stride):
                    beams = range(max(n - window.beams, 0), min(n + window.beams + 1, n_beams))
                    if 0 <= i < n_ranges:
                        reference += [x[i, j] for j in beams if flags[i, j] & REFERENCE]
            J = len(reference)
            if min_ref > J or not flags[m, n] & TEST:
                continue
            total = max(np.sum(np.square(reference)), J * floor**2)
            if total > 0:
                ratio[m, n] = x[m, n] / np.sqrt((pfa ** (-1 / J) - 1) * total)
    return ratio


def within_binomial_bounds(count, n, p, sigmas=4.0):
    return abs(count - n * p) <= sigmas * np.sqrt(n * p * (1 - p)) + 1


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("shape", [(120, 9), (37, 1), (1, 9), (300, 40), (60, 130)])
def test_kernel_equals_the_definition(dtype, shape):
    rng = np.random.default_rng(shape[0])
    for case, (window, _) in enumerate(WINDOWS):
        amplitude = np.minimum(rng.rayleigh(30.0, shape), 255).astype(dtype)
        flags = rng.choice([0, REFERENCE, TEST, BOTH], p=[0.05, 0.05, 0.3, 0.6], size=shape).astype(np.uint8)
        wide = window._replace(widest=3 * 2**window.levels)
        for w, f in ((window, NO_FLAGS), (window, flags), (wide, flags)):
            expected = slow_hits(amplitude, w, 1e-2, 8, floor=case % 2, flags=f if f.size else None)
            assert_array_equal(rayleigh_hits(amplitude, w, pfa=1e-2, floor=case % 2, flags=f), expected)


@pytest.mark.parametrize("levels", [0, 1, 2, 3, 4, 5])
def test_windows_of_any_depth_over_several_chunks(levels):
    rng = np.random.default_rng(levels)
    amplitude = rng.rayleigh(1.0, (400, 3)).astype(np.float32)
    flags = rng.choice([TEST, BOTH], p=[0.2, 0.8], size=amplitude.shape).astype(np.uint8)
    window = Window(1, 1 + levels % 2, levels, 1, 0)
    for given in (NO_FLAGS, flags):
        expected = slow_hits(amplitude, window, 0.05, 4, flags=given if given.size else None)
        assert expected.any()
        assert_array_equal(rayleigh_hits(amplitude, window, pfa=0.05, min_ref=4, flags=given), expected)
    wide = rng.rayleigh(1.0, (200, 100)).astype(np.float32)  # more rows than enter at once
    expected = slow_hits(wide, window, 0.01, 4)
    assert_array_equal(rayleigh_hits(wide, window, pfa=0.01, min_ref=4), expected)


def test_more_reference_cells_than_a_byte_counts():
    rng = np.random.default_rng(4)
    amplitude = rng.rayleigh(1.0, (180, 7)).astype(np.float32)
    flags = rng.choice([TEST, BOTH], p=[0.1, 0.9], size=amplitude.shape).astype(np.uint8)
    window = Window(1, 1, 6, 1, 0)
    assert window.size == 384
    expected = slow_hits(amplitude, window, 0.03, 8, flags=flags)
    assert expected.any()
    assert_array_equal(rayleigh_hits(amplitude, window, pfa=0.03, flags=flags), expected)


@pytest.mark.parametrize("shape", [(120, 9), (60, 130)])
def test_a_scale_per_beam_multiplies_the_threshold(shape):
    rng = np.random.default_rng(shape[0])
    amplitude = rng.rayleigh(30.0, shape).astype(np.float32)
    flags = rng.choice([0, REFERENCE, TEST, BOTH], p=[0.05, 0.05, 0.3, 0.6], size=shape).astype(np.uint8)
    scale = rng.uniform(0.7, 1.5, shape[1])
    for window, _ in WINDOWS:
        for given in (NO_FLAGS, flags):
            ratio = slow_ratio(amplitude, window, 0.05, 8, flags=given if given.size else None)
            assert_allclose(rayleigh_ratio(amplitude, window, pfa=0.05, flags=given), ratio, rtol=1e-12)
            hits = rayleigh_hits(amplitude, window, pfa=0.05, flags=given, scale=scale)
            assert_array_equal(hits, np.nan_to_num(ratio, nan=-1.0) > scale)


def test_kernel_equals_the_definition_where_whole_areas_are_excluded():
    rng = np.random.default_rng(3)
    amplitude = rng.rayleigh(1.0, (200, 12)).astype(np.float32)
    flags = np.full(amplitude.shape, BOTH, np.uint8)
    flags[60:140, 2:9] = TEST
    for widest in (0, 5, 40):
        window = Window(4, 3, 2, 1, widest)
        expected = slow_hits(amplitude, window, 0.05, 8, flags=flags)
        assert_array_equal(rayleigh_hits(amplitude, window, pfa=0.05, flags=flags), expected)
        assert expected[80:120, 4:7].any() == (widest == 40)  # decided only with a reference from outside


@pytest.mark.parametrize(("window", "J"), WINDOWS)
@pytest.mark.parametrize("pfa", [1e-2, 1e-3, 1e-4, 1e-5])
def test_false_alarm_rate_is_pfa(window, J, pfa):
    assert window.size == J
    amplitude = np.random.default_rng(11).rayleigh(50.0, (1000, 640)).astype(np.float32)
    hits = rayleigh_hits(amplitude, window, pfa=pfa)
    # Cells share reference cells: the count scatters a little more than a binomial one.
    assert within_binomial_bounds(np.count_nonzero(hits), hits.size, pfa, sigmas=5.0)


@pytest.mark.parametrize("pfa", [1e-2, 1e-3])
def test_false_alarm_rate_is_pfa_at_edges_and_corners(pfa):
    rng = np.random.default_rng(12)
    window = WINDOWS[-1][0]
    edges, corners, n = 0, 0, 1500
    for _ in range(n):
        hits = rayleigh_hits(rng.rayleigh(9.0, (140, 3)).astype(np.float32), window, pfa=pfa)
        edges += np.count_nonzero(hits[0]) + np.count_nonzero(hits[-1])
        corners += np.count_nonzero(hits[[0, 0, -1, -1], [0, -1, 0, -1]])
    assert within_binomial_bounds(edges, 6 * n, pfa)
    assert within_binomial_bounds(corners, 4 * n, pfa)


@pytest.mark.parametrize("pfa", [1e-2, 1e-3, 1e-4])
def test_false_alarm_rate_is_pfa_beside_and_inside_excluded_cells(pfa):
    rng = np.random.default_rng(13)
    shape = (1000, 300)
    amplitude = rng.rayleigh(50.0, shape).astype(np.float32)
    excluded = np.zeros(shape, bool)
    for _ in range(150):
        m, n = rng.integers(0, 960), rng.integers(0, 296)
        excluded[m : m + 40, n : n + 4] = True
    amplitude[excluded] *= 30.0  # must not raise the threshold beside them
    flags = np.where(excluded, TEST, BOTH).astype(np.uint8)
    hits = rayleigh_hits(amplitude, WINDOWS[-1][0]._replace(widest=60), pfa=pfa, flags=flags)
    near = ~excluded & np.roll(excluded, 25, axis=0)
    assert within_binomial_bounds(np.count_nonzero(hits & near), np.count_nonzero(near), pfa, sigmas=5.0)
    assert np.count_nonzero(hits[excluded]) > 0.9 * np.count_nonzero(excluded)
    quiet = np.where(excluded, amplitude / 30.0, amplitude)
    inside = rayleigh_hits(quiet, WINDOWS[-1][0]._replace(widest=60), pfa=pfa, flags=flags) & excluded
    assert within_binomial_bounds(np.count_nonzero(inside), np.count_nonzero(excluded), pfa, sigmas=5.0)


def test_threshold_of_few_cells_is_not_that_of_a_known_scale():
    """T = b sqrt(-ln pfa) would give (1 - ln(pfa)/J)^-J: five times as many at 1e-6 and J = 50."""
    pfa, J = 1e-6, 50
    exact = np.sqrt(rayleigh_factors(pfa, 1, J + 1)[J] * J)
    assert exact > 1.05 * np.sqrt(-np.log(pfa))
    assert_allclose((1 - np.log(pfa) / J) ** -J, 5.0e-6, rtol=0.02)
    assert_allclose((1 + exact**2 / J) ** -J, pfa, rtol=1e-12)


@pytest.mark.parametrize("snr", [10.0, 30.0, 100.0])
def test_detection_probability_of_a_fluctuating_target(snr):
    rng = np.random.default_rng(14)
    window, J = WINDOWS[-1]
    amplitude = rng.rayleigh(1.0, (2001, 300))
    targets = np.zeros(amplitude.shape, bool)
    targets[200:-200:200, 2:-2:4] = True
    amplitude[targets] = rng.rayleigh(np.sqrt(1 + snr), np.count_nonzero(targets))
    hits = rayleigh_hits(amplitude.astype(np.float32), window, pfa=1e-4)
    expected = (1 + rayleigh_factors(1e-4, 8, J + 1)[J] / (1 + snr)) ** -J
    assert within_binomial_bounds(np.count_nonzero(hits[targets]), np.count_nonzero(targets), expected)


@pytest.mark.parametrize("scale", [2.0**-60, 1e-12, 1e-3, 1e6, 2.0**50, 2.0**66, 2.0**120])
def test_scale_does_not_matter(scale):
    amplitude = np.random.default_rng(15).rayleigh(1.0, (300, 20)).astype(np.float32)
    window = WINDOWS[3][0]
    expected = rayleigh_hits(amplitude, window, pfa=1e-2)
    assert_array_equal(rayleigh_hits((amplitude * scale).astype(np.float32), window, pfa=1e-2), expected)


def test_echoes_that_span_many_decades_leave_no_trace_behind_them():
    """A running sum would keep rounding errors of 1e32 in clutter of 1e-6."""
    amplitude = np.full((400, 5), 1e-3, np.float32)
    amplitude[100, 2] = 1e16
    amplitude[300, 2] = 1.0
    window = WINDOWS[-1][0]
    assert_array_equal(np.argwhere(rayleigh_hits(amplitude, window, pfa=1e-6)), [[100, 2], [300, 2]])


def test_amplitudes_at_the_end_of_float32_are_decided():
    amplitude = np.full((200, 3), 1e19, np.float32)
    amplitude[100, 1] = 3e38
    assert_array_equal(np.argwhere(rayleigh_hits(amplitude, WINDOWS[-1][0], pfa=1e-6)), [[100, 1]])


def test_nothing_fires_on_zeros_and_an_echo_in_zeros_needs_a_floor():
    amplitude = np.zeros((200, 5), np.uint8)
    window = WINDOWS[-1][0]
    assert not rayleigh_hits(amplitude, window, pfa=0.5).any()
    amplitude[100, 2] = 200
    amplitude[50, 1] = 3
    assert not rayleigh_hits(amplitude, window, pfa=1e-6).any()
    assert_array_equal(np.argwhere(rayleigh_hits(amplitude, window, pfa=1e-6, floor=1.0)), [[100, 2]])


def test_the_inequality_is_strict():
    J = 8
    pfa = 2.0**-J  # a = 1, so T^2 = sum
    amplitude = np.zeros((40, 1), np.float32)
    window = Window(3, 2, 2, 0, 0)
    amplitude[[20 - 4, 20 - 6, 20 + 4, 20 + 6]] = 1.0
    for x, expected in ((2.0, False), (np.nextafter(np.float32(2.0), np.float32(3.0)), True)):
        amplitude[20] = x
        assert rayleigh_hits(amplitude, window, pfa=pfa)[20, 0] == expected


def test_too_few_reference_cells_decide_nothing():
    amplitude = np.ones((40, 1), np.float32)
    amplitude[20] = 1e6
    window = Window(3, 2, 2, 0, 0)
    assert rayleigh_hits(amplitude, window, pfa=1e-3, min_ref=8)[20, 0]
    assert not rayleigh_hits(amplitude, window, pfa=1e-3, min_ref=9).any()
    flags = np.full(amplitude.shape, BOTH, np.uint8)
    flags[24] = TEST
    assert not rayleigh_hits(amplitude, window, pfa=1e-3, min_ref=8, flags=flags).any()


def test_negative_amplitudes_never_fire():
    amplitude = np.full((100, 3), 0.1, np.float32)
    amplitude[50, 1] = -100.0
    assert not rayleigh_hits(amplitude, WINDOWS[-1][0], pfa=1e-3).any()


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_pings_without_reference_give_nothing(shape):
    assert not rayleigh_hits(np.ones(shape, np.float32), WINDOWS[-1][0], pfa=0.5).any()


def test_a_guard_or_stride_beyond_the_ping_decides_nothing():
    amplitude = np.ones((50, 5), np.float32)
    amplitude[20, 2] = 100.0
    assert not rayleigh_hits(amplitude, Window(10**9, 5, 3, 1, 0), pfa=1e-3).any()
    assert not rayleigh_hits(amplitude, Window(49, 10**9, 3, 1, 0), pfa=1e-3).any()


def test_memory_layout_does_not_matter():
    amplitude = np.random.default_rng(17).rayleigh(1.0, (200, 30)).astype(np.float32)
    expected = rayleigh_hits(amplitude, WINDOWS[3][0], pfa=1e-2)
    assert_array_equal(rayleigh_hits(np.asfortranarray(amplitude), WINDOWS[3][0], pfa=1e-2), expected)
    assert_array_equal(rayleigh_hits(amplitude[:, ::-1], WINDOWS[3][0], pfa=1e-2), expected[:, ::-1])
    assert_array_equal(rayleigh_hits(amplitude[::-1], WINDOWS[3][0], pfa=1e-2), expected[::-1])


def test_window_spreads_its_cells_over_the_reference():
    metres = {"guard_m": 1.0, "guard_beams": 1, "reference_m": 2.0, "max_ref": 48, "widen_m": 20.0}
    assert Window.of(0.05, **metres) == Window(20, 5, 3, 1, 80)
    assert Window.of(0.5, **metres) == Window(2, 1, 3, 1, 40)
    assert Window.of(0.05, **(metres | {"max_ref": 47})).size == 24


def test_factors_are_infinite_below_the_least_count():
    factors = rayleigh_factors(1e-6, 8, 10)
    assert np.isinf(factors[:8]).all()
    assert_allclose(factors[8:], [1e-6 ** (-1 / 8) - 1, 1e-6 ** (-1 / 9) - 1])
