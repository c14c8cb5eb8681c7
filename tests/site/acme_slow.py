"""A node that sleeps, or fails."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from fls_flow import Detections, NavState, Ping, hookimpl


@dataclass
class Slow:
    """Gives what it has got, so that loss or disorder shows."""

    sleep_s: float = 0.0
    fail_at: int = -1
    says: str = ""

    def __call__(
        self, ping: Ping, nav: tuple[NavState, ...] = (), before: Detections | None = None
    ) -> Detections:
        time.sleep(self.sleep_s)
        if self.says:
            print(self.says, ping.seq)  # noqa: T201  # what becomes of it is tested
        if ping.seq == self.fail_at:
            raise ValueError("no echo today")
        values = [float(ping.amplitude[-1, -1]), *(one.stamp_ns * 1e-9 for one in nav)]
        values.append(-1.0 if before is None else float(before.range_m.sum()))
        zeros = np.zeros(len(values))
        return Detections.of(ping, range_m=values, bearing_rad=zeros, amplitude=zeros)


@hookimpl
def fls_node() -> type[Slow]:
    return Slow
