"""The three CSV sinks: columns, exact numbers, empty pings, and whole files after a restart."""

import csv
import resource
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fls_flow import Classes, Detections, InputError, Ping, Tracks, Truth
from fls_sinks.csv_file import CsvFile
from fls_sinks.detection_csv import DetectionCsv
from fls_sinks.track_csv import TrackCsv
from fls_sinks.truth_csv import TruthCsv
from fls_sources.detections_csv import DetectionsCsv

TRACKS = "seq,stamp_ns,track_id,status,x_m,y_m,vx_mps,vy_mps,var_x,cov_xy,var_y,label,probability,frame"
DETECTIONS = "seq,stamp_ns,range_m,bearing_rad,amplitude"
TRUTH = "seq,stamp_ns,target_id,x_m,y_m,vx_mps,vy_mps,class,frame"


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_hand_written_file(tmp_path):
    sink = TrackCsv(tmp_path / "t.csv")
    covariance = np.diag([1.0, 4.0, 9.0, 16.0])
    covariance[0, 1] = covariance[1, 0] = -0.5
    tracks = Tracks(
        7, 100, np.array([5]), np.array([1], np.uint8), np.array([[1.5, -2.0, 0.25, 0.1]]), covariance[None],
        np.ones(1), np.ones(1),
    )  # fmt: skip
    sink(tracks)
    sink(Tracks(9, 200))
    sink.close()
    assert (tmp_path / "t.csv").read_text() == (
        f"{TRACKS}\n7,100,5,confirmed,1.5,-2.0,0.25,0.1,1.0,-0.5,4.0,,,sensor\n9,200,,,,,,,,,,,,\n"
    )


def test_numbers_read_back_exactly(tmp_path, make_tracks):
    sink = TrackCsv(tmp_path / "t.csv")
    sent = [make_tracks(seq, ids=range(seq % 5)) for seq in range(20)]
    for tracks in sent:
        sink(tracks)
    sink.close()
    rows = [row for row in read(tmp_path / "t.csv") if row["track_id"]]
    columns = ("x_m", "y_m", "vx_mps", "vy_mps")
    assert_array_equal(
        [[float(row[c]) for c in columns] for row in rows], np.concatenate([t.state for t in sent])
    )
    assert_array_equal(
        [[float(row[c]) for c in ("var_x", "cov_xy", "var_y")] for row in rows],
        np.concatenate([t.covariance[:, [0, 0, 1], [0, 1, 1]] for t in sent]),
    )


@pytest.mark.parametrize("value", [5e-324, 1 / 3, -0.0, 1.7976931348623157e308, np.pi * 1e-9, np.inf, np.nan])
def test_awkward_floats_read_back_exactly(tmp_path, value):
    sink = DetectionCsv(tmp_path / "d.csv")
    sink(Detections(0, 0, [1.0], [value], [2.0], np.zeros((1, 2)), np.zeros((1, 2, 2)), np.zeros(1)))
    sink.close()
    back = float(read(tmp_path / "d.csv")[0]["bearing_rad"])
    assert_array_equal(np.float64(back).view(np.uint64), np.float64(value).view(np.uint64))


