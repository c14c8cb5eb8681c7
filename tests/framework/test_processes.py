"""The same graph as processes over Zenoh: the same bytes, the same rules, nothing left behind."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fls_flow import graph as graphs
from fls_flow.errors import RunError
from fls_flow.nursery import Nursery
from fls_flow.runtime import Pace
from fls_flow.runtime.worker import Assignment

FLS_FLOW = [sys.executable, "-m", "fls_flow.cli"]
ROOT = Path(__file__).parents[2]


def ended(process: subprocess.Popen[str], timeout_s: float = 60.0) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=timeout_s)
    return process.returncode, out, err


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def wait_for(what: Callable[[], object], timeout_s: float = 30.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.02)


# --- the same bytes ------------------------------------------------------------------------------

GRAPHS = sorted(path.stem for path in (ROOT / "graphs").glob("*.yaml"))
PINGS = {"surface_obstacle": 60, "surface_on_recording": 40}  # of the others, 25: enough for tracks
PINGS |= {name: 10 for name in GRAPHS if name.startswith("active_array")}  # 7 MB each


@pytest.mark.parametrize("name", GRAPHS)
def test_in_process_as_processes_and_grouped_give_the_same_bytes(name, place, start):
    graph = graphs.load(name)
    recorded = {
        node.name: [port.name for port in node.kind.outputs]
        for node in graph.nodes
        if node.kind.outputs and node.name not in graph.streams  # a stream has no ping to be written with
    }
    lines = [f"graph: {graph.name}", f"base: {graph.path}", "nodes:"]
    for node, ports in recorded.items():
        wires = ", ".join(f"p{n}: {node}.{port}" for n, port in enumerate(ports))
        lines.append(f"  rec-{node}: {{use: acme-recorder, in: {{{wires}}}, with: {{path: {node}.bin}}}}")
    (place / "all.yaml").write_text("\n".join(lines) + "\n")
    nodes = [*(node.name for node in graph.nodes), *(f"rec-{node}" for node in recorded)]
    half = len(nodes) // 2
    groups = f"{{one: [{', '.join(nodes[:half])}], two: [{', '.join(nodes[half:])}]}}"
    (place / "two.yaml").write_text(f"deployment: two\nprocesses: {groups}\n")
    ways = {"here": ["--in-process"], "processes": [], "grouped": ["--deploy", "two.yaml"]}
    for way, words in ways.items():
        code, _, err = ended(
            start("all.yaml", "--out", way, "--set", f"{graph.clock}.pings={PINGS.get(name, 25)}", *words),
            timeout_s=150.0,  # the first time it compiles, perhaps on a busy machine
        )
        assert code == 0, err
    files = sorted(path.name for path in (place / "here").glob("*") if path.suffix in (".csv", ".bin"))
    assert len(files) >= len(recorded) + 1
    for file in files:
        whole = (place / "here" / file).read_bytes()
        assert whole
        for way in ("processes", "grouped"):
            assert (place / way / file).read_bytes() == whole, f"{way}/{file}"


def test_a_stream_joins_by_time_in_the_same_way(place, start):
    for way, words in {"here": ["--in-process"], "there": []}.items():
        code, _, err = ended(start("toy.yaml", "--out", way, *words))
        assert code == 0, err
    assert (place / "here" / "detections.csv").read_bytes() == (
        place / "there" / "detections.csv"
    ).read_bytes()
    assert len(rows(place / "there" / "detections.csv")) > 100


# --- nothing lost, or shed at the source ---------------------------------------------------------


def test_a_replay_through_a_slow_node_loses_nothing(place, start):
    code, out, err = ended(
        start("toy.yaml", "--out", "o", "--set", "slow.sleep_s=0.05", "--set", "sonar.cells=50000")
    )
    assert code == 0, err
    firsts = {}
    for row in rows(place / "o" / "detections.csv"):
        firsts.setdefault(row["seq"], float(row["range_m"]))
    assert firsts == {str(n): float(n) for n in range(40)}
    assert "pings 40" in out


def test_a_paced_source_sheds_whole_pings_and_keeps_the_newest(place, start):
    words = ["--rate", "5", "--set", "slow.sleep_s=0.2"]
    code, _, err = ended(start("toy.yaml", "--out", "o", *words))
    assert code == 0, err
    said = json.loads((place / "o" / "run.json").read_text())
    shed = said["counts"]["sonar"]["shed"]
    assert shed > 10
    seqs = list(dict.fromkeys(int(row["seq"]) for row in rows(place / "o" / "detections.csv")))
    assert len(seqs) == 40 - shed == said["pings"]
    assert seqs == sorted(seqs)
    assert seqs[-1] == 39


def test_two_runs_at_once_do_not_see_each_other(place, start):
    one = start("toy.yaml", "--out", "one", "--set", "sonar.pings=30")
    two = start("toy.yaml", "--out", "two", "--set", "sonar.pings=50")
    for process, name, pings in ((one, "one", 30), (two, "two", 50)):
        code, _, err = ended(process)
        assert code == 0, err
        seqs = [row["seq"] for row in rows(place / name / "detections.csv")]
        assert list(dict.fromkeys(seqs)) == [str(n) for n in range(pings)]


# --- ends ----------------------------------------------------------------------------------------


def test_a_node_that_raises_is_named_and_what_was_written_stays(place, start):
    code, _, err = ended(start("toy.yaml", "--out", "o", "--set", "slow.fail_at=25"))
    assert code == 1
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert errors == ["error: node 'slow' failed at ping seq 25 (index 25): ValueError: no echo today"]
    assert "Traceback" not in err
    assert {row["seq"] for row in rows(place / "o" / "detections.csv")} == {str(n) for n in range(25)}
    assert "Traceback" in (place / "o" / "run.log").read_text()


def long_run(start: Any) -> subprocess.Popen[str]:
    return start("toy.yaml", "--out", "o", "--set", "sonar.pings=100000", "--set", "slow.sleep_s=0.01")


def running(place: Path) -> bool:
    path = place / "o" / "detections.csv"
    return path.is_file() and path.stat().st_size > 5_000


def test_ctrl_c_stops_everything_within_two_seconds(place, start):
    process = long_run(start)
    wait_for(lambda: running(place))
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    code, out, err = ended(process)
    assert (
        time.monotonic() - began < 2.0 + 1.5
    )  # a loaded machine closes more slowly; nothing waits for longer
    assert code == 130, err
    assert "interrupted" in out
    read = rows(place / "o" / "detections.csv")
    assert all(row["stamp_ns"] for row in read)


@pytest.mark.parametrize("victim", ["slow", "sonar", "out"])
def test_a_process_that_dies_is_named(place, start, victim):
    process = long_run(start)
    wait_for(lambda: running(place))
    os.kill(start.pid_of(victim), signal.SIGKILL)
    code, _, err = ended(process)
    assert code == 1
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert f"process '{victim}' with node '{victim}'" in errors[0]
    assert "died (signal 9: SIGKILL)" in errors[0]
    assert rows(place / "o" / "detections.csv")
    text = (place / "o" / "run.json").read_text()
    record = json.loads(text)
    assert record["status"] == "failed"
    assert "NaN" not in text  # the times of the one that died are not known; JSON has no nan
    assert record["pings"] > 0  # also when the process that counts them is the one that died


def test_a_process_that_hangs_is_named(place, start):
    process = long_run(start)
    wait_for(lambda: running(place))
    os.kill(start.pid_of("slow"), signal.SIGSTOP)
    code, _, err = ended(process)
    assert code == 1
    assert "process 'slow' with node 'slow'" in err
    assert "is silent for 3." in err


FATED = """
graph: fated
nodes:
  sonar: {use: acme-pings, with: {pings: 40}}
  fated: {use: acme-fated, in: {ping: sonar}}
  out: {use: detection-csv, in: {detections: fated}}
