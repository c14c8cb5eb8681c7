"""`fls-flow evaluate` as a user meets it: files or a run's folder, a table, JSON, a picture, exit codes."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fls_flow.evaluate import Settings, find, report, score
from fls_flow.evaluate.picture import POINTS, draw, means

GOLDEN = Path(__file__).parent / "golden"
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def command(tmp_path: Path) -> Command:
    """Run `fls-flow` in the test's folder."""

    def call(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "fls_flow.cli", *words],
            cwd=tmp_path,
            env={**os.environ, "COLUMNS": "100"},
            capture_output=True,
            text=True,
            timeout=120,
        )

    return call


@pytest.fixture
def run_folder(tmp_path: Path, write: Callable[..., Path]) -> Path:
    """A run of two targets in four pings, with all four kinds of files and one that is none."""
    folder = tmp_path / "run"
    folder.mkdir()
    pings = range(4)
    write("run/truth.csv", "seq,stamp_ns,target_id,x_m,y_m,vx_mps,vy_mps,class,frame",
          *(f"{t},{t}000000000,1,{10 + t},0,1,0,diver,sensor" for t in pings),
          *(f"{t},{t}000000000,2,30,{t},0,1,seal,sensor" for t in pings))  # fmt: skip
    write("run/tracks.csv",
          "seq,stamp_ns,track_id,status,x_m,y_m,vx_mps,vy_mps,var_x,cov_xy,var_y,label,probability,frame",
          *(f"{t},{t}000000000,5,{'confirmed' if t else 'tentative'},{10.1 + t},0,1,0,0.01,0,0.01,diver,0.8,sensor" for t in pings),
          *(f"{t},{t}000000000,6,confirmed,30,{t}.1,0,1,0.01,0,0.01,{'seal' if t else 'diver'},0.7,sensor" for t in pings))  # fmt: skip
    write("run/detections.csv", "seq,stamp_ns,range_m,bearing_rad,amplitude",
          *(f"{t},{t}000000000,{10 + t},0,{t + 1}" for t in pings), "3,3000000000,50,1,9")  # fmt: skip
    write("run/estimates.csv", "seq,stamp_ns,expected_targets,x_m,y_m,vx_mps,vy_mps,weight,frame",
          *(f"{t},{t}000000000,1.5,{10 + t},0,0,0,1,sensor" for t in pings))  # fmt: skip
    write("run/other.csv", "a,b", "1,2")
    return folder


def test_a_run_folder_is_scored_whole(command: Command, run_folder: Path) -> None:
    done = command("evaluate", "run", "--json", "--plot", "scores.png")
    assert (done.returncode, done.stderr) == (0, "")
    document = json.loads(done.stdout)
    overall = document["overall"]
    assert overall["gospa"] == pytest.approx((0.1 * 7 + 5) / 4)
    assert overall["targets_found"] == 2
    assert overall["pd"] == pytest.approx(0.5)
    assert overall["phd_expected_error"] == pytest.approx(-0.5)
    assert overall["class_error"] == pytest.approx(1 / 7)
    assert [row["target_id"] for row in document["targets"]] == [1, 2]
    assert [row["time_to_confirm_s"] for row in document["targets"]] == [1.0, 0.0]
    assert [row["pd"] for row in document["targets"]] == [1.0, 0.0]
    assert document["classifier"]["confusion"] == [[3, 0], [1, 3]]
    assert document["detector"]["roc"][-1] == pytest.approx(
        {"threshold": 1.0, "pd": 0.5, "false_alarms_per_ping": 0.25}
    )
    picture = cv2.imread(str(run_folder.parent / "scores.png"))
    assert picture is not None
    assert picture.std() > 10


