"""What a process shows of itself while it runs: a liveliness token, and counters for those who ask."""

from __future__ import annotations

import json
import os
import threading
import time
from pathlib import Path
from typing import Any

import zenoh

from fls_flow.runtime.run import Run

__all__ = ["LiveState"]

PAGE = os.sysconf("SC_PAGE_SIZE")


class LiveState:
    """Declares `<prefix>/@alive/<process>` and answers `<prefix>/@counters/<process>` with JSON."""

    def __init__(self, session: zenoh.Session, prefix: str, host: str, process: str, run: Run) -> None:
        self._run, self._host, self._process = run, host, process
        self._lock = threading.Lock()
        self._before = (time.monotonic(), time.process_time(), run.fired())
        self._rates: dict[str, float] = {}
        self._cpu = 0.0
        key = f"{prefix}/@counters/{process}"

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(key, json.dumps(self.document()))

        handler = zenoh.handlers.Callback(answer, indirect=False)
        token = session.liveliness().declare_token(f"{prefix}/@alive/{process}")
        self._declared: list[Any] = [session.declare_queryable(key, handler), token]

    def beat(self) -> None:
        """Measure rates and load since the last beat."""
        now, cpu, fired = time.monotonic(), time.process_time(), self._run.fired()
        with self._lock:
            then, cpu_then, fired_then = self._before
            passed = max(now - then, 1e-6)
            self._rates = {name: (fired[name] - fired_then[name]) / passed for name in fired}
            self._cpu = (cpu - cpu_then) / passed
            self._before = (now, cpu, fired)

    def document(self) -> dict[str, Any]:
        """The counters as plain values; `cpu` 1.0 is one core, `memory_bytes` is resident."""
        with self._lock:
            rates, cpu = dict(self._rates), self._cpu
        nodes = self._run.status()
        for name, node in nodes.items():
            node["rate_hz"] = round(rates.get(name, 0.0), 2)
        resident = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE
        about = {"process": self._process, "host": self._host, "pid": os.getpid()}
        return {**about, "cpu": round(cpu, 3), "memory_bytes": resident, "nodes": nodes}

    def close(self) -> None:
        """Stop answering."""
        for one in self._declared:
            one.undeclare()
