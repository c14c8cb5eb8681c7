"""Delay and sum, minimum variance: bearings, ranges, lobes, focus, precision, a slow reference."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_beamformers.capon import Capon
from fls_beamformers.capon import fls_node as capon_node
from fls_beamformers.delay_and_sum import DelayAndSum
from fls_beamformers.delay_and_sum import fls_node as delay_and_sum_node
from fls_beamformers.grid import Beams, CellGrid, arrival_delays_s, focus_zones
from fls_beamformers.layout import Settings
from fls_beamformers.messages import CompressedBlock
from fls_beamformers.mvdr import minimum_variance, smoothed_covariance
from fls_beamformers.pattern import ambiguity_pattern, main_lobe_width_rad
from fls_beamformers.pulse_compression import PulseCompression
from fls_flow import HydrophoneBlock, InputError, Mount, NavState
from fls_flow.geometry import wrap
from fls_flow.testing import check_node

FLOATER = np.array([[-0.385, 0.0, 0.0], [0.0, 0.395, 0.0], [0.405, 0.0, 0.0], [0.0, -0.405, 0.0]])
WINDOW = {"range_min_m": 10.0, "range_max_m": 95.0}
BEAMFORMERS = [DelayAndSum, Capon]


def peak(ping) -> tuple[float, float, float]:
    """Range (m), bearing (deg) and amplitude of the largest cell."""
    i, j = np.unravel_index(int(ping.amplitude.argmax()), ping.amplitude.shape)
    return ping.range_m[i], np.rad2deg(ping.bearing_rad[j]), ping.amplitude[i, j]


def off_deg(a: float, b: float) -> float:
    return float(np.abs(np.rad2deg(wrap(np.deg2rad(a - b)))))


def by_spectra(block: CompressedBlock, range_m: np.ndarray, bearing_rad: np.ndarray) -> np.ndarray:
    """|b| of plane waves by the definition: delays as phases of the whole spectrum, evaluated at each time."""
    n = 2 * block.samples.shape[1]
    spectrum = np.fft.fft(block.samples, n)
    f = np.fft.fftfreq(n, 1.0 / block.sample_rate_hz)
    f = np.where(f < 0.0, f + block.sample_rate_hz, f)  # analytic: negative bins hold what lies above
    tau = arrival_delays_s(block.position_m, bearing_rad, block.sound_speed_mps)
    time_s = 2.0 * range_m / block.sound_speed_mps
    at = np.exp(2j * np.pi * time_s[:, None] * f) / n
    beams = [
        np.mean(spectrum * np.exp(2j * np.pi * f * tau[:, u, None]), axis=0) for u in range(bearing_rad.size)
    ]
    return np.abs(at @ np.array(beams).T)


@pytest.mark.parametrize("node", BEAMFORMERS)
def test_kinds_and_contract(sea, node) -> None:
    assert delay_and_sum_node() is DelayAndSum
    assert capon_node() is Capon
    sea.length_m = 30.0
    compress = PulseCompression()
    blocks = [compress(sea.block([(15.0, 40.0 * k, 1.0)], seq=k)) for k in range(4)]
    firings = [{"block": one} for one in [*blocks[:2], CompressedBlock(7, 7), *blocks[2:]]]
    check_node(node(range_min_m=5.0, beam_spacing_deg=5.0), firings)
    check_node(node(range_min_m=0.0, focus=False, precision="double", beam_spacing_deg=15.0), firings)


@pytest.mark.parametrize("bearing_deg", [0.3, 33.3, 90.0, -120.4, 179.6, -45.25])
@pytest.mark.parametrize(("near", "r"), [(False, 80.0), (True, 80.0), (True, 12.0)])
def test_the_peak_lies_within_half_a_step_of_a_plane_or_near_source(sea, bearing_deg, near, r) -> None:
    beams = DelayAndSum(**WINDOW, focus=near)
    found = peak(beams(PulseCompression()(sea.block([(r, bearing_deg, 2.0)], near=near))))
    assert_allclose(found[0], r, atol=0.02)
    assert off_deg(found[1], bearing_deg) <= 0.5
    assert 0.87 * 2.0 < found[2] < 1.01 * 2.0


def test_a_source_on_the_grid_has_its_amplitude(sea) -> None:
    r = 1264 * 0.038  # a cell of 96 kHz, oversampled twice
    for bearing_deg in (-90.0, 12.0, 180.0):
        ping = DelayAndSum(**WINDOW, focus=False)(PulseCompression()(sea.block([(r, bearing_deg, 3.0)])))
        found = peak(ping)
        assert_allclose(found, (r, bearing_deg, 3.0), rtol=0.01)


def test_near_waves_need_the_focus(sea) -> None:
    block = PulseCompression()(sea.block([(5.0, 33.0, 1.0)], near=True))
    plane = peak(DelayAndSum(range_min_m=3.0, range_max_m=8.0, focus=False)(block))[2]
    focused = peak(DelayAndSum(range_min_m=3.0, range_max_m=8.0)(block))[2]
    assert focused > 0.9
    assert plane < 0.87


def test_a_nearer_hydrophone_hears_earlier_so_no_bearing_is_mirrored(sea) -> None:
    """With the other sign every bearing comes out turned by 180 degrees."""
    tau = arrival_delays_s(FLOATER, np.array([0.0]), 1500.0)[:, 0]
    assert_allclose(tau * 1500.0, [0.385, 0.0, -0.405, 0.0])
    near = arrival_delays_s(FLOATER, np.deg2rad([10.0, 200.0]), 1500.0, 2000.0)
    assert_allclose(near, arrival_delays_s(FLOATER, np.deg2rad([10.0, 200.0]), 1500.0), atol=2e-7)
    three = FLOATER[:3]
    found = peak(DelayAndSum(**WINDOW)(PulseCompression()(sea.block([(50.0, 70.0, 1.0)], three))))
    assert off_deg(found[1], 70.0) <= 0.5


@pytest.mark.parametrize("precision", ["single", "double"])
def test_all_beams_equal_the_slow_definition(sea, precision) -> None:
    sea.length_m = 30.0
    echoes = [(15.0, 20.0, 1.0), (16.3, -100.0, 0.5), (24.0, 170.0, 2.0)]
    block = PulseCompression(precision=precision)(sea.block(echoes))
    beams = DelayAndSum(
        range_min_m=12.0, range_max_m=26.0, focus=False, precision=precision, beam_spacing_deg=9.0
    )
    ping = beams(block)
    expected = by_spectra(block, ping.range_m, ping.bearing_rad)
    assert np.abs(ping.amplitude - expected).max() < 2.0 * 10.0 ** (-60.0 / 20.0)


@pytest.mark.parametrize(
    "settings",
    [{"range_step_m": 0.05}, {"range_step_m": 0.021}, {"oversampling": 1.0}, {"oversampling": 3.7}],
)
def test_any_cell_size_gives_the_same_field(sea, settings) -> None:
    sea.length_m = 30.0
    block = PulseCompression()(sea.block([(15.0, 20.0, 1.0)]))
    ping = DelayAndSum(range_min_m=12.0, range_max_m=18.0, focus=False, beam_spacing_deg=24.0, **settings)(
        block
    )
    wanted = settings.get(
        "range_step_m",
        sea.c / (2e4 * settings.get("oversampling", 0.0)) if "oversampling" in settings else 0.0,
    )
    assert_allclose(ping.cell_m, wanted, rtol=0.012)
    assert np.abs(ping.amplitude - by_spectra(block, ping.range_m, ping.bearing_rad)).max() < 2e-3


def test_scalloping_is_as_stated(sea) -> None:
    """The loss of an echo half a cell away: 3.9 dB at one cell per 1/B, 0.9 dB at two, 0.4 dB at three."""
    for oversampling, loss_db in ((1.0, 3.9), (2.0, 0.9), (3.0, 0.4)):
        beams = DelayAndSum(
            **WINDOW, focus=False, oversampling=oversampling, beam_spacing_deg=30.0, first_beam_deg=-180.0
        )
        cell = beams(PulseCompression()(sea.block([(30.0, 0.0, 1.0)]))).range_m
        between = 0.5 * (cell[700] + cell[701])
        found = peak(beams(PulseCompression()(sea.block([(between, 0.0, 1.0)]))))
        assert_allclose(-20.0 * np.log10(found[2]), loss_db, atol=0.25)


def test_the_image_ends_where_the_block_or_the_window_does(sea) -> None:
    block = PulseCompression()(sea.block([(50.0, 0.0, 1.0)]))
    ping = DelayAndSum(range_min_m=20.0, range_max_m=400.0, beam_spacing_deg=60.0)(block)
    assert 20.0 <= ping.range_m[0] < 20.04
    assert 99.9 < ping.range_m[-1] <= 100.0
    assert ping.amplitude.dtype == np.float32
    assert (np.diff(ping.range_m) > 0).all()
    whole = DelayAndSum(range_min_m=0.0, range_max_m=99.0, beam_spacing_deg=60.0)(block)
    assert whole.range_m[0] == 0.0
    assert np.isfinite(whole.amplitude).all()
    with pytest.raises(InputError, match="lower range_min_m"):
        DelayAndSum(range_min_m=200.0, range_max_m=400.0)(block)


def test_the_end_of_a_block_does_not_leak_into_its_beginning(sea) -> None:
    """Transforms are circular: silence must lie between the two."""
    block = PulseCompression()(sea.block([(99.6, 0.0, 1.0)]))
    for node in (DelayAndSum(range_min_m=0.0), Capon(range_min_m=0.0)):
        ping = node(block)
        assert ping.amplitude[ping.range_m < 50.0].max() < 1e-3


@pytest.mark.parametrize("node", BEAMFORMERS)
def test_sound_speed_mount_and_navigation_go_through(sea, node) -> None:
    sea.length_m = 30.0
    block = sea.block([(20.0, 0.0, 1.0)])
    nav, mount = NavState(3, 4, position_m=(1.0, 2.0, 3.0)), Mount((0.0, 0.0, 1.0))
    carried = HydrophoneBlock(
        3, 4, block.samples, block.sample_rate_hz, block.position_m, block.waveform, sea.c, mount, nav
    )
    ping = node(sound_speed_mps=1400.0, beam_spacing_deg=10.0)(PulseCompression()(carried))
    assert (ping.seq, ping.stamp_ns, ping.mount, ping.nav) == (3, 4, mount, nav)
    assert ping.sound_speed_mps == 1400.0
    assert_allclose(ping.frequency_hz, 36e3, rtol=2e-3)
    assert_allclose(peak(ping)[0], 20.0 * 1400.0 / sea.c, atol=0.05)


def test_a_beamformer_follows_a_changed_geometry(sea) -> None:
    sea.length_m = 30.0
    compress, beams = PulseCompression(), DelayAndSum(beam_spacing_deg=3.0)
    blocks = [compress(sea.block([(20.0, 30.0, 1.0)], p)) for p in (FLOATER, 0.7 * FLOATER, FLOATER[:3])]
    for block in blocks:
        assert_array_equal(beams(block).amplitude, DelayAndSum(beam_spacing_deg=3.0)(block).amplitude)


def test_one_hydrophone_sees_the_same_everywhere(sea) -> None:
    sea.length_m = 30.0
    ping = DelayAndSum(beam_spacing_deg=30.0)(
        PulseCompression()(sea.block([(20.0, 30.0, 1.0)], np.zeros((1, 3))))
    )
    assert_allclose(ping.amplitude, np.broadcast_to(ping.amplitude[:, :1], ping.amplitude.shape), atol=1e-6)
    assert np.isnan(ping.beamwidth_rad)


# --- what the array cannot tell apart ------------------------------------------------------------


def test_the_main_lobe_is_2p2_degrees_wide() -> None:
    fine = np.deg2rad(np.arange(-6.0, 6.0, 0.01))
    widths = []
    for source in np.deg2rad(np.arange(0.0, 360.0, 7.0)):
        response = ambiguity_pattern(FLOATER, source + fine, np.array([source]), 36e3, 0.0, 1520.0)[:, 0]
        above = fine[(response > np.sqrt(0.5)) & (np.abs(fine) < np.deg2rad(2.5))]
        widths.append(np.rad2deg(above[-1] - above[0]))
    assert_allclose(np.mean(widths), 2.2, atol=0.1)
    assert_allclose(np.rad2deg(main_lobe_width_rad(FLOATER, 36e3, 1520.0)), np.mean(widths), rtol=0.05)
    spaced = 0.25 / np.sqrt(2.0) * np.array([[-1.0, 0, 0], [0, 1, 0], [1, 0, 0], [0, -1, 0]])
    assert_allclose(np.rad2deg(main_lobe_width_rad(spaced, 36e3, 1520.0)), 5.0, atol=0.25)


@pytest.mark.parametrize(("source_deg", "lobe_deg", "height"), [(0.0, 6.0, 0.91), (45.0, 4.3, 0.96)])
def test_ambiguous_lobes_stand_where_they_were_computed(source_deg, lobe_deg, height) -> None:
    for side in (-1.0, 1.0):
        around = source_deg + side * np.arange(lobe_deg - 1.5, lobe_deg + 1.5, 0.01)
        response = ambiguity_pattern(
            FLOATER, np.deg2rad(around), np.deg2rad([source_deg]), 36e3, 10e3, 1520.0
        )[:, 0]
        assert_allclose(response.max(), height, atol=0.02)
        assert_allclose(abs(around[response.argmax()] - source_deg), lobe_deg, atol=0.35)


def test_the_pattern_is_what_the_beams_give(sea) -> None:
    r = 1264 * 0.038
    ping = DelayAndSum(**WINDOW, focus=False)(PulseCompression()(sea.block([(r, 25.0, 1.0)])))
    row = int(np.argmin(np.abs(ping.range_m - r)))
    expected = ambiguity_pattern(FLOATER, ping.bearing_rad, np.deg2rad([25.0]), 36e3, 10e3, sea.c)[:, 0]
    assert_allclose(ping.amplitude[row], expected, atol=0.05)
    block = PulseCompression()(sea.block([(r, 25.0, 1.0)]))
    ping = DelayAndSum(**WINDOW, focus=False, oversampling=10.0)(block)
    near = np.abs(ping.range_m - r) < 0.0765
    highest = ambiguity_pattern(FLOATER, ping.bearing_rad, np.deg2rad([25.0]), 36e3, 10e3, sea.c, lags=41)[
        :, 0
    ]
    assert_allclose(ping.amplitude[near].max(axis=0), highest, atol=0.06)


def test_a_pattern_is_one_at_the_source_and_symmetric() -> None:
    bearings = np.deg2rad(np.arange(-179.0, 181.0, 5.0))
    found = ambiguity_pattern(FLOATER, bearings, bearings, 36e3, 10e3, 1520.0)
    assert_allclose(np.diag(found), 1.0)
    assert_allclose(found, found.T, atol=1e-12)
    assert found.max() <= 1.0 + 1e-12


# --- grids ---------------------------------------------------------------------------------------


def test_a_full_turn_of_bearings_has_each_once() -> None:
    beams = Settings.of(DelayAndSum()).beams()
    bearings = beams.bearing_rad
    assert bearings.size == 360
    assert_allclose(np.rad2deg(bearings[[0, 179, 359]]), [-179.0, 0.0, 180.0])
    assert bearings.max() <= np.pi
    assert Beams(-60.0, 120.0, 0.5).count == 241
    assert Beams(-180.0, 360.0, 0.7).count == 514


@pytest.mark.parametrize("rate", [1.0, 0.31, 0.9999, 1.7, 0.012])
def test_cells_stand_at_whole_fine_samples(rate) -> None:
    grid = CellGrid.of(6316, 96e3, 10e3, rate * 20e3, (0.01, 0.06), 2.7e-4)
    assert grid.fine_length % grid.stride == 0
    assert_allclose(grid.fine_rate_hz / 96e3, grid.fine_length / grid.fft_length)
    assert grid.fine_rate_hz >= 0.98 * 80e3
    assert grid.time_s[0] >= 0.01 - 1e-9
    assert grid.time_s[-1] <= 0.06 + 1e-9
    assert grid.fft_length - 6316 >= 2 * 2.7e-4 * 96e3


def test_focus_zones_keep_the_path_within_a_32nd_of_a_wavelength() -> None:
    range_m, wavelength = np.arange(2.0, 500.0, 0.038), 1520.0 / 36e3
    starts, focus = focus_zones(range_m, 0.405, wavelength)
    assert starts[0] == 0
    assert starts[-1] == range_m.size
    assert (np.diff(starts) > 0).all()
    for zone, at in enumerate(focus):
        inside = range_m[starts[zone] : starts[zone + 1]]
        u = np.array([np.cos(0.3), np.sin(0.3), 0.0])
        for p in FLOATER:
            exact = np.linalg.norm(inside[:, None] * u - p, axis=1) - inside
            used = np.linalg.norm(at * u - p) - at
            assert np.abs(exact - used).max() < 1.4 * wavelength / 32.0
    assert len(focus_zones(np.arange(400.0, 500.0, 0.1), 0.405, wavelength)[1]) == 1
    assert len(focus_zones(np.zeros(1), 0.0, wavelength)[1]) == 1


# --- minimum variance ----------------------------------------------------------------------------


def test_beams_are_the_textbooks() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 4, 7):
        y = rng.standard_normal((6, 9, n)) + 1j * rng.standard_normal((6, 9, n))
        turn = np.exp(1j * rng.uniform(0, 6, (6, n, 5)))
        R = smoothed_covariance(y, 2, 1, 0.2)
        beams = minimum_variance(y, R, 2, turn)
        for k, t, u in ((0, 0, 0), (5, 4, 3), (2, 8, 4)):
            window = y[k // 2 * 2 : k // 2 * 2 + 2, max(0, t - 1) : t + 2].reshape(-1, n)
            summed = window.T @ window.conj()
            loaded = summed + 0.2 * np.trace(summed).real * np.eye(n)
            assert_allclose(R[k // 2, t], loaded, atol=1e-9)
            a = turn[k, :, u].conj()
            inverse = np.linalg.inv(loaded)
            w = inverse @ a / (a.conj() @ inverse @ a)
            assert_allclose(w.conj() @ a, 1.0)
            assert_allclose(beams[k, t, u], w.conj() @ y[k, t], atol=1e-10)


def test_silence_stays_silent() -> None:
    y = np.zeros((4, 8, 3), complex)
    y[:, 6:] = 1.0
    R = smoothed_covariance(y, 2, 1, 0.2)
    assert_array_equal(R[:, :4], np.broadcast_to(np.eye(3), (2, 4, 3, 3)))
    beams = minimum_variance(y, R, 2, np.ones((4, 3, 1), complex))
    assert_array_equal(beams[:, :4], 0.0)
    assert np.isfinite(beams).all()


@pytest.mark.parametrize("settings", [{}, {"oversampling": 1.0}, {"range_step_m": 0.4}])
def test_much_loading_is_delay_and_sum(sea, settings) -> None:
    """But for what the chirp has beyond the band that is worked."""
    sea.length_m = 40.0
    block = PulseCompression()(sea.block([(15.0, 20.0, 1.0), (25.0, -100.0, 0.5)]))
    look = {"range_min_m": 2.0, "beam_spacing_deg": 4.0, "focus": False, **settings}
    ping, expected = Capon(loading=1e7, **look)(block), DelayAndSum(**look)(block)
    assert_array_equal(ping.range_m, expected.range_m)
    assert np.abs(ping.amplitude - expected.amplitude).max() < 0.02


@pytest.mark.parametrize("bearing_deg", [0.0, 33.25, -120.7, 179.9])
def test_capon_peaks_at_the_true_bearing(sea, bearing_deg) -> None:
    rng = np.random.default_rng(5)
    clean = sea.block([(50.0, bearing_deg, 1.0)], near=True)
    noisy = clean.samples + rng.standard_normal(clean.samples.shape).astype(np.float32)
    block = HydrophoneBlock(0, 0, noisy, 96e3, FLOATER, clean.waveform, sea.c)
    for loading in (0.02, 0.1):
        found = peak(Capon(**WINDOW, loading=loading)(PulseCompression()(block)))
        assert_allclose(found[0], 50.0, atol=0.02)
        assert off_deg(found[1], bearing_deg) <= 0.5
        assert found[2] > 0.6


@pytest.mark.parametrize("band_hz", [(31e3, 41e3), (35e3, 37e3)])
@pytest.mark.parametrize(("loading", "gain_db"), [(0.1, 10.0), (0.0125, 18.0)])
def test_capon_silences_a_steady_source_from_elsewhere(make_sea, band_hz, loading, gain_db) -> None:
    """Noise from one direction, filling all ranges: its power falls where delay and sum has a side lobe."""
    sea = make_sea(start_hz=band_hz[0], stop_hz=band_hz[1])
    rng = np.random.default_rng(6)
    n, rate = sea.n_samples, sea.sample_rate_hz
    tau = arrival_delays_s(FLOATER, np.deg2rad([-70.0]), sea.c)[:, 0]
    spectrum = np.fft.rfft(rng.standard_normal(n))
    f = np.fft.rfftfreq(n, 1.0 / rate)
    ship = np.fft.irfft(spectrum * np.exp(-2j * np.pi * f * tau[:, None]), n)
    samples = (ship + 0.03 * rng.standard_normal(ship.shape)).astype(np.float32)
    block = PulseCompression()(HydrophoneBlock(0, 0, samples, rate, FLOATER, sea.waveform, sea.c))
    power = {}
    for name, node in (
        ("sum", DelayAndSum(**WINDOW, focus=False)),
        ("capon", Capon(**WINDOW, focus=False, loading=loading)),
    ):
        ping = node(block)
        power[name] = np.mean(ping.amplitude.astype(float) ** 2, axis=0)
    away = np.abs(wrap(ping.bearing_rad - np.deg2rad(-70.0))) > np.deg2rad(8.0)
    towards = int(np.argmin(np.abs(wrap(ping.bearing_rad - np.deg2rad(-70.0)))))
    assert power["sum"].argmax() == power["capon"].argmax() == towards
    assert 10.0 * np.log10(power["sum"][away].mean() / power["capon"][away].mean()) > gain_db


# --- mistakes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("node", BEAMFORMERS)
@pytest.mark.parametrize(
    "settings",
    [
        {"range_min_m": -1.0},
        {"range_max_m": 5.0},
        {"range_max_m": float("inf")},
        {"oversampling": 0.5},
        {"range_step_m": 0.0},
        {"sound_speed_mps": -3.0},
        {"beam_spacing_deg": 0.0},
        {"sector_deg": 400.0},
        {"first_beam_deg": -200.0},
        {"first_beam_deg": float("nan")},
        {"precision": "half"},
    ],
)
def test_bad_parameters_are_named_with_their_value(node, settings) -> None:
    ((name, value),) = settings.items()
    with pytest.raises(ValueError, match=str(value).removeprefix("-").split(".")[0]):
        node(**settings)
    with pytest.raises(ValueError, match=r"window_m|loading"):
        Capon(**{("window_m" if name == "range_min_m" else "loading"): 0.0})


def test_blocks_without_geometry_are_named() -> None:
    lost = np.full((4, 3), np.nan)
    samples = np.ones((4, 100), np.complex64)
    with pytest.raises(InputError, match="block seq 3: position_m"):
        DelayAndSum()(CompressedBlock(3, 0, samples, 96e3, 36e3, 10e3, lost))
    with pytest.raises(InputError, match="block seq 3: carrier_hz is nan"):
        DelayAndSum()(CompressedBlock(3, 0, samples, 96e3, float("nan"), 10e3, FLOATER))
