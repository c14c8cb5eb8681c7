"""A toy scene for sweeps: two targets, tracks beside them, and nodes that fail in every way."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Command = Callable[..., subprocess.CompletedProcess[str]]

TOY = '''
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fls_flow import InputError, Ping, Tracks, Truth, hookimpl


class Seen(NamedTuple):
    ping: Ping
    truth: Truth


@dataclass
class Scene:
    pings: int = 5
    seed: int = 0

    def __call__(self) -> Iterator[Seen]:
        rng = np.random.default_rng(self.seed)
        for k in range(self.pings):
            state = np.array([[10.0, 0.0, 0.0, 0.0], [30.0, 5.0, 0.0, 0.0]]) + 0.01 * rng.standard_normal((2, 4))
            yield Seen(Ping(k, k * 10**9), Truth(k, k * 10**9, np.arange(2), state, ("buoy", "buoy")))


@dataclass
class Recording:
    """Plays as many empty pings as the file says."""

    path: Path
    names: tuple[str, ...] = ()

    def __call__(self) -> Iterator[Ping]:
        try:
            count = int(self.path.read_text())
        except ValueError as error:
            raise InputError(f"{self.path}: holds no number; write one") from error
        for k in range(count):
            yield Ping(k, k * 10**9)


@dataclass
class Tracker:
    """Tracks `bias_m` beside the truth; `fate` is what happens at ping 2."""

    bias_m: float = 0.0
    fate: str = "live"

    def __call__(self, truth: Truth) -> Tracks:
        if truth.seq == 2 and self.fate == "raise":
            raise RuntimeError("no idea")
        if truth.seq == 2 and self.fate == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if truth.seq == 2 and self.fate == "hang":
            Path("hanging").touch()
            time.sleep(60.0)
        state = truth.state + np.array([self.bias_m, 0.0, 0.0, 0.0])
        n = len(truth)
        return Tracks(
            truth.seq, truth.stamp_ns, truth.target_id + 1, np.ones(n, np.uint8), state, np.tile(np.eye(4), (n, 1, 1)),
            np.full(n, truth.seq), np.full(n, truth.seq),
        )


@dataclass
class Count:
    """Writes how many pings it has seen."""

    path: Path = Path("count.txt")

    def __call__(self, ping: Ping) -> None:
        self.path.write_text(str(ping.seq + 1))
'''
KINDS = {"toy-scene": "Scene", "toy-recording": "Recording", "toy-tracker": "Tracker", "toy-count": "Count"}
GRAPH = """
graph: toy
nodes:
  sonar:   {use: toy-scene}
  tracker: {use: toy-tracker, in: {truth: sonar.truth}}
  count:   {use: toy-count, in: {ping: sonar.ping}}
"""
SINKS = """
  csv:     {use: track-csv, in: {tracks: tracker}, with: {path: mine.csv}}
  truth:   {use: truth-csv, in: {truth: sonar}}
"""
RECORDINGS = """
graph: archive
nodes:
  sonar: {use: toy-recording, with: {path: 1.txt}}
  count: {use: toy-count, in: {ping: sonar}}
"""


@pytest.fixture
def toys(tmp_path: Path) -> Path:
    """A folder with the toy kinds installed beside it, and graphs: toy, toy_sinks, archive."""
    site = tmp_path / "site"
    info = site / "toys-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toys\nVersion: 1.0\n")
    entries = [f"{kind} = toys.{cls.lower()}\n" for kind, cls in KINDS.items()]
    (info / "entry_points.txt").write_text("[fls_flow]\n" + "".join(entries))
    (site / "toys").mkdir()
    (site / "toys" / "__init__.py").write_text(TOY)
    for cls in KINDS.values():
        hook = f"from toys import {cls}, hookimpl\n\n\n@hookimpl\ndef fls_node():\n    return {cls}\n"
        (site / "toys" / f"{cls.lower()}.py").write_text(hook)
    work = tmp_path / "work"
    work.mkdir()
    (work / "toy.yaml").write_text(GRAPH)
    (work / "toy_sinks.yaml").write_text(GRAPH + SINKS)
    (work / "archive.yaml").write_text(RECORDINGS)
    (work / "1.txt").write_text("1")
    return work


@pytest.fixture
def environment(toys: Path) -> dict[str, str]:
    """The environment of processes that shall find the toy kinds, with a folder `tmp` for what is temporary."""
    scratch = toys.parent / "tmp"
    scratch.mkdir(exist_ok=True)
    paths = {"PYTHONPATH": str(toys.parent / "site"), "TMPDIR": str(scratch)}
    return {**os.environ, **paths, "COLUMNS": "160"}


@pytest.fixture
def sweep(toys: Path, environment: dict[str, str]) -> Command:
    """Run `fls-flow sweep` in the folder of the toys."""

    def call(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "fls_flow.cli", "sweep", *words],
            cwd=toys,
            env=environment,
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )

    return call
