"""A sink that cannot keep up."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from fls_flow import Detections, Ping, hookimpl


@dataclass
class Lazy:
    """Notes the numbers of the pings that it got."""

    path: Path = Path("lazy.txt")
    sleep_s: float = 0.3
    _seen: list[int] = field(default_factory=list, init=False, repr=False)

    def __call__(self, detections: Detections, ping: Ping) -> None:
        time.sleep(self.sleep_s)
        if detections.seq != ping.seq:
            raise ValueError("inputs of different pings")
        self._seen.append(detections.seq)

    def close(self) -> None:
        self.path.write_text(" ".join(map(str, self._seen)))


@hookimpl
def fls_node() -> type[Lazy]:
    return Lazy
