"""Files of our own and of other programs read alike, and each fault names file and line."""

import csv
import math

import numpy as np
import pytest

from fls_flow.errors import UserError
from fls_flow.evaluate.table import kind_of, read

TRUTH = "seq,stamp_ns,target_id,x_m,y_m,vx_mps,vy_mps,class,frame"
TRACKS = "seq,stamp_ns,track_id,status,x_m,y_m,vx_mps,vy_mps,var_x,cov_xy,var_y,label,probability,frame"


def same(a, b):
    assert a.seq.tolist() == b.seq.tolist()
    assert a.stamp_ns.tolist() == b.stamp_ns.tolist()
    assert a.ping.tolist() == b.ping.tolist()
    assert a.frame == b.frame
    assert a.columns.keys() == b.columns.keys()
    for name, column in a.columns.items():
        assert np.array_equal(column, b.columns[name], equal_nan=column.dtype.kind == "f")


def test_rows_become_columns_and_a_ping_without_entries_stays(write):
    table = read(
        write(
            "truth.csv", TRUTH, "3,30,7,1.5,-2.25,0.1,0.2,buoy,sensor", "3,30,9,4,5,,,,sensor", "4,40,,,,,,,"
        ),
        "truth",
    )
    assert table.seq.tolist() == [3, 4]
    assert table.stamp_ns.tolist() == [30, 40]
    assert table.ping.tolist() == [0, 0]
    assert table.line.tolist() == [2, 3]
    assert table.columns["target_id"].tolist() == [7, 9]
    assert table.columns["x_m"].tolist() == [1.5, 4.0]
    assert table.columns["class"].tolist() == ["buoy", ""]
    assert math.isnan(table.columns["vx_mps"][1])


def test_floats_read_back_exactly(write):
    values = [0.1, 1 / 3, 5e-324, 999999999.9999999, -0.0, 123456.789]
    path = write("truth.csv", TRUTH, *(f"{n},{n},1,{value!r},0,,,,sensor" for n, value in enumerate(values)))
    assert read(path, "truth").columns["x_m"].tolist() == values


def test_stamps_keep_all_their_digits(write):
    path = write(
        "truth.csv",
        TRUTH,
        "0,1371024000000000001,1,0,0,,,,sensor",
        "1,1.371024000000000003e18,1,0,0,,,,sensor",
    )
    assert read(path, "truth").stamp_ns.tolist() == [1371024000000000001, 1371024000000000003]


def test_the_way_of_writing_does_not_matter(tmp_path, write):
    rows = [
        "0,10,1,1000,2,0.5,0,buoy,sensor",
        "0,10,2,3,4,0,0,boat,sensor",
        "1,20,,,,,,,",
        "2,30,1,5,6,0,0,buoy,sensor",
    ]
    plain = read(write("a.csv", TRUTH, *rows), "truth")
    names = TRUTH.split(",")
    order = [8, 3, 4, 0, 1, 2, 7, 6, 5]

    def shuffled(row, extra):
        cells = row.split(",")
        return ",".join([*(cells[n] for n in order), extra])

    text = "\r\n".join([shuffled(TRUTH, "remark"), *(shuffled(row, "x") for row in reversed(rows))])
    text = text.replace("1000", "1e3").replace("buoy", " buoy ").replace(",1,x", ",1.0,x")
    other = tmp_path / "b.csv"
    other.write_bytes(b"\xef\xbb\xbf" + text.encode() + b"\r\n\r\n")
    found = read(other, "truth")
    # rows of one ping stay in the order of the file
    assert sorted(names) == sorted(shuffled(TRUTH, "").rstrip(",").split(","))
    assert found.columns["target_id"].tolist() == [2, 1, 1]
    back = [1, 0, 2]
    assert found.stamp_ns.tolist() == plain.stamp_ns.tolist()
    for name, column in plain.columns.items():
        assert np.array_equal(column, found.columns[name][back])


def test_ids_that_a_table_program_turned_into_floats_are_read(write):
    """A column of whole numbers with gaps comes out of many programs as 1.0, 2.0, ..."""
    table = read(write("t.csv", "seq,stamp_ns,track_id,x_m,y_m", "0,1,7.0,1,2", "1.0,2,,,"), "tracks")
    assert table.columns["track_id"].tolist() == [7]
    assert table.seq.tolist() == [0, 1]


