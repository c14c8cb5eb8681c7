"""Track before detect: ratios whose mean is one, correlation, weak targets, false tracks, lobes, frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
import pytest

from fls_flow import NavState, Ping, Tracks, TrackStatus
from fls_flow.geometry import to_polar, wrap
from fls_flow.testing import check_node
from fls_trackers.multi_ping_integration import CAUTION, MultiPingIntegration
from fls_trackers.tbd_bank import LEAD, Bank, Rules
from fls_trackers.tbd_births import LAGS, Past, Peaks, born, fresh_scouts
from fls_trackers.tbd_evidence import EDGE, halves, wholes
from fls_trackers.tbd_grid import Grid, Motion
from fls_trackers.tbd_hypotheses import SWITCH, rival, weighed
from fls_trackers.tbd_ratio import NO_PLANE, candidates, encoded, power_correlation, ratio_map, ratio_table
from fls_trackers.tbd_scouts import (
    COLUMNS,
    SCORE,
    SIGMA,
    best_of_cells,
    by_range,
    followed,
    predicted,
    with_agile,
)
from fls_trackers.tbd_tables import excess_table, tables_of
from fls_trackers.tbd_tracks import cartesian, first_bearings, likeliest_bearing, spread_bearings

FloatArray = npt.NDArray[np.float64]
HYDROPHONES = np.array([[-0.385, 0.0], [0.0, 0.395], [0.405, 0.0], [0.0, -0.405]])
C, LOW_HZ, BAND_HZ, NEAR_M, FAR_M = 1520.0, 31e3, 10e3, 60.0, 90.0
STILL = Motion(1.0, 2.0, 0.01, 0.5, 0.0, 0.0, 0.0)
NOW = STILL._replace(dt_s=0.0)
GRID = Grid(
    NEAR_M,
    0.038,
    700,
    float(np.radians(-179.0)),
    float(np.radians(1.0)),
    360,
    True,
    0.076,
    float(np.radians(2.2)),
)


class Scene:
    """Images of a window of range: white noise in the band of each hydrophone, echoes with their delays."""

    def __init__(self, seed: int, scr_db: float, correlation: float = 0.0, pings: int = 40) -> None:
        self.rng, self.pings, self.rho = np.random.default_rng(seed), pings, correlation
        self.power = 10.0 ** (scr_db / 10.0)
        period = 2.0 * (FAR_M - NEAR_M) / C * 1.05
        self.n = int(BAND_HZ * period)
        self.frequency = LOW_HZ + np.arange(self.n) / period
        self.range_m = NEAR_M + np.arange(2 * self.n) * period / (2 * self.n) * C / 2.0
        self.bearing = np.radians(np.arange(-179.0, 181.0))
        self.steer = np.exp(-2j * np.pi * self.frequency[:, None, None] * (self._away(self.bearing) / C))

    def _away(self, bearing: npt.ArrayLike) -> FloatArray:
        """p . u of each hydrophone, (n, M)."""
        u = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
        return np.asarray(u @ HYDROPHONES.T)

    def __call__(self, targets: Callable[[int], FloatArray]) -> Iterator[Ping]:
        """Pings of the targets (n, 2) that a ping's number gives."""
        noise = self._noise()
        for k in range(self.pings):
            if k:
                noise = self.rho * noise + math.sqrt(1.0 - self.rho**2) * self._noise()
            spectra = noise.copy()
            for place in targets(k).reshape(-1, 2):
                r, b = np.hypot(*place), np.arctan2(place[1], place[0])
                delay = 2.0 * (r - NEAR_M) / C - self._away(b) / C
                level = np.sqrt(self.power / 4.0 / self.n) * np.exp(2j * np.pi * self.rng.random())
                spectra += level * np.exp(-2j * np.pi * (self.frequency[:, None] * delay))
            beams = np.einsum("fum,fm->fu", self.steer, spectra) / 4.0
            image = np.zeros((2 * self.n, 360), complex)
            image[: self.n] = beams * math.sqrt(self.n)
            amplitude = np.abs(np.fft.ifft(image, axis=0) * 2.0).astype(np.float32)
            keep = self.range_m < FAR_M
            yield Ping(
                k, k * 1_000_000_000, amplitude[keep], self.range_m[keep], self.bearing, sound_speed_mps=C
            )

    def _noise(self) -> npt.NDArray[np.complex128]:
        shape = (self.n, len(HYDROPHONES))
        return np.asarray(
            (self.rng.standard_normal(shape) + 1j * self.rng.standard_normal(shape)) / math.sqrt(2.0)
        )


def moving(start: tuple[float, float], velocity: tuple[float, float]) -> Callable[[int], FloatArray]:
    return lambda k: np.array(start) + k * np.array(velocity)


def nothing(k: int) -> FloatArray:
    return np.zeros((0, 2))


def confirmed(tracks: Tracks) -> Tracks:
    return tracks.select(tracks.status == TrackStatus.CONFIRMED)


def clutter(seed: int, shape: tuple[int, int] = (2000, 200)) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).rayleigh(3.0, shape).astype(np.float32)


