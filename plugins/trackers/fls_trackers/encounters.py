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
STREAK = 11  # pings in a row that speak for the same exchange, or (negative) against any
WAY = 12  # id of the track whose path that exchange gives it
# and, of a track that began beside two that had met:
BEGUN, BESIDE = 13, 14  # whether it was looked at; id of one of them, 0: none
MEETING_COLUMNS = 15

MEMORY_S = 10.0  # of speed and strength
KNOWN_S = 1.5  # alone, before a track can be told from another
LEAST_MPS = 0.1  # speeds below are not told apart
SPEED_SD = 0.6  # of ln(speed) of one swimmer
TURN_RADPS = 0.5  # how much a swimmer's course changes within a second
ASPECT = 1.5  # factor on the sd of ln(amplitude): over a meeting swimmers turn, and their echoes change more
A_MISS, MOST_MISSES = 0.7, 8.0  # what a ping without an event counts, and all in a row at most
MOST = 4.0  # what one trait counts at most
SURE = 4.0  # log odds that decide
PINGS = 3  # in a row
CLOSED_S = 6.0  # apart, after which the meeting is over
OWN_SHARE = 1.0 / 3.0  # of meeting_m: tracks with different events at that distance are two again
# Which of the paths of i, j and of one that began beside them each of these goes on, by place:
EXCHANGES = ((1, 0, 2), (2, 1, 0), (0, 2, 1), (1, 2, 0), (2, 0, 1))


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
    misses those of b just now, each term at most MOST (misses: MOST_MISSES), and all 0 for a track that was
    not alone before, tracks i and j exchange their paths when c(i, i) + c(j, j) - c(i, j) - c(j, i) > SURE in
    PINGS pings in a row. A swimmer that leaves both tracks behind gets a new one: so a confirmed track that
    began within `meeting_m` of i or j, since those met, takes part, and of all exchanges among i, j and such
    a one that is made that saves most. `walk`: dt and velocity walk; `amplitude_sd` 0: strengths are not
    looked at.

    Source: objects that merge and split, and are told apart by what they were before: Gabriel, Verly, Piater
    & Genon 2003; the costs are ours.
    """
    after, path = table.copy(), np.arange(scan.ids.size)
    _note_begun(after, scan, meeting_m)
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
        ways, gain = _best_ways(i, j, two, after, scan, walk[1], amplitude_sd)
        streak = _streak(i, j, ways, gain, after, scan)
        if streak >= PINGS:
            _exchange(path, i, j, ways)
        over = apart_m > meeting_m and (streak <= -PINGS or after[i, PARTED_S] > CLOSED_S)
        if streak >= PINGS or over:
            _part(i, j, after, scan)
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
    row[OTHER:BEGUN] = 0.0
    if nearest >= 0:
        if _partner(nearest, table, scan) < 0:
            table[nearest, OTHER:BEGUN] = 0.0
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
def _note_begun(table: FloatArray, scan: Scan, meeting_m: float) -> None:
    """Note beside which track that has met another each new track began."""
    for t in range(scan.ids.size):
        if table[t, BEGUN] != 0.0:
            continue
        table[t, BEGUN], least = 1.0, meeting_m
        for j in range(scan.ids.size):
            if j != t and _partner(j, table, scan) >= 0 and _distance(t, j, scan) <= least:
                table[t, BESIDE], least = scan.ids[j], _distance(t, j, scan)


@compiled
def _best_ways(
    i: int, j: int, two: bool, table: FloatArray, scan: Scan, velocity_walk_mps: float, amplitude_sd: float
) -> tuple[tuple[int, int, int], float]:
    """The paths of i, of j and of a third track, -1: none, that save most, and what they save.

    The ways are (on the path of which i goes on, that of j, the third); while i and j are not `two`, only
    exchanges with a third one count.
    """
    best, most = (j, i, -1), -np.inf
    if two:
        most = _gain((i, j, j), EXCHANGES[0], table, scan, velocity_walk_mps, amplitude_sd)
    for k in range(scan.ids.size):
        beside = table[k, BESIDE] == scan.ids[i] or table[k, BESIDE] == scan.ids[j]
        if not beside or scan.status[k] != CONFIRMED or scan.event[k] < 0 or _partner(k, table, scan) >= 0:
            continue
        three = (i, j, k)
        for ways in EXCHANGES:
            gain = _gain(three, ways, table, scan, velocity_walk_mps, amplitude_sd)
            if gain > most and (two or ways[2] != 2):
                best, most = (three[ways[0]], three[ways[1]], k), gain
    return best, most


@compiled
def _gain(
    tracks: tuple[int, int, int],
    ways: tuple[int, int, int],
    table: FloatArray,
    scan: Scan,
    velocity_walk_mps: float,
    amplitude_sd: float,
) -> float:
    """What it saves when of three `tracks` the first two go on by `ways`; nothing is known of the third."""
    gain = 0.0
    for place in range(2):
        a, b = tracks[place], tracks[ways[place]]
        if b != a and table[a, ALONE_S] >= KNOWN_S:
            gain += _cost(table[a], table[a], scan, a, velocity_walk_mps, amplitude_sd)
            gain -= _cost(table[a], table[b], scan, b, velocity_walk_mps, amplitude_sd)
    return gain


@compiled
def _streak(i: int, j: int, ways: tuple[int, int, int], gain: float, table: FloatArray, scan: Scan) -> float:
    """How many pings in a row have spoken for these ways, or (negative) against any; notes both."""
    same = table[i, WAY] == scan.ids[ways[0]] and table[j, WAY] == scan.ids[ways[1]]
    before, streak = table[i, STREAK], 0.0
    if gain > SURE:
        streak = max(before, 0.0) + 1.0 if same else 1.0
    elif -np.inf < gain < -SURE:
        streak = min(before, 0.0) - 1.0
    for t, way in ((i, ways[0]), (j, ways[1])):
        table[t, STREAK], table[t, WAY] = streak, scan.ids[way]
    return streak


@compiled
def _exchange(path: IntArray, i: int, j: int, ways: tuple[int, int, int]) -> None:
    """Send tracks i and j on their ways, and the third one, if any, on the path that is left."""
    path[i], path[j] = ways[0], ways[1]
    if ways[2] >= 0:
        path[ways[2]] = i + j + ways[2] - ways[0] - ways[1]


@compiled
def _part(i: int, j: int, table: FloatArray, scan: Scan) -> None:
    """Forget a meeting, and who began beside it."""
    for t in range(scan.ids.size):
        if table[t, BESIDE] == scan.ids[i] or table[t, BESIDE] == scan.ids[j]:
            table[t, BESIDE] = 0.0
    for t in (i, j):
        table[t, OTHER:BEGUN] = 0.0


@compiled
def _cost(
    mine: FloatArray, path: FloatArray, scan: Scan, b: int, velocity_walk_mps: float, amplitude_sd: float
) -> float:
    """How badly the path of track b fits what a track was alone."""
    cost = min(A_MISS * path[MISSED], MOST_MISSES)
    vx, vy = scan.state[b, 2], scan.state[b, 3]
    before = math.exp(mine[LN_SPEED])
    variance = (velocity_walk_mps**2 + (TURN_RADPS * before) ** 2) * mine[SINCE_S]
    variance += 0.5 * (scan.covariance[b, 2, 2] + scan.covariance[b, 3, 3])
    cost += min(0.5 * ((vx - mine[VX]) ** 2 + (vy - mine[VY]) ** 2) / variance, MOST)
    faster = math.log(max(math.hypot(vx, vy), LEAST_MPS)) - mine[LN_SPEED]
    cost += min(0.5 * (faster / SPEED_SD) ** 2, MOST)
    new = path[BESIDE] != 0.0
    if amplitude_sd > 0.0 and (new or path[EVENTS] > 0.0):
        level = scan.strength[b, TRACK_LEVEL] if new else path[HEARD] / path[EVENTS]
        cost += min(0.5 * ((level - mine[LEVEL]) / (ASPECT * amplitude_sd)) ** 2, MOST)
    return float(cost)