def test_the_table_names_the_scores(command: Command, run_folder: Path) -> None:
    done = command("evaluate", "run/tracks.csv", "--truth", "run/truth.csv", "--gate-m", "0.05")
    assert done.returncode == 0
    for text in ("OSPA(2), m", "id switches", "MOTA", "HOTA", "NEES", "id class"):
        assert text in done.stdout
    assert "detector" not in done.stdout
    shown = dict(line.rsplit(maxsplit=1) for line in done.stdout.splitlines() if "life time" in line)
    assert shown == {"  tracked time over life time": "0.000"}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run/tracks.csv",), "run/tracks.csv: no truth in there; name its file with --truth"),
        (("run/truth.csv",), "nothing to score"),
        (("run", "--truth", "none.csv"), "none.csv: No such file or directory; check the path"),
        (("none.csv",), "none.csv: No such file or directory; check the path"),
        (("run/other.csv", "--truth", "run/truth.csv"), "run/other.csv:1: has none of the columns"),
        (("run", "run/tracks2.csv"), "run/tracks.csv and run/tracks2.csv: both hold tracks"),
        (("run/tracks2.csv", "--truth", "run/truth.csv"), "run/tracks2.csv:2: frame is 'map'; it takes sensor, ned"),
        (("run", "--cutoff-m", "-1"), "--cutoff-m must be positive, not -1.0"),
        (("run", "--order", "0.5"), "--order must lie between 1 and 20, not 0.5"),
        (("run", "--positive", "whale"), "--positive whale: is no class here; there are diver, seal"),
        (("run", "--plot", "run/other.csv"), "--plot run/other.csv: is there already; name another file"),
        (("run", "--plot", "no/where.png"), "--plot no/where.png: cannot be written"),
        (("run/tracks.csv", "--truth", "run/tracks.csv"), "run/tracks.csv:1: the header lacks target_id"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_and_exit_code_2(command: Command, run_folder: Path, words, says) -> None:
    if any("tracks2" in word for word in words):
        (run_folder / "tracks2.csv").write_text("seq,stamp_ns,track_id,x_m,y_m,frame\n0,0,1,2,3,map\n")
        if words[0] == "run":
            words = ("run/tracks.csv", *words[1:])
    done = command("evaluate", *words)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


def test_truth_that_is_named_takes_the_place_of_the_folders(run_folder: Path) -> None:
    files = find([run_folder], GOLDEN / "truth.csv")
    assert files.truth == GOLDEN / "truth.csv"
    assert files.tracks == run_folder / "tracks.csv"


def test_what_cannot_be_measured_is_null_in_json(run_folder: Path) -> None:
    scores = score(GOLDEN / "tracks.csv", GOLDEN / "truth.csv")
    document = json.loads(json.dumps(report.document(scores), allow_nan=False))
    assert document["overall"]["nees"] is None
    assert document["overall"]["hota"] > 0.5


def test_every_overall_score_stands_in_the_table(run_folder: Path) -> None:
    scores = score(
        run_folder / "tracks.csv",
        run_folder / "truth.csv",
        detections=run_folder / "detections.csv",
        estimates=run_folder / "estimates.csv",
    )
    shown = {name for family in report.FAMILIES.values() for name in family}
    only_json = {"misses", "false_positives", "id_precision", "id_recall"}
    only_json |= {"phd_gospa_localisation", "phd_gospa_missed", "phd_gospa_false"}
    assert set(scores.overall) == shown | only_json


def test_a_long_curve_is_thinned_in_json_and_keeps_its_ends(write: Callable[..., Path]) -> None:
    truth = write("truth.csv", "seq,stamp_ns,target_id,x_m,y_m", "0,0,1,10,0")
    rows = (f"0,0,30,0,{n}" for n in range(1000))
    detections = write("detections.csv", "seq,stamp_ns,range_m,bearing_rad,amplitude", *rows)
    curve = report.document(score(None, truth, detections=detections))["detector"]["roc"]
    assert len(curve) == report.CURVE_POINTS
    assert (curve[0]["threshold"], curve[-1]["threshold"]) == (999.0, 0.0)


@pytest.mark.parametrize("lines", [0, 1])
def test_files_without_rows_are_scored_and_drawn(
    write: Callable[..., Path], tmp_path: Path, lines: int
) -> None:
    truth = write("truth.csv", "seq,stamp_ns,target_id,x_m,y_m", *["0,0,,,"] * lines)
    tracks = write("tracks.csv", "seq,stamp_ns,track_id,x_m,y_m", *["0,0,,,"] * lines)
    scores = score(tracks, truth)
    assert scores.overall["targets"] == 0
    assert list(report.tables(scores))
    draw(scores, tmp_path / "p.png")


def test_a_long_run_is_drawn_as_means(write: Callable[..., Path], tmp_path: Path) -> None:
    n = 2 * POINTS + 7
    truth = write(
        "truth.csv", "seq,stamp_ns,target_id,x_m,y_m", *(f"{t},{t},1,10,{t / 100}" for t in range(n))
    )
    tracks = write(
        "tracks.csv", "seq,stamp_ns,track_id,x_m,y_m", *(f"{t},{t},1,11,{t / 100}" for t in range(9, n))
    )
    draw(score(tracks, truth), tmp_path / "p.png")
    values = np.arange(float(n))
    values[3:7] = np.nan
    found = means(values)
    assert found.size == -(-n // 3)
    assert found[:4].tolist() == pytest.approx([1.0, np.nan, 7.5, 10.0], nan_ok=True)
    assert found[-1] == n - 2
    assert np.array_equal(means(values[:POINTS]), values[:POINTS], equal_nan=True)


@pytest.mark.parametrize(
    "wrong",
    [
        {"cutoff_m": 0.0},
        {"gate_m": float("nan")},
        {"order": 0.9},
        {"order": 21.0},
        {"window_pings": 0},
        {"miss_cost": -1.0},
    ],
)
def test_bad_settings_are_refused_with_their_value(wrong) -> None:
    ((name, value),) = wrong.items()
    with pytest.raises(ValueError, match=f"{name} must .*{value}"):
        Settings(**wrong)


def test_scores_do_not_depend_on_the_order_of_rows(tmp_path: Path) -> None:
    for name in ("tracks", "truth"):
        header, *rows = (GOLDEN / f"{name}.csv").read_text().splitlines()
        (tmp_path / f"{name}.csv").write_text("\n".join([header, *reversed(rows)]))
    turned = score(tmp_path / "tracks.csv", tmp_path / "truth.csv").overall
    assert turned == pytest.approx(score(GOLDEN / "tracks.csv", GOLDEN / "truth.csv").overall, nan_ok=True)


def test_classes_of_the_truth_count_as_the_one_that_a_classifier_knows(write: Callable[..., Path]) -> None:
    rows = [
        f"{t},{t},{n},{10 * n},0,{what}" for t in range(4) for n, what in enumerate(("diver", "seal", "fish"))
    ]
    truth = write("truth.csv", "seq,stamp_ns,target_id,x_m,y_m,class", *rows)
    rows = [
        f"{t},{t},{n},{10 * n},0,{'diver' if n == 0 else 'marine-life'},0.9"
        for t in range(4)
        for n in range(3)
    ]
    tracks = write("tracks.csv", "seq,stamp_ns,track_id,x_m,y_m,label,probability", *rows)
    assert score(tracks, truth).overall["class_error"] == pytest.approx(2 / 3)
    grouped = Settings(groups=(("marine-life", ("seal", "fish*")),))
    found = score(tracks, truth, settings=grouped)
    assert found.overall["class_error"] == 0.0
    assert found.overall["class_roc_area"] == 1.0
    assert found.classifier is not None
    assert found.classifier.confusion.tolist() == [[4, 0], [0, 8]]
