"""Plugins that fork, exit, change the process they are in or hold it up: one clear line, or the right files."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import pytest

FATED = """
graph: fated
nodes:
  sonar: {use: acme-pings, with: {pings: 30}}
  fated: {use: acme-fated, in: {ping: sonar}}
  out: {use: detection-csv, in: {detections: fated}}
  rec: {use: acme-recorder, in: {ping: sonar, detections: fated}}
"""
MODES = {
    "here": ["--in-process"],
    "processes": [],
    "one": ["--deploy", "one.yaml"],
}


@pytest.fixture
def fated(start: Any, place: Path) -> Any:
    """Run the graph with a fate: exit code, error lines, all of stderr."""
    (place / "fated.yaml").write_text(FATED)
    (place / "one.yaml").write_text("deployment: one\nprocesses: {all: [sonar, fated, out, rec]}\n")

    def run(fate: str, mode: str, *words: str, out: str = "o") -> tuple[int, list[str], str]:
        given = ["fated.yaml", "--out", out, "--set", f"fated.fate={fate}", *MODES[mode], *words]
        return start.finish(*given)

    return run


def assert_right(start: Any, out: str = "o") -> None:
    """Each ping is there once, in order."""
    assert [row["seq"] for row in start.rows(out)] == [str(n) for n in range(30)]
    about = start.about(out)
    assert (about["status"], about["pings"]) == ("finished", 30)


@pytest.mark.parametrize(
    ("fate", "mode"),
    [
        *(("fork", mode) for mode in MODES),
        ("fork_and_exit", "processes"),
        *(("close_streams", mode) for mode in ("processes", "here")),
        *(("log_long", mode) for mode in ("one", "here")),
    ],
)
def test_what_leaves_the_answers_as_they_are_leaves_the_run_as_it_is(
    start: Any, fated: Any, place: Path, fate: str, mode: str
) -> None:
    code, errors, err = fated(fate, mode)
    assert errors == []
    assert code == 0 or (mode, fate) == ("here", "close_streams")  # its own table finds no terminal
    assert_right(start)
    assert "Traceback" not in err
    assert fated("''", "here", out="plain")[0] == 0
    for name in ("detections.csv", "messages.bin"):
        assert (place / "o" / name).read_bytes() == (place / "plain" / name).read_bytes()


@pytest.mark.parametrize("mode", MODES)
def test_files_lie_in_the_runs_folder_wherever_a_node_goes(start: Any, fated: Any, mode: str) -> None:
    code, errors, _ = fated("change_folder", mode, "--set", "fated.at=0", "--window", "1")
    assert (code, errors) == (0, [])
    assert_right(start)


@pytest.mark.parametrize(
    ("fate", "mode", "cause"),
    [
        ("die_unnamed", "processes", "died (signal 40)"),
        ("exit_quietly", "one", "died (exit code 0)"),
        ("fork_and_die", "processes", "died (signal 9: SIGKILL)"),
        ("fork_and_die", "one", "died (signal 9: SIGKILL)"),
        ("hold_the_lock", "processes", "is silent for "),
    ],
)
def test_what_ends_or_stops_a_process_is_named_with_its_ping(
    start: Any, fated: Any, fate: str, mode: str, cause: str
) -> None:
    began = time.monotonic()
    code, errors, err = fated(fate, mode, "--window", "1")
    assert code == 1, err
    assert time.monotonic() - began < 15.0, "nobody waits for the 20 s of native code"
    (line,) = errors
    assert "'fated'" in line
    assert "at ping index 5" in line
    assert cause in line
    about = start.about()
    assert about["status"] == "failed"
    assert line == f"error: {about['error']}"


def test_closed_descriptors_are_no_obstacle(start: Any, fated: Any) -> None:
    code, errors, err = fated("close_descriptors", "one")
    assert (code, errors) == (0, []), err
    assert_right(start)


def test_a_run_folder_that_is_removed_does_not_hold_up_the_run(start: Any, fated: Any, place: Path) -> None:
    process = start("toy.yaml", "--out", "o", "--set", "sonar.pings=100000", "--set", "slow.sleep_s=0.01")
    start.wait_until_running()
    for path in (place / "o").iterdir():
        path.unlink()
    (place / "o").rmdir()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 1
    assert [line for line in err.splitlines() if line.startswith("error:")] == [
        f"error: {place / 'o' / 'run.json'}: cannot be written: No such file or directory"
    ]


@pytest.mark.parametrize("grouped", [False, True])
def test_a_node_whose_making_does_not_end_is_named(
    start: Any, fated: Any, place: Path, grouped: bool
) -> None:
    groups = "processes: {all: [sonar, fated, out, rec]}\n" if grouped else ""
    (place / "d.yaml").write_text(f"deployment: d\nconnect_timeout_s: 1\nlost_after_s: 1\n{groups}")
    code, errors, err = fated("never_made", "processes", "--deploy", "d.yaml")
    assert code == 1, err
    (line,) = errors
    if grouped:
        assert line.endswith("'out', 'rec', after 0 pings, was not ready after 2 s")
    else:  # or one who waits for it notices first
        assert "'fated', after 0 pings, was not ready" in line or ("nobody takes" in line and "fated" in line)
    assert start.about()["status"] == "failed"