"""


@pytest.mark.parametrize(
    ("groups", "who"),
    [
        ("", "process 'fated' with node 'fated', at ping index 5,"),
        ("[sonar, fated]", "process 'both' with nodes 'sonar', 'fated', node 'fated' at ping index 5,"),
    ],
)
def test_of_a_process_that_dies_at_work_node_and_ping_are_named(place, start, groups, who):
    (place / "fated.yaml").write_text(FATED)
    (place / "d.yaml").write_text("deployment: d\n" + (f"processes: {{both: {groups}}}\n" if groups else ""))
    code, _, err = ended(
        start("fated.yaml", "--deploy", "d.yaml", "--out", "o", "--set", "fated.fate=die", "--window", "1")
    )
    assert code == 1
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert errors == [f"error: {who} died (signal 9: SIGKILL)"]
    assert [row["seq"] for row in rows(place / "o" / "detections.csv")] == [str(n) for n in range(5)]
    counts = json.loads((place / "o" / "run.json").read_text())["counts"]
    assert counts["fated"]["fired"] == 5


def test_what_goes_wrong_while_closing_fails_the_run(place, start):
    (place / "fated.yaml").write_text(FATED)
    code, _, err = ended(start("fated.yaml", "--out", "o", "--set", "fated.fate=unclosable"))
    assert code == 1
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert errors == [
        "error: node 'fated' failed: while closing: OSError: [Errno 28] No space left on device"
    ]
    assert len(rows(place / "o" / "detections.csv")) == 40


def test_a_program_that_a_node_has_started_ends_with_the_run(place, start):
    (place / "fated.yaml").write_text(FATED)
    code, _, err = ended(start("fated.yaml", "--out", "o", "--set", "fated.fate=leave_program"))
    assert code == 0, err


def test_a_process_that_lets_go_of_everything_is_lost(place, start):
    (place / "fated.yaml").write_text(FATED)
    code, _, err = ended(start("fated.yaml", "--out", "o", "--set", "fated.fate=let_go"))
    assert code == 1
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert errors[0].startswith("error: process 'fated' with node 'fated', at ping index 5, ")


def test_no_name_of_a_node_is_taken(place, start):
    names = {"sonar": "hub", "fated": "run", "out": "_"}
    text = FATED
    for old, new in names.items():
        text = text.replace(f"  {old}:", f"  {new}:").replace(f": {old}}}", f": {new}}}")
    (place / "fated.yaml").write_text(text)
    code, _, err = ended(start("fated.yaml", "--out", "o"))
    assert code == 0, err
    assert len(rows(place / "o" / "detections.csv")) == 40


def test_closed_standard_streams_are_no_obstacle(place, start):
    within = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh"]
    code, _, _ = ended(start("toy.yaml", "--out", "o", "--set", "sonar.pings=5", within=within))
    assert code == 0
    assert json.loads((place / "o" / "run.json").read_text())["status"] == "finished"


def test_a_terminal_that_is_closed_stops_the_run(place, start):
    process = long_run(start)
    wait_for(lambda: running(place))
    process.send_signal(signal.SIGHUP)
    code, _, err = ended(process)
    assert code == 130, err
    assert json.loads((place / "o" / "run.json").read_text())["status"] == "interrupted"


def test_a_second_signal_ends_the_run_at_once_and_run_json_says_so(place, start):
    process = long_run(start)
    wait_for(lambda: running(place))
    os.kill(start.pid_of("slow"), signal.SIGSTOP)  # so that the first takes its time
    process.send_signal(signal.SIGTERM)
    time.sleep(0.3)
    process.send_signal(signal.SIGTERM)
    assert ended(process)[0] == 130
    said = json.loads((place / "o" / "run.json").read_text())
    assert (said["status"], said["error"]) == ("interrupted", "stopped at once by a second signal")


def test_a_run_that_cannot_begin_says_so_in_run_json(place, start):
    with tempfile.TemporaryDirectory(prefix="open-") as short:  # enough for sockets: else another one is used
        (Path(short) / "fls-flow").mkdir(mode=0o755)
        code, _, err = ended(start("toy.yaml", "--out", "o", XDG_RUNTIME_DIR=short))
    assert code == 1
    assert "is not a private folder of this user; remove it or set XDG_RUNTIME_DIR" in err
    said = json.loads((place / "o" / "run.json").read_text())
    assert said["status"] == "failed"
    assert "is not a private folder" in said["error"]


def test_a_nursery_that_died_before_it_was_needed_is_named():
    nursery = Nursery()
    nursery.process.kill()
    nursery.process.wait()
    assignment = Assignment("r", "local", "g", "/none", "/none", Pace(8, False), {}, {})
    with pytest.raises(RunError, match="the process that starts the others failed: it died"):
        nursery.bear(graphs.load("surface_obstacle"), assignment, ())
    nursery.channel.close()


def test_a_nursery_ends_with_its_supervisor_while_it_loads(start):
    code = "from fls_flow.nursery import Nursery; import os; Nursery(); os.kill(os.getpid(), 9)"
    done = subprocess.run([sys.executable, "-c", code], env=start.environment(), check=False)
    assert done.returncode == -signal.SIGKILL
    assert not start.left_over()


def test_when_the_supervisor_is_killed_the_others_notice_and_end(place, start):
    process = long_run(start)
    wait_for(lambda: running(place))
    process.kill()
    assert not start.left_over()
    read = rows(place / "o" / "detections.csv")
    assert all(row["stamp_ns"] for row in read), "the file was closed whole"
    assert json.loads((place / "o" / "run.json").read_text())["status"] == "running"


def test_what_a_node_prints_is_shown_with_its_name(place, start):
    words = ["--set", "sonar.pings=2", "--set", "slow.says=hello"]
    code, _, err = ended(start("toy.yaml", "--out", "o", *words))
    assert code == 0
    assert "[slow] hello 0" in err
    assert "[slow] hello 1" in err


def test_a_process_has_as_many_threads_as_its_deployment_says(place, start):
    (place / "g.yaml").write_text(
        "graph: g\nnodes:\n  sonar: {use: acme-pings, with: {pings: 2}}\n"
        "  one: {use: acme-threads, in: {ping: sonar}}\n  two: {use: acme-threads, in: {ping: sonar}}\n"
        "  csv1: {use: detection-csv, in: {detections: one}, with: {path: one.csv}}\n"
        "  csv2: {use: detection-csv, in: {detections: two}, with: {path: two.csv}}\n"
    )
    (place / "d.yaml").write_text("deployment: d\nthreads: {two: 2}\n")
    code, _, err = ended(start("g.yaml", "--deploy", "d.yaml", "--out", "o"))
    assert code == 0, err
    cores = os.cpu_count() or 1
    for name, threads in (("one", 1), ("two", 2)):
        numba, opencv, blas = (float(row["range_m"]) for row in rows(place / "o" / f"{name}.csv")[:3])
        assert (numba, opencv) == (min(threads, cores), threads)
        assert blas <= threads


def test_a_user_without_privileges_has_the_same_bytes_through_shared_memory(place, start, tmp_path):
    """A small limit of locked memory is what Zenoh's own shared memory gives up at, without a word."""
    own = tmp_path / "own"
    own.mkdir()
    words = ["--set", "sonar.pings=20", "--set", "sonar.cells=40000"]
    plain = ["prlimit", "--memlock=65536:65536"]
    if os.geteuid() == 0:  # may read what the tests have installed, and nothing else
        may = [
            "--inh-caps=-all,+dac_read_search",
            "--ambient-caps=+dac_read_search",
            "--bounding-set=-all,+dac_read_search",
        ]
        plain += ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", *may]
        for folder in (own, start.short):
            os.chown(folder, 65534, 65534)
    graph = str(place / "recorded.yaml")
    toy = (place / "toy.yaml").read_text()
    Path(graph).write_text(toy + "  rec: {use: acme-recorder, in: {ping: sonar, slow: slow}}\n")
    process = start(graph, "--out", str(own / "o"), *words, within=plain, HOME=str(own))
    code, _, err = ended(process)
    assert code == 0, err
    assert "sent as bytes" not in err
    code, _, err = ended(start(graph, "--in-process", "--out", str(own / "here"), *words))
    assert code == 0, err
    for name in ("detections.csv", "messages.bin"):
        assert (own / "o" / name).read_bytes() == (own / "here" / name).read_bytes()


