"""When a blob tracker's track is confirmed, and when it ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow import TrackStatus
from fls_trackers.ncv_bank import Rows

__all__ = ["WINDOW", "Life"]

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

WINDOW = 62  # bits of a track's history


@dataclass(frozen=True, slots=True)
class Life:
    """Confirmation by count and score, end by count, score and lobes.

    Raises ValueError for bad values.
    """

    confirm_hits: int
    confirm_score: float
    keep_hits: int
    keep_pings: int
    drop_score: float
    lobe_pings: int

    def __post_init__(self) -> None:
        if not max(self.confirm_score, self.drop_score) < np.inf:
            raise ValueError(
                f"confirm_score {self.confirm_score} and drop_score {self.drop_score} must be numbers or -inf"
            )
        if not 1 <= self.keep_hits <= self.keep_pings <= WINDOW:
            raise ValueError(
                f"keep_hits {self.keep_hits} of keep_pings {self.keep_pings}: needs 1 to {WINDOW}"
            )
        for name, least in (("confirm_hits", 0), ("lobe_pings", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}")

    def after(self, rows: Rows, hit: BoolArray, lobe: BoolArray) -> Rows:
        """The rows after a ping: which tracks it gave a blob, and which it showed as lobes.

        A tentative track that ends has 0 hits from then on: it is dropped without a word.
        """
        rows = rows.copy()
        rows["history"] = ((rows["history"] << 1) & ((1 << WINDOW) - 1)) | hit
        rows["span"] = np.minimum(rows["span"] + 1, WINDOW)
        rows["mirrored"] = np.maximum(rows["mirrored"] + np.where(lobe, 1, -hit.astype(np.int64)), 0)
        judged = np.minimum(rows["span"], self.keep_pings)
        misses = judged - np.bitwise_count(rows["history"] & ((1 << self.keep_pings) - 1))
        ends = (misses > self.keep_pings - self.keep_hits) | (rows["mirrored"] >= self.lobe_pings)
        tentative = rows["status"] == TrackStatus.TENTATIVE
        ends |= tentative & (rows["score"] < self.drop_score)
        confirmed = tentative & ~ends & (rows["hits"] > self.confirm_hits) & (rows["mirrored"] == 0)
        confirmed &= rows["score"] >= self.confirm_score
        rows["status"][confirmed] = TrackStatus.CONFIRMED
        rows["hits"][ends & tentative] = 0
        rows["status"][ends] = TrackStatus.LOST
        return rows
