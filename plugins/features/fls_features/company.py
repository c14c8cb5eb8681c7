"""Which regions belong to one swimmer alone, judged by the other tracks about them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_features.chip_messages import Chips
from fls_flow.kernels import compiled, frozen

__all__ = ["Company", "nearest_cells_m"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

KNOWN = 5  # pings alone, before that says something
FORGOTTEN = 100  # pings without a chip, after which a track has ended


def _none() -> IntArray:
    return np.zeros(0, np.int64)


@dataclass
class Company:
    """How often each track's region was its own, and how often another track was in it."""

    _firing: int = field(default=0, init=False, repr=False)
    _id: IntArray = field(default_factory=_none, init=False, repr=False)  # increasing
    _last: IntArray = field(default_factory=_none, init=False, repr=False)  # firing of the newest chip
    _alone: IntArray = field(default_factory=_none, init=False, repr=False)  # pings
    _shared: IntArray = field(default_factory=_none, init=False, repr=False)

    def describes(self, chips: Chips, mask: BoolArray, reach_m: float) -> BoolArray:
        """Whether the region (n, rows, columns) in each chip shows one object; learns of the tracks.

        A region is shared with the tracks nearer than `reach_m` to one of its cells. A shared one shows more
        than its object when its own track, or one that it is shared with, was alone in most pings before, and
        in KNOWN at least.
        """
        self._firing += 1
        apart = nearest_cells_m(chips, mask)
        pairs = np.flatnonzero(apart <= reach_m)
        chip, other = chips.near_chip[pairs], chips.near_id[pairs]
        mixed = np.zeros(len(chips), bool)
        loner = self._is_loner(chips.track_id)
        mixed[chip[loner[chip] | self._is_loner(other)]] = True
        shared = np.zeros(len(chips), bool)
        shared[chip] = True
        self._learn(chips.track_id, shared)
        return ~mixed

    def _is_loner(self, track_id: IntArray) -> BoolArray:
        if not self._id.size:
            return np.zeros(track_id.size, bool)
        at = np.minimum(np.searchsorted(self._id, track_id), self._id.size - 1)
        loner = (self._alone >= KNOWN) & (self._alone > self._shared)
        return np.asarray((self._id[at] == track_id) & loner[at])

    def _learn(self, track_id: IntArray, shared: BoolArray) -> None:
        track_id, first = np.unique(track_id, return_index=True)
        every = np.union1d(self._id, track_id)
        old, new = np.searchsorted(every, self._id), np.searchsorted(every, track_id)
        counts = np.zeros((3, every.size), np.int64)
        counts[:, old] = self._last, self._alone, self._shared
        counts[0, new] = self._firing
        counts[1, new] += ~shared[first]
        counts[2, new] += shared[first]
        goes_on = self._firing - counts[0] < FORGOTTEN
        self._id, (self._last, self._alone, self._shared) = every[goes_on], counts[:, goes_on]

    def snapshot(self) -> dict[str, Any]:
        """The counts."""
        return {
            "firing": self._firing,
            "id": self._id.copy(),
            "last": self._last.copy(),
            "alone": self._alone.copy(),
            "shared": self._shared.copy(),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._firing = int(snapshot["firing"])
        self._id, self._last = np.array(snapshot["id"]), np.array(snapshot["last"])
        self._alone, self._shared = np.array(snapshot["alone"]), np.array(snapshot["shared"])


def nearest_cells_m(chips: Chips, mask: BoolArray) -> FloatArray:
    """(m,) how far each of the tracks near the chips is from the nearest cell of the chip's region, m."""
    apart = np.full(chips.near_chip.size, np.inf)
    if apart.size:
        near = frozen(chips.near_chip), frozen(chips.near_polar)
        _nearest(frozen(mask), frozen(chips.range_m), frozen(chips.bearing_rad), *near, apart)
    return np.asarray(np.sqrt(apart))


@compiled
def _nearest(
    mask: BoolArray,
    range_m: FloatArray,
    bearing_rad: FloatArray,
    chip: IntArray,
    polar: FloatArray,
    square: FloatArray,
) -> None:
    _, rows, columns = mask.shape
    cosine = np.empty(columns)
    for p in range(chip.size):
        k, r0, b0 = chip[p], polar[p, 0], polar[p, 1]
        for j in range(columns):
            cosine[j] = np.cos(bearing_rad[k, j] - b0)
        for i in range(rows):
            r = range_m[k, i]
            if (r - r0) * (r - r0) >= square[p]:  # no cell of this row is nearer
                continue
            for j in range(columns):
                if mask[k, i, j]:
                    square[p] = min(square[p], max(r * r + r0 * r0 - 2.0 * r * r0 * cosine[j], 0.0))
