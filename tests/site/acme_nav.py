"""A stream of navigation that has no end of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from fls_flow import NavState, hookimpl


@dataclass
class Nav:
    """Stamps at a fixed rate."""

    rate_hz: float = 33.0

    def __call__(self) -> Iterator[NavState]:
        for n in range(100_000):
            yield NavState(n, int(n * 1e9 / self.rate_hz))


@hookimpl
def fls_node() -> type[Nav]:
    return Nav
