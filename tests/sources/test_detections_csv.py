"""Files of detections: grouped to pings, exact, with file and line for every fault."""

import logging
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import InputError
from fls_sources.detections_csv import DetectionsCsv

HEADER = "seq,stamp_ns,range_m,bearing_rad,amplitude\n"


@pytest.fixture
def write(tmp_path):
    def written(text, header=HEADER):
        path = tmp_path / "detections.csv"
        path.write_bytes(header.encode() + (text if isinstance(text, bytes) else text.encode()))
        return path

    return written


def play(path, **parameters):
    return list(DetectionsCsv(path, **parameters)())


def test_a_hand_written_file(write):
    got = play(write("3,100,10.5,-0.25,7.0\n3,100,20,0.1,8\n4,200,,,\n9,300,1,0,2\n"))
    assert [(d.seq, d.stamp_ns, len(d)) for d in got] == [(3, 100, 2), (4, 200, 0), (9, 300, 1)]
    assert_array_equal(got[0].range_m, [10.5, 20.0])
    assert_array_equal(got[0].bearing_rad, [-0.25, 0.1])
    assert_array_equal(got[0].amplitude, [7.0, 8.0])
    assert got[1].covariance.shape == (0, 2, 2)


def test_repr_floats_read_back_exactly(write):
    values = np.random.default_rng(0).uniform(0, 3, (50, 3))
    text = "".join(f"1,2,{a!r},{b!r},{c!r}\n" for a, b, c in values.tolist())
    (got,) = play(write(text))
    assert_array_equal(np.column_stack([got.range_m, got.bearing_rad, got.amplitude]), values)


def test_the_view_comes_from_the_parameters(write):
    (got,) = play(
        write("0,0,1,0,1\n"), range_min_m=2.0, range_max_m=80.0, sector_deg=90.0, n_beams=3, range_sd_m=0.1,
        bearing_sd_deg=2.0, sound_speed_mps=1450.0,
    )  # fmt: skip
    view = got.view
    assert (view.range_min_m, view.range_max_m, view.cell_m, view.sound_speed_mps) == (2.0, 80.0, 0.1, 1450.0)
    assert_allclose(np.degrees(view.bearing_rad), [-30.0, 0.0, 30.0])
    assert_allclose(np.degrees(view.beamwidth_rad), 30.0)
    assert_allclose(view.area_m2, 0.5 * np.radians(90.0) * (80.0**2 - 2.0**2))
    assert_allclose(got.covariance[0], np.diag([0.01, np.radians(2.0) ** 2]))


def test_one_beam(write):
    (got,) = play(write("0,0,1,0,1\n"), n_beams=1)
    assert_array_equal(got.view.bearing_rad, [0.0])


@pytest.mark.parametrize(
    "text",
    [
        "1,5\n2,6\n",  # short rows
        "1,5,,,\r\n2,6,,,\r\n",
        "1,5,,,\n\n2,6,,,",  # a blank line, no end of line
        " 1 , 5 , , , \n2,6\n",
        '"1","5","","",""\n2,6\n',
    ],
)
def test_pings_without_detections(write, text):
    assert [(d.seq, d.stamp_ns, len(d)) for d in play(write(text))] == [(1, 5, 0), (2, 6, 0)]


def test_columns_in_any_order_and_more_of_them(write):
    path = write("9,0.5,1,2,30\n", header="amplitude,bearing_rad,seq,stamp_ns,range_m\n")
    (got,) = play(path)
    assert (got.seq, got.stamp_ns, got.range_m[0], got.bearing_rad[0], got.amplitude[0]) == (
        1,
        2,
        30.0,
        0.5,
        9.0,
    )
    path = write("1,2,30,0.5,9,shoal\n", header="\ufeff" + HEADER.strip() + ",remark\n")
    assert len(play(path)[0]) == 1


def test_a_repeated_seq_at_another_time_is_another_ping(write):
    assert [d.stamp_ns for d in play(write("1,5,1,0,1\n1,6,1,0,1\n1,6,2,0,1\n"))] == [5, 6]


def test_no_rows_no_pings(write):
    assert play(write("")) == []


def test_amplitude_may_be_missing(write):
    (got,) = play(write("1,2,3,0.1,\n"))
    assert np.isnan(got.amplitude[0])


