"""The rules of a run between processes: the same as inside one (`test_run_rules`), seen in the files."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

GRAPH = """
graph: ruled
nodes:
  sonar: {use: acme-sonar}
  nav: {use: acme-stamps}
  node: {use: acme-ruled, in: {ping: sonar, nav: nav@time, before: node@previous}}
  out: {use: detection-csv, in: {detections: node}}
"""
PLACES = {"each": "", "pairs": "processes: {front: [sonar, out], back: [nav, node]}\n"}


@pytest.fixture
def run(request: Any, start: Any, place: Path) -> Any:
    """Run the graph, a process per node or two of them: exit code, error lines, `run.json`, ranges per ping."""
    (place / "ruled.yaml").write_text(GRAPH)
    (place / "d.yaml").write_text("deployment: d\n" + PLACES[getattr(request, "param", "each")])

    def go(*given: str, words: tuple[str, ...] = (), deploy: str = "", graph: str = "ruled.yaml") -> Any:
        with (place / "d.yaml").open("a") as file:
            file.write(deploy)
        sets = [word for one in given for word in ("--set", one)]
        code, errors, _ = start.finish(graph, "--deploy", "d.yaml", "--out", "o", *sets, *words)
        file = place / "o" / "detections.csv"
        return code, errors, start.about(), pings(start.rows()) if file.exists() else []

    return go


BOTH = pytest.mark.parametrize("run", PLACES, indirect=True)


def pings(rows: list[dict[str, str]]) -> list[tuple[int, list[float]]]:
    """Number and ranges of each ping; by stamps, since numbers repeat."""
    found: dict[str, tuple[int, list[float]]] = {}
    for row in rows:
        _, ranges = found.setdefault(row["stamp_ns"], (int(row["seq"]), []))
        ranges += [float(row["range_m"])] if row["range_m"] else []
    return list(found.values())


@BOTH
def test_numbers_may_gap_and_repeat_and_previous_is_the_last_ping(run: Any) -> None:
    code, errors, about, given = run("sonar.pings=9")
    assert (code, errors, about["pings"]) == (0, [], 9)
    assert [seq for seq, _ in given] == [3 * (n // 2) for n in range(9)]
    assert [ranges[:3] for _, ranges in given] == [[n, n - 1, n + 1] for n in range(9)]


@pytest.mark.parametrize("number", [0, 1])
def test_short_inputs_end_cleanly(run: Any, number: int) -> None:
    code, errors, about, given = run(f"sonar.pings={number}")
    assert (code, errors, about["status"], about["pings"]) == (0, [], "finished", number)
    assert len(given) == number


@BOTH
def test_samples_come_once_in_order_up_to_the_first_at_or_after_the_ping(run: Any) -> None:
    code, _, about, given = run("sonar.pings=4", "nav.stamps_ms=[0, 50, 40, 50, 100, 120, 250, 900, 901]")
    assert code == 0
    assert [ranges[3:] for _, ranges in given] == [[0], [50, 100], [120, 250], [900]]
    assert about["counts"]["nav"]["dropped"] == 2, "those whose stamp does not increase"
    assert about["counts"]["nav"]["fired"] <= 8, "a replayed stream runs no further than it must"


@pytest.mark.parametrize("stamps", ["[]", "[0, 10]", "[250]"])
def test_a_stream_that_ends_early_gives_what_is_there(run: Any, stamps: str) -> None:
    code, _, about, given = run("sonar.pings=5", f"nav.stamps_ms={stamps}")
    assert (code, about["pings"]) == (0, 5)
    assert [stamp for _, ranges in given for stamp in ranges[3:]] == json.loads(stamps)


def test_a_dead_navigation_link_never_silences_detection_and_the_run_can_be_repeated(
    run: Any, start: Any, place: Path
) -> None:
    settings = ["sonar.pings=6", "nav.stamps_ms=[0, 100, 200]"]
    code, _, about, live = run("sonar.live=true", "nav.live=true", *settings)
    assert (code, about["status"]) == (0, "finished")
    assert about["counts"]["node"]["fired"] + about["counts"]["sonar"]["shed"] == 6
    taken = about["samples_taken"]["node"]["nav"]
    assert [len(ranges[3:]) for _, ranges in live] == taken
    assert sum(taken) == 3, "what there is arrives"
    assert taken[-1] == 0, "and the last ping does not wait for more than there will be"
    if about["counts"]["sonar"]["shed"]:
        return  # a repetition has other pings then
    words = ["--repeat", "o/run.json", *(word for one in settings for word in ("--set", one))]
    code, errors, _ = start.finish("ruled.yaml", "--deploy", "d.yaml", "--out", "again", *words)
    assert (code, errors) == (0, [])
    assert (place / "again" / "detections.csv").read_bytes() == (place / "o" / "detections.csv").read_bytes()


@BOTH
def test_a_live_source_sheds_whole_pings_and_keeps_the_newest(run: Any) -> None:
    code, _, about, given = run(
        "sonar.pings=60", "sonar.live=true", "sonar.period_s=0.01", "node.sleep_s=0.05"
    )
    assert code == 0
    shed = about["counts"]["sonar"]["shed"]
    held = [ranges[0] for _, ranges in given]
    assert shed > 20
    assert about["pings"] == len(held) == 60 - shed
    assert held == sorted(held)
    assert held[-1] == 59
    assert [ranges[2] for _, ranges in given] == [n + 1 for n in range(len(held))], "no ping half processed"


@pytest.mark.parametrize("window", [1, 3])
def test_no_more_than_the_window_is_begun(run: Any, window: int) -> None:
    code, errors, about, given = run(
        "node.breaks=hangs", "sonar.pings=100", words=("--window", str(window)), deploy="deadline_s: 1\n"
    )
    assert code == 1
    assert errors == ["error: node 'node' failed at index 4: no answer for 1 s"]
    assert about["counts"]["sonar"]["fired"] == 4 + window, "the next begins when `index - window` is done"
    assert [ranges[0] for _, ranges in given] == [0, 1, 2, 3], "what was answered before is in the file"


BROKEN = {
    "none": "it answered None, not Detections; a node answers every ping, with an empty message if it has "
    "nothing to say",
    "seq": "it answered seq 7 to the ping seq 6; copy it from the input",
    "stamp": "it answered stamp_ns 400000001 to a ping of 400000000; copy it from the input",
    "writes": "ValueError: assignment destination is read-only",
    "raises": "ValueError: no echo today",
}


@pytest.mark.parametrize("breaks", BROKEN)
def test_an_answer_that_breaks_the_contract_ends_the_run(run: Any, breaks: str) -> None:
    code, errors, about, given = run(f"node.breaks={breaks}")
    assert code == 1
    assert errors == [f"error: node 'node' failed at ping seq 6 (index 4): {BROKEN[breaks]}"]
    assert (about["status"], about["pings"]) == ("failed", 4)
    assert [ranges[0] for _, ranges in given] == [0, 1, 2, 3]


def test_skip_answers_empty_restores_the_state_and_counts(run: Any, place: Path) -> None:
    (place / "skips.yaml").write_text("base: ruled.yaml\nnodes: {node: {on_error: skip}}\n")
    code, errors, about, given = run("node.breaks=raises", "sonar.pings=8", graph="skips.yaml")
    assert (code, errors, about["counts"]["node"]["failed"]) == (0, [], 1)
    assert [len(ranges) for _, ranges in given] == [3, 3, 3, 3, 0, 3, 3, 3]
    assert [ranges[2] for _, ranges in given if ranges] == [1, 2, 3, 4, 5, 6, 7], (
        "not counted: state as before"
    )


def test_a_live_source_that_waits_is_ended_by_close(start: Any, place: Path) -> None:
    (place / "ruled.yaml").write_text(GRAPH)
    words = ["--set", "sonar.live=true", "--set", "sonar.hangs=true", "--set", "sonar.pings=3"]
    process = start("ruled.yaml", "--out", "o", *words)
    start.wait_until_running(size=60)
    time.sleep(0.5)
    process.terminate()
    began = time.monotonic()
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert time.monotonic() - began < 1.0 + 2.0  # the source within 1 s; and a loaded machine
    assert (start.about()["status"], start.about()["pings"]) == ("interrupted", 3)
