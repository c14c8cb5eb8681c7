"""Runs one measurement: its processes, their time limit, what they leave."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.transport_peers.results import Result, read
from benchmarks.transport_peers.rig import Setting, Step
from benchmarks.transport_peers.stalled import other

__all__ = ["Contestant", "measure", "measure_stall"]

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Contestant:
    """A way to carry arrays between processes."""

    name: str
    module: str
    variant: str
    needs: str  # what must be importable
    hint: str = 'pip install -e ".[bench]"'

    @property
    def is_there(self) -> bool:
        """Whether it can be run here."""
        return importlib.util.find_spec(self.needs) is not None


def commands(setting: Setting, path: Path) -> list[list[str]]:
    """The processes of a measurement."""
    run = [sys.executable, "-m", "benchmarks.transport_peers.rig", str(path)]
    if setting.module == "over_dora":
        return [[dora(), "run", str(dataflow(setting, path))]]
    if setting.module == "memcpy":
        return [[*run, "send", "0"]]
    return [[*run, "send", "0"], *([*run, "receive", str(index)] for index in range(setting.readers))]


def dora() -> str:
    """The dora command of this environment."""
    return shutil.which("dora", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}") or "dora"


def dataflow(setting: Setting, path: Path) -> Path:
    """The dataflow that `dora run` takes (JSON is YAML)."""
    source = {"source": "sender/array", "queue_size": 1000, "queue_policy": setting.variant}
    run = f"-m benchmarks.transport_peers.rig {path}"
    sender = {"id": "sender", "path": sys.executable, "args": f"{run} send 0", "outputs": ["array"]}
    receivers = [
        {
            "id": f"receiver-{index}",
            "path": sys.executable,
            "args": f"{run} receive {index}",
            "inputs": {"array": source},
        }
        for index in range(setting.readers)
    ]
    file = setting.folder / "dataflow.yml"
    file.write_text(json.dumps({"nodes": [sender, *receivers]}), encoding="utf-8")
    return file


def measure(contestant: Contestant, steps: Sequence[Step], limit_s: float, readers: int = 1) -> Result | str:
    """What it reached in fresh processes, or why there is nothing."""
    with tempfile.TemporaryDirectory(prefix="flsbench-") as folder:
        setting = Setting(contestant.module, contestant.variant, _key(), Path(folder), tuple(steps), readers)
        return _run(setting, limit_s) or read(setting)


def measure_stall(carrier: str, stall_s: float, limit_s: float) -> tuple[Result, Result] | str:
    """A topic of 500 messages that a module carries, its reader asleep for a while, and another beside it."""
    with tempfile.TemporaryDirectory(prefix="flsbench-") as folder:
        steps = (Step(624_000, 500, 100.0, limit_s=limit_s),)
        setting = Setting("stalled", carrier, _key(), Path(folder), steps, stall_s=stall_s)
        other(setting).folder.mkdir()
        return _run(setting, limit_s) or (read(setting), read(other(setting)))


def _key() -> str:
    return f"bench-{uuid.uuid4().hex[:12]}"


def _run(setting: Setting, limit_s: float) -> str:
    """Run the processes of a measurement to their end; "" or what went wrong."""
    path = setting.folder / "setting.json"
    setting.dump(path)
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with (setting.folder / "log").open("w", encoding="utf-8") as log:
        where: dict[str, Any] = {"cwd": setting.folder, "env": env, "stdout": log, "stderr": log}
        processes = [
            subprocess.Popen(command, start_new_session=True, **where) for command in commands(setting, path)
        ]
        end = time.monotonic() + limit_s
        try:
            while any(process.poll() is None for process in processes):
                if time.monotonic() > end:
                    return f"not done in {limit_s:.0f} s: {last_line(setting)}"
                if any(process.poll() for process in processes):
                    return last_line(setting)
                time.sleep(0.02)
        finally:
            stop(processes)
    return ""


def last_line(setting: Setting) -> str:
    """The last thing that a measurement's processes said."""
    lines = (setting.folder / "log").read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1][:200] if lines else "nothing said"


def stop(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """End them and what they started."""
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
