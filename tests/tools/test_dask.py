"""A sweep on a real Dask cluster: a scheduler and two workers in other processes, on loopback."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def cluster(toys: Path, environment: dict[str, str], tmp_path: Path) -> Iterator[str]:
    """The address of a scheduler with two workers."""
    file = tmp_path / "scheduler.json"
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    workers = ["--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path / "dask")]
    commands = [
        ["dask_scheduler", *local, "--port", "0", "--scheduler-file", str(file)],
        *[["dask_worker", *local, *workers, "--scheduler-file", str(file)]] * 2,
    ]
    place = tmp_path / "elsewhere"
    place.mkdir()
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", *words],
            cwd=place,
            env={**environment, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for module, *words in commands
    ]
    try:
        deadline = time.monotonic() + 60.0
        while not file.exists():
            assert time.monotonic() < deadline
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_a_cluster_gives_the_numbers_of_this_machine(cluster, sweep, toys):
    words = (
        "toy.yaml",
        "--set",
        "tracker.bias_m=0.5,1",
        "--set",
        "tracker.fate=live,raise",
        "--set",
        "sonar.seed=0:4",
    )
    here = sweep(*words, "--out", "here", "--workers", "1")
    there = sweep(*words, "--out", "there", "--dask", cluster)
    assert here.returncode == there.returncode == 1, there.stderr
    tables = [(toys / out / "cells.csv").read_bytes() for out in ("here", "there")]
    assert tables[0] == tables[1]
    assert tables[0].count(b"failed") == 8
    assert "node 'tracker' failed" in there.stderr


def test_a_worker_that_dies_costs_its_cell(cluster, sweep, toys):
    done = sweep("toy.yaml", "--set", "tracker.fate=die", "--out", "dying", "--dask", cluster)
    assert done.returncode == 1
    assert "KilledWorker" in json.loads((toys / "dying" / "cells.jsonl").read_text())["error"]


def test_a_missing_scheduler_is_told(sweep, toys):
    done = sweep("toy.yaml", "--dask", "tcp://127.0.0.1:9", "--out", "s")
    assert done.returncode == 2
    assert "no scheduler answers there" in done.stderr
    assert "Traceback" not in done.stderr
