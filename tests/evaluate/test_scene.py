"""Two files on common pings."""

import pytest

from fls_flow.errors import UserError
from fls_flow.evaluate.scene import common_pings, detections_of, targets_of, tracks_of
from fls_flow.evaluate.table import read

TRUTH = "seq,stamp_ns,target_id,x_m,y_m,frame"
TRACKS = "seq,stamp_ns,track_id,status,x_m,y_m,frame"


@pytest.fixture
def truth(write):
    return read(
        write("truth.csv", TRUTH, "0,0,4,1,2,sensor", "1,500000000,4,1,3,sensor", "2,1000000000,,,,"), "truth"
    )


def test_a_ping_that_one_file_lacks_has_no_entries_there(write, truth):
    tracks = read(
        write(
            "tracks.csv", TRACKS, "1,500000000,9,confirmed,1,3,sensor", "3,3000000000,9,confirmed,1,3,sensor"
        ),
        "tracks",
    )
    pings = common_pings(truth, tracks)
    assert pings.seq.tolist() == [0, 1, 2, 3]
    assert pings.time_s.tolist() == [0.0, 0.5, 1.0, 3.0]
    assert pings.share_s.tolist() == [0.5, 0.5, 1.25, 2.0]
    assert pings.notes == (
        "pings only in tracks.csv: 1; truth.csv counts as empty there",
        "pings only in truth.csv: 2; tracks.csv counts as empty there",
    )
    assert targets_of(truth, pings).ping.tolist() == [0, 1]
    assert tracks_of(tracks, pings).ping.tolist() == [1, 3]
    assert tracks_of(tracks, pings).name.tolist() == [9]


def test_only_confirmed_tracks_are_scored_and_lost_rows_never(write, truth):
    rows = (
        "0,0,1,tentative,0,0,sensor",
        "1,500000000,1,confirmed,0,0,sensor",
        "2,1000000000,1,lost,0,0,sensor",
    )
    tracks = read(write("tracks.csv", TRACKS, *rows), "tracks")
    pings = common_pings(truth, tracks)
    assert tracks_of(tracks, pings).ping.tolist() == [1]
    assert tracks_of(tracks, pings, tentative=True).ping.tolist() == [0, 1]


def test_two_frames_are_refused(write, truth):
    tracks = read(write("tracks.csv", TRACKS, "0,0,1,confirmed,0,0,ned"), "tracks")
    with pytest.raises(UserError, match=r"frame is 'ned'.*'sensor'"):
        common_pings(truth, tracks)


def test_files_of_two_runs_are_refused(write, truth):
    with pytest.raises(UserError, match=r"ping seq 1 has stamp_ns 7, in .* it has 500000000"):
        common_pings(truth, read(write("a.csv", TRACKS, "1,7,1,confirmed,0,0,sensor"), "tracks"))
    with pytest.raises(UserError, match="shares no stamp_ns"):
        common_pings(truth, read(write("b.csv", TRACKS, "8,7,1,confirmed,0,0,sensor"), "tracks"))


def test_a_ping_number_may_repeat(write):
    """A sensor that restarts counts anew: the stamp tells pings apart."""
    truth = read(write("truth.csv", TRUTH, "0,0,4,1,2,sensor", "0,9,4,1,3,sensor"), "truth")
    tracks = read(
        write("tracks.csv", TRACKS, "0,9,1,confirmed,1,3,sensor", "0,0,1,confirmed,1,2,sensor"), "tracks"
    )
    pings = common_pings(truth, tracks)
    assert len(pings) == 2
    assert tracks_of(tracks, pings).position_m.tolist() == [[1.0, 2.0], [1.0, 3.0]]


def test_detections_are_turned_to_the_sensors_axes(write, truth):
    table = read(
        write("d.csv", "seq,stamp_ns,range_m,bearing_rad", "0,0,2,0", "0,0,3,1.5707963267948966"),
        "detections",
    )
    place = detections_of(table, common_pings(truth, table)).position_m
    assert place[0].tolist() == [2.0, 0.0]
    assert place[1] == pytest.approx([0.0, 3.0], abs=1e-12)
