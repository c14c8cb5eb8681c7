"""A node that tells what it gets, and breaks a rule at one ping."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from fls_flow import Detections, NavState, Ping, hookimpl


@dataclass
class Ruled:
    """Ranges: what the ping holds, what the one before held (-1: None), how many it has seen, stamps of nav (ms)."""

    breaks: Literal["", "none", "seq", "stamp", "writes", "raises", "hangs"] = ""
    at: int = 4
    sleep_s: float = 0.0
    _seen: int = field(default=0, init=False, repr=False)

    def __call__(
        self, ping: Ping, nav: tuple[NavState, ...] = (), before: Detections | None = None
    ) -> Detections:
        held, last = (
            float(ping.amplitude[0, 0]),
            -1.0 if before is None or not len(before) else float(before.amplitude[0]),
        )
        self._seen += 1
        time.sleep(self.sleep_s)
        values = [held, last, float(self._seen), *(one.stamp_ns / 1e6 for one in nav)]
        amplitude = np.full(len(values), held)
        answer = Detections.of(ping, range_m=values, bearing_rad=np.zeros(len(values)), amplitude=amplitude)
        return answer if held != self.at else self._broken(ping, answer)

    def _broken(self, ping: Ping, answer: Detections) -> Any:
        if self.breaks == "raises":
            raise ValueError("no echo today")
        if self.breaks == "hangs":
            time.sleep(60.0)
        if self.breaks == "writes":
            ping.amplitude[0, 0] = 7.0
        broken = {
            "none": None,
            "seq": Detections(ping.seq + 1, ping.stamp_ns),
            "stamp": Detections(ping.seq, ping.stamp_ns + 1),
        }
        return broken.get(self.breaks, answer)

    def snapshot(self) -> dict[str, Any]:
        return {"seen": self._seen}

    def restore(self, state: dict[str, Any]) -> None:
        self._seen = state["seen"]


@hookimpl
def fls_node() -> type[Ruled]:
    return Ruled