# --- sinks that may lose pings -------------------------------------------------------------------

LATEST = """
deployment: lossy
qos: {"* -> lazy": latest}
"""


@pytest.mark.parametrize("grouped", [False, True])
def test_a_sink_that_takes_the_latest_never_holds_up_the_others(place, start, grouped):
    (place / "lazy.yaml").write_text(
        (place / "toy.yaml").read_text().replace("graph: toy", "graph: lossy")
        + "  lazy: {use: acme-lazy, in: {detections: slow, ping: sonar}}\n"
    )
    processes = "processes: {all: [sonar, nav, slow, out, lazy]}\n" if grouped else ""
    (place / "d.yaml").write_text(LATEST + processes)
    words = ["--deploy", "d.yaml", "--set", "sonar.pings=150", "--set", "slow.sleep_s=0.02"]
    code, _, err = ended(start("lazy.yaml", "--out", "o", *words))
    assert code == 0, err
    said = json.loads((place / "o" / "run.json").read_text())
    assert said["pings"] == 150
    assert len({row["seq"] for row in rows(place / "o" / "detections.csv")}) == 150
    seen = [int(word) for word in (place / "o" / "lazy.txt").read_text().split()]
    assert seen == sorted(set(seen))
    assert seen[-1] == 149, "the newest is kept"
    assert len(seen) < 60
    counts = said["counts"]["lazy"]
    assert counts["fired"] == len(seen)
    assert counts["fired"] + counts["dropped"] == 150


