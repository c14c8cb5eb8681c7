"""Log-domain CFAR: equal to its definition, at its false-alarm rate in Weibull and log-normal clutter."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.log_cfar import LogCfar
from fls_detectors.log_factors import known_spread, log_factors
from fls_detectors.log_statistic import log_hits, log_ratio
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
FAR = WINDOWS[3]  # J = 48


def slow_ratio(amplitude, window, pfa, min_ref, floor, flags):
    """The definition, cell by cell."""
    x = amplitude.astype(float)
    flags = np.full(x.shape, BOTH) if not flags.size else flags
    ratio = np.full(x.shape, np.nan)
    for m, n in np.ndindex(*x.shape):
        reference = []
        for k in range(max(2**window.levels, window.widest)):
            enough = min_ref if k == 2**window.levels else window.size
            if k >= 2**window.levels and len(reference) >= enough:
                break
            for i in (m - window.guard - 1 - k * window.stride, m + window.guard + 1 + k * window.stride):
                if 0 <= i < len(x):
                    beams = range(max(n - window.beams, 0), min(n + window.beams + 1, x.shape[1]))
                    usable = [x[i, j] for j in beams if flags[i, j] & REFERENCE and (floor or x[i, j] > 0)]
                    reference += usable
        J = len(reference)
        if min_ref <= J and flags[m, n] & TEST:
            y = np.log(np.maximum(reference, floor))
            T = np.exp(y.mean() + log_factors(pfa, J) * y.std(ddof=1))
            ratio[m, n] = x[m, n] / max(T, floor * np.sqrt(-np.log(pfa)))
    return ratio


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("shape", [(70, 9), (37, 1), (1, 9), (90, 40)])
def test_kernel_equals_the_definition(dtype, shape):
    rng = np.random.default_rng(shape[0])
    flags = rng.choice([0, REFERENCE, TEST, BOTH], p=[0.05, 0.05, 0.3, 0.6], size=shape).astype(np.uint8)
    scale = rng.uniform(0.7, 1.5, shape[1])
    for case, window in enumerate(WINDOWS):
        amplitude = np.minimum(rng.rayleigh(30.0 * 10.0**-case, shape), 255).astype(dtype)
        floor = (0.0, 1.0)[case % 2]
        for given in (NO_FLAGS, flags):
            options = {"pfa": 0.05, "min_ref": 6, "floor": floor, "flags": given}
            expected = slow_ratio(amplitude, window, 0.05, 6, floor, given)
            assert_allclose(log_ratio(amplitude, window, **options), expected, rtol=1e-9)
            decided = np.nan_to_num(expected, nan=-1.0)
            assert_array_equal(log_hits(amplitude, window, **options), decided > 1.0)
            assert_array_equal(log_hits(amplitude, window, **options, scale=scale), decided > scale)


@pytest.mark.parametrize("offset", [1e-12, 1.0, 1e12])
def test_the_screen_misses_nothing_whatever_the_scale_and_however_even_the_clutter(offset):
    rng = np.random.default_rng(2)
    for spread in (1e-4, 0.01, 3.0):
        amplitude = (offset * np.exp(spread * rng.normal(size=(150, 11)))).astype(np.float32)
        expected = slow_ratio(amplitude, FAR, 0.05, 8, 0.0, NO_FLAGS) > 1.0
        found = log_hits(amplitude, FAR, pfa=0.05)
        assert expected.any()
        assert_array_equal(found, expected)


@pytest.mark.parametrize("shape", [0.7, 2.0, 4.0])
@pytest.mark.parametrize("pfa", [1e-2, 1e-3, 1e-4])
def test_false_alarms_in_weibull_clutter_come_at_the_rate_wished_for(shape, pfa):
    """Shape 2 is Rayleigh: the shape need not be known."""
    rng = np.random.default_rng(11)
    count = size = 0
    for _ in range(3):
        hits = log_hits(rng.weibull(shape, (800, 400)).astype(np.float32), FAR, pfa=pfa)
        count, size = count + np.count_nonzero(hits), size + hits.size
    assert abs(count - size * pfa) <= 5.0 * np.sqrt(size * pfa) + 1


@pytest.mark.parametrize("pfa", [1e-2, 1e-3, 1e-4])
def test_false_alarms_in_log_normal_clutter_come_at_the_rate_wished_for(pfa):
    rng = np.random.default_rng(12)
    hits = log_hits(
        rng.lognormal(2.0, 0.8, (1600, 600)).astype(np.float32), FAR, pfa=pfa, clutter="lognormal"
    )
    assert abs(np.count_nonzero(hits) - hits.size * pfa) <= 5.0 * np.sqrt(hits.size * pfa) + 1


@pytest.mark.parametrize("pfa", [1e-2, 1e-3])
def test_false_alarms_come_at_that_rate_at_edges_and_corners(pfa):
    rng = np.random.default_rng(13)
    edges, n = 0, 3000
    for _ in range(n):
        hits = log_hits(rng.rayleigh(9.0, (100, 3)).astype(np.float32), FAR, pfa=pfa)
        edges += np.count_nonzero(hits[0]) + np.count_nonzero(hits[-1])
    assert abs(edges - 6 * n * pfa) <= 5.0 * np.sqrt(6 * n * pfa) + 1


def conditional_tail(t, count, samples=4000, seed=1):
    """P(y > m + t s) for ln of exponentials: exact over mean and spread, sampled over the configuration."""
    rng = np.random.default_rng(seed)
    y = np.log(rng.exponential(size=(samples, count)))
    u = (y - y.mean(1, keepdims=True)) / y.std(1, ddof=1, keepdims=True)
    log_s = np.linspace(0.25 - 45.0 / (count - 1) - 3.0 / count**0.5, 0.25 + min(2.35, 12.0 / count**0.5), 90)
    s = np.exp(log_s)
    # scaled by the largest u, so that no exponential overflows
    top = s * u.max(axis=1, keepdims=True)
    power = np.stack([np.exp(v * (u - u.max(axis=1, keepdims=True))).sum(axis=1) for v in s], axis=1)
    log_below = (count - 1) * log_s - count * (top + np.log(power))
    log_above = (count - 1) * log_s - count * np.logaddexp(top + np.log(power), t * s)
    peak = log_below.max(axis=1, keepdims=True)
    each = np.exp(log_above - peak).sum(axis=1) / np.exp(log_below - peak).sum(axis=1)
    return each.mean(), each.std() / samples**0.5


@pytest.mark.parametrize("count", [6, 8, 11, 17, 30, 48, 100])
@pytest.mark.parametrize("pfa", [0.1, 1e-3, 1e-6, 1e-12])
def test_factors_have_the_tail_of_the_log_t_statistic(count, pfa):
    found, sd = conditional_tail(float(log_factors(pfa, [count])[0]), count)
    assert abs(found - pfa) < 4.0 * sd + 0.06 * pfa


def test_factors_tend_to_those_of_a_known_spread_and_of_students_t():
    assert_allclose(log_factors(1e-6, [1e9])[0], known_spread(1e-6), rtol=1e-6)
    assert_allclose(log_factors(0.025, [1e9], "lognormal")[0], 1.959964, rtol=1e-6)
    assert_allclose(log_factors(0.025, [10], "lognormal")[0], 2.262157 * 1.1**0.5, rtol=1e-6)
    assert (np.diff(log_factors(1e-6, np.arange(6, 400))) < 0.0).all()


def test_scale_does_not_matter_and_neither_does_a_power():
    """The statistic is blind to x -> a x^b."""
    x = np.random.default_rng(15).rayleigh(1.0, (300, 20))
    expected = log_hits(x.astype(np.float32), FAR, pfa=1e-2)
    assert expected.any()
    for a, b in ((1e-9, 1.0), (1e9, 1.0), (1.0, 0.25), (7.0, 3.0)):
        found = log_hits((a * x**b).astype(np.float32), FAR, pfa=1e-2)
        assert np.count_nonzero(found != expected) <= 1  # one rounding of float32 may decide a cell


def test_integers_that_hardly_differ_stay_silent_and_an_echo_in_them_is_heard(make_ping):
    amplitude = (np.random.default_rng(9).random((500, 39)) < 0.01).astype(np.uint8)
    assert len(LogCfar()(make_ping(amplitude))) == 0
    amplitude[250, 12] = 40
    assert len(LogCfar()(make_ping(amplitude))) == 1
    assert len(LogCfar()(make_ping(np.zeros((500, 39), np.float32)))) == 0


@pytest.mark.parametrize(("level", "dtype"), [(7, np.uint16), (255, np.uint8), (0.3, np.float32)])
def test_an_image_of_one_level_is_silent(make_ping, level, dtype):
    amplitude = np.full((300, 20), level, dtype)
    assert len(LogCfar()(make_ping(amplitude))) == 0
    assert not log_hits(amplitude, FAR, pfa=1e-3).any()


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0), (1, 1), (2, 3)])
def test_small_images(shape):
    ones = np.ones(shape, np.float32)
    assert not log_hits(ones, FAR, pfa=0.1).any()
    assert np.isnan(log_ratio(ones, FAR, pfa=0.1)).all()


def test_a_guard_beyond_the_ping_and_negative_amplitudes_decide_nothing():
    amplitude = np.ones((50, 5), np.float32)
    amplitude[20, 2] = 100.0
    assert not log_hits(amplitude, Window(10**9, 10**9, 6, 1, 0), pfa=1e-3).any()
    assert not log_hits(-amplitude, WINDOWS[0], pfa=0.1).any()


def test_noisy_beams_holes_and_wakes_are_left_out(make_ping):
    rng = np.random.default_rng(8)
    clean = rng.rayleigh(10.0, (400, 39)).astype(np.float32)
    holes = rng.random(clean.shape) < 0.1
    broken = np.where(holes, np.nan, clean).astype(np.float32)
    noisy = BeamMask(7, 1_000, np.isin(np.arange(39), [19]), np.zeros(39))
    wakes = Wakes(6, 0, [[8.0, 0.0]], [0.0], [5.0], [0.2], [0], [True])
    a = LogCfar(pfa=1e-2)(make_ping(clean, valid=~holes), noisy, wakes)
    b = LogCfar(pfa=1e-2)(make_ping(broken), noisy, wakes)
    assert len(a) > 50
    assert_array_equal(a.range_m, b.range_m)
    assert_array_equal(a.bearing_rad, b.bearing_rad)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"clutter": "k"}, "clutter must be weibull or lognormal, not 'k'"),
        ({"pfa": 0.2}, "pfa must lie between 1e-12 and 0.1 here, not 0.2"),
        ({"pfa": 1e-13}, "not 1e-13"),
        ({"min_ref": 5}, "min_ref must be at least 6 here, not 5"),
        ({"max_ref": 7}, "max_ref must be at least 8"),
    ],
)
def test_bad_parameters_are_named(parameters, text):
    with pytest.raises(ValueError, match=text):
        LogCfar(**parameters)


def test_the_node_keeps_the_contract():
    check_node("log-cfar")
    check_node(LogCfar(clutter="lognormal", threshold_scale=1.3))
