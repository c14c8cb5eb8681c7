"""A source whose numbers gap and repeat, and which may be live."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from fls_flow import Ping, hookimpl


@dataclass
class Sonar:
    """Ping n has the number 3 * (n // 2) and holds n in each cell; a live one keeps the pace of its stamps."""

    pings: int = 12
    period_s: float = 0.1
    live: bool = False
    hangs: bool = False
    _closed: threading.Event = field(default_factory=threading.Event, init=False, repr=False)

    def __call__(self) -> Iterator[Ping]:
        for n in range(self.pings):
            if self.live and self._closed.wait(self.period_s):
                return
            image = np.full((4, 3), n, np.float32)
            yield Ping(3 * (n // 2), int(n * self.period_s * 1e9), image, np.arange(1.0, 5.0), np.arange(3.0))
        if self.hangs:
            self._closed.wait(60.0)

    def close(self) -> None:
        self._closed.set()


@hookimpl
def fls_node() -> type[Sonar]:
    return Sonar
