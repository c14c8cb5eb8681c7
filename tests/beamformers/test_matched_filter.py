"""Pulse compression: gain, resolution, side lobes, pieces, precision."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import get_window

from fls_beamformers.matched_filter import Replica, compressed
from fls_beamformers.pulse_compression import PulseCompression, fls_node
from fls_flow import HydrophoneBlock, InputError
from fls_flow.testing import check_node


def by_sums(x: np.ndarray, replica: Replica) -> np.ndarray:
    """The definition: y[l] = sum_n x[n + l] conj(h[n])."""
    h = replica.samples
    padded = np.concatenate([x, np.zeros(h.size)])
    return np.array([padded[k : k + h.size] @ np.conj(h) for k in range(x.size)])


def finely(sea, taper: str = "none", rate: float = 16.0) -> tuple[np.ndarray, np.ndarray]:
    """Lags (s) and |y| of one echo, at `rate` times the usual sample rate."""
    sea.sample_rate_hz *= rate
    sea.length_m = 30.0
    y = compressed(sea.samples([(15.0, 0.0, 1.0)])[:1], Replica.of(sea.waveform, sea.sample_rate_hz, taper))[
        0
    ]
    lag = np.arange(y.size) / sea.sample_rate_hz - (2 * 15.0 - 0.0) / sea.c
    return lag, np.abs(y)


def test_kind_and_contract(sea) -> None:
    assert fls_node() is PulseCompression
    check_node(PulseCompression())
    sea.length_m = 20.0
    blocks = [{"block": sea.block([(12.0, 20.0 * k, 1.0)], seq=k)} for k in range(4)]
    check_node(PulseCompression(), [*blocks, {"block": HydrophoneBlock(9, 9)}])
    check_node(PulseCompression(taper="hann", precision="double", max_fft=1024), blocks)


def test_an_echo_peaks_at_its_onset_with_its_amplitude_and_no_phase() -> None:
    rng = np.random.default_rng(0)
    w = rng.standard_normal(200)
    x = np.zeros((1, 3000))
    x[0, 700:900] = 0.37 * w
    y = compressed(x, Replica.of(w, 96e3))[0]
    assert int(np.argmax(np.abs(y))) == 700
    assert_allclose(y[700], 0.37, atol=1e-12)


@pytest.mark.parametrize("taper", ["none", "hann", "hamming"])
def test_the_fast_filter_is_the_definition(taper) -> None:
    rng = np.random.default_rng(1)
    replica = Replica.of(rng.standard_normal(64), 10e3, taper)
    x = rng.standard_normal((2, 700))
    expected = np.stack([by_sums(one, replica) for one in x])
    assert_allclose(compressed(x, replica), expected, atol=1e-12)


@pytest.mark.parametrize("n", [1, 63, 64, 1000, 5000, 5003])
@pytest.mark.parametrize("max_fft", [1024, 1500, 1 << 18])
def test_pieces_add_up_to_the_whole(n, max_fft) -> None:
    rng = np.random.default_rng(n)
    replica = Replica.of(rng.standard_normal(300), 10e3)
    x = rng.standard_normal((3, n))
    assert_allclose(compressed(x, replica, max_fft), compressed(x, replica, 1 << 20), atol=1e-12)


def test_compression_gains_twenty_decibels_against_noise(sea) -> None:
    """Time times bandwidth is 100: of the echo's mean power over the noise in its band."""
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((1, 400_000))
    w = sea.waveform
    y = compressed(noise, Replica.of(w, sea.sample_rate_hz))[0]
    in_band = 10e3 / (sea.sample_rate_hz / 2.0)  # share of the noise's power
    before = np.mean(w**2) / in_band
    after = 1.0 / np.mean(np.abs(y) ** 2)  # of envelopes: both twice what they are for waves
    assert_allclose(10.0 * np.log10(after / before), 20.0, atol=0.5)


def test_a_lone_chirp_resolves_0p886_over_its_bandwidth(sea) -> None:
    lag, y = finely(sea)
    above = lag[y > y.max() / np.sqrt(2.0)]
    assert_allclose(above[-1] - above[0], 0.886 / 10e3, rtol=0.03)


