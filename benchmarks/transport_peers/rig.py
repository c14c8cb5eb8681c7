"""What every contestant is measured by: the messages to send, when, and the tally of those that arrive.

    python -m benchmarks.transport_peers.rig SETTING.json send|receive INDEX

A message is an array of bytes that begins with its step, number and the time at which sending began, and ends
with its number again. Times are of CLOCK_MONOTONIC, which processes of one host share.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Generator, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["END", "Bytes", "Setting", "Step", "Tally", "load"]

Bytes = npt.NDArray[np.uint8]
END = 1 << 32  # the step of the messages that say that all is sent
PAUSE_S = 0.3  # between steps, for what is still on its way


@dataclass(frozen=True)
class Step:
    """At most `count` messages of `size` bytes, for at most `limit_s`; unpaced without `rate_hz`."""

    size: int
    count: int
    rate_hz: float
    limit_s: float = 10.0


@dataclass(frozen=True)
class Setting:
    """What sender and receivers of one measurement are told."""

    module: str
    variant: str
    key: str  # of this measurement alone
    folder: Path
    steps: tuple[Step, ...]
    readers: int = 1
    stall_s: float = 0.0  # how long each receiver sleeps, once, a fifth into the first step

    def dump(self, path: Path) -> None:
        """Write it for the processes to read."""
        path.write_text(json.dumps(asdict(self), default=str), encoding="utf-8")

    def address(self) -> str:
        """What the sender has said of where it listens, when it has."""
        path = self.folder / "address"
        while not path.exists():
            time.sleep(0.005)
        return path.read_text(encoding="utf-8")

    def say_address(self, address: str) -> None:
        """Tell the receivers where the sender listens."""
        (self.folder / "address.new").write_text(address, encoding="utf-8")
        (self.folder / "address.new").rename(self.folder / "address")

    def ready(self, index: int) -> None:
        """Tell the sender that a receiver listens."""
        (self.folder / f"ready-{index}").touch()

    def wait_ready(self) -> None:
        """Wait until all receivers listen."""
        while not all((self.folder / f"ready-{index}").exists() for index in range(self.readers)):
            time.sleep(0.005)

    def all_done(self) -> bool:
        """Whether every receiver has told its results."""
        return all((self.folder / f"receive-{index}.json").exists() for index in range(self.readers))

    def messages(self) -> Iterator[float | Bytes]:
        """What to send, in turn: an array, or how many seconds to wait before asking again."""
        sent, costs_us = [], []
        for number, step in enumerate(self.steps):
            counted, costs = yield from _of_step(number, step)
            sent.append(counted)
            costs_us.append(costs)
            yield PAUSE_S
        result = {"sent": sent, "send_us": costs_us}
        (self.folder / "send.json").write_text(json.dumps(result), encoding="utf-8")
        while not self.all_done():
            message = np.zeros(1024, np.uint8)
            message[:8].view(np.uint64)[0] = END
            yield message
            yield 0.1


def _of_step(number: int, step: Step) -> Generator[float | Bytes, None, tuple[int, list[float]]]:
    """The messages of a step; returns how many there were and the microseconds that each took to send."""
    message = np.random.default_rng(number).integers(0, 256, step.size, np.uint8)
    head, tail = message[:32].view(np.uint64), message[-8:].view(np.uint64)
    costs: list[float] = []
    began = time.perf_counter()
    due = began
    for count in range(step.count):
        now = time.perf_counter()
        if now - began > step.limit_s:
            return count, costs
        if step.rate_hz:
            due = max(due + 1.0 / step.rate_hz, now)
            yield due - now
        head[0] = number
        head[1] = tail[0] = count
        head[2] = sending = time.perf_counter_ns()
        yield message
        costs.append((time.perf_counter_ns() - sending) / 1e3)
    return step.count, costs


@dataclass
class Tally:
    """What one receiver has got, step by step."""

    setting: Setting
    index: int
    latency_us: list[list[float]] = field(init=False)
    received: list[int] = field(init=False)
    disordered: int = 0
    torn: int = 0

    def __post_init__(self) -> None:
        steps = len(self.setting.steps)
        self.latency_us = [[] for _ in range(steps)]
        self.received = [0] * steps
        self._span = [[0, 0] for _ in range(steps)]  # when the first was sent, and the last had arrived, ns
        self._next = [0] * steps

    def take(self, message: Bytes) -> bool:
        """Count a message that is now an array here; False when there will be no more."""
        now = time.perf_counter_ns()
        step, count, sent, _ = (int(word) for word in message[:32].view(np.uint64))
        if step == END:
            return False
        last = int(message[-8:].view(np.uint64)[0])
        self.torn += last != count or message.size != self.setting.steps[step].size
        self.disordered += count < self._next[step]
        self._next[step] = count + 1
        if self.received[step] == 0:
            self._span[step][0] = sent
        self._span[step][1] = now
        self.received[step] += 1
        if self.setting.steps[step].rate_hz:
            self.latency_us[step].append((now - sent) / 1e3)
        if self.setting.stall_s and step == 0 and self.received[0] == self.setting.steps[0].count // 5:
            time.sleep(self.setting.stall_s)
        return True

    def save(self) -> None:
        """Write the results."""
        result = {
            "latency_us": self.latency_us,
            "received": self.received,
            "span_s": [(end - begin) / 1e9 for begin, end in self._span],
            "disordered": self.disordered,
            "torn": self.torn,
        }
        path = self.setting.folder / f"receive-{self.index}.json"
        path.with_suffix(".new").write_text(json.dumps(result), encoding="utf-8")
        path.with_suffix(".new").rename(path)


def load(path: Path) -> Setting:
    """The setting in a file that `dump` wrote."""
    values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    values["steps"] = tuple(Step(**step) for step in values["steps"])
    return Setting(**{**values, "folder": Path(values["folder"])})


def main() -> None:
    """Be one process of a measurement."""
    setting, role, index = load(Path(sys.argv[1])), sys.argv[2], int(sys.argv[3])
    module = importlib.import_module(f"benchmarks.transport_peers.{setting.module}")
    if role == "send":
        module.send(setting)
    else:
        tally = Tally(setting, index)
        module.receive(setting, tally)
        tally.save()


if __name__ == "__main__":
    main()
