"""How many false measurements a ping brings, set or learnt."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["ClutterRate"]

FloatArray = npt.NDArray[np.float64]

FIRST_GUESS, FLOOR = 2.0, 0.02
RATE = 0.1  # of the recursive mean


@dataclass
class ClutterRate:
    """The expected number of false measurements per ping: `fixed`, or else a running mean of those seen."""

    fixed: float | None
    _mean: float = field(default=FIRST_GUESS, init=False, repr=False)
    _pings: int = field(default=0, init=False, repr=False)

    @property
    def per_ping(self) -> float:
        """The number to expect in the next ping."""
        return self._mean if self.fixed is None else self.fixed

    def learn(self, taken: FloatArray) -> None:
        """Take in a ping whose measurements come from targets with the probabilities `taken` (m,)."""
        self._pings += 1
        rate = max(RATE, 1.0 / (self._pings + 1))
        self._mean = max(FLOOR, self._mean + rate * (float((1.0 - taken).sum()) - self._mean))

    def snapshot(self) -> dict[str, Any]:
        """What was learnt."""
        return {"mean": self._mean, "pings": self._pings}

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._mean, self._pings = float(saved["mean"]), int(saved["pings"])