def test_messages_share_no_memory(write):
    a, b = play(write("1,2,3,0,1\n2,3,3,0,1\n"))
    assert not np.shares_memory(a.view.bearing_rad, b.view.bearing_rad)
    assert not np.shares_memory(a.range_m, b.range_m)


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("1,2,3,0.1,1\n1,2,far,0.1,1\n", 3, "range_m is 'far'"),
        ("1,2,3\n", 2, "bearing_rad is ''"),
        ("1,2,,0.1,1\n", 2, "range_m is ''"),
        ("1,2,-3,0.1,1\n", 2, "range_m is -3.0"),
        ("1,2,nan,0.1,1\n", 2, "range_m is nan"),
        ("1,2,inf,0.1,1\n", 2, "range_m is inf"),
        ("1,2,3,45,1\n", 2, "are these degrees?"),
        ("1,2,3,nan,1\n", 2, "bearing_rad is nan"),
        ("1,2,3,0.1,loud\n", 2, "amplitude is 'loud'"),
        ("x,2,3,0.1,1\n", 2, "seq is 'x'"),
        ("1,2.5,3,0.1,1\n", 2, "stamp_ns is '2.5'"),
        (f"1,{2**63},3,0.1,1\n", 2, "64 bits"),
        ("1,2\n2,2\n", 3, "stamp_ns 2 does not increase"),
        ("1,5\n2,4\n", 3, "stamp_ns 4 does not increase"),
        ("1,5,1,0,1\n2,6\n1,5,2,0,1\n", 4, "stamp_ns 5 does not increase"),
        ("1,2,3,0.1,1,7\n", 2, "has 6 fields, the header 5"),
        ("1,2\n" + "7" * 70_000, 3, "longer than 65536 characters"),
    ],
)
def test_faults_name_the_line(write, text, line, said):
    path = write(text)
    with pytest.raises(InputError) as caught:
        play(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_faults_of_the_file(write, tmp_path):
    with pytest.raises(
        InputError, match=":1: the header lacks bearing_rad, amplitude; it takes seq,stamp_ns,"
    ):
        play(write("1,2,3\n", header="seq,stamp_ns,range_m\n"))
    with pytest.raises(InputError, match=":1: the header lacks"):
        play(write("", header=""))
    with pytest.raises(InputError, match="no UTF-8 text"):
        play(write(b"1,2,\xff\xfe,0,1\n"))
    with pytest.raises(InputError, match=r"nope\.csv: No such file"):
        play(tmp_path / "nope.csv")


def test_pings_before_a_fault_are_played(write):
    stream = DetectionsCsv(write("1,2,3,0.1,1\n2,3\nx\n"))()
    assert next(stream).seq == 1
    with pytest.raises(InputError, match=":4: seq is 'x'"):
        list(stream)


def test_the_file_is_never_held_whole(write):
    remark = "x" * 1000
    path = write(
        "".join(f"{i},{i},10.0,0.1,1.0,{remark}\n" for i in range(3000)), HEADER.strip() + ",remark\n"
    )
    tracemalloc.start()
    assert sum(1 for _ in DetectionsCsv(path)()) == 3000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < path.stat().st_size / 4


def test_echoes_beyond_the_view_are_warned_of_once(write, caplog):
    with caplog.at_level(logging.WARNING):
        got = play(write("1,2,70,0,1\n2,3,80,0,1\n"))
    assert [d.range_m[0] for d in got] == [70.0, 80.0]
    assert caplog.text.count("beyond range_max_m") == 1


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"range_min_m": -1.0}, "not -1.0"),
        ({"range_min_m": 60.0}, "60.0 and 50.0"),
        ({"sector_deg": 0.0}, "not 0.0"),
        ({"sector_deg": 361.0}, "361"),
        ({"n_beams": 0}, "not 0"),
        ({"range_sd_m": 0.0}, "range_sd_m must be positive, not 0.0"),
        ({"bearing_sd_deg": float("nan")}, "bearing_sd_deg must be positive, not nan"),
        ({"sound_speed_mps": -5.0}, "-5.0"),
    ],
)
def test_bad_parameters_are_named(parameters, said):
    with pytest.raises(ValueError, match=said):
        DetectionsCsv(Path("d.csv"), **parameters)
