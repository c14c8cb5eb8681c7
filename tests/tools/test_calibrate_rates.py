"""Rates, scales and tails from binned ratios, against the ratios themselves and against theory."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow.tools.calibrate_rates import (
    Tally,
    beam_scales,
    exceeded,
    jackknife_sd,
    measured,
    quantile,
    tail_scale,
)


def tally_of(ratios):
    """Ratios (n_blocks, n_cells, n_beams), counted."""
    tally = Tally.of(len(ratios), ratios.shape[2])
    for block, one in enumerate(ratios):
        tally.add(block, one)
    return tally


def test_what_lies_above_a_scale_is_counted_to_a_bin():
    rng = np.random.default_rng(1)
    ratio = rng.rayleigh(1.0, (1, 20_000, 3))
    counts = tally_of(ratio).counts[0]
    for scale in (0.03, 0.5, 1.0, 2.2, 3.9, 50.0):
        within = [np.count_nonzero(ratio[0] > scale * factor, axis=0) for factor in (1.01, 0.99)]
        found = exceeded(counts, scale)
        assert (within[0] <= found).all()
        assert (found <= within[1]).all()
    assert_array_equal(exceeded(counts, 1.0), np.count_nonzero(ratio[0] > 1.0, axis=0))
    assert_array_equal(exceeded(counts, [1e-9, 1.0, 1e9])[[0, 2]], [20_000, 0])


def test_ratios_at_one_are_no_alarms_and_undecided_ones_are_no_cells():
    tally = tally_of(np.array([[[1.0], [np.nan], [0.0], [np.inf], [1.0 + 1e-9]]]))
    assert tally.counts.sum() == 4
    assert exceeded(tally.counts[0], 1.0)[0] == 2


def test_each_ratio_counts_in_its_own_beam():
    tally = tally_of(np.array([[[np.nan, 2.0], [3.0, np.nan], [0.5, np.nan]]]))
    assert_array_equal(tally.counts[0].sum(axis=1), [2, 1])
    assert_array_equal(exceeded(tally.counts[0], 1.0), [1, 1])


@pytest.mark.parametrize("pfa", [0.3, 1e-2, 1e-3])
def test_the_quantile_is_that_of_the_ratios(pfa):
    ratio = np.random.default_rng(2).lognormal(0.0, 1.0, (1, 50_000, 1))
    counts = tally_of(ratio).counts[0]
    assert_allclose(quantile(counts[0], pfa), np.quantile(ratio, 1.0 - pfa), rtol=0.011)
    assert_allclose(exceeded(counts, quantile(counts[0], pfa)), pfa * 50_000, rtol=1e-9)


def test_nothing_counted_and_nothing_above_zero_give_a_scale_all_the_same():
    assert quantile(Tally.of(1, 1).counts[0, 0], 1e-3) == 1.0
    silent = tally_of(np.zeros((1, 100, 1))).counts[0, 0]
    assert 0.0 < quantile(silent, 1e-3) < 0.1


def test_beams_of_different_gain_and_tail_get_scales_that_give_each_the_rate():
    rng = np.random.default_rng(3)
    gain = np.linspace(0.5, 3.0, 8)
    ratio = gain * rng.rayleigh(1.0, (1, 400_000, 8))
    counts = tally_of(ratio).counts[0]
    for pfa in (1e-2, 1e-4):
        scale = beam_scales(counts, pfa, per_beam=True)
        assert_allclose(scale / gain, np.sqrt(-2.0 * np.log(pfa)), rtol=0.05)
        assert_allclose(exceeded(counts, scale).sum(), pfa * counts.sum(), rtol=0.02)
        one = beam_scales(counts, pfa, per_beam=False)
        assert_allclose(exceeded(counts, one).sum(), pfa * counts.sum(), rtol=0.02)
        assert exceeded(counts, one)[-1] > 5.0 * pfa * 400_000


def test_beams_with_too_few_cells_for_a_rate_meet_it_together():
    """20,000 cells of a beam hold two alarms at 1e-4: beams give the shares, all of them the rate."""
    gain = np.linspace(0.5, 3.0, 32)
    ratio = gain * np.random.default_rng(7).rayleigh(1.0, (1, 20_000, 32))
    counts = tally_of(ratio).counts[0]
    scale = beam_scales(counts, 1e-4, per_beam=True)
    assert_allclose(exceeded(counts, scale).sum(), 1e-4 * counts.sum(), rtol=0.02)
    assert_allclose(scale / gain, np.sqrt(-2.0 * np.log(1e-4)), rtol=0.15)


def test_a_beam_without_cells_does_not_stop_the_others():
    ratio = np.random.default_rng(4).rayleigh(1.0, (1, 50_000, 3))
    ratio[:, :, 1] = np.nan
    scale = beam_scales(tally_of(ratio).counts[0], 1e-3, per_beam=True)
    assert np.isfinite(scale).all()
    assert_allclose(scale[[0, 2]], np.sqrt(-2.0 * np.log(1e-3)), rtol=0.1)


@pytest.mark.parametrize(("shape", "pfa"), [(2.0, 1e-6), (2.0, 1e-7), (1.0, 1e-6)])
def test_a_fitted_tail_reaches_beyond_the_counts(shape, pfa):
    """Weibull amplitudes of shape 2 are Rayleigh; of shape 1 they have a heavier tail, fitted less well."""
    errors = []
    for seed in range(8):
        ratio = np.random.default_rng(seed).weibull(shape, (1, 100_000, 1))
        scale = tail_scale(tally_of(ratio).counts[0], pfa, per_beam=False)
        errors.append(np.log(scale[0]) - np.log((-np.log(pfa)) ** (1.0 / shape)))
    assert abs(np.mean(errors)) < 0.1
    assert np.std(errors) < 0.15


def test_a_power_tail_is_extrapolated_as_one():
    """P(r > s) = s^-4."""
    ratio = np.random.default_rng(5).pareto(4.0, (1, 200_000, 1)) + 1.0
    scale = tail_scale(tally_of(ratio).counts[0], 1e-6, per_beam=False)
    assert_allclose(np.log(scale[0]), np.log(1e6) / 4.0, atol=0.4)


def test_a_tail_that_can_be_counted_is_counted():
    counts = tally_of(np.random.default_rng(6).rayleigh(1.0, (1, 100_000, 2))).counts[0]
    assert_array_equal(tail_scale(counts, 0.05, per_beam=False), beam_scales(counts, 0.05, per_beam=False))


def test_the_spread_of_a_scale_is_that_between_recordings():
    def fit(counts):
        return beam_scales(counts, 1e-3, per_beam=False)

    found, spread = [], []
    for seed in range(60):
        ratio = np.random.default_rng(seed).rayleigh(1.0, (10, 4_000, 1))
        counts = tally_of(ratio).counts
        found.append(np.log(fit(counts.sum(axis=0))[0]))
        spread.append(jackknife_sd(counts, fit))
    assert_allclose(np.mean(spread), np.std(found), rtol=0.35)


@pytest.mark.parametrize("pfa", [1e-2, 1e-4])
def test_the_interval_of_a_rate_holds_it(pfa):
    inside = 0
    for seed in range(200):
        ratio = np.random.default_rng(seed).rayleigh(1.0, (10, 2_000, 2))
        found = measured(tally_of(ratio).counts, np.full(2, np.sqrt(-2.0 * np.log(pfa))))
        assert found.cells == 40_000
        inside += found.low <= pfa <= found.high
    assert inside >= 0.9 * 200  # of few alarms a symmetric interval leaves out a little more than 5 %


def test_no_alarm_gives_the_rule_of_three_and_no_cell_gives_nothing():
    found = measured(tally_of(np.full((10, 1000, 1), 0.5)).counts, np.ones(1))
    assert (found.rate, found.low, found.alarms) == (0.0, 0.0, 0.0)
    assert_allclose(found.high, 3e-4)
    assert np.isnan(measured(Tally.of(10, 2).counts, np.ones(2)).rate)
