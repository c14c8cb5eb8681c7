"""`fls-flow sweep` as a user meets it: processes, files, exit codes."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from fls_flow.evaluate import score


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "cells.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "cells.jsonl").read_text().splitlines()]


def alive(group: int) -> list[int]:
    """The processes of a group, but those that only wait for their parent's notice."""
    stats = [
        path.read_text().rpartition(")")[2].split()
        for path in Path("/proc").glob("[0-9]*/stat")
        if path.exists()
    ]
    return [int(fields[2]) for fields in stats if int(fields[2]) == group and fields[0] != "Z"]


def test_a_grid_is_run_and_scored(sweep, toys):
    done = sweep(
        "toy.yaml",
        "--set",
        "tracker.bias_m=0,0.5,2.0",
        "--set",
        "sonar.seed=0:2",
        "--metric",
        "gospa",
        "--out",
        "s",
        "--workers",
        "2",
    )
    assert done.returncode == 0, done.stderr
    assert "6 cells; writing to s" in done.stderr
    table = rows(toys / "s")
    assert [(row["tracker.bias_m"], row["sonar.seed"]) for row in table] == [
        (bias, seed) for bias in ("0", "0.5", "2.0") for seed in ("0", "1")
    ]
    # Two targets, each followed at that distance: the distance of the sets is twice the bias.
    assert [float(row["gospa"]) for row in table] == pytest.approx([0, 0, 1, 1, 4, 4], abs=1e-9)
    assert [row["pings"] for row in table] == ["5.0"] * 6
    shown = [line.split() for line in done.stdout.splitlines()]
    assert ["2.0", "2/2", "4"] in shown
    assert (toys / "s" / "sweep.png").read_bytes().startswith(b"\x89PNG")
    assert not list(toys.rglob("count.txt"))  # sinks that are not scored do not run


def test_a_second_start_does_only_what_is_missing(sweep, toys):
    words = ("toy.yaml", "--set", "tracker.bias_m=1,2", "--workers", "1", "--json")
    first = json.loads(sweep(*words).stdout)
    folder = toys / first["out"]
    before = lines(folder)
    path = folder / "cells.jsonl"
    path.write_text(path.read_text().splitlines(keepends=True)[0] + '{"index":1,"sta')
    again = json.loads(sweep(*words, "--metric", "ospa").stdout)
    after = lines(folder)
    assert after[0] == before[0]
    assert after[1]["scores"] == before[1]["scores"]
    assert [cell["scores"] for cell in again["cells"]] == [cell["scores"] for cell in first["cells"]]
    other = sweep("toy.yaml", "--set", "tracker.bias_m=1,3", "--out", first["out"])
    assert other.returncode == 2
    assert "holds another sweep (set differ)" in other.stderr
    assert lines(folder) == after


def test_failed_cells_are_told_and_stop_nobody(sweep, toys):
    done = sweep(
        "toy.yaml",
        "--set",
        "tracker.fate=live,raise,die",
        "--set",
        "sonar.seed=0:2",
        "--out",
        "s",
        "--workers",
        "2",
    )
    assert done.returncode == 1
    found = {line["index"]: line for line in lines(toys / "s")}
    assert [found[i]["status"] for i in range(6)] == ["ok"] * 2 + ["failed"] * 4
    assert all("node 'tracker' failed at ping seq 2" in found[i]["error"] for i in (2, 3))
    assert all("its process died (signal SIGKILL)" in found[i]["error"] for i in (4, 5))
    assert "(tracker.fate=die sonar.seed=1) failed: its process died" in done.stderr
    assert "4 of 6 cells failed" in done.stderr
    assert not list((toys.parent / "tmp").iterdir())
    (row,) = [line.split() for line in done.stdout.splitlines() if line.strip().startswith("live")]
    assert row[:3] == ["live", "2/2", "0"]


def test_the_numbers_do_not_depend_on_who_computes_them(sweep, toys):
    words = ("surface_obstacle", "--set", "sonar.pings=12", "--set", "sonar.seed=0:3")
    for count in (1, 2):
        done = sweep(*words, "--out", f"s{count}", "--workers", str(count))
        assert done.returncode == 0, done.stderr
    one, two = (toys / f"s{count}" / "cells.csv" for count in (1, 2))
    assert one.read_bytes() == two.read_bytes()
    assert len({row["detections"] for row in rows(toys / "s1")}) > 1