@pytest.mark.parametrize("snr", [1.0, 2.0, 10.0])
def test_ratios_have_a_mean_of_one_in_clutter_and_less_where_bounded(snr: float):
    table = ratio_table(snr, 1e9, 50.0)
    u = np.arange(table.size) / 32.0
    assert np.sum(table * np.exp(-u)) / np.sum(np.exp(-u)) == pytest.approx(1.0, abs=0.02)
    bounded = ratio_table(snr, 1e9, 2.0)
    assert bounded.max() == pytest.approx(math.exp(2.0), rel=1e-6)
    assert (bounded <= table * (1.0 + 1e-6)).all()


def test_ratios_of_clutter_with_an_estimated_level_do_not_exceed_one_on_average():
    # Half a bin of the table lets ratios be a little small; too many would make false tracks.
    ratios = ratio_map(clutter(1), None, NO_PLANE, NO_PLANE, 2, 32, ratio_table(2.0, 64.0, 7.0))
    assert 0.9 < ratios.ratio.mean(dtype=float) < 1.01
    assert ratios.power.mean(dtype=float) == pytest.approx(64.0 / 63.0, abs=0.01)
    assert np.log(ratios.ratio).mean(dtype=float) < -0.3


def test_power_is_over_the_mean_of_the_neighbours_in_the_same_beam():
    amplitude = clutter(2, (80, 5))
    power = ratio_map(amplitude, None, NO_PLANE, NO_PLANE, 2, 10, ratio_table(2.0, 20.0, 7.0)).power
    for r, b in ((0, 0), (40, 3), (79, 4), (5, 2)):
        rows = [i for i in range(80) if 2 < abs(i - r) <= 12]
        assert power[r, b] == pytest.approx(amplitude[r, b] ** 2 / np.mean(amplitude[rows, b] ** 2), rel=1e-5)


def test_what_is_not_known_says_nothing():
    amplitude, valid = clutter(3, (200, 20)), np.ones((200, 20), bool)
    amplitude[50, 3], valid[:, 7] = np.nan, False
    ratios = ratio_map(amplitude, valid, NO_PLANE, NO_PLANE, 2, 32, ratio_table(2.0, 64.0, 7.0))
    assert ratios.ratio[50, 3] == 1.0
    assert (ratios.ratio[:, 7] == 1.0).all()
    assert np.isfinite(ratios.ratio).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_give_what_their_floats_give(dtype: type):
    amplitude = np.round(clutter(4, (300, 20)) * 10.0).astype(dtype)
    table = ratio_table(2.0, 64.0, 7.0)
    one = ratio_map(amplitude, None, NO_PLANE, NO_PLANE, 2, 32, table)
    other = ratio_map(amplitude.astype(np.float32), None, NO_PLANE, NO_PLANE, 2, 32, table)
    assert np.array_equal(one.ratio, other.ratio)


@pytest.mark.parametrize("rho", [0.0, 0.5, math.exp(-1.0 / 3.0)])
def test_the_correlation_of_clutter_is_measured_and_made_up_for(rho: float):
    rng = np.random.default_rng(5)
    shape, table = (2000, 100), ratio_table(2.0, 64.0, 7.0)
    old = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / math.sqrt(2.0)
    new = rho * old + math.sqrt(1.0 - rho**2) * (
        rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    ) / math.sqrt(2.0)
    before = ratio_map(np.abs(old).astype(np.float32), None, NO_PLANE, NO_PLANE, 2, 32, table)
    plain = ratio_map(np.abs(new).astype(np.float32), None, NO_PLANE, NO_PLANE, 2, 32, table)
    assert power_correlation(plain.power, before.power) == pytest.approx(rho**2, abs=0.03)
    if rho > 0.0:
        expected = excess_table(table, 2.0, 64.0, CAUTION * rho**2)
        allowed = ratio_map(np.abs(new).astype(np.float32), None, before.power, expected, 2, 32, table)
        assert 0.9 < allowed.ratio.mean(dtype=float) < 1.02
        assert (before.ratio * allowed.ratio).mean(dtype=float) < 1.02  # two pings of one place: no evidence
        assert np.log(allowed.ratio).mean(dtype=float) < np.log(plain.ratio).mean(dtype=float)
    if rho > 0.6:
        assert (before.ratio * plain.ratio).mean(dtype=float) > 1.3  # what it would be without


@pytest.mark.parametrize("snr", [1.0, 2.0, 30.0])
def test_codes_keep_ratios_to_a_part_of_them(snr: float):
    table = ratio_table(snr, 64.0, 7.0)
    code, decoded = encoded(table)
    steps = np.log(decoded[1:].astype(float) / decoded[:-1])
    assert np.ptp(steps) < 1e-5
    assert np.abs(np.log(decoded[code] / table)).max() < 0.51 * steps.mean()
    assert (decoded == 1.0).sum() == 1


