"""`fls-flow sweep` as a user meets it: processes, files, exit codes."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest


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
    done = sweep("archive.yaml", "--set", "sonar.path=rec/*.txt", "--metric", "pings", "--out", "s")
    assert done.returncode == 0, done.stderr
    assert [line["index"] for line in lines(toys / "s")[len(before) :]] == [1]


def test_mistakes_are_told_before_anything_starts(sweep, toys):
    cases = {
        ("toy.yaml", "--set", "tracker.bias=1,2"): "did you mean 'bias_m'",
        ("toy.yaml", "--set", "sonar.pings=1,x"): "--set sonar.pings=x",
        ("toy.yaml", "--over", "sonar.seed"): "is no axis",
        ("archive.yaml", "--metric", "gospa"): "no tracks and truth",
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_keeps_what_is_done_and_leaves_no_process(toys, environment, number):
    words = ["sweep", "toy.yaml", "--set", "tracker.fate=live,hang", "--out", "s", "--workers", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "fls_flow.cli", *words],
        cwd=toys,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a script's `&` ignores it
    )
    deadline = time.monotonic() + 60.0
    while not ((toys / "hanging").exists() and (toys / "s" / "cells.jsonl").read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "interrupted: 1 of 2 cells are done" in said
    assert "Traceback" not in said
    assert [line["index"] for line in lines(toys / "s")] == [0]
    assert not list((toys.parent / "tmp").iterdir())
    while alive(process.pid):
        assert time.monotonic() < deadline
        time.sleep(0.05)
