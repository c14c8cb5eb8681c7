"""The sink `chip-sheet`: which chips it shows, and that its file is whole or not there."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fls_features.chip_messages import Chips, Regions
from fls_features.chip_sheet import ChipSheet
from fls_features.sheet import Shown, Strip
from fls_flow import Classes, Features, InputError
from fls_flow.testing import check_node


@pytest.fixture
def make_firing(rng):
    """Chips of the tracks `ids`, their regions, features and classes."""

    def made(seq, ids, rows=12):
        n, stamp = len(ids), seq * 10**9
        track = np.array(ids, np.int64)
        amplitude = rng.rayleigh(1.0, (n, rows, 8)).astype(np.float32)
        mask = np.zeros((n, rows, 8), bool)
        mask[:, 3:7, 2:5] = True
        two = np.zeros((n, 2), np.int64)
        tables = np.tile(20 + 0.1 * np.arange(rows), (n, 1)), np.tile(0.01 * np.arange(8), (n, 1))
        return {
            "chips": Chips(
                seq, stamp, track, amplitude, two, two, *tables, 0.1, 0.01, course_rad=np.zeros(n)
            ),
            "regions": Regions(seq, stamp, track, mask, two, np.ones(n, bool)),
            "features": Features(seq, stamp, track, ("area", "mean"), rng.random((n, 2))),
            "classes": Classes(
                seq, stamp, track, ("diver", "seal"), np.zeros(n, np.int64), np.full((n, 2), 0.5)
            ),
        }

    return made


def test_the_sheet_is_a_picture_with_a_row_per_track(tmp_path, make_firing):
    sizes = []
    for tracks in (1, 3):
        sheet = ChipSheet(tmp_path / f"{tracks}.png", tracks=tracks, chips_per_track=4)
        for seq in range(6):
            sheet(**make_firing(seq, [1, 2, 3]))
        sheet.close()
        picture = cv2.imread(str(tmp_path / f"{tracks}.png"))
        assert picture.std() > 5
        sizes.append(picture.shape[0])
    assert sizes[1] > 2 * sizes[0]
    assert sorted(one.name for one in tmp_path.iterdir()) == ["1.png", "3.png"]


def test_chips_of_a_long_track_are_thinned_evenly():
    strip = Strip(5)
    for n in range(1000):
        strip.add(Shown(float(n), np.zeros((1, 1)), np.zeros((1, 1), bool), (0.0, 1.0), (0.0, 1.0), ()))
        assert len(strip.shown) < 10
    times = [one.time_s for one in strip.chosen()]
    assert len(times) == 5
    assert times[0] == 0.0
    assert times[-1] > 800
    assert np.ptp(np.diff(times)) <= strip.stride


def test_a_short_track_shows_all_it_has():
    strip = Strip(5)
    for n in range(3):
        strip.add(Shown(float(n), np.zeros((1, 1)), np.zeros((1, 1), bool), (0.0, 1.0), (0.0, 1.0), ()))
    assert [one.time_s for one in strip.chosen()] == [0.0, 1.0, 2.0]


def test_the_tracks_with_most_chips_are_shown(tmp_path, make_firing):
    sheet = ChipSheet(tmp_path / "c.png", tracks=2, chips_per_track=3)
    for seq in range(9):
        sheet(**make_firing(seq, [n for n in (1, 2, 3) if seq % n == 0]))
    assert [(title, strip.count) for title, strip in sheet.rows()] == [
        ("track 1\ndiver 0.50", 9),
        ("track 2\ndiver 0.50", 5),
    ]


def test_after_a_restart_the_sheet_is_the_same(tmp_path, make_firing):
    firings = [make_firing(seq, [1, 2] if seq % 3 else [1]) for seq in range(12)]
    whole, first, second = (ChipSheet(tmp_path / f"{n}.png", chips_per_track=3) for n in range(3))
    for firing in firings:
        whole(**firing)
    for firing in firings[:7]:
        first(**firing)
    second.restore(first.snapshot())
    for firing in firings[7:]:
        second(**firing)
    whole.close()
    second.close()
    assert (cv2.imread(str(tmp_path / "0.png")) == cv2.imread(str(tmp_path / "2.png"))).all()


def test_no_file_is_replaced(tmp_path, make_firing):
    (tmp_path / "c.png").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        ChipSheet(tmp_path / "c.png")(**make_firing(0, [1]))
    assert (tmp_path / "c.png").read_text() == "mine"


def test_a_run_without_chips_leaves_a_sheet_that_says_so(tmp_path, caplog):
    sheet = ChipSheet(tmp_path / "c.png")
    sheet(Chips(0, 0), Regions(0, 0))
    sheet.close()
    assert (tmp_path / "c.png").stat().st_size > 0
    assert "none came" in caplog.text


def test_chips_whose_size_changes_flat_ones_and_whole_regions(tmp_path, make_firing):
    sheet = ChipSheet(tmp_path / "c.png")
    for seq, rows in enumerate((12, 8, 7)):
        sheet(**make_firing(seq, [1], rows))
    flat = make_firing(9, [1])
    zeros = np.zeros(flat["chips"].amplitude.shape, np.uint8)
    chips = Chips(
        9,
        9,
        flat["chips"].track_id,
        zeros,
        *(getattr(flat["chips"], n) for n in ("origin", "centre", "range_m", "bearing_rad")),
        course_rad=np.zeros(1),
    )
    sheet(chips, Regions(9, 9, chips.track_id, zeros == 0, chips.origin, np.ones(1, bool)))
    sheet.close()
    assert (tmp_path / "c.png").stat().st_size > 0


def test_the_sink_keeps_the_contract(make_firing):
    check_node(ChipSheet(chips_per_track=2), [make_firing(seq, range(seq % 3)) for seq in range(5)])


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"path": Path("c.gif")}, "path must end"),
        ({"tracks": 0}, "tracks is 0"),
        ({"tracks": 50}, "is over 400"),
    ],
)
def test_bad_values_are_named(parameters, says):
    with pytest.raises(ValueError, match=says):
        ChipSheet(**parameters)