def test_what_a_power_is_worth_after_another_is_what_monte_carlo_says():
    rng, snr, rho2 = np.random.default_rng(15), 2.0, 0.5
    table = ratio_table(snr, 1e9, 7.0)
    expected = excess_table(table, snr, 1e9, rho2)

    def gaussian(n: int) -> npt.NDArray[np.complex128]:
        return (rng.standard_normal(n) + 1j * rng.standard_normal(n)) / math.sqrt(2.0)

    n = 400_000
    phase = np.exp(2j * np.pi * rng.random(n))
    steady = rng.random(n) < 0.7
    echo = math.sqrt(snr) * np.where(steady, phase, gaussian(n))
    for old in (0.0, 0.5, 2.0, 5.0):
        clutter = math.sqrt(rho2 * old) + math.sqrt(1.0 - rho2) * gaussian(n)
        bins = np.arange(0.25, 12.0, 1.0)
        without = np.histogram(np.abs(clutter) ** 2, bins)[0]
        with_it = np.histogram(np.abs(clutter + echo) ** 2, bins)[0]
        for i in np.flatnonzero((without > 2000) & (with_it > 2000)):
            cells = slice(int(8 * bins[i]), int(8 * bins[i + 1]) + 1)
            ratios = table[(32.0 * expected[round(8 * old), cells]).astype(int)]
            assert ratios.min() * 0.9 < with_it[i] / without[i] < ratios.max() * 1.1


def test_ratios_by_code_are_those_by_power():
    tables = tables_of(3.0, 64.0, 7.0, 0.0)
    code, decoded = encoded(tables.weakest)
    assert np.log(tables.decoded[2]) == pytest.approx(np.log(decoded), abs=0.05)  # 3 dB: the same table
    u = np.arange(0, 12 * 32)
    for level in (4, 6):
        exact = np.minimum(np.log(tables.levels[level, u]), 7.0)
        assert np.abs(np.log(tables.decoded[level, code[u]]) - exact).max() < 0.1
        assert np.diff(tables.decoded[level]).min() >= 0.0


def test_in_clutter_that_persists_all_tracks_are_scored_alike():
    # Powers there are equivalents for one strength of target; for another their ratio is not known.
    white, correlated = tables_of(3.0, 64.0, 7.0, 0.0), tables_of(3.0, 64.0, 7.0, 0.5)
    assert np.ptp(white.levels, axis=0).max() > 1.0
    assert np.ptp(correlated.levels, axis=0).max() == 0.0
    assert np.ptp(correlated.decoded, axis=0).max() == 0.0


def test_candidates_are_local_maxima_in_order():
    power = np.zeros((20, 10), np.float32)
    power[5, 9], power[5, 0], power[8, 4], power[12, 4], power[13, 4] = 5.0, 6.0, 7.0, 3.0, 9.0
    row, beam = candidates(power, 2.0, True, 10)
    assert list(zip(beam.tolist(), row.tolist(), strict=True)) == [(0, 5), (4, 8), (4, 13)]
    row, beam = candidates(power, 2.0, False, 10)
    assert (9, 5) in list(zip(beam.tolist(), row.tolist(), strict=True))
    assert candidates(power, 2.0, True, 1)[0].tolist() == [13]


def scout(range_m: float = 70.0, rate: float = 0.3, bearing: float = 0.5) -> FloatArray:
    one = np.zeros((1, COLUMNS))
    one[0, :5] = range_m, rate, 0.02**2, 0.0, 0.05**2
    one[0, 5:10] = bearing, 0.002, 0.01**2, 0.0, 0.003**2
    return one


def test_a_scout_goes_straight_in_space():
    one = scout(rate=-1.0)
    r, b, turn = one[0, 0], one[0, 5], one[0, 6]
    place = r * np.array([np.cos(b), np.sin(b)])
    velocity = -1.0 * np.array([np.cos(b), np.sin(b)]) + r * turn * np.array([-np.sin(b), np.cos(b)])
    for _ in range(30):
        one = predicted(one, STILL)
    state, covariance = cartesian(one, np.zeros(1))
    assert state[0] == pytest.approx([*(place + 30.0 * velocity), *velocity], abs=1e-9)
    assert (np.linalg.eigvalsh(covariance[0]) > 0.0).all()


def test_own_motion_moves_what_stands_still():
    one = scout(rate=0.0)
    one[0, 6] = 0.0
    place = 70.0 * np.array([np.cos(0.5), np.sin(0.5)])
    moved = predicted(one, Motion(1.0, 2.0, 0.01, 0.5, 3.0, -2.0, 0.1))
    r, b = to_polar(place - [3.0, -2.0])
    assert moved[0, 0] == pytest.approx(float(r))
    assert moved[0, 5] == pytest.approx(float(b) - 0.1)