def test_tracks_in_the_world_are_scored(sweep, toys):
    done = sweep("surface_obstacle_200m", "--set", "sonar.pings=8", "--out", "s", "--workers", "1")
    assert done.returncode == 0, done.stderr
    (row,) = rows(toys / "s")
    assert 0.0 < float(row["gospa"]) < 60.0


def test_sinks_of_the_graph_and_taps_give_the_same_scores(sweep, toys):
    for name, keep in (("toy", ()), ("toy_sinks", ()), ("toy_sinks", ("--keep",))):
        out = f"{name}{len(keep)}"
        done = sweep(f"{name}.yaml", "--set", "tracker.bias_m=1", "--out", out, "--workers", "1", *keep)
        assert done.returncode == 0, done.stderr
    tables = [rows(toys / out) for out in ("toy0", "toy_sinks0", "toy_sinks1")]
    assert tables[0] == tables[1] == tables[2]
    kept = toys / "toy_sinks1" / "cells" / "0"
    assert {path.name for path in kept.iterdir()} == {"tracks.csv", "truths.csv", "count.txt", "run.json"}
    record = json.loads((kept / "run.json").read_text())
    assert (record["status"], record["nodes"]["tracker"]["with"]["bias_m"]) == ("finished", 1.0)


def test_detectors_are_scored_over_their_threshold(sweep, toys):
    axes = ("--set", "cfar.pfa=1e-3,1e-5", "--set", "sonar.pings=8", "--workers", "1")
    metrics = ("--metric", "pd", "--metric", "false_alarms_per_ping")
    done = sweep("surface_obstacle", *axes, *metrics, "--out", "s")
    assert done.returncode == 2
    assert "several Detections: noise, cfar, wakes; name one with --detections" in done.stderr
    done = sweep("surface_obstacle", *axes, *metrics, "--detections", "cfar", "--out", "s", "--keep")
    assert done.returncode == 0, done.stderr
    loud, quiet = rows(toys / "s")
    assert float(loud["pd"]) >= float(quiet["pd"]) > 0.5
    assert float(loud["false_alarms_per_ping"]) > 5.0 * float(quiet["false_alarms_per_ping"])
    assert "gospa" not in loud
    alone = score(None, toys / "s/cells/0/truths.csv", detections=toys / "s/cells/0/detections.csv").overall
    assert {name: float(loud[name]) for name in alone} == alone


def test_a_detector_alone_tells_how_much_it_detects(sweep, toys):
    nodes = (
        "sonar: {use: surface-scene, with: {pings: 3}}, cfar: {use: rayleigh-cfar, in: {ping: sonar.ping}}"
    )
    (toys / "bare.yaml").write_text(
        f"graph: bare\nnodes: {{{nodes}, out: {{use: detection-csv, in: {{detections: cfar}}}}}}\n"
    )
    done = sweep("bare.yaml", "--set", "cfar.pfa=1e-2,1e-4", "--workers", "1", "--out", "s", "--keep")
    assert done.returncode == 0, done.stderr
    for cell, row in enumerate(rows(toys / "s")):
        (file,) = (toys / "s" / "cells" / str(cell)).glob("detections.csv")
        assert float(row["detections"]) == len(file.read_text().splitlines()) - 1 > 0
    assert "confirmed_tracks" not in row
    assert sweep("archive.yaml", "--workers", "1", "--out", "t").returncode == 0
    assert [row["pings"] for row in rows(toys / "t")] == ["1.0"]


def test_the_estimates_of_phd_filters_are_scored(sweep, toys):
    words = ("phd", "--set", "sonar.seed=5,6", "--metric", "phd_cardinality_rmse", "--metric", "ospa")
    done = sweep(*words, "--set", "sonar.pings=15", "--out", "s", "--workers", "1")
    assert done.returncode == 0, done.stderr
    for row in rows(toys / "s"):
        assert 0.0 < float(row["phd_cardinality_rmse"]) < 4.0
        assert 0.0 < float(row["phd_ospa"]) <= 10.0
        assert 0.0 < float(row["ospa"]) <= 10.0


