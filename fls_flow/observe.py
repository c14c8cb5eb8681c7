"""Counts, times and results of a run, as `run.json`, the closing table and `top` show them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sized
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fls_flow.messages import Message, Tracks, TrackStatus

__all__ = ["NodeCounts", "Tally"]

RECENT = 4096  # firings over which the percentiles are taken: bounded, whatever the length of the run


@dataclass
class Tally:
    """What one output has given so far."""

    entries: int = 0
    confirmed: int = 0
    _ids: set[int] = field(default_factory=set, repr=False)  # of confirmed tracks; a few bytes a track

    def add(self, message: Message) -> None:
        """Count a message."""
        if isinstance(message, Sized):
            self.entries += len(message)
        if isinstance(message, Tracks):
            self._ids.update(message.id[message.status == TrackStatus.CONFIRMED].tolist())
            self.confirmed = len(self._ids)


@dataclass
class NodeCounts:
    """What one node has done so far; written by its own thread alone."""

    fired: int = 0
    failed: int = 0  # answered empty for `on_error: skip`
    shed: int = 0  # pings that a live source let go
    dropped: int = 0  # samples of a stream whose stamp did not increase, or that found no room
    seconds: float = 0.0
    outputs: dict[str, Tally] = field(default_factory=dict)
    _percentiles: dict[float, float] = field(default_factory=dict, repr=False)
    _recent: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT), repr=False)

    def timed(self, seconds: float) -> None:
        """Count one firing that took that long."""
        self.fired += 1
        self.seconds += seconds
        self._recent.append(seconds)

    def given(self, output: str, message: Message) -> None:
        """Count what an output gives."""
        self.outputs.setdefault(output, Tally()).add(message)

    def percentile_ms(self, q: float) -> float:
        """That percentile of the latest firings' times, ms; nan before the first."""
        if q in self._percentiles:
            return self._percentiles[q]
        recent = list(self._recent)
        return float(np.percentile(recent, q)) * 1e3 if recent else float("nan")

    def summary(self) -> dict[str, Any]:
        """The counts as plain values."""
        times = {"p50_ms": self.percentile_ms(50), "p99_ms": self.percentile_ms(99)}
        times = {name: ms for name, ms in times.items() if not math.isnan(ms)}  # JSON has no nan
        counts = {"fired": self.fired, "failed": self.failed, "shed": self.shed, "dropped": self.dropped}
        outputs = {
            name: {
                "entries": tally.entries,
                **({"confirmed": tally.confirmed} if tally.confirmed else {}),
            }
            for name, tally in self.outputs.items()
        }
        return {**counts, **{name: round(ms, 4) for name, ms in times.items()}, "outputs": outputs}

    @classmethod
    def of_summary(cls, summary: dict[str, Any]) -> NodeCounts:
        """The counts of another process, as `summary` gave them."""
        outputs = {name: Tally(**tally) for name, tally in summary["outputs"].items()}
        percentiles = {q: float(summary.get(f"p{q:.0f}_ms", "nan")) for q in (50.0, 99.0)}
        numbers = {name: summary[name] for name in ("fired", "failed", "shed", "dropped")}
        return cls(**numbers, outputs=outputs, _percentiles=percentiles)
