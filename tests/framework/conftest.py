"""Runs as processes in a folder of their own; afterwards nothing of them may be left."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

FLS_FLOW = [sys.executable, "-m", "fls_flow.cli"]
SITE = Path(__file__).parents[1] / "site"  # a distribution with kinds for tests
GRAPH = """
graph: toy
nodes:
  sonar: {use: acme-pings}
  nav: {use: acme-nav}
  slow: {use: acme-slow, in: {ping: sonar, nav: nav@time}}
  out: {use: detection-csv, in: {detections: slow}}
"""


class Runs:
    """Starts `fls-flow run` in `place`, where the graph `toy.yaml` is; `short` is where runs meet."""

    def __init__(self, place: Path, short: Path) -> None:
        self.place, self.short = place, short
        self._started: list[subprocess.Popen[str]] = []
        (place / "toy.yaml").write_text(GRAPH)

    def __call__(self, *words: str, within: Sequence[str] = (), **variables: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [*within, *FLS_FLOW, "run", *words],
            cwd=self.place,
            env={**self.environment(), **variables},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._started.append(process)
        return process

    def environment(self) -> dict[str, str]:
        # both places where runs meet: those of other tests are out of sight
        paths = {"PYTHONPATH": str(SITE), "XDG_RUNTIME_DIR": str(self.short), "TMPDIR": str(self.short)}
        return {**os.environ, **paths, "COLUMNS": "160"}

    def finish(self, *words: str, timeout_s: float = 60.0, **more: Any) -> tuple[int, list[str], str]:
        """Run to the end: exit code, the lines that tell of errors, all that stands on stderr."""
        process = self(*words, **more)
        _, err = process.communicate(timeout=timeout_s)
        return process.returncode, [line for line in err.splitlines() if line.startswith("error:")], err

    def about(self, out: str = "o") -> dict[str, Any]:
        """What run.json says."""
        said: dict[str, Any] = json.loads((self.place / out / "run.json").read_text())
        return said

    def rows(self, out: str = "o", name: str = "detections.csv") -> list[dict[str, str]]:
        with (self.place / out / name).open(newline="") as file:
            return list(csv.DictReader(file))

    def wait_until_running(self, out: str = "o", size: int = 5_000, timeout_s: float = 30.0) -> None:
        path, deadline = self.place / out / "detections.csv", time.monotonic() + timeout_s
        while not (path.is_file() and path.stat().st_size > size):
            assert time.monotonic() < deadline
            time.sleep(0.02)

    def pids(self) -> list[str]:
        """The processes that were started with this folder's environment."""
        found = []
        mark = f"XDG_RUNTIME_DIR={self.short}\0".encode()
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if mark in (folder / "environ").read_bytes() and (folder / "cmdline").read_bytes():
                    found.append(folder.name)
            except OSError:
                continue
        return found

    def pid_of(self, nodes: str) -> int:
        """The process of a group of nodes, found by the socket on which it listens."""
        inodes = {
            line.split()[-2]
            for line in Path("/proc/net/unix").read_text().splitlines()
            if line.endswith(f"/{nodes}")
        }
        for pid in self.pids():
            try:
                links = [os.readlink(one) for one in Path("/proc", pid, "fd").iterdir()]
            except OSError:
                continue
            if any(link == f"socket:[{inode}]" for inode in inodes for link in links):
                return int(pid)
        raise AssertionError(f"no process of {nodes}")

    def left_over(self, wait_s: float = 5.0) -> list[str]:
        """Processes and files of runs in this folder, after a moment in which they may end."""
        deadline = time.monotonic() + wait_s
        runs = [json.loads(path.read_text()).get("run", "?") for path in self.place.glob("*/run.json")]
        while found := [*self.pids(), *map(str, self._files(runs))]:
            if time.monotonic() > deadline:
                break
            time.sleep(0.05)
        return found

    def _files(self, runs: Sequence[str]) -> list[Path]:
        shared = [path for run in runs for path in Path("/dev/shm").glob(f"fls-{run}-*")]
        return [*(self.short / "fls-flow").glob("*"), *shared]

    def end(self) -> None:
        for process in self._started:
            if process.poll() is None:
                process.kill()
            process.communicate()


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """The folder in which runs are started."""
    return tmp_path


@pytest.fixture
def start(place: Path) -> Iterator[Callable[..., Any]]:
    """Start `fls-flow run`; afterwards nothing of it may be left."""
    with tempfile.TemporaryDirectory(prefix="fls") as short:  # names of sockets have to be short
        runs = Runs(place, Path(short).resolve())
        yield runs
        runs.end()
        assert not runs.left_over()
