"""Tracks that each follow their object for themselves, and follow the same one; compiled."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.life import CONFIRMED, SEEN, TENTATIVE, UNRESOLVED, near
from fls_trackers.track_bank import Ledger

__all__ = ["alike", "common"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

SAME_GATE = 9.49  # statistical distance over position and velocity of tracks that may be one: 95 %
LONG_KNOWN = 40  # pings: what a track's own past counts at most against being part of another


@compiled
def alike(
    status: IntArray,
    table: Ledger,
    keep: BoolArray,
    state: FloatArray,
    covariance: FloatArray,
    none: FloatArray,
    max_common: int,
) -> IntArray:
    """The track (n,) that each one is part of, -1: none, of tracks that share events out.

    That one is confirmed if t is, and the older of two that both are, or both are not. Both are near, and
    have about one event together, counted in `table`. A track that is part of another goes from `keep`.
    """
    n = status.size
    part, scratch = np.full(n, -1), np.empty((5, 4))
    x, y = state[:, 0].copy(), state[:, 1].copy()
    gate = 1.001 * SAME_GATE
    reach_x, reach_y = gate * covariance[:, 0, 0], gate * covariance[:, 1, 1]
    near_by = np.zeros((n + 7) // 8 * 8, np.uint8)
    words = near_by.view(np.uint64)
    for level in (CONFIRMED, TENTATIVE):
        for t in range(n):
            if status[t] != level or not keep[t]:
                continue
            here_x, here_y, far_x, far_y = x[t], y[t], reach_x[t], reach_y[t]
            for j in range(n):  # no distance is less than that along one axis
                near_by[j] = ((here_x - x[j]) ** 2 <= far_x + reach_x[j]) & (
                    (here_y - y[j]) ** 2 <= far_y + reach_y[j]
                )
            near_by[t] = 0
            rival = -1
            for word in range(words.size):
                for j in range(8 * word, 8 * word + 8 if words[word] and rival < 0 else 0):
                    if rival >= 0 or not (near_by[j] and keep[j]):
                        continue
                    senior = status[j] > level or (status[j] == level and j < t)
                    if senior and near(state, covariance, t, j, SAME_GATE, scratch):
                        rival = j
            if _is_part(table, t, rival, none, max_common, status[t] == CONFIRMED):
                part[t], keep[t] = rival, False
    return part


@compiled
def _is_part(table: Ledger, t: int, rival: int, none: FloatArray, max_common: int, sure: bool) -> bool:
    """Whether a track is its rival's part, after counting the events that the two explained together."""
    row = table[t]
    if rival < 0:
        row.rival_pings = max(0, row.rival_pings - 1)
        return False
    explained = 2.0 - none[t] - none[rival]
    if row.rival != table[rival].id:
        row.rival, row.rival_pings = table[rival].id, 0
    if explained > UNRESOLVED:
        row.rival_pings = max(0, row.rival_pings - 2)
    elif explained > SEEN:
        row.rival_pings += 1
    past = min(max(row.hits - row.rival_pings, 0), LONG_KNOWN) if sure else 0
    return bool(row.rival_pings >= max_common + past)


@compiled
def common(
    status: IntArray,
    table: Ledger,
    keep: BoolArray,
    state: FloatArray,
    covariance: FloatArray,
    event: IntArray,
    max_common: int,
) -> IntArray:
    """The same of tracks that each take their own event (n,): two had the same one in as many pings."""
    part, scratch = np.full(status.size, -1), np.empty((5, 4))
    for level in (CONFIRMED, TENTATIVE):
        for t in range(status.size):
            if status[t] == level and keep[t] and event[t] >= 0:
                part[t] = _same_event(t, status, table, keep, state, covariance, event, max_common, scratch)
                keep[t] = part[t] < 0
    return part


@compiled
def _same_event(
    t: int,
    status: IntArray,
    table: Ledger,
    keep: BoolArray,
    state: FloatArray,
    covariance: FloatArray,
    event: IntArray,
    max_common: int,
    scratch: FloatArray,
) -> int:
    row = table[t]
    for j in range(table.size):
        senior = status[j] > status[t] or (status[j] == status[t] and j < t)
        if not (senior and keep[j] and event[j] >= 0):
            continue
        if event[j] == event[t]:
            row.rival_pings = row.rival_pings + 1 if row.rival == table[j].id else 1
            row.rival = table[j].id
            if row.rival_pings < max_common:
                return -1
            return j if near(state, covariance, t, j, SAME_GATE, scratch) else -1
        if table[j].id == row.rival:
            row.rival, row.rival_pings = 0, 0
    return -1
