"""When a track begins: M of N pings with a detection in a box, or M of N pings with an update."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import TrackStatus
from fls_flow.kernels import compiled
from fls_trackers.track_bank import TrackBank, new_tracks

__all__ = [
    "BoxInitiator",
    "BoxStarts",
    "box_tracks",
    "by_place",
    "distinct",
    "several_in_a_beam",
    "starting",
    "strongest",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

INFLATION = 5.0  # of the covariance of a track that a box starts


class BoxStarts(NamedTuple):
    """Where tracks begin in a ping."""

    which: IntArray  # (k,) measurements of the ping, those seen in most pings first
    history: IntArray  # (k,) bit i: seen in the box i pings ago
    span: int  # pings that the histories cover
    window_s: float  # m1 times the mean interval of those pings; nan with one ping


@dataclass
class BoxInitiator:
    """Starts a track where at least `n1` of the last `m1` pings had an unclaimed measurement in one box.

    The box is |dx| < x_max, |dy| < y_max around a measurement of the current ping. Pings are counted, not
    measurements: an extended wake gives many in one ping.

    Source: Karoui 2015, section IV-C; the box as in ALGORITHMS E-K10.
    """

    m1: int
    n1: int
    _positions: list[FloatArray] = field(default_factory=list, init=False, repr=False)
    _stamps_ns: list[int] = field(default_factory=list, init=False, repr=False)

    def __call__(self, unclaimed: FloatArray, stamp_ns: int, x_max_m: float, y_max_m: float) -> BoxStarts:
        """The starts among this ping's unclaimed measurements (m, 2), which must come once per ping."""
        self._positions.append(unclaimed.copy())
        self._stamps_ns.append(stamp_ns)
        del self._positions[: -self.m1], self._stamps_ns[: -self.m1]
        pings = np.repeat(np.arange(len(self._positions))[::-1], [len(p) for p in self._positions])
        history = _box_history(unclaimed, np.concatenate(self._positions), pings, x_max_m, y_max_m)
        seen = np.bitwise_count(history).astype(np.int64)
        order = np.lexsort((unclaimed[:, 1], unclaimed[:, 0], -seen))
        which = order[seen[order] >= self.n1]
        gaps = len(self._stamps_ns) - 1
        window_s = self.m1 * (stamp_ns - self._stamps_ns[0]) * 1e-9 / gaps if gaps else float("nan")
        return BoxStarts(which, history[which], len(self._positions), window_s)

    def snapshot(self) -> dict[str, Any]:
        """The window, as plain arrays."""
        return {
            "box_positions": np.concatenate([np.zeros((0, 2)), *self._positions]),
            "box_lengths": np.array([len(p) for p in self._positions], np.int64),
            "box_stamps_ns": np.array(self._stamps_ns, np.int64),
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        ends = np.cumsum(saved["box_lengths"])[:-1]
        lengths = len(saved["box_lengths"])
        positions = np.array(saved["box_positions"], float).reshape(-1, 2)
        self._positions = list(np.split(positions, ends)) if lengths else []
        self._stamps_ns = [int(s) for s in saved["box_stamps_ns"]]


@compiled
def _box_history(
    current: FloatArray, positions: FloatArray, pings: IntArray, x_max: float, y_max: float
) -> IntArray:
    history = np.zeros(current.shape[0], np.int64)
    for j in range(current.shape[0]):
        for i in range(positions.shape[0]):
            if abs(positions[i, 0] - current[j, 0]) < x_max and abs(positions[i, 1] - current[j, 1]) < y_max:
                history[j] |= 1 << pings[i]
    return history


def box_tracks(
    starts: BoxStarts,
    position: FloatArray,
    noise: FloatArray,
    box_m: tuple[float, float],
    gamma: float,
    speed_sd_mps: float,
) -> TrackBank:
    """The confirmed tracks, without ids, of those starts that lie in no gate of another start of the ping.

    P0 = 5 blkdiag(R_0, (x_max / T)^2, (y_max / T)^2) with T = m1 times the pings' mean interval, or
    `speed_sd_mps` when there was one ping only; the history is that of the box. `position` (m, 2) and `noise`
    (m, 2, 2) are those of the measurements that `starts` was found in.

    Source: Karoui 2015, section V.
    """
    chosen = np.flatnonzero(distinct(position[starts.which], noise[starts.which], gamma))
    which = starts.which[chosen]
    known = starts.window_s > 0.0
    speeds = (box_m[0] / starts.window_s, box_m[1] / starts.window_s) if known else (speed_sd_mps,) * 2
    bank = new_tracks(position[which], noise[which], speeds, int(TrackStatus.CONFIRMED))
    bank.covariance *= INFLATION
    bank.ledger["history"], bank.ledger["span"] = starts.history[chosen], starts.span
    return bank


@compiled
def distinct(position: FloatArray, noise: FloatArray, gamma: float) -> BoolArray:
    """Which of the starts (k, 2) lie in no gate of an earlier one: nu^T (5 R_0 + R)^-1 nu > gamma.

    `noise` (k, 2, 2) are the R_0 of the starts.
    """
    k = position.shape[0]
    keep = np.ones(k, np.bool_)
    for i in range(k):
        for j in range(i):
            if keep[j]:
                s = INFLATION * noise[j] + noise[i]
                e1, e2 = position[i, 0] - position[j, 0], position[i, 1] - position[j, 1]
                det = s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1]
                d2 = (e1 * (s[1, 1] * e1 - s[0, 1] * e2) + e2 * (s[0, 0] * e2 - s[0, 1] * e1)) / det
                keep[i] &= d2 > gamma
    return keep


def several_in_a_beam(bearing_rad: FloatArray, candidate: BoolArray, spacing_rad: float) -> BoolArray:
    """Which detections are among several candidates in one beam, (m,).

    A beam that a ship's noise fills gives several candidate ranges, of which at most one is the ship: none
    of them should start a track, until the wake has told which one it is.
    """
    several = np.zeros(candidate.size, bool)
    where = np.flatnonzero(candidate)
    apart = np.abs(bearing_rad[where, None] - bearing_rad[None, where])
    several[where] = np.count_nonzero(apart < spacing_rad, axis=1) > 1
    return several


@compiled
def starting(
    free: BoolArray, range_m: FloatArray, bearing_rad: FloatArray, amplitude: FloatArray, room: int
) -> tuple[IntArray, bool]:
    """Which of the detections that are `free` begin tracks, by place: at most `room`, the strongest ones.

    Also whether there was no room for all.
    """
    count = free.sum()
    if count <= room:
        return by_place(free, range_m, bearing_rad), False
    best = np.zeros(free.size, np.bool_)
    best[strongest(np.flatnonzero(free), amplitude, max(room, 0))] = True
    return by_place(best, range_m, bearing_rad), count > 0


@compiled
def by_place(free: BoolArray, range_m: FloatArray, bearing_rad: FloatArray) -> IntArray:
    """Which detections are `free` (m,), by range, then bearing, in whatever order they came."""
    which = np.flatnonzero(free)
    which = which[np.argsort(bearing_rad[which], kind="mergesort")]
    return which[np.argsort(range_m[which], kind="mergesort")]


@compiled
def strongest(which: IntArray, amplitude: FloatArray, n: int) -> IntArray:
    """The `n` of the detections `which` with the largest amplitude; nan counts as the smallest."""
    level = np.where(np.isnan(amplitude[which]), -np.inf, amplitude[which])
    return which[np.argsort(-level, kind="mergesort")[:n]]
