"""One scan of tracks that each follow their object for themselves (PDAF, NNKF), compiled as a whole."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.adaptive_noise import SENSOR, learn, predict_each
from fls_trackers.association import INDEPENDENT, evidence, shared_out
from fls_trackers.conversion import noise_of
from fls_trackers.gating import pairs_in_gates
from fls_trackers.kalman import update
from fls_trackers.life import CONFIRMED, LOST, TENTATIVE, count, distance, largest_sd, ones
from fls_trackers.track_bank import Ledger

__all__ = ["Gains", "follow", "nearest", "settle_by_score"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Gains = tuple[float, float, float]  # gamma, p_d / (1 - p_d p_g), 1 - p_d p_g

SAME_GATE = 9.49  # statistical distance over position and velocity of tracks that may be one: 95 %


@compiled
def follow(
    state: FloatArray,
    covariance: FloatArray,
    ledger: Ledger,
    noise: FloatArray,
    y: FloatArray,
    density: FloatArray,
    motion: tuple[float, float],
    sensor: tuple[float, float, float, float, float],
    extent_sd_m: float,
    gains: Gains,
    one_event: bool,
    only_probable: bool,
    adaptive: bool,
) -> tuple[FloatArray, FloatArray, Ledger, FloatArray, IntArray, BoolArray, BoolArray]:
    """States, covariances, ledger and noise after the events `y` (m, 2); the tracks' own events.

    Last come which events (m,) lie in a track's gate, and in a confirmed one's.

    `motion`: dt and velocity walk; `sensor`: sd in range and bearing, pose; `extent_sd_m` adds to both. Each
    track weighs all events in its gate (PDAF), or takes the nearest (`one_event`, NNKF). An update is an
    event in the gate; if `only_probable`, one more likely than none, and the NNKF then takes no other. The
    track's own event is the most probable one, -1 when none is more probable. Confirmed tracks come first:
    tentative ones get the events that more likely are no confirmed track's.

    Source: Brinkmann 2010 (3.20)-(3.31), with the density per m^2, 1 - p_d p_g for a miss, and a gate first.
    """
    gamma, factor, miss = gains
    x, P = predict_each(state, covariance, motion[0], motion[1], noise)
    R = noise_of(x, sensor[0], sensor[1], sensor[2], sensor[3], sensor[4])
    for t in range(R.shape[0]):
        for a in range(2):
            R[t, a, a] += extent_sd_m * extent_sd_m
        R[t] *= math.exp(noise[t, SENSOR])
    start, places, likelihood = pairs_in_gates(x, P, R, y, gamma)
    rank = np.zeros(ledger.size, np.int64)
    for t in range(ledger.size):
        rank[t] = ledger[t].status == TENTATIVE
    beta, none, _, claimed, in_gate, _ = shared_out(
        start, places, likelihood, density, factor, rank, 1, INDEPENDENT
    )
    score = none
    if one_event:
        least = density / factor if only_probable else np.zeros(density.size)
        beta, none = nearest(start, places, np.where(beta > 0.0, likelihood, -1.0), least)
        score = evidence(start, places, likelihood, density, factor, beta, none)
    event = _own(start, places, beta, none)
    table = learn(noise, x, P, R, y, event) if adaptive else noise.copy()
    x, P = update(x, P, R, y, start, places, beta, none)
    hit = in_gate & (none < 0.5) if only_probable else in_gate
    gated = np.zeros(density.size, np.bool_)
    for j in places:
        gated[j] = True
    return x, P, count(ledger, hit, score, miss), table, event, gated, claimed


@compiled
def nearest(
    start: IntArray, places: IntArray, likelihood: FloatArray, least: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """1 for each track's nearest event (pairs,) if its likelihood is above `least` (m,), 1 for none (n,)."""
    beta, none = np.zeros(places.size), np.ones(start.size - 1)
    for t in range(none.size):
        best = -1
        for e in range(start[t], start[t + 1]):
            if likelihood[e] > least[places[e]] and (best < 0 or likelihood[e] > likelihood[best]):
                best = e
        if best >= 0:
            beta[best], none[t] = 1.0, 0.0
    return beta, none


@compiled
def _own(start: IntArray, places: IntArray, beta: FloatArray, none: FloatArray) -> IntArray:
    event = np.full(none.size, -1)
    for t in range(none.size):
        most = none[t]
        for e in range(start[t], start[t + 1]):
            if beta[e] > most:
                event[t], most = places[e], beta[e]
    return event


@compiled
def settle_by_score(
    rows: Ledger,
    state: FloatArray,
    covariance: FloatArray,
    event: IntArray,
    confirm: tuple[int, int, float],
    max_propagate: int,
    max_sd_m: float,
    max_common: int,
) -> tuple[Ledger, BoolArray, IntArray]:
    """The ledger with new statuses, which tracks go on (n,), and the one each is part of (n,), -1: none.

    A track's score is `max_propagate` after an update and falls by one with each miss; a miss at score 0 ends
    it. `confirm` is (m1, n1, score): a tentative track is confirmed with n1 updates in its last m1 pings and
    that log likelihood ratio, and ends when the updates cannot be reached any more. Either ends with a
    position less certain than max_sd_m. Two tracks are one when they had the same own event in each of their
    last `max_common` common updates, and are as near as if they followed one object.

    Source: Brinkmann 2010, 3.4, with tentative tracks and the test of nearness added.
    """
    m1, n1, least = confirm
    table, keep, part = rows.copy(), np.ones(rows.size, np.bool_), np.full(rows.size, -1)
    for t in range(table.size):
        row = table[t]
        hits = ones(row.history & ((1 << m1) - 1))
        if row.status == TENTATIVE:
            if hits >= n1 and row.score >= least:
                row.status = CONFIRMED
            keep[t] = hits + max(0, m1 - row.span) >= n1
        elif row.history & ((1 << (max_propagate + 1)) - 1) == 0:
            keep[t] = False
        keep[t] &= largest_sd(covariance[t]) <= max_sd_m
    for level in (CONFIRMED, TENTATIVE):
        for t in range(table.size if max_common else 0):
            if rows[t].status == level and keep[t]:
                part[t] = _other_self(t, rows["status"], table, keep, state, covariance, event, max_common)
                keep[t] = part[t] < 0
    for t in range(table.size):
        if table[t].status == CONFIRMED and not keep[t]:
            table[t].status = LOST
    return table, keep, part


@compiled
def _other_self(
    t: int,
    status: IntArray,
    table: Ledger,
    keep: BoolArray,
    state: FloatArray,
    covariance: FloatArray,
    event: IntArray,
    max_common: int,
) -> int:
    """The track that track t is part of, after counting their common events in `table`; -1: none.

    That one is confirmed if t is, and the older of two that both are, or both are not.
    """
    row = table[t]
    for j in range(table.size):
        senior = status[j] > status[t] or (status[j] == status[t] and j < t)
        if not (senior and keep[j] and event[t] >= 0 and event[j] >= 0):
            continue
        if event[j] == event[t]:
            row.rival_pings = row.rival_pings + 1 if row.rival == table[j].id else 1
            row.rival = table[j].id
            if row.rival_pings < max_common:
                return -1
            near = distance(state, covariance, t, j, np.empty((5, 4))) <= SAME_GATE
            return j if near else -1
        if table[j].id == row.rival:
            row.rival, row.rival_pings = 0, 0
    return -1
