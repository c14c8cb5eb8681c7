"""One scan of tracks that each follow their object for themselves (PDAF, NNKF), compiled as a whole."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.adaptive_noise import SENSOR, learn, predict_each
from fls_trackers.association import ASSIGNED, INDEPENDENT, JOINT, evidence, shared_out
from fls_trackers.conversion import noise_of
from fls_trackers.echo_strength import agreeing, learned
from fls_trackers.exchanges import exchanged
from fls_trackers.gating import pairs_in_gates
from fls_trackers.kalman import update
from fls_trackers.life import CONFIRMED, LOST, TENTATIVE, count, largest_sd, ones
from fls_trackers.repeats import alike, common
from fls_trackers.track_bank import Ledger
from fls_trackers.unresolved import common_events

__all__ = ["Gains", "follow", "nearest", "settle_by_score"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Gains = tuple[float, float, float]  # gamma, p_d / (1 - p_d p_g), 1 - p_d p_g

MAX_SHARED = 14  # events that a cluster of tracks may share at a time, for exact probabilities


@compiled
def follow(
    state: FloatArray,
    covariance: FloatArray,
    ledger: Ledger,
    noise: FloatArray,
    strength: FloatArray,
    y: FloatArray,
    ln_amplitude: FloatArray,
    density: FloatArray,
    motion: tuple[float, float],
    sensor: tuple[float, float, float, float, float],
    spread: tuple[float, float, float],
    gains: Gains,
    choices: tuple[bool, bool, bool, bool],
) -> tuple[
    FloatArray, FloatArray, Ledger, FloatArray, FloatArray, IntArray, FloatArray, BoolArray, BoolArray
]:
    """States, covariances, ledger, noise and strength after the events `y` (m, 2).

    Then the tracks' own events (n,), the probability that they had none (n,), which events (m,) are no new
    track's, and which lie in a confirmed track's gate.

    `motion`: dt and velocity walk; `sensor`: sd in range and bearing, pose; `spread`: sd of an echo's centre
    (m) and of ln(amplitude), 0: not weighed, and the distance (m) of objects that may make one event.
    `choices`: one_event, only_probable, adaptive, joint. Each track weighs all events in its gate (PDAF), or
    takes the nearest (`one_event`, NNKF); if `joint`, by the probabilities of joint events, in which no event
    is two tracks', or by the most probable one and its `exchanges`. An update is an event in the gate; if
    `only_probable`, one more likely than none, and the NNKF then takes no other. The track's own event is the
    most probable one, -1 when none is more probable. Confirmed tracks come first: tentative ones get the
    events that more likely are no confirmed track's. An event that lies in a gate starts no track; if
    `joint`, it does unless it more likely is some track's, or the best that a track has.

    Source: Brinkmann 2010 (3.20)-(3.31), with the density per m^2, 1 - p_d p_g for a miss, and a gate first.
    """
    gamma, factor, miss = gains
    one_event, only_probable, adaptive, joint = choices
    x, P = predict_each(state, covariance, motion[0], motion[1], noise)
    R = _noise(x, noise, sensor, spread[0])
    start, places, likelihood = pairs_in_gates(x, P, R, y, gamma)
    if spread[1] > 0.0:
        likelihood = agreeing(likelihood, start, places, strength, ln_amplitude, spread[1])
    beta, none, score, taken, claimed, in_gate = _shared(
        start, places, likelihood, density, factor, ledger, one_event, only_probable, joint
    )
    event = _own(start, places, beta, none)
    table = learn(noise, x, P, R, y, event) if adaptive else noise.copy()
    where, moved, shares, rest, several = common_events(
        start, places, beta, none, x, strength, y, spread[2] if joint else 0.0
    )
    left = rest
    if one_event and only_probable and joint:
        rank = _ranks(ledger)
        shares, left = exchanged(start, places, likelihood, density, factor, rank, shares, rest)
    x, P = update(x, P, R, moved, start, where, shares, left)
    hit = in_gate & (rest < 0.5) if only_probable else in_gate
    levels = learned(strength, start, places, beta, ln_amplitude, motion[0])
    for t in range(several.size):
        if several[t]:  # the strength of a common echo is nobody's
            levels[t] = strength[t]
    known = _explained(start, places, beta, taken, joint)
    rows = count(ledger, hit, np.where(several, rest, score), miss)
    return x, P, rows, table, levels, event, none, known, claimed


@compiled
def _shared(
    start: IntArray,
    places: IntArray,
    likelihood: FloatArray,
    density: FloatArray,
    factor: float,
    ledger: Ledger,
    one_event: bool,
    only_probable: bool,
    joint: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray, BoolArray]:
    """beta (pairs,), beta_none (n,) and its part in the score; taken and claimed (m,), in_gate (n,)."""
    rank = _ranks(ledger)
    assigned = joint and one_event and only_probable
    sharing = (ASSIGNED if assigned else JOINT) if joint else INDEPENDENT
    beta, none, taken, claimed, in_gate, _ = shared_out(
        start, places, likelihood, density, factor, rank, MAX_SHARED, sharing
    )
    score = none
    if one_event:
        if not assigned:
            least = density / factor if only_probable else np.zeros(density.size)
            beta, none = nearest(start, places, np.where(beta > 0.0, likelihood, -1.0), least)
        score = evidence(start, places, likelihood, density, factor, beta, none)
    return beta, none, score, taken, claimed, in_gate


@compiled
def _ranks(ledger: Ledger) -> IntArray:
    """Confirmed tracks take first."""
    rank = np.zeros(ledger.size, np.int64)
    for t in range(ledger.size):
        rank[t] = ledger[t].status == TENTATIVE
    return rank


@compiled
def _noise(
    x: FloatArray, noise: FloatArray, sensor: tuple[float, float, float, float, float], extent_sd_m: float
) -> FloatArray:
    """R (n, 2, 2) of each track's events: the sensor's noise, and how the echo's centre wanders."""
    R = noise_of(x, sensor[0], sensor[1], sensor[2], sensor[3], sensor[4])
    for t in range(R.shape[0]):
        factor = math.exp(noise[t, SENSOR])
        for a in range(2):
            R[t, a, a] += extent_sd_m * extent_sd_m
            for b in range(2):
                R[t, a, b] *= factor
    return R


