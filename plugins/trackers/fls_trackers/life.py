"""What becomes of tracks after a ping: their counts, confirmation, deletion, duplicates; compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.track_bank import MAX_WINDOW, Ledger

__all__ = ["TENTATIVE", "Rules", "count", "judge", "settle", "suspect"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

TENTATIVE, CONFIRMED, LOST = 0, 1, 2  # TrackStatus, as the compiler takes them
HISTORY_BITS = (1 << MAX_WINDOW) - 1
TINY = 1e-300
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
    miss: float,
    only_probable: bool,
    merge_pings: int,
    rules: Rules,
) -> tuple[Ledger, BoolArray]:
    """The ledger (n,) after the update of a ping, and which tracks go on, (n,).

    Tracks are counted, then suspected of repeating others (if merge_pings is not 0), then settled. An update
    is a measurement in the gate; if `only_probable`, one that is also more likely than none.
    """
    updated = in_gate & (beta_none < 0.5) if only_probable else in_gate
    rows = count(ledger, updated, beta_none, miss)
    repeats = np.zeros(rows.size, np.bool_)
    if merge_pings:
        repeats = suspect(rows, state, covariance, beta_none, merge_pings)
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
    when the updates cannot be reached any more. A confirmed one is lost with fewer than n2 updates in its
    last m2 pings (full windows only). Either ends when it repeats another, or when its largest position axis
    sqrt(lambda_max(P_pos)) exceeds max_sd_m.

    Source: Karoui 2015, section IV-C; deletion in reading A of ALGORITHMS E-K11.
    """
    rows, keep = ledger.copy(), ~repeats
    for t in range(rows.size):
        row = rows[t]
        if row.status == TENTATIVE:
            hits = _ones(row.history & ((1 << rules.m1) - 1))
            if hits >= rules.n1 and row.score >= rules.min_score:
                row.status = CONFIRMED
            keep[t] &= hits + max(0, rules.m1 - row.span) >= rules.n1
        else:
            few = _ones(row.history & ((1 << rules.m2) - 1)) < rules.n2
            keep[t] &= not (few and row.span >= rules.m2)
        keep[t] &= _largest_sd(covariance[t]) <= rules.max_sd_m
        if row.status == CONFIRMED and not keep[t]:
            row.status = LOST
    return rows, keep


@compiled
def _ones(bits: int) -> int:
    n = 0
    while bits:
        bits &= bits - 1
        n += 1
    return n


@compiled
def _largest_sd(P: FloatArray) -> float:
    a, b, c = P[0, 0], P[0, 1], P[1, 1]
    return math.sqrt(0.5 * (a + c) + math.sqrt(0.25 * (a - c) ** 2 + b * b))


@compiled
def suspect(
    rows: Ledger, state: FloatArray, covariance: FloatArray, beta_none: FloatArray, pings: int
) -> BoolArray:
    """Which tracks repeat an older one, (n,); counts the pings of suspicion in `rows`.

    A track is suspected in a ping when an older one is as near as if both followed one object,
    dx^T (P_i + P_j)^-1 dx <= 4 over position and velocity, and both explain about one detection together,
    (1 - beta_none_i) + (1 - beta_none_j) <= 1.25. Its count goes up while it is suspected of the same track;
    two detections count down twice as fast, and a ping with none says nothing. It repeats that track once the
    count reaches `pings` (a quarter of them while it is tentative).

    Objects that cross are neither merged while two echoes are seen, nor as long as their velocities differ.
    """
    repeats = np.zeros(rows.size, np.bool_)
    for i in range(rows.size):
        row = rows[i]
        rival = _rival(i, rows, repeats, state, covariance)
        explained = 2.0 - beta_none[i] - beta_none[rival]
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
def _rival(i: int, rows: Ledger, repeats: BoolArray, state: FloatArray, covariance: FloatArray) -> int:
    """The oldest track that track i may repeat; -1: none."""
    for j in range(i):
        if repeats[j] or rows[j].status < rows[i].status:
            continue
        # Cheap tests first: the distance along one axis is never more than the whole.
        near = True
        for a in range(4):
            reach = MERGE_GATE * (covariance[i, a, a] + covariance[j, a, a])
            near &= (state[i, a] - state[j, a]) ** 2 <= reach
        if near and _distance(state[i] - state[j], covariance[i] + covariance[j]) <= MERGE_GATE:
            return j
    return -1


@compiled
def _distance(x: FloatArray, P: FloatArray) -> float:
    """x^T P^-1 x of a positive definite P, by its Cholesky factor."""
    n, d2 = x.size, 0.0
    L, z = np.zeros((n, n)), np.zeros(n)
    for a in range(n):
        for b in range(a + 1):
            total = P[a, b]
            for c in range(b):
                total -= L[a, c] * L[b, c]
            if a == b:
                L[a, a] = math.sqrt(max(total, 1e-300))
            else:
                L[a, b] = total / L[b, b]
        z[a] = x[a]
        for c in range(a):
            z[a] -= L[a, c] * z[c]
        z[a] /= L[a, a]
        d2 += z[a] * z[a]
    return d2
