"""The sink `feature-table`, as CSV and as Parquet."""

import csv
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from numpy.testing import assert_array_equal

from fls_flow import Features, InputError
from fls_flow.testing import check_node
from fls_sinks.feature_table import FeatureTable

NAMES = ("area", "area.mean")


@pytest.fixture
def described(rng):
    def made(seq, ids=(), names=NAMES):
        values = rng.normal(size=(len(ids), len(names))) * 10.0 ** rng.integers(-300, 300, (len(ids), 1))
        return Features(seq, 2**60 + seq, np.array(ids, np.int64), names, values)

    return made


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def read(path):
    if path.suffix == ".parquet":
        return pyarrow.parquet.read_table(path).to_pylist()
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_hand_written_file(tmp_path):
    sink = FeatureTable(tmp_path / "f.csv")
    sink(Features(3, 100))
    sink(Features(4, 200, np.array([7, 9]), NAMES, np.array([[1.5, 0.1], [2.0, -1e-9]])))
    sink(Features(5, 300, names=NAMES))
    sink.close()
    assert (tmp_path / "f.csv").read_text() == (
        "seq,stamp_ns,track_id,area,area.mean\n4,200,7,1.5,0.1\n4,200,9,2.0,-1e-09\n"
    )


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_numbers_read_back_exactly(tmp_path, described, suffix):
    path = tmp_path / f"f{suffix}"
    sink, sent = FeatureTable(path), [described(seq, range(seq % 4)) for seq in range(9)]
    for features in sent:
        sink(features)
    sink.close()
    rows = read(path)
    assert list(rows[0]) == ["seq", "stamp_ns", "track_id", *NAMES]
    assert_array_equal(
        [[float(row[name]) for name in NAMES] for row in rows], np.concatenate([one.values for one in sent])
    )
    assert [int(row["stamp_ns"]) for row in rows] == [one.stamp_ns for one in sent for _ in range(len(one))]
    assert [int(row["track_id"]) for row in rows] == [n for one in sent for n in one.track_id]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_run_without_features_leaves_the_header(tmp_path, suffix):
    sink = FeatureTable(tmp_path / f"f{suffix}")
    sink(Features(0, 0, names=NAMES))
    sink.close()
    sink.close()
    if suffix == ".csv":
        assert (tmp_path / "f.csv").read_text() == "seq,stamp_ns,track_id,area,area.mean\n"
    else:
        assert pyarrow.parquet.read_schema(tmp_path / "f.parquet").names == [
            "seq",
            "stamp_ns",
            "track_id",
            *NAMES,
        ]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_no_file_is_replaced(tmp_path, described, suffix):
    path = tmp_path / f"f{suffix}"
    path.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        FeatureTable(path)(described(0, [1]))
    assert path.read_text() == "mine"


def test_no_file_is_replaced_that_came_during_the_run(tmp_path, described):
    sink = FeatureTable(tmp_path / "f.parquet")
    sink(described(0, [1]))
    (tmp_path / "f.parquet").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        sink.close()
    assert [one.read_text() for one in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_after_a_restart_the_file_is_whole(tmp_path, described, suffix):
    sent = [described(seq, range(seq % 3)) for seq in range(10)]
    whole, first, second = (FeatureTable(tmp_path / name / f"f{suffix}") for name in ("whole", "cut", "cut"))
    for features in sent:
        whole(features)
    for features in sent[:5]:
        first(features)
    state = first.snapshot()
    for features in sent[5:8]:
        first(features)  # lost with the process
    if suffix == ".csv":
        first.close()
    second.restore(state)
    for features in sent[5:]:
        second(features)
    for sink in (whole, second):
        sink.close()
    assert read(tmp_path / "whole" / f"f{suffix}") == read(tmp_path / "cut" / f"f{suffix}")


def test_names_that_change_are_an_error(tmp_path, described):
    sink = FeatureTable(tmp_path / "f.csv")
    sink(described(0, [1]))
    with pytest.raises(InputError, match="features change"):
        sink(described(1, [1], names=("area", "other")))
    sink.close()


def test_other_formats_are_refused():
    with pytest.raises(ValueError, match=r"path must end in \.csv or \.parquet"):
        FeatureTable("features.xlsx")


def test_the_sink_keeps_the_contract(described):
    firings = [{"features": described(seq, range(seq % 3))} for seq in range(6)]
    check_node(FeatureTable(Path("f.csv")), firings)