@compiled
def _explained(
    start: IntArray, places: IntArray, beta: FloatArray, taken: FloatArray, joint: bool
) -> BoolArray:
    """Which events (m,) start no track."""
    known = np.zeros(taken.size, np.bool_)
    for t in range(start.size - 1):
        best = -1
        for e in range(start[t], start[t + 1]):
            known[places[e]] |= not joint or taken[places[e]] > 0.5
            if beta[e] > (beta[best] if best >= 0 else 0.0):
                best = e
        if best >= 0:
            known[places[best]] = True
    return known


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
    none: FloatArray,
    confirm: tuple[int, int, float],
    max_propagate: int,
    max_sd_m: float,
    max_common: int,
    joint: bool,
) -> tuple[Ledger, BoolArray, IntArray]:
    """The ledger with new statuses, which tracks go on (n,), and the one each is part of (n,), -1: none.

    A track's score is `max_propagate` after an update and falls by one with each miss; a miss at score 0 ends
    it. `confirm` is (m1, n1, score): a tentative track is confirmed with n1 updates in its last m1 pings and
    that log likelihood ratio, and ends when the updates cannot be reached any more. Either ends with a
    position less certain than max_sd_m. Two tracks are one when they had the same own event in each of their
    last `max_common` common updates, and are as near as if they followed one object. If `joint`, no event is
    two tracks' own: then they are one when, as near as that, they explained one event together, rather than
    two, `max_common` times more often than the younger was updated before (at most 40 are held against it).
    So two long known swimmers who meet are still two when they part.

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
    status = rows["status"].copy()
    if max_common and joint:
        part = alike(status, table, keep, state, covariance, none, max_common)
    elif max_common:
        part = common(status, table, keep, state, covariance, event, max_common)
    for t in range(table.size):
        if table[t].status == CONFIRMED and not keep[t]:
            table[t].status = LOST
    return table, keep, part
