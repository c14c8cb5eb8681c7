"""How scouts begin: two peaks, some pings apart, and what the pings between and before say of that path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.tbd_evidence import halves, wholes
from fls_trackers.tbd_grid import Grid, Motion, Place, place_from
from fls_trackers.tbd_ratio import Codes, Plane
from fls_trackers.tbd_scouts import (
    AGE,
    BEARING,
    COLUMNS,
    P_BB,
    P_BT,
    P_RR,
    P_RV,
    P_TT,
    P_VV,
    RANGE,
    RATE,
    SCORE,
    SIGMA,
    TURN,
    FloatArray,
    by_range,
    followed,
)

__all__ = ["Past", "Peaks", "born", "fresh_scouts"]

IntArray = npt.NDArray[np.int64]

LAGS = 2  # pings back that the first of two peaks may lie
PAIR_SCORE = 0.5  # of two peaks whose path is looked at in the other pings
LOOK_SCORE = 0.0  # below which a path is given up, rising from ping to ping to
PATH_SCORE = 1.0  # that of a path which becomes a scout
CROSS_REACH = 2.5  # standard deviations of the speed across that pairs may show


class Peaks(NamedTuple):
    """Local maxima of a ping, in order of beam, then row."""

    row: IntArray
    beam: IntArray
    gain: FloatArray  # log ratios

    def of(self, which: npt.NDArray[np.bool_]) -> Peaks:
        """Those that a mask selects."""
        return Peaks(self.row[which], self.beam[which], self.gain[which])


class Past(NamedTuple):
    """What is remembered of a ping."""

    stamp_ns: int
    pose: Place
    half: Codes  # as `halves` gives them
    peaks: Peaks

    def saved(self) -> dict[str, Any]:
        """As a snapshot holds it."""
        peaks = {name: values.copy() for name, values in self.peaks._asdict().items()}
        return {"stamp_ns": self.stamp_ns, "pose": np.array(self.pose), "code": wholes(self.half), **peaks}

    @classmethod
    def restored(cls, saved: dict[str, Any], closed: bool) -> Past:
        """What a snapshot holds, of a closed ring or not."""
        row, beam = (np.array(saved[name], np.int64) for name in ("row", "beam"))
        peaks = Peaks(row, beam, np.array(saved["gain"], float))
        half = halves(np.array(saved["code"], np.uint8), closed)
        return cls(int(saved["stamp_ns"]), place_from(saved["pose"]), half, peaks)


def fresh_scouts(
    peaks: Peaks, past: Sequence[Past], since: Sequence[Motion], decoded: Plane, grid: Grid, most: int
) -> FloatArray:
    """Scouts (n, COLUMNS) that end in peaks of now, from the remembered pings, the newest first.

    A path is begun by a peak of now and one of the last LAGS pings; all other remembered pings then score it
    as if it had been followed through them. So what a target has shown before it became apparent is not lost.
    """
    groups = []
    for lag in range(min(LAGS, len(past))):
        paths = pairs(peaks, past[lag].peaks, grid, since[lag], PAIR_SCORE + math.log(LAGS), most)
        paths[:, SCORE] -= math.log(LAGS)
        paths = by_range(paths)
        others = [one for one in range(len(past)) if one != lag]
        for done, other in enumerate(others, 1):
            paths = followed(paths, past[other].half, decoded, grid, since[other])
            least = LOOK_SCORE + (PATH_SCORE - LOOK_SCORE) * done / len(others)
            paths = paths[paths[:, SCORE] >= least]
        groups.append(paths[paths[:, SCORE] >= PATH_SCORE])
    return np.concatenate([np.zeros((0, COLUMNS)), *groups])


def pairs(peaks: Peaks, old: Peaks, grid: Grid, since: Motion, least: float, most: int) -> FloatArray:
    """Scouts of all pairs as `born` makes them. In each, one peak has half the score: most have neither."""
    half = 0.5 * (least + _log_window(grid.last_m, grid, since))
    strong, old_strong = peaks.gain >= half, old.gain >= half
    first = born(*peaks.of(strong), *old, grid, since, least, most)
    return np.concatenate([first, born(*peaks.of(~strong), *old.of(old_strong), grid, since, least, most)])


@compiled
def born(
    row: IntArray,
    beam: IntArray,
    gain: FloatArray,
    old_row: IntArray,
    old_beam: IntArray,
    old_gain: FloatArray,
    grid: Grid,
    since: Motion,
    least: float,
    most: int,
) -> FloatArray:
    """Scouts (n, COLUMNS) of pairs of peaks, of a past ping and of this, that one target may have made.

    Seen from where the sonar was then, ranges differ by at most v_max dt, bearings by CROSS_REACH cross dt
    over r and half a beamwidth. The score is the sum of both log ratios, less ln W, the resolution cells that
    the other might have been in; pairs below `least` are left out, and of more than `most` the lower half.
    """
    first, old_first = _of_beams(beam, grid.n_beams), _of_beams(old_beam, grid.n_beams)
    highest = old_gain.max() if old_gain.size else -np.inf
    dt = since.dt_s
    reach = since.v_max_mps * dt / grid.cell_m
    n, scouts = 0, np.empty((4096, COLUMNS))
    for b in range(grid.n_beams):
        bearing = grid.first_rad + b * grid.beam_rad
        c, s = math.cos(bearing + since.own_turn_rad), math.sin(bearing + since.own_turn_rad)
        own_m = since.own_x_m * c + since.own_y_m * s
        own_across_m = since.own_y_m * c - since.own_x_m * s
        begin = old_first[:-1].copy()  # where the peaks of a beam begin that are not too near, row by row
        for a in range(first[b], first[b + 1]):
            range_m = grid.first_m + row[a] * grid.cell_m
            here = gain[a] - _log_window(range_m, grid, since)
            if here + highest < least:
                continue
            turned_rad = since.own_turn_rad + own_across_m / max(range_m, 1.0)
            side = min(int(_half_angle(range_m, grid, since) / abs(grid.beam_rad)), (grid.n_beams - 1) // 2)
            aim = b + math.floor(turned_rad / grid.beam_rad + 0.5)
            middle = row[a] + own_m / grid.cell_m
            for k in range(aim - side, aim + side + 1):
                if not grid.closed and not 0 <= k < grid.n_beams:
                    continue
                col = k % grid.n_beams
                e, high = begin[col], old_first[col + 1]
                while e < high and old_row[e] < middle - reach:
                    e += 1
                begin[col] = e
                while e < high and old_row[e] - middle <= reach:
                    score = here + old_gain[e]
                    if score >= least:
                        if n == len(scouts):
                            scouts, n, least = _with_room(scouts, least, most)
                        rate = (middle - old_row[e]) * grid.cell_m / dt
                        off = (k - b) * grid.beam_rad - turned_rad
                        _begin(scouts[n], range_m, rate, bearing, off, score, grid, since)
                        n += 1
                    e += 1
    return scouts[:n].copy()


@compiled
def _half_angle(range_m: float, grid: Grid, since: Motion) -> float:
    """How far apart the bearings of a pair may be."""
    across_mps = min(since.v_max_mps, CROSS_REACH * since.cross_mps)
    return across_mps * since.dt_s / max(range_m, 1.0) + 0.5 * grid.beamwidth_rad


@compiled
def _log_window(range_m: float, grid: Grid, since: Motion) -> float:
    """ln of how many resolution cells the other peak may be in."""
    along = 2.0 * since.v_max_mps * since.dt_s / grid.resolution_m + 1.0
    return math.log(along * max(2.0 * _half_angle(range_m, grid, since) / grid.beamwidth_rad, 1.0))


@compiled
def _with_room(scouts: FloatArray, least: float, most: int) -> tuple[FloatArray, int, float]:
    """Scouts in twice the room, up to `most`, or the better half; how many, and what the next must score."""
    if scouts.shape[0] < most:
        more = np.empty((min(2 * scouts.shape[0], most), COLUMNS))
        more[: scouts.shape[0]] = scouts
        return more, scouts.shape[0], least
    least = np.median(scouts[:, SCORE])
    n = 0
    for i in range(scouts.shape[0]):
        if scouts[i, SCORE] > least:
            scouts[n] = scouts[i]
            n += 1
    return scouts, n, least


@compiled
def _begin(
    s: FloatArray,
    range_m: float,
    rate: float,
    bearing: float,
    off: float,
    score: float,
    grid: Grid,
    since: Motion,
) -> None:
    """Fill in a scout that two peaks began, the older one `off` from the bearing of the newer.

    Rates are known to be within v_max, and bearings to move as `cross_mps` lets them.
    """
    dt = since.dt_s
    variance = (0.3 * grid.resolution_m) ** 2
    share = 1.0 / (1.0 + 2.0 * variance / (dt * since.v_max_mps) ** 2)
    s[RANGE], s[RATE] = range_m, rate
    s[P_RR], s[P_RV] = variance, share * variance / dt
    s[P_VV] = share * 2.0 * variance / dt**2 + (since.sigma_v_mps2 * dt) ** 2 / 4.0
    variance = (0.4 * grid.beamwidth_rad) ** 2
    turn = (since.cross_mps / max(range_m, 1.0)) ** 2
    total = 2.0 * variance + dt * dt * turn
    s[BEARING], s[TURN] = bearing + variance / total * off, -dt * turn / total * off
    s[P_BB], s[P_BT] = variance - variance**2 / total, variance * dt * turn / total
    s[P_TT] = turn - (dt * turn) ** 2 / total
    s[SCORE], s[AGE], s[SIGMA] = score, 1.0, since.sigma_v_mps2


@compiled
def _of_beams(beam: IntArray, n_beams: int) -> IntArray:
    """Where each beam's peaks begin, (n_beams + 1,)."""
    first = np.zeros(n_beams + 1, np.int64)
    for b in beam:
        first[b + 1] += 1
    return np.cumsum(first)