@pytest.mark.parametrize("closed", [True, False])
def test_half_cells_and_beams_lie_between_those_around(closed: bool):
    rng = np.random.default_rng(16)
    code = rng.integers(0, 256, (9, 7)).astype(np.uint8)
    code[:, 2:5] = 100  # where nothing changes, nothing does in between
    half = halves(code, closed)
    assert half.shape == (17, 14 + 2 * EDGE)
    assert np.array_equal(wholes(half), code)
    assert half[7, EDGE + 6] == 100
    a, b, c, d = code[3:7, 0].astype(float)
    assert half[9, EDGE] == math.floor(np.clip(0.5625 * (b + c) - 0.0625 * (a + d), 0, 255) + 0.5)
    a, b, c, d = code[4, [6, 0, 1, 2] if closed else [0, 0, 1, 2]].astype(float)
    assert half[8, EDGE + 1] == math.floor(np.clip(0.5625 * (b + c) - 0.0625 * (a + d), 0, 255) + 0.5)
    around = np.arange(-EDGE, 14 + EDGE)
    if closed:
        assert np.array_equal(half, half[:, EDGE + around % 14])
    else:
        assert np.array_equal(half[:, : EDGE - 2], np.repeat(half[:, EDGE, None], EDGE - 2, axis=1))


@pytest.mark.parametrize(("closed", "sign"), [(True, 1.0), (False, 1.0), (True, -1.0)])
def test_a_scout_is_scored_by_bayes_rule(closed: bool, sign: float):
    # The same sum over half cells and half beams, interpolated all over the plane.
    rng = np.random.default_rng(6)
    grid = GRID._replace(closed=closed, first_rad=sign * GRID.first_rad, beam_rad=sign * GRID.beam_rad)
    code = rng.integers(60, 200, (700, 360)).astype(np.uint8)
    decoded = encoded(ratio_table(2.0, 64.0, 7.0))[1]
    one = scout()
    got = followed(one, halves(code, closed), decoded, grid, NOW)[0]
    cubic = np.array([-1.0, 9.0, 9.0, -1.0]) / 16.0
    fine = np.zeros((1399, 719))
    fine[::2, ::2] = code
    fine[3:-3:2] = sum(c * fine[2 * i : 2 * i + 1393 : 2] for i, c in enumerate(cubic))
    fine[:, 3:-3:2] = sum(c * fine[:, 2 * i : 2 * i + 713 : 2] for i, c in enumerate(cubic))
    ratio = decoded[np.floor(fine + 0.5).astype(int).clip(0, 255)].astype(float)
    r, b = (
        grid.first_m + grid.cell_m / 2.0 * np.arange(1399),
        grid.first_rad + grid.beam_rad / 2.0 * np.arange(719),
    )
    sd_r, sd_b = 0.02, 0.01
    w = np.where(np.abs(r - 70.0) <= 2.0 * sd_r, np.exp(-0.5 * ((r - 70.0) / sd_r) ** 2), 0.0)
    v = np.where(np.abs(b - 0.5) <= 2.0 * sd_b, np.exp(-0.5 * ((b - 0.5) / sd_b) ** 2), 0.0)
    joint = w[:, None] * v * ratio
    assert got[SCORE] == pytest.approx(math.log(joint.sum() / (w.sum() * v.sum())), rel=1e-4)


@pytest.mark.parametrize("sd_r", [0.002, 0.01, 0.03, 0.08])
@pytest.mark.parametrize("sd_b", [0.001, 0.01, 0.03])
def test_what_a_ping_says_is_a_kalman_update_whatever_the_prior(sd_r: float, sd_b: float):
    # Ratios that are Gaussian about a place: a prior far narrower than a cell must not be believed more.
    step, place, sd = 0.03, (70.02, 0.507), (0.04, 0.025)
    decoded = np.exp((np.arange(256) - 255.0) * step).astype(np.float32)
    r = NEAR_M + 0.038 * np.arange(700) - place[0]
    b = GRID.first_rad + GRID.beam_rad * np.arange(360) - place[1]
    log_ratio = -0.5 * ((r / sd[0]) ** 2)[:, None] - 0.5 * (b / sd[1]) ** 2
    code = np.rint(255.0 + log_ratio / step).clip(0, 255).astype(np.uint8)
    one = scout()
    one[0, 2:5] = sd_r**2, 0.0, 1e-4
    one[0, 7:10] = sd_b**2, 0.0, 1e-6
    got = followed(one, halves(code, True), decoded, GRID, NOW)[0]
    for mean, variance, prior, p, measured, noise in (
        (got[0], got[2], 70.0, sd_r**2, place[0], sd[0] ** 2),
        (got[5], got[7], 0.5, sd_b**2, place[1], sd[1] ** 2),
    ):
        assert mean - prior == pytest.approx(p / (p + noise) * (measured - prior), rel=0.15)
        assert variance == pytest.approx(p * noise / (p + noise), rel=0.15)


