"""What nodes do wrong at run time: each ends the run with its name and cause, in bounded time."""

from __future__ import annotations

import itertools
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fls_flow import Detections, Ping
from fls_flow import graph as graphs
from fls_flow.catalog import Catalog
from fls_flow.runtime import Options, Report, Run
from fls_flow.runtime.position import Whereabouts, kept, look

GRAPH = """
graph: faults
nodes:
  sonar: {use: sonar}
  node: {use: node, in: {ping: sonar}}
  sink: {use: sink, in: {detections: node}}
"""


def ping(seq: int) -> Ping:
    return Ping(seq, seq, np.ones((4, 3), np.float32), np.arange(1.0, 5.0), np.arange(3.0) - 1)


@dataclass
class Sonar:
    def __call__(self) -> Iterator[Ping]:
        for n in range(20):
            yield ping(n)

    def __len__(self) -> int:
        return 20


@dataclass
class Node:
    def __call__(self, ping: Ping) -> Detections:
        return Detections(ping.seq, ping.stamp_ns)


@dataclass
class Sink:
    seen: list[int] = field(default_factory=list, init=False, repr=False)

    def __call__(self, detections: Detections) -> None:
        self.seen.append(detections.seq)


Go = Callable[..., Report]


@pytest.fixture
def go(tmp_path: Path) -> Go:
    """Run the graph with other classes in place of its own."""

    def run(options: Options | None = None, on_finished: Any = None, **classes: type) -> Report:
        path = tmp_path / "faults.yaml"
        path.write_text(GRAPH)
        kinds = {"sonar": Sonar, "node": Node, "sink": Sink, **classes}
        graph = graphs.load(path, catalog=Catalog(kinds))
        return Run(graph, options, out=tmp_path, on_finished=on_finished or (lambda pings: None)).start()

    return run


class SilentError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


def raising(error: BaseException) -> type:
    @dataclass
    class Raises(Node):
        def __call__(self, ping: Ping) -> Detections:
            if ping.seq == 5:
                raise error
            return Detections(ping.seq, ping.stamp_ns)

    return Raises


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (KeyboardInterrupt(), "KeyboardInterrupt"),
        (GeneratorExit(), "GeneratorExit"),
        (SystemExit(0), "SystemExit: 0"),
        (MemoryError(), "MemoryError"),
        (ValueError("two\nlines"), "ValueError: two lines"),
        (SilentError(), "SilentError: which cannot say why"),
    ],
    ids=lambda one: type(one).__name__ if isinstance(one, BaseException) else "",
)
def test_whatever_a_node_raises_ends_the_run_with_its_name(go: Go, error: BaseException, cause: str) -> None:
    report = go(node=raising(error))
    assert str(report.error) == f"node 'node' failed at ping seq 5 (index 5): {cause}"
    assert report.status == "failed"
    assert report.pings == 5


def test_ctrl_c_is_no_fault_of_the_node_that_it_comes_to(go: Go) -> None:
    with pytest.raises(KeyboardInterrupt):
        go(Options(in_order=True), node=raising(KeyboardInterrupt()))


@dataclass
class Unplugged(Sonar):
    def __call__(self) -> Iterator[Ping]:
        raise OSError(19, "no such sonar")


@dataclass
class Number(Sonar):
    def __call__(self) -> Iterator[Ping]:
        return 5  # type: ignore[return-value]  # that is the fault


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize(
    ("cls", "cause"),
    [(Unplugged, "OSError: [Errno 19] no such sonar"), (Number, "TypeError: 'int' object is not iterable")],
)
def test_a_source_that_cannot_begin_says_why(go: Go, cls: type, cause: str, live: bool) -> None:
    report = go(Options(rate=1e6 if live else None), sonar=cls)
    assert str(report.error) == f"node 'sonar' failed: {cause}"


@dataclass
class Unclosable(Sonar):
    def __call__(self) -> Iterator[Ping]:
        try:
            for n in itertools.count():
                yield ping(n)
        finally:
            raise OSError("the device does not let go")


@dataclass
class Enough(Node):
    def __call__(self, ping: Ping) -> Detections:
        raise ValueError("enough")


@pytest.mark.parametrize("live", [False, True])
def test_a_source_that_cannot_be_abandoned_says_why(go: Go, live: bool) -> None:
    report = go(Options(rate=1e6 if live else None), sonar=Unclosable, node=Enough)
    assert "enough" in str(report.error)  # the first fault is the one to tell
    assert report.status == "failed"


@pytest.mark.parametrize("error", [RuntimeError("no idea"), OverflowError("too many")])
def test_a_source_that_does_not_know_its_length_runs_on(go: Go, error: Exception) -> None:
    @dataclass
    class Endless(Sonar):
        def __len__(self) -> int:
            raise error

    report = go(sonar=Endless)
    assert (report.status, report.pings) == ("finished", 20)


@dataclass
class Full(Sink):
    def close(self) -> None:
        raise OSError(28, "No space left on device")


@dataclass
class Stuck(Sink):
    def close(self) -> None:
        time.sleep(5.0)


def test_what_goes_wrong_while_closing_fails_the_run(go: Go) -> None:
    report = go(sink=Full)
    assert "node 'sink' failed: while closing: OSError: [Errno 28] No space left" in str(report.error)
    assert (report.status, report.pings) == ("failed", 20)


def test_a_node_that_does_not_close_is_left_behind(go: Go) -> None:
    began = time.monotonic()
    report = go(Options(deadline_s=0.2), sink=Stuck)
    assert time.monotonic() - began < 4.0
    assert str(report.error) == "node 'sink' failed: close() takes over 0.2 s"


@pytest.mark.parametrize("in_order", [False, True])
def test_the_last_pings_are_told_too(go: Go, in_order: bool) -> None:
    told: list[int] = []
    go(Options(in_order=in_order, window=8), told.append)
    assert told[-1] == 20
    assert told == sorted(told)


def test_positions_outlive_who_wrote_them(tmp_path: Path) -> None:
    path = tmp_path / "front.at"
    places = kept(path, ["a", "b"])
    places["a"][0], places["a"][1] = 8, 7
    places["b"][0], places["b"][1] = 7, 7
    assert look(path, ["a", "b"]) == {"a": Whereabouts(7, 7), "b": Whereabouts(7, None)}
    assert look(tmp_path / "none.at", ["a"]) == {}
    path.write_bytes(b"half")
    assert look(path, ["a"]) == {}


def test_positions_that_cannot_be_kept_cost_only_themselves(tmp_path: Path) -> None:
    places = kept(tmp_path / "missing" / "front.at", ["a"])
    places["a"][0] = 3
    assert look(tmp_path / "missing" / "front.at", ["a"]) == {}


@pytest.mark.parametrize("mode", ["--in-process", "--no-progress"])  # the other one: as processes
def test_a_recording_that_cannot_be_read_is_one_line_and_no_files_but_the_runs_own(
    tmp_path: Path, mode: str
) -> None:
    (tmp_path / "junk.npz").write_bytes(bytes(range(256)) * 20)
    words = ["run", "surface_on_recording", "--set", "sonar.path=junk.npz", "--out", "o", mode]
    run = subprocess.run(
        [sys.executable, "-m", "fls_flow.cli", *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 1
    said = [line for line in run.stderr.splitlines() if not line.startswith("writing to")]
    assert len(said) == 1, run.stderr
    assert "junk.npz: is not an npz file" in said[0]
    assert [path.name for path in (tmp_path / "o").iterdir()] == ["run.json"]
