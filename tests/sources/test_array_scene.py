"""The simulated active array: echoes, reverberation as a field, noise, drift, truth.

Fields are checked on the samples themselves, by matched filters and beams that are written out here.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.fft import next_fast_len
from scipy.signal import hilbert
from scipy.special import j0
from scipy.stats import kstest

from fls_flow.geometry import sensor_pose, to_polar, turn
from fls_flow.testing import check_node
from fls_sources.array_echoes import Array, echo_delays_s
from fls_sources.array_geometry import FLOATER_M
from fls_sources.array_plan import Drift, apparent_states
from fls_sources.array_scene import ArrayScene, fls_node
from fls_sources.array_waveform import Chirp

C, FS = 1520.0, 96e3
QUIET = {"cnr_db": 200.0, "blast_db": None}


def compressed(block) -> np.ndarray:
    """Analytic matched-filter outputs, scaled to the echo's amplitude."""
    n = next_fast_len(block.samples.shape[1] + block.waveform.size)
    spectrum = np.fft.fft(block.samples, n) * np.conj(np.fft.fft(block.waveform, n))
    spectrum[:, n // 2 :] = 0.0
    return 2.0 * np.fft.ifft(spectrum)[:, : block.samples.shape[1]] / np.sum(block.waveform**2)


def beam(block, bearing_rad: float) -> np.ndarray:
    """The delayed sum towards one bearing, complex, at the block's rate."""
    y = compressed(block)
    n = next_fast_len(y.shape[1] + 100)
    tau = (
        -block.position_m @ np.array([np.cos(bearing_rad), np.sin(bearing_rad), 0.0]) / block.sound_speed_mps
    )
    f = np.arange(n) * (block.sample_rate_hz / n)
    return np.fft.ifft(np.mean(np.fft.fft(y, n) * np.exp(2j * np.pi * f * tau[:, None]), axis=0))[
        : y.shape[1]
    ]


def blocks(**settings) -> list:
    return [one.block for one in ArrayScene(**settings)()]


def test_kind_and_contract() -> None:
    assert fls_node() is ArrayScene
    check_node(ArrayScene(pings=3, range_max_m=40.0, target_min_m=15.0, target_max_m=30.0))
    moving = {"drift_mps": (0.1, -0.05), "yaw_deg": 5.0, "clutter_correlation_pings": 3.0}
    check_node(ArrayScene(pings=3, range_max_m=40.0, fluctuation="swerling-1", n_targets=3, **moving))


def test_a_ping_is_the_papers() -> None:
    scene = ArrayScene(pings=2)
    block, truth = next(scene())
    assert block.samples.shape == (4, 63158)
    assert block.samples.dtype == np.float32
    assert block.waveform.size == 960
    assert_allclose(block.position_m, FLOATER_M)
    assert (block.sample_rate_hz, block.sound_speed_mps) == (FS, C)
    assert len(truth.target_id) == 1
    assert len(scene) == len(list(scene())) == 2


def test_a_ping_does_not_depend_on_how_many_follow() -> None:
    settings = {"range_max_m": 60.0, "clutter_correlation_pings": 2.0, "acceleration_sd_mps2": 0.1, "seed": 4}
    for (a, s), (b, t) in zip(
        ArrayScene(pings=3, **settings)(), ArrayScene(pings=5, **settings)(), strict=False
    ):
        assert_array_equal(a.samples, b.samples)
        assert_array_equal(s.state, t.state)


# --- echoes --------------------------------------------------------------------------------------


def only_echo(target, **settings):
    scene = ArrayScene(pings=1, targets=(target,), range_max_m=60.0, scr_db=200.0, **QUIET, **settings)
    return next(scene())


def test_an_echo_stands_at_its_exact_delays() -> None:
    x, y = 30.0, 25.0
    block, _ = only_echo((x, y, 0.0, 0.0))
    amplitude = 1e10  # 200 dB
    for m, p in enumerate(block.position_m):
        path = np.linalg.norm(np.array([x, y, 0.4])) + np.linalg.norm(np.array([x, y, 0.0]) - p)
        expected = Chirp().at(np.arange(block.samples.shape[1]) / FS - path / C)
        assert_allclose(block.samples[m] / amplitude, expected, atol=2e-5)


@pytest.mark.parametrize("bearing_deg", [0.0, 57.0, -140.0])
def test_an_echo_points_to_its_target(bearing_deg) -> None:
    bearing = np.deg2rad(bearing_deg)
    block, _ = only_echo((40.0 * np.cos(bearing), 40.0 * np.sin(bearing), 0.0, 0.0))
    grid = np.deg2rad(np.arange(-180.0, 180.0, 1.0))
    power = [np.abs(beam(block, one)).max() for one in grid]
    assert abs(np.rad2deg(grid[int(np.argmax(power))]) - bearing_deg) <= 0.5
    peak = np.abs(beam(block, bearing))
    assert_allclose(peak.max(), 1e10, rtol=0.02)
    assert_allclose(peak.argmax() * C / (2 * FS), 40.0, atol=0.01)


def test_a_target_is_struck_when_the_sound_arrives_and_shifts_its_echo_by_doppler() -> None:
    array = Array(np.zeros((1, 3)), np.zeros(3), C, FS, 1000, Chirp())
    start, velocity, own = np.array([[100.0, 0.0, 0.0]]), np.array([[30.0, 0.0, 0.0]]), np.zeros(3)
    first, last = (echo_delays_s(array, start, velocity, own, t)[0, 0] for t in (0.0, 0.01))
    strike = 100.0 / (C - 30.0)  # it flees: r + v t = c t
    assert_allclose(first, 2.0 * strike, rtol=1e-9)
    # what is sent dt later meets it v dt further, and again while the sound catches up
    assert_allclose((last - first) / 0.01, 2.0 * 30.0 / (C - 30.0), rtol=1e-6)
    same = echo_delays_s(array, start, velocity, np.array([30.0, 0.0, 0.0]), 0.0)[0, 0]
    # moving along with it: out as before, back against the own way
    assert_allclose(same, strike + (100.0 + 30.0 * strike - 30.0 * strike) / (C + 30.0), rtol=1e-6)


def test_steady_echoes_are_even_and_swerling_ones_exponential_in_power() -> None:
    """Power over the mean is Exp(1); one and the same draw for all channels."""
    settings = {"range_max_m": 25.0, "scr_db": 60.0, "targets": ((15.0, 0.0, 0.0, 0.0),), **QUIET}
    steady = [np.abs(beam(one, 0.0)).max() for one in blocks(pings=5, **settings)]
    assert_allclose(steady, np.mean(steady), rtol=0.01)
    assert_allclose(steady, 1000.0, rtol=0.1)  # waves from near are not quite plane
    drawn = np.concatenate(
        [
            [
                np.abs(beam(b, 0.0)).max()
                for b in blocks(pings=100, fluctuation="swerling-1", seed=s, **settings)
            ]
            for s in (0, 1)
        ]
    )
    power = (drawn / np.mean(steady)) ** 2
    assert kstest(power, "expon").pvalue > 1e-3


def test_the_direct_blast_comes_first_and_is_as_loud_as_said() -> None:
    (block,) = blocks(pings=1, n_targets=0, range_max_m=30.0, blast_db=50.0, cnr_db=200.0)
    y = np.abs(compressed(block))
    for m, p in enumerate(block.position_m):
        path = np.linalg.norm(p - np.array([0.0, 0.0, -0.4]))
        assert_allclose(np.argmax(y[m]), path / C * FS, atol=1.0)
        assert_allclose(y[m].max(), 10.0**2.5, rtol=0.06)
    (without,) = blocks(pings=1, n_targets=0, range_max_m=30.0, blast_db=None)
    assert np.abs(compressed(without)).max() < 10.0


# --- reverberation and noise ---------------------------------------------------------------------


def clutter(pings: int = 1, **settings) -> list:
    return blocks(pings=pings, n_targets=0, **{**QUIET, "range_max_m": 200.0, **settings})


def test_the_mean_clutter_power_of_a_cell_is_one_all_around() -> None:
    """So that 10 dB of `scr_db` is a peak power of 10 over it; the spread is that of bearings."""
    bearings = np.deg2rad(np.arange(0.0, 360.0, 24.0))
    power = np.zeros(bearings.size)
    for block in clutter(pings=3):
        power += [np.mean(np.abs(beam(block, one)[2000:-2000]) ** 2) / 3.0 for one in bearings]
    assert_allclose(power.mean(), 1.0, atol=0.03)
    assert power.min() > 0.6
    assert power.max() < 1.5


def test_a_cell_is_rayleigh() -> None:
    (block,) = clutter(range_max_m=500.0)
    y = np.abs(beam(block, 0.7))[1000:-1000:12]  # more than 1/B apart
    scaled = y**2 / np.mean(y**2)
    assert kstest(scaled, "expon").pvalue > 1e-3
    channel = compressed(block)[2][1000:-1000:12]
    assert kstest(np.abs(channel) ** 2 / np.mean(np.abs(channel) ** 2), "expon").pvalue > 1e-3


def test_clutter_has_the_coherence_of_waves_from_all_around() -> None:
    """E[y_m conj(y_n)] over the power is J0(k d), averaged over the band: a field, not channel noise."""
    spaced = ((0.0, 0.0, 0.0), (0.012, 0.0, 0.0), (0.0, 0.03, 0.0), (0.5, 0.1, 0.0))
    y = np.concatenate([compressed(b) for b in clutter(pings=3, hydrophones_m=spaced)], axis=1)
    places = np.array(spaced)
    f = np.linspace(31e3, 41e3, 200)
    for m, n in itertools.combinations(range(4), 2):
        found = np.mean(y[m] * np.conj(y[n])) / np.sqrt(
            np.mean(np.abs(y[m]) ** 2) * np.mean(np.abs(y[n]) ** 2)
        )
        expected = np.mean(j0(2 * np.pi * f / C * np.linalg.norm(places[m] - places[n])))
        assert_allclose(found, expected, atol=0.06)


@pytest.mark.parametrize("tau", [0.0, 1.0, 3.0])
def test_clutter_fades_with_its_correlation_time(tau) -> None:
    y = [compressed(b)[0] for b in clutter(pings=5, clutter_correlation_pings=tau)]
    power = np.mean([np.mean(np.abs(one) ** 2) for one in y])
    for lag in (1, 2, 4):
        found = np.mean([np.mean(b * np.conj(a)) for a, b in zip(y, y[lag:], strict=False)]) / power
        expected = np.exp(-lag / tau) if tau > 0.0 else 0.0
        assert_allclose(found, expected, atol=0.06)
    assert_allclose([np.mean(np.abs(one) ** 2) / power for one in y], 1.0, atol=0.12)


def test_drift_moves_the_field_by_twice_the_way() -> None:
    """A hydrophone that drifts s sees J0(2 k s) of what it saw, from one ping to the next, and so does its power."""
    drift = 0.006
    y = [compressed(b)[0] for b in clutter(pings=4, clutter_correlation_pings=1e6, drift_mps=(drift, 0.0))]
    f = np.linspace(31e3, 41e3, 200)
    expected = np.mean(j0(2 * np.pi * f / C * 2.0 * drift))
    found = np.mean([np.mean(b * np.conj(a)) / np.mean(np.abs(a) ** 2) for a, b in itertools.pairwise(y)])
    assert_allclose(found, expected, atol=0.06)
    assert_allclose([np.mean(np.abs(one) ** 2) for one in y] / np.mean(np.abs(y[0]) ** 2), 1.0, atol=0.12)
    turned = [
        compressed(b)[0]
        for b in clutter(pings=2, clutter_correlation_pings=1e6, yaw_deg=20.0, yaw_period_s=4.0)
    ]
    moved = np.linalg.norm(np.array(FLOATER_M[0][:2]) @ turn(np.deg2rad(20.0)).T - np.array(FLOATER_M[0][:2]))
    found = np.mean(turned[1] * np.conj(turned[0])) / np.mean(np.abs(turned[0]) ** 2)
    assert_allclose(found, np.mean(j0(2 * np.pi * f / C * moved)), atol=0.06)


def test_noise_lies_where_it_is_said_to() -> None:
    """Below the clutter of a cell by `cnr_db`; it is white and independent between channels."""
    settings = {"seed": 5, "range_max_m": 200.0, "n_targets": 0, "pings": 1, "blast_db": None}
    (loud,), (quiet,) = (blocks(cnr_db=level, **settings) for level in (-3.0, 200.0))
    noise = loud.samples - quiet.samples
    assert_allclose(np.corrcoef(noise), np.eye(4), atol=0.03)
    # without the clutter, which is the same in both
    only = type(loud)(0, 0, noise, FS, loud.position_m, loud.waveform, C)
    assert_allclose(10 * np.log10(np.mean(np.abs(beam(only, 1.0)) ** 2)), 3.0, atol=0.3)
    spectrum = np.mean(np.abs(np.fft.rfft(noise)) ** 2, axis=0)
    assert_allclose(spectrum[:10_000].mean(), spectrum[-10_000:].mean(), rtol=0.05)


def test_clutter_before_compression_is_as_reported() -> None:
    """About 26 dB: 20 of time times bandwidth, 6 of four hydrophones."""
    scene = ArrayScene(scr_db=10.0, range_max_m=200.0)
    (block,) = clutter()
    echo = 10.0 * np.mean(block.waveform**2)
    found = 10.0 * np.log10(echo / np.mean(block.samples.astype(float) ** 2))
    assert_allclose(scene.scr_before_compression_db, found, atol=0.2)
    assert_allclose(found, 10.0 - 26.0, atol=0.5)


def test_scr_is_measured_after_beamforming() -> None:
    """The mean power in the target's cell is that of the target and the clutter: 10 + 1."""
    settings = {"targets": ((30.0, 20.0, 0.0, 0.0),), "range_max_m": 45.0, "blast_db": None, "cnr_db": 40.0}
    bearing, r = np.arctan2(20.0, 30.0), np.hypot(30.0, 20.0)
    at = round((r + np.linalg.norm([30.0, 20.0, 0.4])) / C * FS)
    power = [
        np.abs(beam(b, bearing)[at]) ** 2
        for seed in range(3)
        for b in blocks(pings=60, seed=seed, scr_db=10.0, **settings)
    ]
    assert_allclose(np.mean(power), 11.0, rtol=0.12)


# --- motion and truth ----------------------------------------------------------------------------


def test_truth_follows_nearly_constant_velocity() -> None:
    straight = [t.state[0] for _, t in ArrayScene(pings=20, range_max_m=500.0, seed=3, ping_rate_hz=0.5)()]
    for k, state in enumerate(straight):
        assert_allclose(state[:2], straight[0][:2] + 2.0 * k * straight[0][2:], atol=1e-9)
    scene = ArrayScene(pings=400, range_max_m=500.0, n_targets=40, acceleration_sd_mps2=0.05, seed=1)
    states = scene._states()
    kick = np.diff(states[:, :, 2:], axis=0)
    assert_allclose(kick.std(), 0.05, rtol=0.03)
    step = states[1:, :, :2] - states[:-1, :, :2] - states[:-1, :, 2:]
    assert_allclose(step, 0.5 * kick, atol=1e-9)


def test_drawn_targets_lie_in_their_limits_and_are_those_of_fewer() -> None:
    limits = {"target_min_m": 120.0, "target_max_m": 200.0, "speed_min_mps": 0.5, "speed_max_mps": 0.9}
    states = ArrayScene(n_targets=200, **limits)._states()[0]
    r, bearing = to_polar(states[:, :2])
    assert r.min() >= 120.0
    assert r.max() <= 200.0
    assert ((np.hypot(*states[:, 2:].T) >= 0.5) & (np.hypot(*states[:, 2:].T) <= 0.9)).all()
    assert kstest(bearing, "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 1e-3
    assert_array_equal(ArrayScene(n_targets=3, **limits)._states()[0], states[:3])


def test_truth_is_what_the_drifting_turning_sensor_sees() -> None:
    drift = Drift((0.3, -0.2), 0.2, 50.0)
    state = np.array([[100.0, 50.0, 0.4, 0.1]])

    def place(t: float) -> np.ndarray:
        ahead = np.concatenate([state[:, :2] + t * state[:, 2:], state[:, 2:]], axis=1)
        return apparent_states(ahead, drift, t)

    now, h = place(7.0), 1e-4
    assert_allclose(now[:, 2:], (place(7.0 + h) - place(7.0 - h))[:, :2] / (2 * h), atol=1e-6)
    scene = ArrayScene(
        pings=4, targets=((60.0, 20.0, 0.5, 0.0),), range_max_m=100.0, drift_mps=(0.3, -0.2), yaw_deg=10.0
    )
    for k, (block, truth) in enumerate(scene()):
        assert block.nav is not None
        assert_allclose(
            sensor_pose(block.nav, block.mount).to_ned(truth.state[:, :2]), [[60.0 + 0.5 * k, 20.0]]
        )
        assert truth.stamp_ns == block.stamp_ns == scene.start_ns + k * 10**9


def test_echoes_follow_drift_and_yaw() -> None:
    settings = {"drift_mps": (2.0, 1.0), "yaw_deg": 30.0, "yaw_period_s": 8.0, "range_max_m": 60.0}
    scene = ArrayScene(pings=3, targets=((30.0, 10.0, 0.0, 0.0),), scr_db=60.0, **QUIET, **settings)
    for block, truth in scene():
        (r,), (bearing,) = to_polar(truth.state[:, :2])
        grid = bearing + np.deg2rad(np.arange(-3.0, 3.1, 0.5))
        power = [np.abs(beam(block, one)).max() for one in grid]
        assert abs(grid[int(np.argmax(power))] - bearing) <= np.deg2rad(0.5)
        peak = np.abs(beam(block, bearing))
        assert_allclose(peak.argmax() * C / (2 * FS), r, atol=0.25)  # it closes in while the sound travels


def test_what_lies_beyond_is_no_truth_and_a_late_echo_is_cut() -> None:
    block, truth = only_echo((61.0, 0.0, 0.0, 0.0))
    assert len(truth.target_id) == 0
    block, truth = only_echo((59.5, 0.0, 0.0, 0.0))
    assert len(truth.target_id) == 1
    assert np.abs(block.samples).max() > 1e8


def test_positions_by_distances() -> None:
    places = np.array(FLOATER_M)
    table = np.linalg.norm(places[:, None] - places, axis=-1)
    scene = ArrayScene(pings=1, range_max_m=30.0, distances_m=tuple(map(tuple, table.tolist())))
    block, _ = next(scene())
    found = np.linalg.norm(block.position_m[:, None] - block.position_m, axis=-1)
    assert_allclose(found, table, atol=1e-9)
    assert block.position_m[0, 0] > 0.0
    assert_allclose(block.position_m[0, 1], 0.0, atol=1e-9)


# --- the pulse -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("start", "stop"), [(31e3, 41e3), (41e3, 31e3)])
def test_the_pulse_sweeps_its_band(start, stop) -> None:
    pulse = Chirp(start, stop, 0.01)
    w = pulse.samples(960e3)
    assert w.size == 9600
    phase = np.unwrap(np.angle(hilbert(w)))
    frequency = np.diff(phase) * 960e3 / (2 * np.pi)
    assert_allclose(frequency[500:-500], np.linspace(start, stop, frequency.size)[500:-500], rtol=0.03)
    assert_array_equal(pulse.at(np.array([-1e-9, 0.01])), 0.0)


def test_a_taper_rises_and_falls_as_a_cosine() -> None:
    pulse, plain = Chirp(taper=0.4), Chirp()
    t = np.array([0.0005, 0.002, 0.005, 0.009])
    assert_allclose(pulse.at(t), plain.at(t) * (0.5 - 0.5 * np.cos(np.pi * np.array([0.25, 1.0, 1.0, 0.5]))))


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"pings": 0}, "pings is 0"),
        ({"range_max_m": -5.0}, "range_max_m is -5"),
        ({"scr_db": float("nan")}, "scr_db is nan"),
        ({"clutter_correlation_pings": -1.0}, "clutter_correlation_pings is -1"),
        ({"fluctuation": "swerling-9"}, "swerling-9"),
        ({"target_max_m": 10.0}, "target_max_m is 10"),
        ({"sample_rate_hz": 50e3}, "sample_rate_hz 50000"),
        ({"hydrophones_m": ()}, "hydrophones_m"),
        ({"hydrophones_m": ((0.0, float("inf"), 0.0),)}, "hydrophones_m"),
        ({"distances_m": ((0.0, 1.0),)}, "distances_m"),
        ({"distances_m": ((0.0, 1.0), (2.0, 0.0))}, "distances_m is 1"),
        ({"drift_mps": (float("nan"), 0.0)}, "drift_mps"),
        ({"drift_mps": (0.0, 300.0)}, "drift_mps reaches 300"),
        ({"targets": ((0.0, 0.0, 0.0, 900.0),)}, "targets reaches 900"),
    ],
)
def test_bad_parameters(settings, named) -> None:
    with pytest.raises(ValueError, match=named):
        ArrayScene(**settings)


@pytest.mark.parametrize(
    "settings", [{"start_hz": 0.0}, {"duration_s": -1.0}, {"stop_hz": float("inf")}, {"taper": 1.5}]
)
def test_bad_pulses(settings) -> None:
    ((name, value),) = settings.items()
    with pytest.raises(ValueError, match=f"{name} is {value}"):
        Chirp(**settings)
