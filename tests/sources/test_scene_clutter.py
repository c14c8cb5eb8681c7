"""The water of simulated images: laws, gains, beam pattern, number formats."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_sources.scene_clutter import (
    LEVEL,
    WEIBULL_SHAPE,
    background,
    beam_power,
    mean_gain,
    measured_scale,
    noise_gain,
    quantized,
    speckle,
)

SHAPE = (4000, 40)


def drawn(law, extra=None, k_shape=1.5, seed=3):
    rng = np.random.default_rng(seed)
    return speckle(background(law, k_shape, "float32", SHAPE, rng), extra, rng).astype(float)


def test_rayleigh_speckle_has_the_moments_and_the_tail_of_its_law():
    intensity = drawn("rayleigh")
    assert intensity.mean() == pytest.approx(1.0, abs=4.0 / np.sqrt(intensity.size))
    amplitude = np.sqrt(intensity)
    assert amplitude.mean() / amplitude.std() == pytest.approx(np.sqrt(np.pi / (4.0 - np.pi)), rel=0.01)
    for p in (1e-1, 1e-2, 1e-3):
        hits = (intensity > -np.log(p)).sum()
        assert abs(hits - p * intensity.size) < 4.0 * np.sqrt(p * intensity.size)


def test_rayleigh_speckle_is_independent_from_cell_to_cell():
    x = drawn("rayleigh") - 1.0
    assert abs((x[1:] * x[:-1]).mean()) < 4.0 / np.sqrt(x.size)
    assert abs((x[:, 1:] * x[:, :-1]).mean()) < 4.0 / np.sqrt(x.size)


@pytest.mark.parametrize("k_shape", [0.7, 2.0, 10.0])
def test_k_speckle_has_the_second_moment_of_its_law(k_shape):
    intensity = drawn("k", k_shape=k_shape)
    assert intensity.mean() == pytest.approx(1.0, rel=0.03)
    assert (intensity**2).mean() == pytest.approx(2.0 * (1.0 + 1.0 / k_shape), rel=0.12)


def test_k_clutter_is_heavier_than_rayleigh_but_noise_over_it_is_not():
    rayleigh, k = drawn("rayleigh"), drawn("k")
    assert (k > 9.0).mean() > 10.0 * (rayleigh > 9.0).mean()
    loud = drawn("k", np.full(SHAPE, 1000.0, np.float32))
    assert (loud**2).mean() / loud.mean() ** 2 == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("law", ["rayleigh", "k", "measured"])
def test_extra_power_adds_to_the_clutter(law):
    extra = np.zeros(SHAPE, np.float32)
    extra[:, 7] = 9.0
    intensity = drawn(law, extra)
    assert intensity[:, 7].mean() == pytest.approx(10.0, rel=0.15)
    assert intensity[:, 8:].mean() == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("mean", [1.5, 2.7, 4.4])
def test_measured_scale_gives_whole_numbers_of_that_mean(mean):
    scale = float(measured_scale(np.array([mean]))[0])
    weibull = scale * np.random.default_rng(1).weibull(WEIBULL_SHAPE, 400_000)
    assert np.floor(weibull).mean() == pytest.approx(mean, rel=0.02)


def test_gains_are_smooth_positive_and_rise_at_the_far_end():
    f = np.linspace(0.0, 1.0, 500)
    gain = mean_gain(f)
    assert (gain > 0.9).all()
    assert gain[-1] > gain[250] < gain[0]
    assert np.abs(np.diff(np.log(gain))).max() < 0.02
    assert noise_gain(np.array([0.5]))[0] == 1.0
    assert (np.diff(noise_gain(f)) > 0.0).all()


def test_level_follows_the_number_format():
    for number_format, level in LEVEL.items():
        fixed = background("rayleigh", 1.0, number_format, (100, 3), np.random.default_rng(0))
        assert_allclose(fixed.range_gain[:, 0], level * mean_gain((np.arange(100) + 0.5) / 100), rtol=1e-6)
        assert_array_equal(fixed.beam_gain, 1.0)


def test_measured_beams_have_a_fixed_pattern_of_mean_one():
    fixed = background("measured", 1.0, "uint8", (10, 96), np.random.default_rng(0))
    assert fixed.beam_gain.mean() == pytest.approx(1.0, rel=1e-5)
    assert 0.1 < fixed.beam_gain.std() < 0.2


def test_beam_pattern_is_one_on_axis_half_at_half_its_width_and_falls():
    width = np.deg2rad(1.5)
    assert beam_power(0.0, width, -28.0) == 1.0
    assert_allclose(beam_power([-width / 2, width / 2], width, -28.0), 0.5)
    far = beam_power(width * np.linspace(0.0, 20.0, 300), width, -28.0)
    assert (np.diff(far) <= 0.0).all()
    assert 10.0 * np.log10(beam_power(1.5 * width, width, -28.0)) == pytest.approx(-27.0, abs=1.1)
    assert 10.0 * np.log10(beam_power(6.0 * width, width, -28.0)) == pytest.approx(-28.0 - 12.04, abs=0.01)


def test_number_formats_round_and_saturate():
    amplitude = np.array([[0.4, 0.6, 254.7, 300.0, 70000.0]], np.float32)
    assert_array_equal(quantized(amplitude, "rayleigh", "uint8"), [[0, 1, 255, 255, 255]])
    assert_array_equal(quantized(amplitude, "rayleigh", "uint16"), [[0, 1, 255, 300, 65535]])
    assert_array_equal(quantized(amplitude, "measured", "uint8"), [[0, 0, 254, 255, 255]])
    assert quantized(amplitude, "rayleigh", "float32").dtype == np.float32
    assert quantized(amplitude, "rayleigh", "uint8").dtype == np.uint8
    assert quantized(amplitude, "rayleigh", "uint16").dtype == np.uint16
