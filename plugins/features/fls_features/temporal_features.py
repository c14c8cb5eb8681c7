"""Describe how the features of each track change from ping to ping."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_features.blocks import block_names, block_statistics
from fls_flow import Features, hookimpl

__all__ = ["TemporalFeatures"]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]


def _none() -> IntArray:
    return np.zeros(0, np.int64)


def _nothing() -> FloatArray:
    return np.zeros((0, 0, 0))


@dataclass
class TemporalFeatures:
    """Mean, variance, mean rate and variance of the rate of each feature over blocks of `block` pings.

    A row comes in the ping that completes a block; then the next block of the track begins. A track must be
    described at least every `max_gap` pings, counted as they come: after a longer gap its block begins anew,
    since differences over several pings are not those over one. It begins anew, too, with a ping in which
    the feature `leap_of` (a size) is more than `max_leap` times as large as in the last one, or as small: a
    region that takes in another swimmer, or lets it go, is not the same object. Rates are per ping.

    Raises ValueError when features come without the one of `leap_of`.

    Source: Brinkmann 2010, 3.3.2.2; leaps are ours.
    """

    block: int = 5
    max_gap: int = 1
    leap_of: str | None = None  # None: no block is broken
    max_leap: float = 2.5
    _names: tuple[str, ...] = field(default=(), init=False, repr=False)
    _firing: int = field(default=0, init=False, repr=False)
    _id: IntArray = field(default_factory=_none, init=False, repr=False)  # of the open blocks, increasing
    _count: IntArray = field(default_factory=_none, init=False, repr=False)  # their rows so far
    _last: IntArray = field(default_factory=_none, init=False, repr=False)  # firing of the newest row
    _rows: FloatArray = field(default_factory=_nothing, init=False, repr=False)  # (n, block, n_features)

    def __post_init__(self) -> None:
        if self.block < 2:
            raise ValueError(f"block is {self.block}; it takes at least 2 pings")
        if self.max_gap < 1:
            raise ValueError(f"max_gap is {self.max_gap}; it must be at least 1")
        if not self.max_leap > 1.0:
            raise ValueError(f"max_leap is {self.max_leap}; it must be more than 1")

    def __call__(self, features: Features) -> Features:
        """The blocks that this ping completes."""
        self._firing += 1
        if features.names and features.names != self._names:
            self._meet(features.names)
            self._open(_none(), _none(), _none(), np.zeros((0, self.block, len(features.names))))
        if not self._names:
            return Features(features.seq, features.stamp_ns)
        self._forget()
        if len(features):
            self._append(features)
        full = self._count == self.block
        track_id, values = self._id[full], block_statistics(self._rows[full])
        self._open(self._id[~full], self._count[~full], self._last[~full], self._rows[~full])
        return Features(features.seq, features.stamp_ns, track_id, block_names(self._names), values)

    def _meet(self, names: tuple[str, ...]) -> None:
        if self.leap_of is not None and self.leap_of not in names:
            raise ValueError(f"leap_of is '{self.leap_of}'; the features are {', '.join(names)}")
        self._names = names

    def _forget(self) -> None:
        """Drop the blocks that can no longer be completed without a gap."""
        alive = self._firing - self._last <= self.max_gap
        self._open(self._id[alive], self._count[alive], self._last[alive], self._rows[alive])

    def _append(self, features: Features) -> None:
        """Add a row to the block of each described track; the first of two rows of one track counts."""
        track_id, first = np.unique(features.track_id, return_index=True)
        every = np.union1d(self._id, track_id)
        count, last = np.zeros(every.size, np.int64), np.zeros(every.size, np.int64)
        rows = np.zeros((every.size, self.block, features.values.shape[1]))
        old, new = np.searchsorted(every, self._id), np.searchsorted(every, track_id)
        count[old], last[old], rows[old] = self._count, self._last, self._rows
        if self.leap_of is not None:
            size = self._names.index(self.leap_of)
            before, now = rows[new, np.maximum(count[new] - 1, 0), size], features.values[first, size]
            leapt = (now > self.max_leap * before) | (before > self.max_leap * now)
            count[new[leapt]] = 0
        rows[new, count[new]] = features.values[first]
        count[new] += 1
        last[new] = self._firing
        self._open(every, count, last, rows)

    def _open(self, track_id: IntArray, count: IntArray, last: IntArray, rows: FloatArray) -> None:
        self._id, self._count, self._last, self._rows = track_id, count, last, rows

    def snapshot(self) -> dict[str, Any]:
        """The open blocks."""
        return {
            "names": list(self._names),
            "firing": self._firing,
            "id": self._id.copy(),
            "count": self._count.copy(),
            "last": self._last.copy(),
            "rows": self._rows.copy(),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._names, self._firing = tuple(snapshot["names"]), int(snapshot["firing"])
        parts = (np.array(snapshot[name]) for name in ("id", "count", "last", "rows"))
        self._open(*parts)


@hookimpl
def fls_node() -> type[TemporalFeatures]:
    """Return the node of kind `temporal-features`."""
    return TemporalFeatures