def test_every_row_has_every_field_in_the_order_of_pings(tmp_path, make_tracks):
    sink = TrackCsv(tmp_path / "t.csv")
    for seq in range(6):
        sink(make_tracks(seq, ids=(3, 4)) if seq != 2 else Tracks(seq, 1))
    sink.close()
    with (tmp_path / "t.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header == TRACKS.split(",")
    assert {len(row) for row in rows} == {len(header)}
    assert [int(row[0]) for row in rows] == [0, 0, 1, 1, 2, 3, 3, 4, 4, 5, 5]
    assert rows[4][2:] == [""] * (len(header) - 2)


def test_seq_and_stamp_keep_all_bits(tmp_path):
    stamp, seq = 1_893_456_000_123_456_789, 2**62 + 1
    sink = DetectionCsv(tmp_path / "d.csv")
    sink(Detections(seq, stamp))
    sink.close()
    assert (tmp_path / "d.csv").read_text() == f"{DETECTIONS}\n{seq},{stamp},,,\n"


def test_status_is_a_word(tmp_path, make_tracks):
    sink = TrackCsv(tmp_path / "t.csv")
    sink(make_tracks(ids=(1, 2, 3), status=(0, 1, 2)))
    sink.close()
    assert [row["status"] for row in read(tmp_path / "t.csv")] == ["tentative", "confirmed", "lost"]


def test_classes_join_by_track_id_in_any_order(tmp_path, make_tracks):
    sink = TrackCsv(tmp_path / "t.csv")
    classes = Classes(
        0,
        0,
        np.array([9, 1]),
        ("buoy", 'diver, "scuba"'),
        np.array([0, 1]),
        np.array([[0.75, 0.25], [0.1, 0.9]]),
    )
    sink(make_tracks(ids=(1, 5, 9)), classes)
    sink.close()
    joined = [(row["track_id"], row["label"], row["probability"]) for row in read(tmp_path / "t.csv")]
    assert joined == [("1", 'diver, "scuba"', "0.9"), ("5", "", ""), ("9", "buoy", "0.75")]


def test_a_track_without_a_class_has_no_label(tmp_path, make_tracks):
    sink = TrackCsv(tmp_path / "t.csv")
    sink(make_tracks(ids=(1,)), Classes(0, 0, np.array([1]), (), np.array([-1]), np.zeros((1, 0))))
    sink.close()
    assert read(tmp_path / "t.csv")[0]["label"] == ""


def test_truth(tmp_path):
    sink = TruthCsv(tmp_path / "truth.csv")
    sink(Truth(1, 2, np.array([4, 3]), np.arange(8.0).reshape(2, 4), ("buoy", "boat"), "ned"))
    sink(Truth(2, 3, np.array([4]), np.zeros((1, 4)), ("",)))
    sink(Truth(3, 4))
    sink.close()
    assert (tmp_path / "truth.csv").read_text() == (
        f"{TRUTH}\n1,2,4,0.0,1.0,2.0,3.0,buoy,ned\n1,2,3,4.0,5.0,6.0,7.0,boat,ned\n"
        "2,3,4,0.0,0.0,0.0,0.0,,sensor\n3,4,,,,,,,\n"
    )


def test_detections_keep_their_order(tmp_path, make_ping):
    ping: Ping = make_ping(3)
    sink = DetectionCsv(tmp_path / "d.csv")
    sink(Detections.of(ping, range_m=[9.0, 1.0, 5.0], bearing_rad=[0.0, 0.1, -0.1], amplitude=[1, 2, 3]))
    sink.close()
    assert [float(row["range_m"]) for row in read(tmp_path / "d.csv")] == [9.0, 1.0, 5.0]


@pytest.mark.parametrize(
    ("sink", "columns"), [(TrackCsv, TRACKS), (DetectionCsv, DETECTIONS), (TruthCsv, TRUTH)]
)
def test_a_run_without_pings_leaves_the_header(tmp_path, sink, columns):
    node = sink(tmp_path / "deep" / "x.csv")
    assert not (tmp_path / "deep").exists()
    node.close()
    node.close()
    assert (tmp_path / "deep" / "x.csv").read_text() == columns + "\n"


def test_defaults_are_the_names_of_the_contract():
    assert (TrackCsv().path, DetectionCsv().path, TruthCsv().path) == (
        Path("tracks.csv"),
        Path("detections.csv"),
        Path("truth.csv"),
    )


def test_every_ping_is_on_disk_when_the_call_returns(tmp_path, make_tracks):
    sink = TrackCsv(tmp_path / "t.csv")
    for seq in range(5):
        sink(make_tracks(seq))
        text = (tmp_path / "t.csv").read_text()
        assert text.endswith("\n")
        assert text.count("\n") == 1 + 2 * (seq + 1)
    sink.close()


def test_another_run_is_never_overwritten(tmp_path):
    (tmp_path / "t.csv").write_text("precious")
    sink = TrackCsv(tmp_path / "t.csv")
    with pytest.raises(InputError, match=r"t\.csv: exists already"):
        sink(Tracks(0, 0))
    with pytest.raises(InputError, match=r"t\.csv: exists already"):
        sink.close()
    assert (tmp_path / "t.csv").read_text() == "precious"


def test_a_path_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written") as caught:
        TrackCsv(tmp_path / "file" / "t.csv")(Tracks(0, 0))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("stop", [0, 1, 4, 9])
def test_a_restart_gives_the_same_bytes(tmp_path, make_tracks, stop):
    sent = [make_tracks(seq, ids=range(seq % 4)) for seq in range(10)]
    whole = TrackCsv(tmp_path / "whole.csv")
    for tracks in sent:
        whole(tracks)
    whole.close()

    crashed = TrackCsv(tmp_path / "t.csv")
    for tracks in sent[:stop]:
        crashed(tracks)
    snapshot = crashed.snapshot()
    for tracks in sent[stop : stop + 3]:
        crashed(tracks)
    with (tmp_path / "t.csv").open("ab") as file:
        file.write(b"99,torn ro")

    again = TrackCsv(tmp_path / "t.csv")
    again.restore(snapshot)
    for tracks in sent[stop:]:
        again(tracks)
    again.close()
    crashed._file._file.close()  # the crashed process's descriptor
    assert (tmp_path / "t.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()


def test_a_restart_after_the_last_ping_keeps_the_file(tmp_path, make_tracks):
    first = TrackCsv(tmp_path / "t.csv")
    first(make_tracks(0))
    snapshot, before = first.snapshot(), (tmp_path / "t.csv").read_bytes()
    first.close()
    again = TrackCsv(tmp_path / "t.csv")
    again.restore(snapshot)
    again.close()
    assert (tmp_path / "t.csv").read_bytes() == before


def test_where_the_disk_is_full_the_last_row_is_whole(tmp_path, make_tracks):
    path = tmp_path / "t.csv"
    sink = TrackCsv(path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, hard))
    try:
        with pytest.raises(InputError, match=r"t\.csv: cannot be written \(File too large\)"):
            deque(map(sink, map(make_tracks, range(100))), maxlen=0)
        sink.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    text = path.read_text()
    assert 3000 < len(text) <= 4000
    assert text.endswith("\n")
    assert {len(row) for row in csv.reader(text.splitlines())} == {len(TRACKS.split(","))}


def test_a_restart_on_a_shorter_file_is_refused(tmp_path, make_tracks):
    first = TrackCsv(tmp_path / "t.csv")
    first(make_tracks(0))
    snapshot = first.snapshot()
    first.close()
    (tmp_path / "t.csv").write_text("short")
    again = TrackCsv(tmp_path / "t.csv")
    again.restore(snapshot)
    with pytest.raises(InputError, match="has 5 of"):
        again(make_tracks(1))
    assert (tmp_path / "t.csv").read_text() == "short"


def test_a_snapshot_before_the_first_ping_restarts_an_empty_file(tmp_path):
    sink = CsvFile(tmp_path / "x.csv", ("seq", "stamp_ns"))
    sink.restore(0)
    sink.write(1, 2, [])
    sink.close()
    assert (tmp_path / "x.csv").read_text() == "seq,stamp_ns\n1,2\n"


def test_nothing_is_lost_between_the_sink_and_the_source(tmp_path, make_ping):
    sent = []
    for seq in range(30):
        n = seq % 4
        polar = np.random.default_rng(seq).random((3, n))
        sent.append(Detections.of(make_ping(seq), range_m=polar[0], bearing_rad=polar[1], amplitude=polar[2]))
    sink = DetectionCsv(tmp_path / "d.csv")
    for detections in sent:
        sink(detections)
    sink.close()
    got = list(DetectionsCsv(tmp_path / "d.csv")())
    assert [(d.seq, d.stamp_ns, len(d)) for d in got] == [(d.seq, d.stamp_ns, len(d)) for d in sent]
    for a, b in zip(got, sent, strict=True):
        for name in ("range_m", "bearing_rad", "amplitude"):
            assert_array_equal(getattr(a, name), getattr(b, name))