def test_a_folder_of_recordings_is_run(sweep, toys):
    (toys / "rec").mkdir()
    for name, text in (("a", "3"), ("b", "x"), ("c", "7")):
        (toys / "rec" / f"{name}.txt").write_text(text)
    done = sweep("archive.yaml", "--set", "sonar.path=rec/*.txt", "--metric", "pings", "--out", "s")
    assert done.returncode == 1
    table = rows(toys / "s")
    assert [(row["sonar.path"], row["status"], row["pings"]) for row in table] == [
        ("a.txt", "ok", "3.0"),
        ("b.txt", "failed", ""),
        ("c.txt", "ok", "7.0"),
    ]
    assert "holds no number" in done.stderr
    (toys / "rec" / "b.txt").write_text("4")  # mended: only it is tried again
    before = lines(toys / "s")
    done = sweep("archive.yaml", "--set", "sonar.path=rec/", "--metric", "pings", "--out", "s")
    assert done.returncode == 0, done.stderr
    assert [line["index"] for line in lines(toys / "s")[len(before) :]] == [1]


def test_mistakes_are_told_before_anything_starts(sweep, toys):
    cases = {
        ("toy.yaml", "--set", "tracker.bias=1,2"): "did you mean 'bias_m'",
        ("toy.yaml", "--set", "sonar.pings=1,x"): "--set sonar.pings=x",
        ("toy.yaml", "--over", "sonar.seed"): "is no axis",
        ("archive.yaml", "--metric", "gospa"): "no tracks and truth",
        ("toy.yaml", "--metric", "pd"): "--metric pd: graph 'toy' has no detections and truth",
        ("toy.yaml", "--metric", "phd_ospa"): "no intensity and truth",
        ("toy.yaml", "--detections", "tracker"): "--detections tracker: no node of that name",
        ("toy.yaml", "--tracks", "sonar"): "--tracks sonar",
    }
    for words, said in cases.items():
        done = sweep(*words)
        assert (done.returncode, said in done.stderr) == (2, True), (words, done.stderr)
    done = sweep("toy.yaml", "--metric", "gopsa", "--workers", "1", "--out", "s")
    assert done.returncode == 2
    assert "did you mean 'gospa'" in done.stderr
    assert sorted(path.name for path in toys.iterdir()) == [
        "1.txt",
        "archive.yaml",
        "s",
        "toy.yaml",
        "toy_sinks.yaml",
    ]


def started(toys: Path, environment: dict[str, str], *words: str) -> subprocess.Popen[str]:
    """A sweep in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "fls_flow.cli", "sweep", *words],
        cwd=toys,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a script's `&` ignores it
    )


def until(condition: Callable[[], bool], within_s: float = 60.0) -> None:
    deadline = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_sweep_that_is_killed_goes_on_and_leaves_nothing_behind(toys, environment, sweep):
    words = ("toy.yaml", "--set", "sonar.seed=0:300", "--out", "s", "--workers", "2")
    process = started(toys, environment, *words)
    path = toys / "s" / "cells.jsonl"
    until(lambda: path.exists() and path.read_bytes().count(b"\n") > 3)
    process.kill()
    process.communicate()
    before = path.read_text()
    assert 3 < before.count("\n") < 300
    until(lambda: not alive(process.pid))
    assert not list((toys.parent / "tmp").iterdir())
    done = sweep(*words)
    assert done.returncode == 0, done.stderr
    assert path.read_text().startswith(before[: before.rfind("\n") + 1])
    assert sorted(line["index"] for line in lines(toys / "s")) == list(range(300))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_keeps_what_is_done_and_leaves_no_process(toys, environment, number):
    words = ("toy.yaml", "--set", "tracker.fate=live,hang", "--out", "s", "--workers", "2")
    process = started(toys, environment, *words)
    until(lambda: (toys / "hanging").exists() and bool((toys / "s" / "cells.jsonl").read_text()))
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "interrupted: 1 of 2 cells are done" in said
    assert "Traceback" not in said
    assert [line["index"] for line in lines(toys / "s")] == [0]
    assert not list((toys.parent / "tmp").iterdir())
    until(lambda: not alive(process.pid))