# --- seen from outside ---------------------------------------------------------------------------


def top(start: Any, *words: str) -> subprocess.CompletedProcess[str]:
    command = [*FLS_FLOW, "top", "--once", *words]
    return subprocess.run(
        command,
        cwd=start.place,
        env=start.environment(),
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )


def test_top_shows_what_the_nodes_do(place, start):
    process = long_run(start)
    wait_for(lambda: running(place))
    time.sleep(1.0)
    done = top(start, "--json")
    assert done.returncode == 0, done.stderr
    nodes = {name: node for one in json.loads(done.stdout) for name, node in one["nodes"].items()}
    assert set(nodes) == {"sonar", "nav", "slow", "out"}
    assert nodes["slow"]["fired"] > 20
    assert nodes["slow"]["p50_ms"] >= 10.0
    assert 0 < nodes["slow"]["rate_hz"] <= 110
    assert all(one["memory_bytes"] > 1e7 for one in json.loads(done.stdout))
    table = top(start).stdout
    assert "slow" in table
    assert "p99 ms" in table
    run = json.loads((place / "o" / "run.json").read_text())["run"]
    assert top(start, run[:6]).returncode == 0
    unknown = top(start, "zzz")
    assert unknown.returncode == 2
    assert f"no run begins with 'zzz'; runs on this machine: {run} (toy)" in unknown.stderr
    process.send_signal(signal.SIGINT)
    assert ended(process)[0] == 130
    nobody = top(start)
    assert nobody.returncode == 2
    assert "runs on this machine: none; start one" in nobody.stderr
