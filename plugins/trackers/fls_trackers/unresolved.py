"""Events that several objects make together: what they tell of each of them."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.echo_strength import EVENTS, LEVEL

__all__ = ["common_events"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Weights = tuple[IntArray, FloatArray, FloatArray, FloatArray, BoolArray]

LEAST = 0.2  # probability of an event at which a track may be one of those that made it together


@compiled
def common_events(
    start: IntArray,
    places: IntArray,
    beta: FloatArray,
    none: FloatArray,
    state: FloatArray,
    strength: FloatArray,
    y: FloatArray,
    resolution_m: float,
) -> Weights:
    """places, y, beta and none of `kalman.update` in which a common event moves all who made it alike.

    Tracks nearer to each other than `resolution_m` whose most probable event is the same one, with a
    probability of LEAST or more each, are taken to have made it together. Its place is that of their mean c,
    weighted by energy exp(2 level): so each track t is given the event y + x_t - c, with the sum of their
    probabilities. It moves their mean, and leaves what is known of their difference, so that they part as
    they met.

    Last come which tracks (n,) have such an event.

    Source: Koch & van Keuk 1997, the unresolved measurement of a group's centre, with each track's own gain.
    """
    n, m = state.shape[0], y.shape[0]
    where, moved, shares, rest = places.copy(), np.empty((m + n, 2)), beta.copy(), none.copy()
    moved[:m], moved[m:] = y, 0.0
    several = np.zeros(n, np.bool_)
    best = _best(start, beta) if resolution_m > 0.0 else np.full(n, -1)
    for t in range(n):
        e = best[t]
        if e < 0:
            continue
        count, together, x, y_centre = _company(t, best, places, beta, state, strength, resolution_m)
        if count < 2:
            continue
        several[t], where[e] = True, m + t
        moved[m + t, 0] = y[places[e], 0] + state[t, 0] - x
        moved[m + t, 1] = y[places[e], 1] + state[t, 1] - y_centre
        left = (1.0 - min(together, 1.0)) / max(1.0 - beta[e], 1e-12)
        for k in range(start[t], start[t + 1]):
            shares[k] = min(together, 1.0) if k == e else beta[k] * left
        rest[t] = none[t] * left
    return where, moved, shares, rest, several


@compiled
def _best(start: IntArray, beta: FloatArray) -> IntArray:
    """The most probable pair of each track (n,), -1 where none has a probability of LEAST."""
    best = np.full(start.size - 1, -1)
    for t in range(best.size):
        for e in range(start[t], start[t + 1]):
            if beta[e] >= LEAST and (best[t] < 0 or beta[e] > beta[best[t]]):
                best[t] = e
    return best


@compiled
def _company(
    t: int,
    best: IntArray,
    places: IntArray,
    beta: FloatArray,
    state: FloatArray,
    strength: FloatArray,
    resolution_m: float,
) -> tuple[int, float, float, float]:
    """How many tracks made track t's event, their probability together, and their centre's x and y."""
    count, together, weight, x, y = 0, 0.0, 0.0, 0.0, 0.0
    for j in range(best.size):
        if best[j] < 0 or places[best[j]] != places[best[t]]:
            continue
        if math.hypot(state[j, 0] - state[t, 0], state[j, 1] - state[t, 1]) > resolution_m:
            continue
        w = 1.0
        if strength[j, EVENTS] > 0.0 and strength[t, EVENTS] > 0.0:
            w = math.exp(2.0 * (strength[j, LEVEL] - strength[t, LEVEL]))
        count, together, weight = count + 1, together + beta[best[j]], weight + w
        x, y = x + w * state[j, 0], y + w * state[j, 1]
    return count, together, x / weight, y / weight
