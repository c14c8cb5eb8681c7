"""The estimates of a PHD filter as CSV: columns, exact numbers, pings without estimates, restart."""

import csv
from pathlib import Path

import numpy as np
from numpy.testing import assert_array_equal

from fls_flow import Intensity
from fls_flow.testing import check_node
from fls_sinks.estimate_csv import EstimateCsv, fls_node

HEADER = "seq,stamp_ns,expected_targets,x_m,y_m,vx_mps,vy_mps,weight,frame"


def test_a_hand_written_file(tmp_path: Path) -> None:
    sink = EstimateCsv(tmp_path / "e.csv")
    state = np.array([[40.5, -2.0, -1.0, 0.25], [30.0, 0.0, 0.0, 0.0]])
    sink(Intensity(7, 100, 1.75, state, np.array([1.0, 0.5]), np.zeros((2, 4, 4)), "ned"))
    sink(Intensity(9, 200, 0.125))
    sink.close()
    assert (tmp_path / "e.csv").read_text() == (
        f"{HEADER}\n7,100,1.75,40.5,-2.0,-1.0,0.25,1.0,ned\n7,100,1.75,30.0,0.0,0.0,0.0,0.5,ned\n9,200,0.125,,,,,,\n"
    )


def test_numbers_read_back_exactly(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    sink = EstimateCsv(tmp_path / "e.csv")
    sent = [
        Intensity(k, k, rng.random(), rng.normal(size=(n, 4)), rng.random(n), np.zeros((n, 4, 4)))
        for k, n in enumerate([2, 0, 3, 1])
    ]
    for one in sent:
        sink(one)
    sink.close()
    with (tmp_path / "e.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["expected_targets"]) for row in rows] == [
        one.expected_targets for one in sent for _ in range(max(1, len(one)))
    ]
    full = [row for row in rows if row["x_m"]]
    found = [[float(row[c]) for c in ("x_m", "y_m", "vx_mps", "vy_mps")] for row in full]
    assert_array_equal(found, np.concatenate([one.state for one in sent]))


def test_a_numpy_number_is_written_as_a_number(tmp_path: Path) -> None:
    sink = EstimateCsv(tmp_path / "e.csv")
    sink(Intensity(0, 0, np.float64(0.1)))
    sink.close()
    assert (tmp_path / "e.csv").read_text().splitlines()[1] == "0,0,0.1,,,,,,"


def test_contract_and_restart(tmp_path: Path) -> None:
    assert fls_node() is EstimateCsv
    check_node("estimate-csv")
    sink = EstimateCsv(tmp_path / "e.csv")
    sink(Intensity(0, 0, 1.0))
    saved = sink.snapshot()
    sink(Intensity(1, 1, 2.0))
    sink.close()
    again = EstimateCsv(tmp_path / "e.csv")
    again.restore(saved)
    again(Intensity(1, 1, 3.0))
    again.close()
    assert [row[4:7] for row in (tmp_path / "e.csv").read_text().splitlines()[1:]] == ["1.0", "3.0"]
