from __future__ import annotations

import csv
import io
import math

import numpy as np
import pytest

from fls_flow.errors import GraphError, UserError
from fls_flow.tools import curves, summary
from fls_flow.tools.cell import Row
from fls_flow.tools.summary import Mean
from fls_flow.tools.sweep import prepare

SMALL = ["sonar.pings=2"]


@pytest.fixture
def swept():
    """pfa 1e-5, 1e-6 x seeds 0..3: the score of a cell is 10 times the place of its pfa, plus its seed."""
    sweep = prepare(
        "surface_obstacle", set_=[*SMALL, "cfar.pfa=1e-5,1e-6", "sonar.seed=0:4"], metrics=["gospa"]
    )
    rows = {i: Row(i, "ok", scores={"gospa": 10.0 * (i // 4) + i % 4, "nees": None}) for i in range(8)}
    return sweep, rows


def test_seeds_are_averaged(swept):
    found = summary.groups(*swept)
    assert [group.labels for group in found] == [{"cfar.pfa": "1e-5"}, {"cfar.pfa": "1e-6"}]
    error = np.std([0, 1, 2, 3], ddof=1) / 2
    for group, mean in zip(found, (1.5, 11.5), strict=True):
        assert group.metrics["gospa"].mean == mean
        assert math.isclose(group.metrics["gospa"].error, error)
        assert (group.done, group.failed, group.metrics["gospa"].count) == (4, 0, 4)


def test_other_axes_are_averaged_on_request(swept):
    (found,) = summary.groups(*swept, over=["cfar.pfa"])
    assert found.labels == {}
    assert found.metrics["gospa"].mean == 6.5


def test_failed_and_missing_cells_do_not_count(swept):
    sweep, rows = swept
    rows[1] = Row(1, "failed", error="no idea")
    del rows[2]
    group = summary.groups(sweep, rows)[0]
    assert (group.done, group.failed, group.metrics["gospa"].mean) == (2, 1, 1.5)


@pytest.mark.parametrize(
    ("values", "text"),
    [([], "-"), ([2.0], "2"), ([1.0, 1.0], "1"), ([0.0, 1.0], "0.5 ± 0.5"), ([100.0, 140.0], "120 ± 20")],
)
def test_means_show_the_digits_that_they_have(values, text):
    assert str(Mean.of(values)) == text


def test_the_csv_holds_every_score_exactly(swept):
    sweep, rows = swept
    rows[0] = Row(0, "ok", scores={"gospa": 0.1 + 0.2, "nees": None})
    read = list(csv.DictReader(io.StringIO(summary.csv_text(sweep, rows))))
    assert float(read[0]["gospa"]) == 0.1 + 0.2
    assert read[0]["nees"] == ""
    assert (read[5]["cfar.pfa"], read[5]["sonar.seed"], read[5]["status"]) == ("1e-6", "1", "ok")


def test_the_picture_shows_means_with_their_errors(swept):
    sweep, rows = swept
    (panel,) = curves.figure(sweep, summary.groups(sweep, rows)).axes
    x, y = panel.lines[0].get_data()
    assert list(x) == [1e-6, 1e-5]
    assert list(y) == [11.5, 1.5]
    assert panel.get_ylabel() == "gospa"


def test_far_apart_numbers_stand_on_a_logarithmic_axis_and_words_in_places(swept):
    sweep = prepare("surface_obstacle", set_=[*SMALL, "cfar.pfa=1e-4,1e-6"], metrics=["gospa"])
    rows = {0: Row(0, "ok", scores={"gospa": 1.0})}
    (panel,) = curves.figure(sweep, summary.groups(sweep, rows)).axes
    assert panel.get_xscale() == "log"
    words = ["sonar.sequence=inflatable-and-buoy,passenger-boat"]
    sweep = prepare("surface_obstacle", set_=[*SMALL, *words], metrics=["gospa"])
    (panel,) = curves.figure(sweep, summary.groups(sweep, rows)).axes
    assert [tick.get_text() for tick in panel.get_xticklabels()] == ["inflatable-and-buoy", "passenger-boat"]


def test_a_sweep_without_axes_is_one_cell():
    sweep = prepare("surface_obstacle", set_=SMALL)
    assert len(sweep.grid) == 1
    assert sweep.varied == ()
    (group,) = summary.groups(sweep, {})
    assert len(curves.figure(sweep, [group]).axes) == 1


def test_every_value_is_checked_before_anything_starts():
    with pytest.raises(GraphError) as caught:
        prepare("surface_obstacle", set_=["cfar.pfa=1e-5,2.0,x", "sonar.seed=0:3", "cfra.pfa=1"])
    text = str(caught.value)
    assert "no node 'cfra'" in text
    with pytest.raises(GraphError) as caught:
        prepare("surface_obstacle", set_=["cfar.pfa=1e-5,2.0,x", "sonar.seed=0,y"])
    text = str(caught.value)
    assert "--set cfar.pfa=2.0: " in text
    assert "--set cfar.pfa=x: " in text
    assert "--set sonar.seed=y: " in text
    assert len(caught.value.problems) == 3


def test_a_metric_that_needs_truth_is_refused_without_it():
    with pytest.raises(UserError, match="no tracks and truth"):
        prepare("surface_on_recording", metrics=["gospa"])
    assert prepare("surface_on_recording").watched == ()


def test_the_folder_is_the_same_for_the_same_sweep_only():
    one = prepare("surface_obstacle", set_=["cfar.pfa=1e-5,1e-6"])
    same = prepare("surface_obstacle", set_=["cfar.pfa=1e-5,1e-6"], metrics=["ospa"])
    other = prepare("surface_obstacle", set_=["cfar.pfa=1e-5,1e-7"])
    assert one.folder == same.folder != other.folder
