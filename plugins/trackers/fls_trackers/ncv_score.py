"""Scores of the blob tracker's tracks: who chooses first, and what a blob tells if clutter persists."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from fls_flow import TrackStatus
from fls_flow.geometry import wrap
from fls_trackers.ncv_bank import Rows
from fls_trackers.ncv_scan import Scan

__all__ = ["Priority", "in_memory", "turns"]

Priority = Literal["none", "confirmed", "score"]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

SCORES = (2.0, 6.0)  # of tracks that choose before those with less
STANDS = 0.25  # probability that a target which is where it was stands there and did not come there


def turns(rows: Rows, priority: Priority) -> list[BoolArray]:
    """The tracks (n,) that choose blobs together, those first that choose first."""
    confirmed = rows["status"] == TrackStatus.CONFIRMED
    if priority == "none":
        return [np.ones(rows.size, bool)]
    if priority == "confirmed":
        return [confirmed, ~confirmed]
    first = len(SCORES) + 1
    rank = np.where(confirmed, first, np.searchsorted(SCORES, rows["score"], side="right"))
    return [rank == k for k in range(first, -1, -1)]


def in_memory(gain: FloatArray, rows: Rows, scan: Scan, blob: IntArray) -> FloatArray:
    """What blobs add to the scores of the tracks that took them, given the last ping; `gain` without it.

    A target that moves comes to places which the last ping announced as little as any other clutter. One that
    stands, and is where the track's last blob was, must persist better than clutter does.
    """
    recalled = scan.recalled.take(blob)
    gain = gain - recalled.announced()
    if recalled.correlation <= 0.0:
        return gain
    off_m = np.abs(scan.polar[blob, 0] - rows["range_m"])
    off_rad = np.abs(wrap(scan.polar[blob, 1] - rows["bearing_rad"]))
    stands = (off_m <= scan.cell[0]) & (off_rad <= scan.cell[1])
    standing = recalled.standing(np.exp(rows["level"])) + np.log(STANDS)
    return np.where(stands, np.logaddexp(gain + np.log(1.0 - STANDS), standing), gain)