def test_a_past_ping_says_where_the_scout_is_now():
    # A Kalman update with H = [1, -dt], of what a single bright cell says.
    code, decoded = np.zeros((700, 360), np.uint8), np.array([1e-6, *np.ones(254), 900.0], np.float32)
    since = STILL._replace(dt_s=3.0, sigma_v_mps2=0.0, own_x_m=2.0, own_y_m=-1.0, own_turn_rad=0.2)
    one = scout()
    one[0, 3] = 0.0005
    place = 70.0 * np.array([np.cos(0.5), np.sin(0.5)])
    along, across = np.array([np.cos(0.5), np.sin(0.5)]), np.array([-np.sin(0.5), np.cos(0.5)])
    then = place - 3.0 * (0.3 * along + 70.0 * 0.002 * across)
    c, n = np.cos(0.2), np.sin(0.2)
    r, b = to_polar(np.array([[c, -n], [n, c]]) @ then + [2.0, -1.0])
    row, beam = round((r - NEAR_M) / 0.038), round((b - GRID.first_rad) / GRID.beam_rad)
    code[row, beam] = 255
    got = followed(one, halves(code, True), decoded, GRID, since)[0]
    off = NEAR_M + 0.038 * row - r
    H, P = np.array([1.0, -3.0]), np.array([[0.02**2, 0.0005], [0.0005, 0.05**2]])
    gain = P @ H / (H @ P @ H)
    moved = got[[0, 1]] - [70.0, 0.3]
    assert moved == pytest.approx(gain * off, rel=0.3)
    assert moved[1] / moved[0] == pytest.approx(gain[1] / gain[0], rel=1e-6)
    gone = P - np.array([[got[2], got[3]], [got[3], got[4]]])
    assert gone == pytest.approx(np.outer(gain, gain) * gone[0, 0] / gain[0] ** 2, rel=1e-6)
    assert H @ gone @ H > 0.9 * (H @ P @ H)
    assert got[SCORE] > 2.0
    elsewhere = np.roll(code, 40, axis=0)
    assert followed(one, halves(elsewhere, True), decoded, GRID, since)[0, SCORE] < -10.0