def test_optional_columns_may_be_missing_and_rows_short(write):
    table = read(write("t.csv", "seq,stamp_ns,track_id,x_m,y_m", "0,1,7,1,2", "1,2"), "tracks")
    assert table.frame == "sensor"
    assert "status" not in table.columns
    assert table.stamp_ns.tolist() == [1, 2]


def test_an_estimate_file_keeps_the_expected_number_of_empty_pings(write):
    header = "seq,stamp_ns,expected_targets,x_m,y_m,vx_mps,vy_mps,weight,frame"
    table = read(
        write(
            "e.csv", header, "0,1,1.75,1,2,0,0,0.9,sensor", "0,1,1.75,3,4,0,0,0.8,sensor", "1,2,0.25,,,,,,"
        ),
        "estimates",
    )
    assert table.expected_targets.tolist() == [1.75, 0.25]
    assert table.ping.tolist() == [0, 0]


def test_chunks_do_not_show(write, monkeypatch):
    rows = [f"{n},{n * 10},{n % 3},{n}.5,0,,,,sensor" for n in range(23)]
    path = write("t.csv", TRUTH, *rows)
    whole = read(path, "truth")
    for size in (1, 5, 23, 24):
        monkeypatch.setattr("fls_flow.evaluate.columns.CHUNK_ROWS", size)
        same(read(path, "truth"), whole)


def test_a_header_alone_is_an_empty_file(write):
    table = read(write("t.csv", TRUTH), "truth")
    assert table.stamp_ns.size == table.ping.size == 0


def test_what_the_sinks_write_is_read(tmp_path):
    csv_rows = [
        TRACKS.split(","),
        [0, 5, 1, "tentative", 1.0, 2.0, 0.1, 0.2, 1.0, 0.5, 2.0, "diver", 0.75, "ned"],
        [1, 6, *[""] * 12],
    ]
    path = tmp_path / "tracks.csv"
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(csv_rows)
    table = read(path, "tracks")
    assert table.frame == "ned"
    assert table.columns["probability"].tolist() == [0.75]


@pytest.mark.parametrize(
    ("header", "rows", "line", "says"),
    [
        ("seq,stamp_ns,x_m,y_m", (), 1, "the header lacks target_id"),
        ("seq;stamp_ns;target_id;x_m;y_m", (), 1, "separated by ';'"),
        (TRUTH + ",x_m", (), 1, "x_m twice"),
        (TRUTH, ("0,1,1,two,0,,,,sensor",), 2, "x_m is 'two'; it takes a number"),
        (TRUTH, ("0,1,1,0,0,,,,sensor", "", "1,2,1,,0,,,,sensor"), 4, "x_m is ''; it takes a finite number"),
        (TRUTH, ("0,1,1,nan,0,,,,sensor",), 2, "x_m is 'nan'"),
        (TRUTH, ("0,1,1,0,inf,,,,sensor",), 2, "y_m is 'inf'"),
        (TRUTH, ("0,1,1.5,0,0,,,,sensor",), 2, "target_id is '1.5'; it takes a whole number"),
        (TRUTH, ("0,,1,0,0,,,,sensor",), 2, "stamp_ns is ''; it takes a whole number"),
        (TRUTH, ("0,-1,1,0,0,,,,sensor",), 2, "stamp_ns is -1; it lies between 0 and"),
        (TRUTH, ("0,1,1,1e10,0,,,,sensor",), 2, "x_m is 10000000000.0; it lies between -1e+09 and 1e+09"),
        (TRUTH, ("0,1e400000000,1,0,0,,,,sensor",), 2, "stamp_ns is 1e400000000; it takes 64 bits"),
        (TRUTH, ("0,1e30,1,0,0,,,,sensor",), 2, "stamp_ns is 1e30; it takes 64 bits"),
        (TRUTH, ("0,1,1,0,0,,,,sensor,9",), 2, "has 10 fields, the header 9"),
        (TRUTH, ("0,1,,3,0,,,,sensor",), 2, "has x_m but no target_id"),
        (TRUTH, ("0,1,1,0,0,,,,sensor", "0,1,1,2,2,,,,sensor"), 3, "target_id 1 stands twice in ping seq 0"),
        (TRUTH, ("0,1,1,0,0,,,,sensor", "9,1,2,2,2,,,,sensor"), 3, "stamp_ns 1 is that of seq 0 too"),
        (TRUTH, ("0,1,1,0,0,,,,sensor", "1,2,1,0,0,,,,ned"), 3, "frame is 'ned' after 'sensor'"),
        (TRUTH, ("0,1,1,0,0,,,,map",), 2, "frame is 'map'; it takes sensor, ned"),
        (TRUTH, ('0,1,1,0,0,,,"a\nb",sensor',), 2, "a quoted field spans lines"),
    ],
)  # fmt: skip
def test_a_fault_names_file_line_and_value(write, header, rows, line, says):
    path = write("truth.csv", header, *rows)
    with pytest.raises(UserError) as caught:
        read(path, "truth")
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "header", "row", "says"),
    [
        ("tracks", TRACKS, "0,1,1,sure,0,0,,,,,,,,sensor", "status is 'sure'; it takes tentative"),
        ("tracks", TRACKS, "0,1,1,confirmed,0,0,,,,,,diver,1.5,sensor", "probability is 1.5"),
        ("detections", "seq,stamp_ns,range_m,bearing_rad", "0,1,-3,0", "range_m is -3.0"),
        ("detections", "seq,stamp_ns,range_m,bearing_rad", "0,1,3,45", "bearing_rad is 45.0"),
    ],
)
def test_values_that_cannot_be_are_refused(write, kind, header, row, says):
    with pytest.raises(UserError, match=says.replace(".", "\\.")):
        read(write("f.csv", header, row), kind)


