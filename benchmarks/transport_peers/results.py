"""What one measurement gave, put together from what its processes wrote."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.transport_peers.rig import Setting

__all__ = ["Result", "read"]


@dataclass(frozen=True)
class Result:
    """Figures of one measurement; lists have an entry per step."""

    p50_us: list[float]  # of all receivers' messages; NaN for unpaced steps
    p99_us: list[float]
    send_us: list[float]  # median time that one send takes the sender
    sent: list[int]
    received: list[int]  # by the receiver that got least
    rate: list[float]  # messages per second at the slowest receiver
    gbps: list[float]  # GB/s
    disordered: int
    torn: int

    def lost(self, step: int) -> float:
        """The part of the messages that a receiver did not get."""
        return 1.0 - self.received[step] / self.sent[step] if self.sent[step] else 0.0


def read(setting: Setting) -> Result:
    """The figures of a measurement that has ended well."""
    sender = _load(setting, "send")
    receivers = [_load(setting, f"receive-{index}") for index in range(setting.readers)]
    steps = range(len(setting.steps))
    latencies = [[us for receiver in receivers for us in receiver["latency_us"][step]] for step in steps]
    rates = [min(_rate(receiver, step) for receiver in receivers) for step in steps]
    return Result(
        p50_us=[_percentile(found, 50) for found in latencies],
        p99_us=[_percentile(found, 99) for found in latencies],
        send_us=[_percentile(found, 50) for found in sender["send_us"]],
        sent=sender["sent"],
        received=[min(receiver["received"][step] for receiver in receivers) for step in steps],
        rate=rates,
        gbps=[rate * step.size / 1e9 for rate, step in zip(rates, setting.steps, strict=True)],
        disordered=sum(receiver["disordered"] for receiver in receivers),
        torn=sum(receiver["torn"] for receiver in receivers),
    )


def _load(setting: Setting, name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((setting.folder / f"{name}.json").read_text(encoding="utf-8"))
    return found


def _rate(receiver: dict[str, Any], step: int) -> float:
    span_s: float = receiver["span_s"][step]
    return float(receiver["received"][step] / span_s) if span_s > 0 else 0.0


def _percentile(values: list[float], percent: float) -> float:
    return float(np.percentile(values, percent)) if values else float("nan")
