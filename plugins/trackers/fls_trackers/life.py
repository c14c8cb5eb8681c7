"""What becomes of tracks after a ping: their counts, confirmation, deletion, duplicates; compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.track_bank import MAX_WINDOW, Ledger

__all__ = [
    "CONFIRMED",
    "LOST",
    "TENTATIVE",
    "Rules",
    "Shared",
    "count",
    "distance",
    "judge",
    "largest_sd",
    "near",
    "ones",
    "settle",
    "suspect",
]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
Shared = tuple[
    IntArray, IntArray, FloatArray
]  # start (n + 1,), places and beta of pairs, as in `Association`

TENTATIVE, CONFIRMED, LOST = 0, 1, 2  # TrackStatus, as the compiler takes them
HISTORY_BITS = (1 << MAX_WINDOW) - 1
TINY = 1e-300
HOPELESS = -7.0  # score of a tentative track that ends: a thousandth of the odds that it began with
MERGE_GATE = 4.0  # statistical distance over position and velocity, below which tracks may be one
SEEN, UNRESOLVED = (
    0.5,
    1.25,
)  # detections that two tracks explain together: at least about one, no more than one


class Rules(NamedTuple):
    """When tracks are confirmed and end."""

    m1: int
    n1: int
    min_score: float
    m2: int
    n2: int
    max_sd_m: float


@compiled
def judge(
    ledger: Ledger,
    state: FloatArray,
    covariance: FloatArray,
    in_gate: BoolArray,
    beta_none: FloatArray,
    evidence: FloatArray,
    miss: float,
    only_probable: bool,
    merge_pings: int,
    rules: Rules,
    shared: Shared,
) -> tuple[Ledger, BoolArray]:
    """The ledger (n,) after the update of a ping, and which tracks go on, (n,).

    Tracks are counted, then suspected of repeating others (if merge_pings is not 0), then settled. An update
    is a measurement in the gate; if `only_probable`, one that is also more likely than none. `evidence` takes
    the place of beta_none in the score.
    """
    updated = in_gate & (beta_none < 0.5) if only_probable else in_gate
    rows = count(ledger, updated, evidence, miss)
    repeats = np.zeros(rows.size, np.bool_)
    if merge_pings:
        repeats = suspect(rows, state, covariance, beta_none, merge_pings, shared)
    return settle(rows, repeats, covariance, rules)


@compiled
def count(ledger: Ledger, updated: BoolArray, beta_none: FloatArray, miss: float) -> Ledger:
    """The ledger (n,) after a judged ping: age, hits, history, span and score.

    The ping's likelihood ratio of an object against clutter is miss / beta_none, miss = 1 - p_d p_g.

    Source: Blackman & Popoli 1999, section 6.2, with the sum over a gate's measurements for one of them.
    """
    rows = ledger.copy()
    for t in range(rows.size):
        row = rows[t]
        row.age += 1
        row.hits += updated[t]
        row.history = ((row.history << 1) & HISTORY_BITS) | updated[t]
        row.span = min(row.span + 1, MAX_WINDOW)
        row.score += math.log(miss / max(beta_none[t], TINY))
    return rows


@compiled
def settle(
    ledger: Ledger, repeats: BoolArray, covariance: FloatArray, rules: Rules
) -> tuple[Ledger, BoolArray]:
    """The ledger with new statuses, and which tracks go on, (n,).

    A tentative track is confirmed with n1 updates in its last m1 pings and a score of min_score, and dropped
    when the updates cannot be reached any more or, if there is a score to reach, its own speaks against it.
    A confirmed one is lost with fewer than n2 updates in its last m2 pings (full windows only). Either ends
    when it repeats another, or when its largest position axis sqrt(lambda_max(P_pos)) exceeds max_sd_m.

    Source: Karoui 2015, section IV-C; deletion in reading A of ALGORITHMS E-K11.
    """
    rows, keep = ledger.copy(), ~repeats
    for t in range(rows.size):
        row = rows[t]
        if row.status == TENTATIVE:
            hits = ones(row.history & ((1 << rules.m1) - 1))
            if hits >= rules.n1 and row.score >= rules.min_score:
                row.status = CONFIRMED
            keep[t] &= hits + max(0, rules.m1 - row.span) >= rules.n1
            keep[t] &= row.score >= min(HOPELESS, rules.min_score)
        else:
            few = ones(row.history & ((1 << rules.m2) - 1)) < rules.n2
            keep[t] &= not (few and row.span >= rules.m2)
        keep[t] &= largest_sd(covariance[t]) <= rules.max_sd_m
        if row.status == CONFIRMED and not keep[t]:
            row.status = LOST
    return rows, keep


@compiled
def ones(bits: int) -> int:
    """How many bits are set."""
    n = 0
    while bits:
        bits &= bits - 1
        n += 1
    return n


@compiled
def largest_sd(P: FloatArray) -> float:
    """sqrt(lambda_max(P_pos)) of a covariance (4, 4)."""
    a, b, c = P[0, 0], P[0, 1], P[1, 1]
    return math.sqrt(0.5 * (a + c) + math.sqrt(0.25 * (a - c) ** 2 + b * b))


@compiled
def suspect(
    rows: Ledger,
    state: FloatArray,
    covariance: FloatArray,
    beta_none: FloatArray,
    pings: int,
    shared: Shared,
) -> BoolArray:
    """Which tracks repeat an older one, (n,); counts the pings of suspicion in `rows`.

    A track is suspected in a ping when an older one is as near as if both followed one object,
    dx^T (P_i + P_j)^-1 dx <= 4 over position and velocity, and both explain about one detection together,
    (1 - beta_none_i) + (1 - beta_none_j) <= 1.25. For tracks that took measurements independently, whose beta
    are in `shared`, sum_k beta_ik beta_jk is subtracted: both took the same one. The count goes up while the
    track is suspected of the same one; two detections count down twice as fast, and a ping with none says
    nothing. It repeats that track once the count reaches `pings` (a quarter of them while it is tentative).

    Objects that cross are neither merged while two echoes are seen, nor as long as their velocities differ.
    """
    repeats = np.zeros(rows.size, np.bool_)
    x, y = state[:, 0].copy(), state[:, 1].copy()
    reach_x, reach_y = MERGE_GATE * covariance[:, 0, 0], MERGE_GATE * covariance[:, 1, 1]
    status = rows["status"].copy()
    scratch = np.empty((5, 4))
    near_by = np.zeros(8 * ((rows.size + 7) // 8), np.uint8)
    words = near_by.view(np.uint64)
    for i in range(rows.size):
        row = rows[i]
        here_x, here_y, far_x, far_y = x[i], y[i], reach_x[i], reach_y[i]
        for j in range(i):  # no distance is less than that along one axis
            near_by[j] = ((here_x - x[j]) ** 2 <= far_x + reach_x[j]) & (
                (here_y - y[j]) ** 2 <= far_y + reach_y[j]
            )
        some = np.uint64(0)
        for word in range((i + 7) >> 3):
            some |= words[word]
        rival = _rival(i, status, repeats, state, covariance, scratch, near_by) if some else -1
        explained = 2.0 - beta_none[i] - beta_none[rival] - (_both(i, rival, shared) if rival >= 0 else 0.0)
        if rival < 0:
            row.rival_pings = max(0, row.rival_pings - 1)
        elif row.rival != rows[rival].id:
            row.rival, row.rival_pings = rows[rival].id, int(SEEN < explained <= UNRESOLVED)
        elif explained > UNRESOLVED:
            row.rival_pings = max(0, row.rival_pings - 2)
        elif explained > SEEN:
            row.rival_pings += 1
        needed = pings if row.status == CONFIRMED else (pings + 3) // 4
        repeats[i] = row.rival_pings >= needed
    return repeats


@compiled
def _both(i: int, j: int, shared: Shared) -> float:
    """The chance that two independent tracks took the same measurement."""
    start, places, beta = shared
    a, b, both = start[i], start[j], 0.0
    while a < start[i + 1] and b < start[j + 1]:
        if places[a] == places[b]:
            both += beta[a] * beta[b]
        step = places[a] - places[b]
        a += step <= 0
        b += step >= 0
    return both


@compiled
def _rival(
    i: int,
    status: IntArray,
    repeats: BoolArray,
    state: FloatArray,
    covariance: FloatArray,
    scratch: FloatArray,
    near_by: npt.NDArray[np.uint8],
) -> int:
    """The oldest of the tracks `near_by` that track i may repeat; -1: none."""
    for j in range(i):
        if not near_by[j] or repeats[j] or status[j] < status[i]:
            continue
        if near(state, covariance, i, j, MERGE_GATE, scratch):
            return j
    return -1


@compiled
def distance(state: FloatArray, covariance: FloatArray, i: int, j: int, scratch: FloatArray) -> float:
    """dx^T (P_i + P_j)^-1 dx of tracks i and j, by the Cholesky factor; `scratch` is (5, 4)."""
    d2 = 0.0
    for a in range(4):
        for b in range(a + 1):
            total = covariance[i, a, b] + covariance[j, a, b]
            for c in range(b):
                total -= scratch[a, c] * scratch[b, c]
            if a == b:
                scratch[a, a] = math.sqrt(max(total, 1e-300))
            else:
                scratch[a, b] = total / scratch[b, b]
        z = state[i, a] - state[j, a]
        for c in range(a):
            z -= scratch[a, c] * scratch[4, c]
        scratch[4, a] = z / scratch[a, a]
        d2 += scratch[4, a] ** 2
    return d2


@compiled
def near(state: FloatArray, covariance: FloatArray, i: int, j: int, gate: float, scratch: FloatArray) -> bool:
    """Whether the `distance` of tracks i and j is at most `gate`; that along an axis is no more."""
    for a in range(4):
        reach = (1.0 + 1e-9) * gate * (covariance[i, a, a] + covariance[j, a, a])
        if (state[i, a] - state[j, a]) ** 2 > reach:
            return False
    return distance(state, covariance, i, j, scratch) <= gate