def test_side_lobes_are_those_of_a_flat_spectrum_or_of_the_taper(sea, make_sea) -> None:
    def highest_side_lobe_db(taper: str) -> float:
        _, y = finely(make_sea(), taper)
        peak = int(y.argmax())
        falling = np.flatnonzero(np.diff(y[peak:]) > 0)[0]  # the first null
        rest = y.copy()
        rest[peak - falling : peak + falling] = 0.0
        return float(20.0 * np.log10(rest.max() / y.max()))

    assert_allclose(highest_side_lobe_db("none"), -13.3, atol=0.7)
    assert highest_side_lobe_db("hann") < -28.0
    assert highest_side_lobe_db("hamming") < -33.0


def test_a_taper_costs_what_its_window_says(sea) -> None:
    noise = np.random.default_rng(3).standard_normal((1, 300_000))
    plain, hann = (
        np.mean(np.abs(compressed(noise, Replica.of(sea.waveform, 96e3, taper))) ** 2)
        for taper in ("none", "hann")
    )
    window = get_window("hann", 960, fftbins=False)
    expected = window.size * np.sum(window**2) / np.sum(window) ** 2
    assert_allclose(10 * np.log10(hann / plain), 10 * np.log10(expected), atol=0.15)  # 1.8 dB


def test_the_band_of_a_chirp(sea) -> None:
    replica = Replica.of(sea.waveform, sea.sample_rate_hz)
    assert_allclose(replica.carrier_hz, 36e3, rtol=2e-3)
    assert_allclose(replica.bandwidth_hz, 10e3, rtol=1e-2)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16])
def test_any_samples(sea, dtype) -> None:
    sea.length_m = 30.0
    x = 1000.0 * sea.samples([(12.0, 30.0, 1.0)])
    block = HydrophoneBlock(1, 2, x.astype(dtype), 96e3, np.zeros((4, 3)), sea.waveform, sea.c)
    single, double = PulseCompression()(block), PulseCompression(precision="double")(block)
    assert single.samples.dtype == np.complex64
    assert double.samples.dtype == np.complex128
    assert_allclose(single.samples, double.samples, atol=2e-3)
    assert single.samples.shape == x.shape


def test_a_dead_channel_and_wild_samples_do_not_spread(sea) -> None:
    sea.length_m = 20.0
    x = sea.samples([(12.0, 30.0, 1.0)]).astype(np.float32)
    wild = x.copy()
    wild[1] = np.nan
    wild[2, 50] = np.inf
    compress = PulseCompression()
    clean = compress(HydrophoneBlock(0, 0, x, 96e3, np.zeros((4, 3)), sea.waveform)).samples
    found = compress(HydrophoneBlock(0, 0, wild, 96e3, np.zeros((4, 3)), sea.waveform)).samples
    assert_array_equal(found[[0, 3]], clean[[0, 3]])
    assert_array_equal(found[1], 0.0)
    assert np.isfinite(found).all()


def test_a_changed_pulse_is_noticed(sea) -> None:
    sea.length_m = 20.0
    compress, block = PulseCompression(), sea.block([(12.0, 0.0, 1.0)])
    compress(block)
    other = HydrophoneBlock(1, 1, block.samples, 96e3, block.position_m, block.waveform[::-1].copy())
    assert_array_equal(compress(other).samples, PulseCompression()(other).samples)


@pytest.mark.parametrize("waveform", [np.zeros(0), np.zeros(30), np.array([1.0, np.nan])])
def test_a_pulse_that_cannot_be_used_is_named(waveform) -> None:
    block = HydrophoneBlock(7, 0, np.ones((2, 50), np.float32), 96e3, np.zeros((2, 3)), waveform)
    with pytest.raises(InputError, match=r"block seq 7: the waveform has \d+ samples"):
        PulseCompression()(block)
    silent = HydrophoneBlock(7, 0, np.ones((2, 50), np.float32), np.nan, np.zeros((2, 3)), np.ones(4))
    with pytest.raises(InputError, match="sample_rate_hz is nan"):
        PulseCompression()(silent)


@pytest.mark.parametrize(
    ("settings", "named"),
    [({"taper": "cosine"}, "cosine"), ({"precision": "half"}, "half"), ({"max_fft": 10}, "10")],
)
def test_bad_parameters(settings, named) -> None:
    with pytest.raises(ValueError, match=named):
        PulseCompression(**settings)
