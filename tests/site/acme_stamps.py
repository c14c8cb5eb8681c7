"""A stream of navigation with the stamps that it is told."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

from fls_flow import NavState, hookimpl


@dataclass
class Stamps:
    """Samples stamped as listed; a live one then falls silent without an end."""

    stamps_ms: tuple[int, ...] = ()
    live: bool = False
    _closed: threading.Event = field(default_factory=threading.Event, init=False, repr=False)

    def __call__(self) -> Iterator[NavState]:
        for n, stamp in enumerate(self.stamps_ms):
            yield NavState(n, stamp * 1_000_000)
        if self.live:
            self._closed.wait(60.0)

    def close(self) -> None:
        self._closed.set()


@hookimpl
def fls_node() -> type[Stamps]:
    return Stamps