def test_a_path_is_found_from_any_pair_of_its_peaks_with_all_that_came_before():
    decoded = np.exp(np.linspace(-1.0, 3.0, 256)).astype(np.float32)
    places = [(300 - 8 * lag, 90 + lag // 3) for lag in range(6)]  # rows and beams, the newest first
    peaks = [Peaks(np.array([r]), np.array([b]), np.array([4.0])) for r, b in places]
    nothing = Peaks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    past, since = [], []
    for lag, (r, b) in enumerate(places[1:], 1):
        code = np.zeros((700, 360), np.uint8)
        code[r - 1 : r + 2, b - 2 : b + 3] = 255
        past.append(Past(0, (0.0, 0.0, 0.0), halves(code, True), peaks[lag] if lag == 2 else nothing))
        since.append(STILL._replace(dt_s=float(lag)))
    found = fresh_scouts(peaks[0], past, since, decoded, GRID, 1000)
    assert len(found) == 1
    assert found[0, :2] == pytest.approx([NEAR_M + 300 * 0.038, 8 * 0.038], abs=0.01)
    assert -GRID.beam_rad / 3.0 < found[0, 6] < 0.0
    window = math.log(LAGS * (8.0 / 0.076 + 1.0) * (5.0 / 71.4 / GRID.beamwidth_rad + 1.0))
    assert 8.0 + 4 * 2.0 < found[0, SCORE] + window < 8.0 + 4 * 3.0
    assert len(fresh_scouts(peaks[0], past[:1], since[:1], decoded, GRID, 1000)) == 0


def test_of_too_many_pairs_the_better_are_left():
    rng = np.random.default_rng(14)
    row = np.sort(rng.choice(700, 200, replace=False))
    beam, gain = np.full(200, 7), rng.uniform(3.0, 9.0, 200)
    everything = born(row, beam, gain, row, beam, gain, GRID, STILL, 0.0, 10**6)
    some = born(row, beam, gain, row, beam, gain, GRID, STILL, 0.0, len(everything) // 2)
    assert len(some) <= len(everything) // 2
    assert some[:, SCORE].max() == everything[:, SCORE].max()
    assert np.median(some[:, SCORE]) > np.median(everything[:, SCORE]) + 0.5


def test_a_scout_takes_the_place_of_a_much_worse_tentative_track_only():
    rules = Rules(10.0, 17.0, 15.0, 1.5, 10, 2.0, (0.005, 0.03))

    def begun(*scores: float) -> Bank:
        bank = Bank()
        for offset, score in enumerate(scores):
            one = scout(70.0 + offset)
            one[0, SCORE] = score
            bank.begin(one, GRID, rules)
        return bank

    assert begun(9.0).row["id"].tolist() == []
    assert begun(11.0, 11.0 + 0.9 * LEAD).row["id"].tolist() == [1]
    assert begun(11.0, 11.0 + 1.1 * LEAD).row["id"].tolist() == [2]
    assert begun(18.0, 30.0).row["status"].tolist() == [TrackStatus.CONFIRMED]
    assert begun(18.0, 30.0, 30.0).row["id"].tolist() == [1, 2]


def test_a_track_that_goes_astray_is_brought_back_under_its_name():
    rules, bank = Rules(10.0, 17.0, 15.0, 1.5, 10, 2.0, (0.005, 0.03)), Bank()
    start, near, far = scout(70.0), scout(70.5), scout(70.5, bearing=0.8)
    start[0, SCORE], near[0, SCORE], far[0, SCORE] = 20.0, 9.0, 14.0
    bank.begin(start, GRID, rules)
    bank.recall(np.concatenate([near, far]), GRID, rules)
    assert bank.path[0, 0] == 70.0  # it does well
    bank.path = bank.path.copy()
    bank.path[0, SCORE] = 12.0
    bank.recall(far, GRID, rules)
    assert bank.path[0, 0] == 70.0  # at another bearing
    bank.recall(np.concatenate([far, near]), GRID, rules)
    assert bank.path[0, [0, SCORE]].tolist() == [70.5, 12.0]
    assert bank.row[["id", "status"]].tolist() == [(1, TrackStatus.CONFIRMED)]
    assert not bank.astray.any()


def test_of_two_hypotheses_the_likelier_is_the_path():
    sigmas = (0.005, 0.03)
    steady = scout(70.0)
    steady[0, [SCORE, SIGMA]] = 12.0, sigmas[0]
    agile, before, doubt = rival(steady, sigmas), steady[:, SCORE], np.full(1, SWITCH)
    assert rival(agile, sigmas)[0].tolist() == steady[0].tolist()
    steady[0, SCORE], agile[0, SCORE] = 12.0 + math.log(0.5), 12.0 + math.log(3.0)
    agile[0, 0] = 70.2
    probability = SWITCH + SWITCH * (1.0 - 2.0 * SWITCH)
    path, other, after = weighed(before, steady, agile, doubt)
    mean = 0.5 * (1.0 - probability) + 3.0 * probability
    assert path[0, [0, SIGMA]].tolist() == [70.0, sigmas[0]]
    assert path[0, SCORE] == pytest.approx(12.0 + math.log(mean))
    assert after[0] == pytest.approx(3.0 * probability / mean)
    for _ in range(3):  # what speaks for it goes on: it takes over, then the first is given up
        score = path[:, SCORE].copy()
        path[0, SCORE] = score[0] + math.log(3.0 if path[0, SIGMA] == sigmas[1] else 0.01)
        other[0, SCORE] = score[0] + math.log(3.0 if other[0, SIGMA] == sigmas[1] else 0.01)
        path, other, after = weighed(score, path, other, after)
    assert path[0, [0, SIGMA]].tolist() == [70.2, sigmas[1]]
    assert other[0, [0, SIGMA]].tolist() == [70.2, sigmas[0]]
    assert after[0] == SWITCH


def test_two_hypotheses_do_not_raise_scores_in_clutter():
    # The mean ratio stays one whatever the weights: no more false tracks than with one hypothesis.
    rng = np.random.default_rng(18)
    n = 20_000
    path = np.repeat(scout(), n, axis=0)
    path[:, SIGMA] = 0.005
    other, doubt = rival(path, (0.005, 0.03)), np.full(n, SWITCH)
    for _ in range(5):
        score = path[:, SCORE].copy()
        other[:, SCORE] = score
        for one in (path, other):
            one[:, SCORE] += rng.normal(-0.125, 0.5, n)  # ln of ratios whose mean is one
        path, other, doubt = weighed(score, path, other, doubt)
    assert np.exp(path[:, SCORE]).mean() == pytest.approx(1.0, abs=0.04)


def test_a_path_that_leaves_the_ping_stays_the_path():
    path, doubt = scout(), np.full(1, 0.3)
    other = rival(path, (0.0, 0.03))
    path[0, SCORE], other[0, SCORE] = -np.inf, 5.0
    one, two, after = weighed(np.full(1, 4.0), path, other, doubt)
    assert (one == path).all()
    assert (two == other).all()
    assert (after == doubt).all()


def test_good_scouts_may_manoeuvre():
    scouts = np.concatenate([scout(70.0), scout(71.0), scout(72.0)])
    scouts[:, SCORE], scouts[:, SIGMA] = [4.0, 6.0, 7.0], [0.005, 0.005, 0.03]
    more = with_agile(scouts, 0.03, 5.0, math.exp(2.0))
    assert more[:, 0].tolist() == [70.0, 71.0, 72.0, 71.0]
    assert more[3, [SCORE, SIGMA]].tolist() == [4.0, 0.03]
    assert len(best_of_cells(more, GRID, 0.1, 0.0, 10)) == 4  # beside each other


def test_the_order_of_scouts_by_range_keeps_each():
    rng = np.random.default_rng(19)
    scouts = np.repeat(scout(), 300, axis=0)
    scouts[:, 0] = rng.uniform(60.0, 90.0, 300)
    ordered = by_range(scouts)
    assert sorted(ordered[:, 0]) == sorted(scouts[:, 0])
    assert (np.diff(ordered[:, 0]) > -0.26).all()


def test_a_scout_that_leaves_the_ping_is_out():
    code, decoded = np.zeros((700, 360), np.uint8), np.ones(256, np.float32)
    for place in (NEAR_M - 1.0, NEAR_M + 700 * 0.038 + 1.0):
        assert np.isneginf(followed(scout(place), halves(code, True), decoded, GRID, NOW)[0, SCORE])


def test_pairs_are_those_that_one_target_may_have_made():
    rng = np.random.default_rng(7)
    peaks = [
        np.unique(np.stack([rng.integers(0, 360, 300), rng.integers(0, 700, 300)], axis=1), axis=0)
        for _ in range(2)
    ]
    (b, r), (old_b, old_r) = (one.T.copy() for one in peaks)
    gain = np.full(300, 9.0)
    found = born(r, b, gain[: r.size], old_r, old_b, gain[: old_r.size], GRID, STILL, 0.0, 10**6)
    expected = 0
    for row, beam in zip(r, b, strict=True):
        side = int((1.25 / (NEAR_M + row * 0.038) + 0.5 * GRID.beamwidth_rad) / GRID.beam_rad)
        near = np.abs((old_b - beam + 180) % 360 - 180) <= side
        expected += int(np.count_nonzero(near & (np.abs(old_r - row) * 0.038 <= 2.0)))
    assert len(found) == expected > 10
    assert np.abs(found[:, 1]).max() <= 2.0


def test_of_scouts_at_one_place_the_best_is_left():
    scouts = np.repeat(scout(), 5, axis=0)
    scouts[:, SCORE] = [1.0, 4.0, 2.0, -3.0, 3.0]
    scouts[4, 0] += 5.0
    kept = best_of_cells(scouts, GRID, 0.1, 0.0, 10)
    assert kept[:, SCORE].tolist() == [4.0, 3.0]
    assert best_of_cells(scouts, GRID, 0.1, 0.0, 1)[:, SCORE].tolist() == [4.0]


@pytest.mark.parametrize("closed", [True, False])
def test_beliefs_move_with_their_track(closed: bool):
    grid = GRID._replace(closed=closed)
    belief = first_bearings(np.zeros(1), np.zeros(1), grid)[None]
    for _ in range(20):
        belief = spread_bearings(belief, np.array([np.radians(0.25)]), np.zeros(1), grid)
    assert belief.sum() == pytest.approx(1.0)
    table = np.degrees(grid.first_rad + grid.beam_rad * np.arange(360))
    assert table[belief[0].argmax()] == pytest.approx(5.0, abs=0.51)


def test_a_track_goes_over_to_a_lobe_that_is_far_more_probable():
    one = scout(bearing=0.0)
    belief = 0.99 * first_bearings(np.radians([6.0]), np.zeros(1), GRID) + 0.01 / 360.0
    belief[np.abs(np.degrees(GRID.first_rad + GRID.beam_rad * np.arange(360))) < 4.0] = 1e-9
    moved = likeliest_bearing(one, belief[None], np.full(1, 100.0), GRID)
    assert np.degrees(moved[0, 5]) == pytest.approx(6.0, abs=0.3)
    unsure = 0.5 * (belief + first_bearings(np.zeros(1), np.zeros(1), GRID))
    assert likeliest_bearing(one, unsure[None], np.full(1, 100.0), GRID)[0, 5] == 0.0


def test_clutter_alone_gives_no_tracks():
    for correlation in (0.0, math.exp(-1.0 / 3.0)):
        node = MultiPingIntegration()
        for ping in Scene(8, -30.0, correlation, pings=25)(nothing):
            assert len(confirmed(node(ping))) == 0
        assert node.snapshot()["correlation"] == pytest.approx(correlation**2, abs=0.05)


@pytest.mark.parametrize(("scr_db", "pings", "latest"), [(5.0, 60, 45), (10.0, 25, 12)])
def test_a_weak_target_is_found_and_kept(scr_db: float, pings: int, latest: int):
    path = moving((70.0, 10.0), (0.2, -0.25))
    node = MultiPingIntegration()
    seen = [confirmed(node(ping)) for ping in Scene(9, scr_db, pings=pings)(path)]
    assert all(len(tracks) == 1 for tracks in seen[latest:])
    r, b = to_polar(seen[-1].state[0, :2])
    true_r, true_b = to_polar(path(pings - 1))
    assert abs(r - true_r) < 0.3
    assert abs(wrap(b - true_b)) < np.radians(1.5)
    along = path(pings - 1) / true_r
    assert abs(along @ (seen[-1].state[0, 2:] - [0.2, -0.25])) < 0.1


def test_all_its_lobes_are_one_track():
    def two(k: int) -> FloatArray:
        return np.array([[70.0 + 0.2 * k, 5.0], [-60.0, 50.0 - 0.3 * k]])

    node = MultiPingIntegration()
    for ping in Scene(10, 16.0, pings=25)(two):
        tracks = confirmed(node(ping))
    assert len(tracks) == 2
    for place in two(24):
        assert np.hypot(*(tracks.state[:, :2] - place).T).min() < 2.0


def test_a_track_ends_when_its_target_does():
    path = moving((70.0, 10.0), (0.2, -0.2))
    node = MultiPingIntegration()
    pings = Scene(11, 13.0, pings=50)(lambda k: path(k) if k < 15 else nothing(k))
    statuses = [node(ping).status.tolist() for ping in pings]
    assert TrackStatus.CONFIRMED in statuses[14]
    assert sum(TrackStatus.LOST in one for one in statuses) == 1
    assert TrackStatus.CONFIRMED not in statuses[-1]


@pytest.mark.parametrize("kind", ["round", "to and fro"])
def test_a_target_that_manoeuvres_is_one_track(kind: str):
    # Both accelerate by 0.02 m/s^2, as what goes round at 0.4 m/s in a circle of 8 m does.
    def place(k: int) -> FloatArray:
        if kind == "round":
            return np.array([70.0 + 8.0 * math.sin(0.05 * k), 5.0 + 8.0 * math.cos(0.05 * k)])
        half, turn = divmod(k, 20)
        return np.array([72.0 + (-1.0) ** half * 0.01 * turn * (20 - turn), 5.0])

    node = MultiPingIntegration()
    seen = [confirmed(node(ping)) for ping in Scene(17, 9.0, pings=70)(place)]
    assert all(one.id.tolist() == [1] for one in seen[25:])
    assert np.hypot(*(seen[-1].state[0, :2] - place(69))) < 2.0


def test_a_track_waits_for_a_target_that_leaves_the_window():
    def cut(ping: Ping, far_m: float) -> Ping:
        keep = ping.range_m < far_m
        return Ping(ping.seq, ping.stamp_ns, ping.amplitude[keep], ping.range_m[keep], ping.bearing_rad)

    path, node = moving((70.0, 10.0), (0.2, -0.2)), MultiPingIntegration()
    windows = [90.0] * 14 + [68.0] * 6 + [90.0] * 6
    for window, ping in zip(windows, Scene(16, 13.0, pings=26)(path), strict=True):
        tracks = confirmed(node(cut(ping, window)))
        assert window == 90.0 or tracks.id.tolist() == [1]
    assert tracks.id.tolist() == [1]
    assert tracks.hits[0] >= 18
    assert tracks.state[0, :2] == pytest.approx(path(25), abs=2.0)
    for k in range(26, 400, 4):  # but not for ever
        tracks = node(cut(Ping(k, k * 10**9, ping.amplitude, ping.range_m, ping.bearing_rad), 68.0))
    assert len(confirmed(tracks)) == 0


def test_the_world_frame_takes_a_turning_drifting_sonar():
    target, node = np.array([75.0, 0.0]), MultiPingIntegration(frame="ned")

    def seen(k: int) -> FloatArray:
        heading, way = 0.01 * k, np.array([0.1 * k, 0.0])
        r, b = to_polar(target - way)
        return np.array([r * np.cos(b - heading), r * np.sin(b - heading)])

    for k, ping in enumerate(Scene(12, 12.0, pings=30)(seen)):
        nav = NavState(k, k, (0.1 * k, 0.0, 0.0), (0.0, 0.0, 0.01 * k))
        tracks = node(Ping(ping.seq, ping.stamp_ns, ping.amplitude, ping.range_m, ping.bearing_rad, nav=nav))
    assert len(confirmed(tracks)) == 1
    assert tracks.frame == "ned"
    assert confirmed(tracks).state[0, :2] == pytest.approx(target, abs=2.0)
    assert np.abs(confirmed(tracks).state[0, 2:]).max() < 0.2
    unplaced = node(Ping(99, 31_000_000_000, ping.amplitude, ping.range_m, ping.bearing_rad))
    assert len(confirmed(unplaced)) == 1


def test_odd_pings_are_answered_and_bad_ones_named():
    node = MultiPingIntegration()
    assert len(node(Ping(1, 10))) == 0
    assert len(node(Ping(2, 20, np.ones((1, 2), np.float32), np.ones(1), np.arange(2.0)))) == 0
    with pytest.raises(ValueError, match="not after"):
        node(Ping(3, 20))
    uneven = np.array([1.0, 2.0, 4.0, 8.0])
    with pytest.raises(ValueError, match="range_m is not evenly"):
        node(Ping(4, 30, np.ones((4, 3), np.float32), uneven, np.arange(3.0)))
    for n in (3, 40, 41):  # the grid may change from ping to ping
        ping = Ping(n, n * 10**9, clutter(n, (n, 20)), 5.0 + 0.1 * np.arange(n), 0.01 * np.arange(20))
        assert (node(ping).seq, node(ping := Ping(n, n * 10**9 + 1)).stamp_ns) == (n, ping.stamp_ns)


def test_the_contract_is_kept():
    path = moving((70.0, 10.0), (0.2, -0.25))
    check_node(
        MultiPingIntegration(max_scouts=3000),
        [{"ping": ping} for ping in Scene(13, 14.0, 0.5, pings=5)(path)],
    )


@pytest.mark.parametrize(
    "bad",
    [
        {"v_max_mps": 0.0},
        {"agile_mps2": math.inf},
        {"guard_m": -1.0},
        {"snr_db": math.nan},
        {"max_scouts": 0},
        {"frame": "body"},
        {"false_per_ping": 0.0},
    ],
)
def test_bad_parameters_are_refused(bad: dict[str, object]):
    with pytest.raises(ValueError, match=next(iter(bad))):
        MultiPingIntegration(**bad)  # type: ignore[arg-type]  # they are wrong
