"""Tracks that met and parted: whether each went on with its own swimmer, or with the other's."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.echo_strength import LEVEL as TRACK_LEVEL
from fls_trackers.life import CONFIRMED

__all__ = ["MEETING_COLUMNS", "Scan", "encounters"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

# Columns of the table (n, MEETING_COLUMNS) that goes with the tracks. First how one was while it was alone:
VX, VY, LN_SPEED, LEVEL = 0, 1, 2, 3  # velocity; means of ln(speed) and ln(amplitude)
ALONE_S = 4  # for how long that is known
# and how it stands with the one that it met:
OTHER, SINCE_S, PARTED_S = 5, 6, 7  # its id, 0: none; since when, and for how long they have been apart
HEARD, EVENTS = 8, 9  # sum of ln(amplitude) of its own events since they are two again, and their number
MISSED = 10  # pings in a row without an event of its own
STREAK = 11  # pings in a row that speak for an exchange, or (negative) against it
MEETING_COLUMNS = 12

MEMORY_S = 10.0  # of speed and strength
KNOWN_S = 1.5  # alone, before a track can be told from another
LEAST_MPS = 0.1  # speeds below are not told apart
SPEED_SD = 0.6  # of ln(speed) of one swimmer
TURN_RADPS = 0.5  # how much a swimmer's course changes within a second
ASPECT = 1.5  # factor on the sd of ln(amplitude): over a meeting swimmers turn, and their echoes change more
A_MISS = 0.7  # what a ping without an event counts
MOST = 4.0  # what one trait counts at most
SURE = 4.0  # log odds that decide
PINGS = 3  # in a row
CLOSED_S = 6.0  # apart, after which the meeting is over
OWN_SHARE = 1.0 / 3.0  # of meeting_m: tracks with different events at that distance are two again


class Scan(NamedTuple):
    """The tracks after a ping, and what each took for its own."""

    ids: IntArray  # (n,)
    status: IntArray  # (n,)
    state: FloatArray  # (n, 4)
    covariance: FloatArray  # (n, 4, 4)
    strength: FloatArray  # (n, STRENGTH_COLUMNS)
    event: IntArray  # (n,) index of its event, -1: none
    ln_amplitude: FloatArray  # (m,) of the events


@compiled
def encounters(
    table: FloatArray, scan: Scan, walk: tuple[float, float], meeting_m: float, amplitude_sd: float
) -> tuple[FloatArray, IntArray]:
    """The table after a ping, and the track (n,) on whose path each should go on: mostly its own.

    Confirmed tracks that come nearer than `meeting_m` to each other have met. Echoes that merge and part may
    leave each with the swimmer of the other, which the swimmers' traits tell later: how a track moved, how
    fast and how strong it was while it was alone. With the cost of track a on the path of b,
    c(a, b) = |v_b - v_a|^2 / 2 sd_v^2 + ln(s_b / s_a)^2 / 2 sd_s^2 + ln(e_b / e_a)^2 / 2 sd_e^2 + misses,
    misses those of b just now, each term at most MOST, and all 0 for a track that was not alone before,
    tracks i and j exchange their paths when c(i, i) + c(j, j) - c(i, j) - c(j, i) > SURE in PINGS pings in a
    row. `walk`: dt and velocity walk; `amplitude_sd` 0: strengths are not looked at.

    Source: objects that merge and split, and are told apart by what they were before: Gabriel, Verly, Piater
    & Genon 2003; the costs are ours.
    """
    after, path = table.copy(), np.arange(scan.ids.size)
    for t in range(path.size):
        if scan.status[t] == CONFIRMED and _partner(t, after, scan) < 0:
            _alone_or_met(t, after, scan, walk[0], meeting_m)
    for i in range(path.size):
        j = _partner(i, after, scan)
        if j <= i:
            continue
        apart_m = _distance(i, j, scan)
        two = scan.event[i] != scan.event[j] and apart_m > OWN_SHARE * meeting_m
        for t in (i, j):
            _hear(after[t], scan, t, two, walk[0], walk[0] if apart_m > meeting_m else 0.0)
        streak = 0.0
        if two:
            streak = _streak(after[i, STREAK], _gain(i, j, after, scan, walk[1], amplitude_sd))
        after[i, STREAK] = after[j, STREAK] = streak
        if streak >= PINGS:
            path[i], path[j] = j, i
        over = apart_m > meeting_m and (streak <= -PINGS or after[i, PARTED_S] > CLOSED_S)
        if streak >= PINGS or over:
            after[i, OTHER:] = 0.0
            after[j, OTHER:] = 0.0
    return after, path


@compiled
def _partner(t: int, table: FloatArray, scan: Scan) -> int:
    """The track that t has met, -1: none."""
    if table[t, OTHER] == 0.0 or scan.status[t] != CONFIRMED:
        return -1
    for j in range(scan.ids.size):
        if scan.ids[j] == table[t, OTHER] and scan.status[j] == CONFIRMED and table[j, OTHER] == scan.ids[t]:
            return j
    return -1


@compiled
def _distance(i: int, j: int, scan: Scan) -> float:
    return math.hypot(scan.state[j, 0] - scan.state[i, 0], scan.state[j, 1] - scan.state[i, 1])


@compiled
def _alone_or_met(t: int, table: FloatArray, scan: Scan, dt_s: float, meeting_m: float) -> None:
    """Learn how a track is that is alone; note whom it meets, if that one has met nobody else."""
    row = table[t]
    nearest, least = -1, meeting_m
    for j in range(scan.ids.size):
        if j != t and scan.status[j] == CONFIRMED and _distance(t, j, scan) <= least:
            nearest, least = j, _distance(t, j, scan)
    row[OTHER:] = 0.0
    if nearest >= 0:
        if _partner(nearest, table, scan) < 0:
            table[nearest, OTHER:] = 0.0
            row[OTHER], table[nearest, OTHER] = scan.ids[nearest], scan.ids[t]
        return
    row[ALONE_S] += dt_s
    share = min(1.0, dt_s / min(row[ALONE_S], MEMORY_S)) if dt_s > 0.0 else 0.0
    row[VX], row[VY] = scan.state[t, 2], scan.state[t, 3]
    speed = max(math.hypot(row[VX], row[VY]), LEAST_MPS)
    row[LN_SPEED] += share * (math.log(speed) - row[LN_SPEED])
    row[LEVEL] += share * (scan.strength[t, TRACK_LEVEL] - row[LEVEL])


@compiled
def _hear(row: FloatArray, scan: Scan, t: int, two: bool, dt_s: float, parted_s: float) -> None:
    """Note what one of two that have met does in this ping."""
    row[SINCE_S] += dt_s
    row[PARTED_S] = row[PARTED_S] + parted_s if parted_s > 0.0 else 0.0
    event = scan.event[t]
    row[MISSED] = 0.0 if event >= 0 else row[MISSED] + 1.0
    if event >= 0 and not two:
        row[HEARD] = row[EVENTS] = 0.0
    elif event >= 0 and math.isfinite(scan.ln_amplitude[event]):
        row[HEARD] += scan.ln_amplitude[event]
        row[EVENTS] += 1.0


@compiled
def _streak(before: float, gain: float) -> float:
    if gain > SURE:
        return max(before, 0.0) + 1.0
    return min(before, 0.0) - 1.0 if gain < -SURE else 0.0


@compiled
def _gain(
    i: int, j: int, table: FloatArray, scan: Scan, velocity_walk_mps: float, amplitude_sd: float
) -> float:
    """What an exchange would save."""
    gain = 0.0
    for a, b, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
        if table[a, ALONE_S] >= KNOWN_S:
            gain += sign * _cost(table[a], table[b], scan, b, velocity_walk_mps, amplitude_sd)
    return gain


@compiled
def _cost(
    mine: FloatArray, path: FloatArray, scan: Scan, b: int, velocity_walk_mps: float, amplitude_sd: float
) -> float:
    """How badly the path of track b fits what a track was alone."""
    vx, vy = scan.state[b, 2], scan.state[b, 3]
    before = math.exp(mine[LN_SPEED])
    variance = (velocity_walk_mps**2 + (TURN_RADPS * before) ** 2) * mine[SINCE_S]
    variance += 0.5 * (scan.covariance[b, 2, 2] + scan.covariance[b, 3, 3])
    cost = min(A_MISS * path[MISSED], MOST)
    cost += min(0.5 * ((vx - mine[VX]) ** 2 + (vy - mine[VY]) ** 2) / variance, MOST)
    faster = math.log(max(math.hypot(vx, vy), LEAST_MPS)) - mine[LN_SPEED]
    cost += min(0.5 * (faster / SPEED_SD) ** 2, MOST)
    if amplitude_sd > 0.0 and path[EVENTS] > 0.0:
        stronger = path[HEARD] / path[EVENTS] - mine[LEVEL]
        cost += min(0.5 * (stronger / (ASPECT * amplitude_sd)) ** 2, MOST)
    return float(cost)
