"""Assignments in which two tracks might as well exchange their measurements."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["exchanged"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@compiled
def exchanged(
    start: IntArray,
    places: IntArray,
    likelihood: FloatArray,
    density: FloatArray,
    factor: float,
    rank: IntArray,
    beta: FloatArray,
    beta_none: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """beta (pairs,) and beta_none (n,) of an assignment and all that differ from it by one exchange.

    Let track t have measurement j, and let another track s of its rank gate j. In an exchange s takes j, and
    t takes what s had, k, or nothing. With ratio_tj = factor N(y_j; H x_t, S_t) / density_j its odds against
    the assignment are (ratio_sj / ratio_tj) (ratio_tk / ratio_sk), or (ratio_sj / ratio_tj) / ratio_sk when t
    takes nothing; ratio_sk is 1 if s had nothing. A track's beta are the mean over the assignment and its
    exchanges by these odds. One whose measurement no other track gates keeps what it was given.

    Tracks of objects that cross so go on as they came: a single assignment, wrong every other time while two
    are nearer than their noise, turns their velocities until each follows the other's object.

    Source: the joint events of Bar-Shalom & Li 1995, section 6.2, next to the most probable one.
    """
    holder, own = np.full(density.size, -1), np.full(rank.size, -1)
    for t in range(rank.size):
        for e in range(start[t], start[t + 1]):
            if beta[e] == 1.0:
                holder[places[e]], own[t] = t, e
    moved, odds = np.zeros(places.size), np.zeros(rank.size)
    for s in range(rank.size):
        for e in range(start[s], start[s + 1]):
            t = holder[places[e]]
            if t >= 0 and t != s and rank[t] == rank[s]:
                _exchange(s, t, e, start, places, likelihood, density, factor, own, moved, odds)
    shares, rest = beta.copy(), beta_none.copy()
    for t in range(rank.size):
        if odds[t] > 0.0:
            some = 0.0
            for e in range(start[t], start[t + 1]):
                shares[e] = (beta[e] + moved[e]) / (1.0 + odds[t])
                some += shares[e]
            rest[t] = max(1.0 - some, 0.0)
    return shares, rest


@compiled
def _exchange(
    s: int,
    t: int,
    e: int,
    start: IntArray,
    places: IntArray,
    likelihood: FloatArray,
    density: FloatArray,
    factor: float,
    own: IntArray,
    moved: FloatArray,
    odds: FloatArray,
) -> None:
    """Adds the odds that s takes the measurement of t, which is in its pair e, to those of both tracks."""
    taken = likelihood[e] / likelihood[own[t]]
    if own[s] < 0:
        moved[e] += taken
        odds[s] += taken
        odds[t] += taken
        return
    k = places[own[s]]
    alone = taken * density[k] / (factor * likelihood[own[s]])
    both = 0.0
    for f in range(start[t], start[t + 1]):
        if places[f] == k:
            both = taken * likelihood[f] / likelihood[own[s]]
    moved[e] += alone + both
    odds[s] += alone
    odds[t] += alone
    if s < t:  # the same exchange comes again from the pair of t
        odds[s] += both
        odds[t] += both
