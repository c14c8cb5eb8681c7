"""A source of pings that do not compress, 10 a second by their stamps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fls_flow import Ping, hookimpl


@dataclass
class Pings:
    """The last cell of each image is the ping's number."""

    pings: int = 40
    cells: int = 100

    def __call__(self) -> Iterator[Ping]:
        for n in range(self.pings):
            image = np.random.default_rng(n).random((self.cells, 3), np.float32)
            image[-1, -1] = n
            yield Ping(n, n * 100_000_000, image, np.arange(float(self.cells)), np.arange(3.0))

    def __len__(self) -> int:
        return self.pings


@hookimpl
def fls_node() -> type[Pings]:
    return Pings
