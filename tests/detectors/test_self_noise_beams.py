from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.self_noise_beams import SelfNoiseBeams
from fls_flow import DetectionKind

SHIP_ROW = 620


@pytest.fixture
def sea():
    return np.random.default_rng(31).rayleigh(20.0, (1000, 39))


def with_ship(sea, beams, gain=3.0, row=SHIP_ROW):
    amplitude = sea.copy()
    amplitude[:, beams] *= gain
    amplitude[:, beams[0]] *= 1.2
    amplitude[row, beams] = 20.0 * gain * 12.0
    return amplitude.astype(np.float32)


def test_no_false_beams_in_rayleigh_noise(make_ping):
    rng = np.random.default_rng(32)
    for _ in range(50):
        answer = SelfNoiseBeams()(make_ping(rng.rayleigh(20.0, (1000, 39)).astype(np.float32)))
        assert not answer.beam_mask.noisy.any()
        assert len(answer.detections) == 0


@pytest.mark.parametrize("beams", [[0], [38], [1, 0], [37, 38], [20], [19, 20, 21], [3, 4]])
def test_a_ship_is_found_anywhere_also_at_the_edges(sea, make_ping, beams):
    ping = make_ping(with_ship(sea, beams))
    mask, candidates = SelfNoiseBeams()(ping)
    assert_array_equal(np.flatnonzero(mask.noisy), sorted(beams))
    assert_array_equal(mask.bearing_rad, ping.bearing_rad)
    assert len(candidates) == 10
    assert (candidates.kind == DetectionKind.SELF_NOISE).all()
    assert_array_equal(candidates.bearing_rad, np.full(10, ping.bearing_rad[beams[0]]))  # the loudest beam
    assert ping.range_m[SHIP_ROW] in candidates.range_m
    assert_allclose(candidates.extent[:, 1], np.ptp(ping.bearing_rad[beams]), atol=1e-12)


def test_two_ships_give_two_sets_of_candidates(sea, make_ping):
    amplitude = with_ship(with_ship(sea, [10]), [29], row=200)
    ping = make_ping(amplitude)
    _, candidates = SelfNoiseBeams()(ping)
    assert_array_equal(candidates.bearing_rad, np.repeat(ping.bearing_rad[[10, 29]], 10))
    for half, row in ((slice(0, 10), SHIP_ROW), (slice(10, 20), 200)):
        assert ping.range_m[row] in candidates.range_m[half]
        assert (np.diff(candidates.range_m[half]) >= 1.0 - 1e-9).all()


def test_a_ship_is_found_under_a_gain_that_rises_with_range(sea, make_ping):
    ping = make_ping(with_ship(sea, [20], row=150) * np.linspace(1, 30, 1000, dtype=np.float32)[:, None])
    assert ping.range_m[150] in SelfNoiseBeams()(ping).detections.range_m


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_zeros_and_flat_images_have_no_noise(make_ping, dtype):
    for level in (0, 1, 7):
        assert not SelfNoiseBeams()(make_ping(np.full((300, 39), level, dtype))).beam_mask.noisy.any()


def test_a_spike_at_zero_is_no_ship(make_ping):
    """8-bit data whose medians are 0 in most beams and 1 in some."""
    amplitude = np.random.default_rng(33).geometric(0.45, (1000, 39)) - 1
    amplitude[:, ::5] += np.random.default_rng(34).random((1000, 8)) < 0.5
    assert not SelfNoiseBeams()(make_ping(amplitude.astype(np.uint8))).beam_mask.noisy.any()


def test_beams_denser_than_the_window_still_have_a_reference(make_ping):
    amplitude = np.random.default_rng(35).rayleigh(20.0, (400, 256)).astype(np.float32)
    amplitude[:, 100:104] *= 3.0
    ping = make_ping(amplitude, bearing_rad=np.deg2rad(0.25) * np.arange(256), beamwidth_rad=np.deg2rad(1.0))
    assert_array_equal(np.flatnonzero(SelfNoiseBeams()(ping).beam_mask.noisy), [100, 101, 102, 103])


def test_cells_that_are_invalid_do_not_count(sea, make_ping):
    amplitude = with_ship(sea, [20])
    valid = np.ones(amplitude.shape, bool)
    amplitude[:700, 5], valid[:700, 5] = 1e6, False
    amplitude[:, 6], valid[:, 6] = 1e6, False
    amplitude[SHIP_ROW + 40, 20], valid[SHIP_ROW + 40, 20] = 1e6, False
    ping = make_ping(amplitude, valid=valid)
    mask, candidates = SelfNoiseBeams()(ping)
    assert_array_equal(np.flatnonzero(mask.noisy), [20])
    assert ping.range_m[SHIP_ROW] in candidates.range_m
    assert ping.range_m[SHIP_ROW + 40] not in candidates.range_m


@pytest.mark.parametrize("shape", [(0, 39), (800, 0), (0, 0), (1, 39), (500, 1)])
def test_small_pings_are_answered(make_ping, shape):
    mask, candidates = SelfNoiseBeams()(make_ping(np.ones(shape, np.float32)))
    assert mask.noisy.shape == (shape[1],)
    assert not mask.noisy.any()
    assert (mask.seq, mask.stamp_ns, candidates.seq, candidates.stamp_ns) == (7, 1_000, 7, 1_000)


def test_outputs_hold_no_memory_of_the_ping(sea, make_ping):
    ping = make_ping(with_ship(sea, [20]))
    mask, candidates = SelfNoiseBeams()(ping)
    for out in (mask.bearing_rad, candidates.range_m, candidates.bearing_rad, candidates.amplitude):
        for given in (ping.amplitude, ping.range_m, ping.bearing_rad):
            assert not np.shares_memory(out, given)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"xi": 1.0}, "xi must be above 1, not 1.0"),
        ({"xi": float("nan")}, "not nan"),
        ({"window_beams": 0}, "window_beams must be at least 1, not 0"),
        ({"guard_beams": -1}, "guard_beams must be at least 0, not -1"),
        ({"median_cells": 0}, "median_cells .* not 0"),
        ({"n_peaks": 0}, "n_peaks .* not 0"),
        ({"min_separation_m": -1.0}, "min_separation_m .* not -1.0"),
    ],
)
def test_bad_parameters_are_named(parameters, text):
    with pytest.raises(ValueError, match=text):
        SelfNoiseBeams(**parameters)
