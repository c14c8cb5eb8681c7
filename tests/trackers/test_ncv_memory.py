"""What the blob tracker remembers of clutter: against simulated clutter, slow references, edges, the contract."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest

from fls_flow import Detections, Ping, TrackStatus
from fls_flow.testing import check_node
from fls_trackers.ncv_auction import NcvAuction
from fls_trackers.ncv_memory import ClutterMemory, Recall, place_powers, row_powers

FloatArray = npt.NDArray[np.float64]
ALL = np.zeros((0, 0), bool)
CELL_M = 0.05


def around(seq: int, amplitude: npt.NDArray[np.generic], valid: npt.NDArray[np.bool_] | None = None) -> Ping:
    n_ranges, n_beams = amplitude.shape
    bearing = np.radians(360.0 / n_beams * (np.arange(n_beams) + 1) - 180.0)
    return Ping(seq, seq * 1_000_000_000, amplitude, 20.0 + CELL_M * np.arange(n_ranges), bearing, valid)  # type: ignore[arg-type]  # any dtype


def persisting(seed: int, correlation: float, shape: tuple[int, int]) -> Iterator[FloatArray]:
    """Rayleigh amplitudes of mean power 1, of which the complex ones keep `correlation` from ping to ping."""
    rng, field = np.random.default_rng(seed), None
    while True:
        fresh = np.sqrt(0.5) * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
        field = fresh if field is None else correlation * field + np.sqrt(1.0 - correlation**2) * fresh
        yield np.abs(field)


def test_announced_powers_come_as_much_more_often():
    """Frequencies of pairs of powers over those of independent ones, cell by cell of a table."""
    rho, n = 0.7, 4_000_000
    pairs = persisting(1, rho, (1, n))
    before, now = (np.square(next(pairs))[0] for _ in range(2))
    edges = np.array([0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    table, *_ = np.histogram2d(now, before, edges)
    middle = np.linspace(0.0, 1.0, 21)[None] * np.diff(edges)[:, None] + edges[:-1, None]
    places = (np.ravel(one) for one in np.meshgrid(middle, middle))
    grid = np.exp(Recall(*places, rho**2).announced())
    alone = np.exp(-middle)
    weight = alone[:, :, None, None] * alone[None, None]
    grid = grid.reshape(middle.size, middle.size).T.reshape(*middle.shape, *middle.shape)
    expected = (grid * weight).sum(axis=(1, 3)) / weight.sum(axis=(1, 3))
    chance = -np.diff(np.exp(-edges))
    seen = table / n / (chance[:, None] * chance)
    likelier = expected > 1.3  # the bound at 1 does not matter there
    assert np.count_nonzero(likelier) > 8
    np.testing.assert_allclose(seen[likelier], expected[likelier], rtol=0.06)


def test_without_correlation_nothing_is_announced():
    z = np.array([0.0, 3.0, 20.0])
    assert not Recall(z, z, 0.0).announced().any()
    high, rho = np.array([4000.0]), 0.9  # where I0 itself overflows
    apart = high * (1.0 - rho) ** 2 / (1.0 - rho**2)
    assert Recall(high, high, rho**2).announced() == pytest.approx(high - apart, rel=0.002)


def test_what_stands_persists_better_than_clutter():
    """The ratio has mean 1 over clutter; over a standing echo its logarithm grows, at any strength."""
    rho, n, rng = 0.7, 200_000, np.random.default_rng(8)
    pairs = persisting(9, rho, (1, n))
    before, now = (np.square(next(pairs))[0] for _ in range(2))
    ratio = np.exp(Recall(now, before, rho**2).standing(np.full(n, 1.5)))
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)
    for amplitude in (2.5, 5.0, 20.0):
        fields = (rng.standard_normal((2, n)) + 1j * rng.standard_normal((2, n))) * np.sqrt(0.5)
        last = fields[0]
        after = rho * last + np.sqrt(1.0 - rho**2) * fields[1]
        z, z_before = np.abs(amplitude + after) ** 2, np.abs(amplitude + last) ** 2
        gain = Recall(z, z_before, rho**2).standing(np.full(n, amplitude)).mean()
        assert gain == pytest.approx((1.0 - rho) ** 2 * amplitude**2 / (1.0 - rho**2), rel=0.15)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_the_correlation_is_measured_whatever_the_gain(dtype: type, correlation: float):
    memory, gain = ClutterMemory(), np.linspace(60.0, 15.0, 1200)[:, None]
    for seq, amplitude in zip(range(6), persisting(2, correlation, (1200, 60)), strict=False):
        memory.recall(around(seq, np.minimum(gain * amplitude, 255.0).astype(dtype)), *np.zeros((2, 0)))
    assert memory.pings == 5
    assert memory.correlation == pytest.approx(correlation**2, abs=0.03)


def test_normalised_powers_are_those_of_a_slow_reference():
    rng = np.random.default_rng(3)
    image, last = rng.rayleigh(1.0, (2, 150, 12)).astype(np.float32)
    image[40, 3], last[90, 5] = np.nan, np.inf
    valid = rng.random(image.shape) < 0.95

    def slow(one: npt.NDArray[np.float32], r: int, b: int) -> float:
        known = valid & np.isfinite(one)
        rows = [r + side * (5 + 2 * k) for k in range(32) for side in (-1, 1)]
        rows = [k for k in rows if 0 <= k < 150 and known[k, b]]
        return one[r, b] ** 2 / float(np.mean(one[rows, b].astype(float) ** 2)) if known[r, b] else 1.0

    rows = np.array([0, 40, 77, 149])
    expected = [[slow(image, r, b) for b in range(12)] for r in rows]
    np.testing.assert_allclose(row_powers(image, valid, rows), expected, rtol=1e-5)
    row, beam = np.array([0, 60, 91, 149]), np.array([0, 7, 5, 11])
    now, before = place_powers(image, last, valid, row, beam, True)
    for i, (r, b) in enumerate(zip(row, beam, strict=True)):
        near = [(k, j % 12) for k in range(max(r - 1, 0), min(r + 2, 150)) for j in range(b - 1, b + 2)]
        top = max((p for p in near if np.isfinite(image[p])), key=lambda p: image[p])
        assert now[i] == pytest.approx(slow(image, *top), rel=1e-5)
        assert before[i] == pytest.approx(slow(last, *top), rel=1e-5)


def test_a_change_of_cells_begins_anew():
    memory, clutter = ClutterMemory(), persisting(4, 0.9, (300, 36))
    places = np.array([25.0, 30.0]), np.array([0.5, -1.0])
    small = persisting(5, 0.9, (200, 36))
    for seq in range(3):
        recalled = memory.recall(around(seq, next(clutter).astype(np.float32)), *places)
    assert recalled.correlation == pytest.approx(0.81, abs=0.05)
    assert memory.recall(around(3, next(small).astype(np.float32)), *places).correlation == 0.0
    assert memory.recall(Ping(4, 4), np.zeros(0), np.zeros(0)).now.shape == (0,)
    one_beam = Ping(5, 5, np.ones((9, 1), np.float32), np.arange(9.0), np.zeros(1))
    for _ in range(2):
        assert memory.recall(one_beam, *places).announced().shape == (2,)


def blobs(ping: Ping, least: float = 6.5) -> Detections:
    """Cells above a power, as ratios; clutter here is independent from cell to cell."""
    row, beam = np.nonzero(np.square(ping.amplitude) > least)
    return Detections.of(
        ping,
        range_m=ping.range_m[row],
        bearing_rad=ping.bearing_rad[beam],
        amplitude=ping.amplitude[row, beam],
    )


SETTINGS = {
    "range_sd_m": 0.1,
    "bearing_sd_deg": 4.0,
    "sigma_v_mps2": 0.02,
    "confirm_hits": 4,
    "confirm_score": 12.0,
    "drop_score": -3.0,
    "p_d": 0.7,
    "snr_db": 9.0,
    "keep_hits": 5,
    "lobe_range_m": 0.0,
    "cost": "likelihood",
    "priority": "score",
    "conversion": "polar",
}


def confirmed(correlation: float, memory: bool, speed_mps: float) -> tuple[int, int]:
    """Confirmed tracks near a target of 11 dB and elsewhere, in 40 pings."""
    tracker, near, far = NcvAuction(**SETTINGS), set(), set()  # type: ignore[arg-type]  # its parameters
    for seq, amplitude in zip(range(40), persisting(6, correlation, (700, 120)), strict=False):
        row = round((10.0 + speed_mps * seq) / CELL_M)
        if speed_mps:
            amplitude[row, 60] = np.abs(amplitude[row, 60] + 10.0 ** (11.0 / 20.0))
        ping = around(seq, amplitude.astype(np.float32))
        tracks = tracker(blobs(ping), ping if memory else None)
        sure = tracks.select(tracks.status == TrackStatus.CONFIRMED)
        off = np.abs(np.hypot(*sure.state[:, :2].T) - ping.range_m[row])
        near |= set(sure.id[off < 1.0].tolist())
        far |= set(sure.id[off >= 1.0].tolist())
    return len(near), len(far - near)


def test_persisting_clutter_is_no_evidence_and_a_moving_target_is():
    assert sum(confirmed(0.93, False, 0.0)) > 8
    assert sum(confirmed(0.93, True, 0.0)) <= 1
    near, far = confirmed(0.93, True, 0.3)
    assert near == 1
    assert far <= 1


def test_in_white_clutter_the_ping_changes_next_to_nothing():
    assert confirmed(0.0, True, 0.3)[0] == confirmed(0.0, False, 0.3)[0] == 1


def test_the_contract_is_kept_with_the_ping():
    pings = [
        around(seq, one.astype(np.float32))
        for seq, one in zip(range(8), persisting(7, 0.7, (300, 60)), strict=False)
    ]
    firings = [{"detections": blobs(ping, 4.0), "ping": ping} for ping in pings]
    check_node(NcvAuction(**SETTINGS), firings)  # type: ignore[arg-type]  # its parameters