def test_a_fault_behind_the_first_chunk_names_its_line(write, monkeypatch):
    monkeypatch.setattr("fls_flow.evaluate.columns.CHUNK_ROWS", 4)
    path = write("t.csv", TRUTH, *(f"{n},{n},1,0,0,,,,sensor" for n in range(9)), "9,9,1,x,0,,,,sensor")
    with pytest.raises(UserError, match=r"t\.csv:11: x_m is 'x'"):
        read(path, "truth")


def test_what_is_no_text_is_refused(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(TRUTH.encode("utf-16"))
    with pytest.raises(UserError, match="UTF-8"):
        read(path, "truth")
    path.write_bytes(TRUTH.encode() + b"\n" + b"0,1,1,0,0,,,na\xefve,sensor\n")
    with pytest.raises(UserError, match="UTF-8"):
        read(path, "truth")


@pytest.mark.parametrize(
    "content", [b"\xff\xfe\x00", b"\x80" * 9000, b"x" * 200_000, b"", b"\x00,\x00\n", b"\n\n"]
)
def test_no_table_at_all_is_one_line(tmp_path, content):
    path = tmp_path / "t.csv"
    path.write_bytes(content)

    def look():
        assert kind_of(path) is None
        read(path, "truth")

    with pytest.raises(UserError, match=r"t\.csv") as caught:
        look()
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"none\.csv: No such file"):
        read(tmp_path / "none.csv", "truth")
    with pytest.raises(UserError, match="directory"):
        read(tmp_path, "truth")


@pytest.mark.parametrize(
    ("header", "kind"),
    [
        (TRUTH, "truth"),
        (TRACKS, "tracks"),
        ("seq,stamp_ns,range_m,bearing_rad,amplitude", "detections"),
        ("seq,stamp_ns,expected_targets,x_m,y_m", "estimates"),
        ("a,b", None),
        ("", None),
    ],
)
def test_the_header_says_what_a_file_is(write, header, kind):
    assert kind_of(write("f.csv", header)) == kind


def test_a_table_of_features_is_none_of_the_four(write):
    assert kind_of(write("f.csv", "seq,stamp_ns,track_id,area,area.mean")) is None
    assert (
        kind_of(write("t.csv", "seq,stamp_ns,track_id,y_m")) == "tracks"
    )  # one that lacks x_m, as read() says


@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_another_separator_than_the_comma_is_named(write, separator):
    path = write("tracks.csv", TRACKS.replace(",", separator), "0,0,1".replace(",", separator))
    with pytest.raises(UserError, match="columns are separated by") as raised:
        kind_of(path)
    assert str(raised.value) == f"{path}:1: its columns are separated by {separator!r}; save it with commas"


def test_another_table_with_such_a_separator_is_none_of_ours(write):
    assert kind_of(write("prices.csv", "name;price", "sonar;1")) is None
