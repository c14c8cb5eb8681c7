"""Blobs of the angle-distance matrix: false alarms against theory, labels against a slow reference, edges."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fls_detectors.array_blobs import blobs_of, closes_circle, joined_hits
from fls_detectors.array_cfar import ArrayCfar
from fls_detectors.mean_energy import MeanEnergy, ring_energy
from fls_flow import Ping
from fls_flow.testing import check_node

CELL_M = 0.038


def around(amplitude: npt.NDArray[np.generic], *, valid: npt.NDArray[np.bool_] | None = None) -> Ping:
    """A ping whose beams go all round, from -179 to 180 degrees if there are 360."""
    n_ranges, n_beams = amplitude.shape
    bearing = np.radians(360.0 / n_beams * (np.arange(n_beams) + 1) - 180.0)
    return Ping(3, 5_000, amplitude, 20.0 + CELL_M * np.arange(n_ranges), bearing, valid)  # type: ignore[arg-type]  # any dtype


def clutter(seed: int, shape: tuple[int, int] = (1500, 360)) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).rayleigh(1.0, shape).astype(np.float32)


def labels_by_flooding(hits: npt.NDArray[np.bool_], closed: bool) -> npt.NDArray[np.int64]:
    """The slow reference: flood every blob in turn."""
    label = np.full(hits.shape, -1)
    count = 0
    for start in zip(*np.nonzero(hits), strict=True):
        if label[start] >= 0:
            continue
        label[start], todo = count, [start]
        while todo:
            r, b = todo.pop()
            for dr, db in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                i, j = r + dr, b + db
                if closed:
                    j %= hits.shape[1]
                if 0 <= i < hits.shape[0] and 0 <= j < hits.shape[1] and hits[i, j] and label[i, j] < 0:
                    label[i, j] = count
                    todo.append((i, j))
        count += 1
    return label[hits]


@pytest.mark.parametrize("pfa", [1e-2, 1e-3])
@pytest.mark.parametrize("references", [8, 32])
def test_false_alarms_come_at_the_rate_asked_for(pfa: float, references: int):
    # Independent cells here: a stride of two cells in the node, of one in the clutter.
    rate = np.mean(
        [ArrayCfar(pfa=pfa, references=references).hits(around(clutter(s))).mean() for s in (1, 2)]
    )
    assert abs(rate - pfa) < 5.0 * np.sqrt(pfa / (2 * 1500 * 360))


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("density", [0.05, 0.4, 0.6])
def test_labels_are_those_of_a_flood(closed: bool, density: float):
    for seed in range(20):
        hits = np.random.default_rng(seed).random((9, 7)) < density
        row, beam = np.nonzero(hits)
        of, n = joined_hits(row, beam, 7, closed)
        expected = labels_by_flooding(hits, closed)
        assert np.array_equal(of, expected)
        assert n == (expected.max() + 1 if expected.size else 0)


def test_a_blob_over_the_seam_is_one_with_its_centre_on_the_seam():
    amplitude = np.zeros((50, 360), np.float32)
    amplitude[20:23, [358, 359, 0, 1]] = 1.0  # 179, 180, -179, -178 degrees
    blobs = blobs_of(around(amplitude), amplitude > 0)
    assert blobs.cells.tolist() == [12]
    assert np.degrees(blobs.bearing_rad[0]) == pytest.approx(-179.5)
    assert blobs.range_m[0] == pytest.approx(20.0 + 21 * CELL_M)
    assert np.degrees(blobs.extent[0, 1]) == pytest.approx(3.0)
    assert blobs.extent[0, 0] == pytest.approx(2 * CELL_M)


def test_corners_do_not_connect():
    amplitude = np.eye(4, dtype=np.float32)[:, [0, 1, 2, 3]]
    assert (
        blobs_of(
            around(np.pad(amplitude, ((0, 0), (0, 8)))), np.pad(amplitude, ((0, 0), (0, 8))) > 0
        ).cells.tolist()
        == [1] * 4
    )


def test_power_weights_draw_the_centre_to_the_strong_cell():
    amplitude = np.zeros((30, 36), np.float32)
    amplitude[10, 5:7] = (1.0, 3.0)
    ping = around(amplitude)
    plain, weighted = blobs_of(ping, amplitude > 0), blobs_of(ping, amplitude > 0, by_power=True)
    one, other = ping.bearing_rad[5:7]
    assert plain.bearing_rad[0] == pytest.approx(0.5 * (one + other))
    assert weighted.bearing_rad[0] == pytest.approx(0.1 * one + 0.9 * other)
    assert weighted.peak[0] == 3.0


def test_which_beams_close_the_circle():
    degrees = np.arange(-179.0, 181.0)
    assert closes_circle(np.radians(degrees))
    assert closes_circle(np.radians(degrees[::-1]))
    assert not closes_circle(np.radians(degrees[:300]))
    assert not closes_circle(np.radians(np.append(degrees, 181.0)))  # the first beam twice
    assert not closes_circle(np.zeros(1))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_an_echo_is_found_where_it_is_in_every_dtype(dtype: type):
    amplitude = np.minimum(20.0 * clutter(4, (600, 90)), 250.0)
    amplitude[300:304, 40:42] = 255.0
    found = ArrayCfar(pfa=1e-7)(around(amplitude.astype(dtype)))
    assert len(found) == 1
    assert found.range_m[0] == pytest.approx(20.0 + 301.5 * CELL_M)
    assert found.amplitude[0] == 255.0


def test_sizes_are_limited():
    amplitude = np.full((600, 360), 0.1, np.float32)
    amplitude[100, 10] = 10.0  # one cell: too small
    amplitude[200:203, 20:22] = 10.0
    amplitude[300, 100:140] = 10.0  # 39 degrees: too wide
    assert np.round(ArrayCfar()(around(amplitude)).range_m, 3).tolist() == [round(20.0 + 201 * CELL_M, 3)]
    assert len(ArrayCfar(min_cells=1)(around(amplitude))) == 2
    assert len(ArrayCfar(max_bearing_deg=60.0)(around(amplitude))) == 2


def test_what_is_not_known_is_neither_tested_nor_reference():
    amplitude = clutter(5, (400, 40))
    amplitude[100:200, 5] = np.nan
    valid = np.ones(amplitude.shape, bool)
    valid[:, 7] = False
    amplitude[300:304, 7:9] = 50.0
    hits = ArrayCfar(pfa=1e-6, min_cells=1).hits(around(amplitude, valid=valid))
    assert not hits[:, 7].any()
    assert not hits[100:200, 5].any()
    assert hits[300:304, 8].all()


def test_ratios_do_not_depend_on_the_level_of_the_clutter():
    amplitude = clutter(6, (900, 40))
    amplitude[200, 10] = amplitude[700, 10] = 30.0
    amplitude[450:] *= 100.0
    found = ArrayCfar(pfa=1e-9, min_cells=1, amplitude="ratio")(around(amplitude))
    assert len(found) == 2
    assert (np.abs(found.amplitude * np.sqrt(2.0) / 30.0 - 1.0) < 0.3).all()


def test_only_the_highest_are_kept_when_there_are_too_many(caplog: pytest.LogCaptureFixture):
    ping = around(clutter(7, (400, 90)))
    all_of_them = ArrayCfar(pfa=1e-2, min_cells=1)(ping)
    node = ArrayCfar(pfa=1e-2, min_cells=1, max_detections=10)
    few = node(ping)
    assert sorted(few.amplitude) == sorted(np.sort(all_of_them.amplitude)[-10:])
    assert (np.diff(few.range_m) >= -3 * CELL_M).all()
    node(ping)
    assert len(caplog.records) == 1


@pytest.mark.parametrize("node", [ArrayCfar(), MeanEnergy()])
@pytest.mark.parametrize("shape", [(0, 0), (1, 5), (5, 1), (3, 3)])
def test_small_pings_are_answered(node: ArrayCfar | MeanEnergy, shape: tuple[int, int]):
    n_ranges, n_beams = shape
    ping = Ping(
        9, 11, np.ones(shape, np.float32), np.arange(float(n_ranges)), np.arange(float(n_beams)) / 9.0
    )
    found = node(ping)
    assert (found.seq, found.stamp_ns) == (9, 11)
    assert len(found) in (0, 1)


@pytest.mark.parametrize(
    ("bad", "text"),
    [
        ({"pfa": 0.0}, "pfa"),
        ({"references": 12}, "12"),
        ({"min_ref": 99}, "99"),
        ({"stride_m": -1.0}, "-1.0"),
        ({"min_cells": 0}, "0"),
        ({"centroid": "peak"}, "peak"),
        ({"guard_m": np.inf}, "inf"),
    ],
)
def test_bad_parameters_are_named(bad: dict[str, object], text: str):
    with pytest.raises(ValueError, match=text):
        ArrayCfar(**bad)  # type: ignore[arg-type]  # they are wrong


def test_mean_energy_has_its_rate_and_sees_no_change_of_level():
    amplitude = clutter(8, (3000, 200))
    amplitude *= np.linspace(10.0, 1.0, 3000, dtype=np.float32)[:, None]
    found = MeanEnergy(pfa=1e-3, window_m=4.0)(around(amplitude))
    assert 0.9 * 600 < len(found) < 1.05 * 600  # some touch
    assert abs(np.mean(found.range_m) - (20.0 + 1500 * CELL_M)) < 5.0


def test_ring_energy_is_the_mean_of_what_is_known():
    power = np.random.default_rng(1).random((40, 6))
    known = np.random.default_rng(2).random((40, 6)) < 0.8
    power[~known] = 0.0
    energy = ring_energy(power.sum(axis=1), known.sum(axis=1), 3)
    for m in (0, 1, 20, 39):
        rows = slice(max(m - 3, 0), m + 4)
        assert energy[m] == pytest.approx(power[rows][known[rows]].mean(), rel=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_mean_energy_knows_nothing_of_cells_without_data(dtype: type):
    amplitude = np.minimum(20.0 * clutter(9, (300, 60)), 255.0).astype(dtype)
    valid = np.ones(amplitude.shape, bool)
    amplitude[100:110, 5], valid[100:110, 5] = 255, False
    if dtype is np.float32:
        amplitude[200, 7] = np.inf
    cells, known = amplitude.astype(float), valid & np.isfinite(amplitude)
    slow = np.zeros(amplitude.shape, bool)
    for m in range(300):
        rows = slice(max(m - 26, 0), m + 27)  # 1 m to either side
        limit = -np.log(0.05) * np.mean(np.square(cells[rows][known[rows]]))
        slow[m] = known[m] & (np.square(cells[m]) > limit)
    found = MeanEnergy(pfa=0.05, window_m=2.0)(around(amplitude, valid=valid))
    assert len(found) == blobs_of(around(amplitude), slow).peak.size > 100


def test_nodes_keep_the_contract():
    pings = [{"ping": around(clutter(s, (300, 72)))} for s in range(4)]
    check_node(ArrayCfar(pfa=1e-2, min_cells=1), pings)
    check_node(MeanEnergy(pfa=1e-2), pings)
    check_node(ArrayCfar)
    check_node(MeanEnergy)
