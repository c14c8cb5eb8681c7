"""Ordered-statistic CFAR: equal to its definition, at the false-alarm rate of Rohling's product formula."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.ordered_statistic import ordered_factors, ordered_hits, ordered_ratio
from fls_detectors.os_cfar import OsCfar
from fls_detectors.rayleigh_cfar import RayleighCfar
from fls_detectors.reference import NO_FLAGS, REFERENCE, TEST, Window
from fls_flow import BeamMask, Wakes
from fls_flow.testing import check_node

BOTH = REFERENCE | TEST
WINDOWS = [
    Window(3, 2, 2, 0, 0),
    Window(2, 3, 1, 1, 0),
    Window(0, 1, 2, 2, 0),
    Window(20, 5, 3, 1, 0),
    Window(4, 3, 2, 1, 12),
]


def slow_reference(x, window, m, n, min_ref, flags):
    """The usable reference cells of one cell, by the definition of the window."""
    found = []
    for k in range(max(2**window.levels, window.widest)):
        if k >= 2**window.levels and len(found) >= (min_ref if k == 2**window.levels else window.size):
            break
        for i in (m - window.guard - 1 - k * window.stride, m + window.guard + 1 + k * window.stride):
            if 0 <= i < len(x):
                beams = range(max(n - window.beams, 0), min(n + window.beams + 1, x.shape[1]))
                found += [x[i, j] for j in beams if flags[i, j] & REFERENCE]
    return found


def slow_ratio(amplitude, window, pfa, rank, min_ref, floor, flags):
    x = amplitude.astype(float)
    flags = np.full(x.shape, BOTH) if not flags.size else flags
    a, _ = ordered_factors(pfa, rank, min_ref, window.most + 1)
    ratio = np.full(x.shape, np.nan)
    for m, n in np.ndindex(*x.shape):
        reference = np.sort(slow_reference(x, window, m, n, min_ref, flags))
        J = len(reference)
        if min_ref <= J and flags[m, n] & TEST:
            middle = max(reference[max(1, math.floor(rank * J + 0.5)) - 1], floor)
            if middle > 0.0:
                ratio[m, n] = x[m, n] / (np.sqrt(a[J]) * middle)
    return ratio


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("shape", [(70, 9), (37, 1), (1, 9), (90, 40)])
def test_kernel_equals_the_definition(dtype, shape):
    rng = np.random.default_rng(shape[0])
    flags = rng.choice([0, REFERENCE, TEST, BOTH], p=[0.05, 0.05, 0.3, 0.6], size=shape).astype(np.uint8)
    scale = rng.uniform(0.7, 1.5, shape[1])
    for case, window in enumerate(WINDOWS):
        amplitude = np.minimum(rng.rayleigh(30.0, shape), 255).astype(dtype)
        rank, floor = (0.75, 0.5, 1.0)[case % 3], float(case % 2)
        for given in (NO_FLAGS, flags):
            options = {"pfa": 0.03, "rank": rank, "min_ref": 4, "floor": floor, "flags": given}
            expected = slow_ratio(amplitude, window, 0.03, rank, 4, floor, given)
            assert_allclose(ordered_ratio(amplitude, window, **options), expected, rtol=1e-12)
            decided = np.nan_to_num(expected, nan=-1.0)
            assert_array_equal(ordered_hits(amplitude, window, **options), decided > 1.0)
            assert_array_equal(ordered_hits(amplitude, window, **options, scale=scale), decided > scale)


def test_a_whole_area_without_reference_is_decided_from_outside():
    rng = np.random.default_rng(3)
    amplitude = rng.rayleigh(1.0, (200, 12)).astype(np.float32)
    flags = np.full(amplitude.shape, BOTH, np.uint8)
    flags[60:140, 2:9] = TEST
    for widest, decided in ((0, False), (40, True)):
        window = Window(4, 3, 2, 1, widest)
        ratio = slow_ratio(amplitude, window, 0.05, 0.75, 8, 0.0, flags)
        hits = ordered_hits(amplitude, window, pfa=0.05, flags=flags)
        assert_array_equal(hits, np.nan_to_num(ratio) > 1.0)
        assert hits[80:120, 4:7].any() == decided


@pytest.mark.parametrize("rank", [0.5, 0.75, 1.0])
@pytest.mark.parametrize("pfa", [0.1, 1e-4, 1e-9, 1e-20])
def test_factors_solve_the_product_formula(rank, pfa):
    factors, k = ordered_factors(pfa, rank, 4, 60)
    assert np.isinf(factors[:4]).all()
    for J in (4, 7, 24, 48, 59):
        assert k[J] == math.floor(rank * J + 0.5)
        product = math.prod((J - i) / (J - i + factors[J]) for i in range(k[J]))
        assert_allclose(product, pfa, rtol=1e-9)


@pytest.mark.parametrize("pfa", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("rank", [0.5, 0.75])
def test_false_alarms_come_at_the_rate_wished_for_and_so_they_do_at_the_edges(pfa, rank):
    rng = np.random.default_rng(11)
    window = WINDOWS[3]
    hits = np.concatenate(
        [
            ordered_hits(rng.rayleigh(9.0, (600, 300)).astype(np.float32), window, pfa=pfa, rank=rank)
            for _ in range(4)
        ],
        axis=1,
    )
    edge = np.concatenate([hits[:21], hits[-21:]])
    for found in (hits, edge):
        # cells share reference cells: the count scatters a little more than a binomial one
        n = found.size * pfa
        assert abs(np.count_nonzero(found) - n) <= 5.0 * np.sqrt(n) + 1


def test_other_echoes_among_the_reference_leave_a_target_that_they_would_mask(make_ping):
    amplitude = np.random.default_rng(5).rayleigh(10.0, (400, 9)).astype(np.float32)
    amplitude[200, 4] = 120.0
    amplitude[230:234, 3:6] = 200.0  # within its reference
    ping = make_ping(amplitude)
    target = ping.range_m[200]
    assert target in OsCfar(pfa=1e-5)(ping).range_m
    assert target not in RayleighCfar(pfa=1e-5)(ping).range_m


def test_a_reference_of_zeros_decides_nothing_without_a_floor():
    amplitude = np.zeros((100, 5), np.float32)
    amplitude[50, 2] = 100.0
    assert not ordered_hits(amplitude, WINDOWS[3], pfa=1e-3).any()
    assert_array_equal(np.argwhere(ordered_hits(amplitude, WINDOWS[3], pfa=1e-3, floor=1.0)), [[50, 2]])


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0), (1, 1), (2, 3)])
def test_small_images(shape):
    ones = np.ones(shape, np.float32)
    assert not ordered_hits(ones, WINDOWS[3], pfa=0.5).any()
    assert np.isnan(ordered_ratio(ones, WINDOWS[3], pfa=0.5)).all()


def test_a_guard_beyond_the_ping_and_negative_amplitudes_decide_nothing():
    amplitude = np.ones((50, 5), np.float32)
    amplitude[20, 2] = 100.0
    assert not ordered_hits(amplitude, Window(10**9, 10**9, 6, 1, 0), pfa=1e-3).any()
    assert not ordered_hits(-amplitude, WINDOWS[0], pfa=0.5).any()


def test_noisy_beams_holes_and_wakes_are_left_out(make_ping):
    rng = np.random.default_rng(8)
    clean = rng.rayleigh(10.0, (400, 39)).astype(np.float32)
    holes = rng.random(clean.shape) < 0.1
    broken = np.where(holes, np.nan, clean).astype(np.float32)
    noisy = BeamMask(7, 1_000, np.isin(np.arange(39), [19]), np.zeros(39))
    wakes = Wakes(6, 0, [[8.0, 0.0]], [0.0], [5.0], [0.2], [0], [True])
    a = OsCfar(pfa=1e-2)(make_ping(clean, valid=~holes), noisy, wakes)
    b = OsCfar(pfa=1e-2)(make_ping(broken), noisy, wakes)
    assert len(a) > 50
    assert_array_equal(a.range_m, b.range_m)
    assert_array_equal(a.bearing_rad, b.bearing_rad)
    assert not np.isin(a.bearing_rad, make_ping(clean).bearing_rad[19]).any()


def test_a_scale_per_beam_thins_the_detections_of_its_beam(make_ping):
    ping = make_ping(np.random.default_rng(9).rayleigh(10.0, (800, 3)).astype(np.float32))
    plain, scaled = OsCfar(pfa=0.05)(ping), OsCfar(pfa=0.05, threshold_scale=(1.0, 1.5, 1.0))(ping)
    for beam, bearing in enumerate(ping.bearing_rad):
        counts = [int(np.sum(found.bearing_rad == bearing)) for found in (plain, scaled)]
        assert (counts[0] == counts[1]) == (beam != 1)
    with pytest.raises(ValueError, match="threshold_scale has 2 entries, the ping has 3 beams"):
        OsCfar(threshold_scale=(1.0, 2.0))(ping)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"rank": 0.0}, "rank must lie above 0 and up to 1, not 0.0"),
        ({"rank": 1.1}, "not 1.1"),
        ({"pfa": 1.0}, "pfa must lie between 0 and 1, not 1.0"),
        ({"threshold_scale": 0.0}, "threshold_scale must be positive and finite, not 0.0"),
        ({"threshold_scale": (1.0, float("nan"))}, "threshold_scale .* not nan"),
        ({"threshold_scale": ()}, "threshold_scale .* not an empty list"),
    ],
)
def test_bad_parameters_are_named(parameters, text):
    with pytest.raises(ValueError, match=text):
        OsCfar(**parameters)


def test_the_node_keeps_the_contract():
    check_node("os-cfar")
    check_node(OsCfar(threshold_scale=1.3, rank=0.5))
