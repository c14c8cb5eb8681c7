"""Joint probabilistic data association: how probable each gated measurement is for each track.

Tracks that share gated measurements form a cluster; clusters are independent. A cluster is summed over all
its joint events by a forward and a backward pass over its tracks and measurements. The state between two
steps is which are taken, and only those need a bit that are open: some of their pairs lie before, some after.
The cost is 2^(open at one time), not the number of events. In a wider cluster the least probable pairs are
replaced by their messages in loopy belief propagation, so that the time per scan is bounded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.assignment import most_probable
from fls_trackers.belief import bounded
from fls_trackers.clusters import cluster_pairs, clusters
from fls_trackers.events import all_events
from fls_trackers.gating import Gated
from fls_trackers.sweep import plan

__all__ = ["ASSIGNED", "INDEPENDENT", "JOINT", "LINEAR", "Association", "associate", "evidence", "shared_out"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

# How measurements are shared out among the tracks that gate them.
JOINT = 0  # all joint events, each with its probability
INDEPENDENT = 1  # each track for itself, as if it were alone
ASSIGNED = 2  # the most probable joint event alone
LINEAR = 3  # as INDEPENDENT, with likelihoods from `linear.against_others`

MAX_STEPS = 3_000_000  # of the sums over events, per scan: some 5 ms
MAX_MESSAGES = 20_000_000  # of belief propagation, per scan: some 200 ms


class Association(NamedTuple):
    """Probabilities of `Gated` pairs, and what is left over."""

    beta: FloatArray  # (pairs,) that the measurement is the track's
    beta_none: FloatArray  # (n,) that none is; over a track, both sum to 1
    taken: FloatArray  # (m,) that the measurement is some track's
    claimed: BoolArray  # (m,) whether it lies in the gate of a track of rank 0
    in_gate: BoolArray  # (n,) whether the track has a measurement
    approximate: int  # clusters that fell back to belief propagation


class Pairs(NamedTuple):
    """Pairs of a track and a measurement in its gate, as in `Gated`, and what becomes of them."""

    start: IntArray  # (n + 1,)
    places: IntArray  # (pairs,)
    ratio: FloatArray  # (pairs,) p_d N / (density (1 - p_d p_g))
    live: BoolArray  # (pairs,) whether the measurement may be taken
    beta: FloatArray  # (pairs,), filled
    beta_none: FloatArray  # (n,), filled


def associate(
    gated: Gated,
    density: FloatArray,
    rank: IntArray,
    *,
    p_d: float,
    p_g: float,
    max_shared: int = 14,
    sharing: int = JOINT,
) -> Association:
    """The probabilities of all pairs, exact unless a sweep of a cluster needs more than `max_shared` bits.

    A joint event gives each track at most one of its measurements and each measurement to at most one track;
    its weight is prod_(t has j) p_d N(y_j; H x_t, S_t) / density_j * prod_(t has none) (1 - p_d p_g).
    `density` (m,) is that of false measurements, per m^2. Tracks of rank 0 come first; those of rank 1 get
    only the measurements that are more likely not taken (`taken` at most 1/2), and so on.

    `sharing` is JOINT, INDEPENDENT (each track's own events alone: PDA) or ASSIGNED (1 for the pairs of the
    most probable joint event, 0 for the others: global nearest neighbour).

    Source: Karoui 2015 (20)-(22), (22) with (1 - p_d p_g) for a miss; PDA: Bar-Shalom & Li 1995, section
    3.4.
    """
    factor = p_d / (1.0 - p_d * p_g)
    return Association(
        *shared_out(gated.start, gated.places, gated.likelihood, density, factor, rank, max_shared, sharing)
    )


@compiled
def shared_out(
    start: IntArray,
    places: IntArray,
    likelihood: FloatArray,
    density: FloatArray,
    factor: float,
    rank: IntArray,
    max_shared: int,
    sharing: int,
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, BoolArray, int]:
    """The fields of `Association`, in machine code; `factor` is p_d / (1 - p_d p_g)."""
    n, m = rank.size, density.size
    ratio = np.empty(places.size)
    for e in range(places.size):
        ratio[e] = factor * likelihood[e] / density[places[e]]
    beta, beta_none, taken = np.zeros(places.size), np.ones(n), np.zeros(m)
    claimed, in_gate, live = np.zeros(m, np.bool_), np.zeros(n, np.bool_), np.zeros(places.size, np.bool_)
    pairs = Pairs(start, places, ratio, live, beta, beta_none)
    budget = np.array([MAX_STEPS, MAX_MESSAGES])
    approximate = 0
    for level in range(rank.max() + 1 if n else 0):
        chosen = np.zeros(n, np.bool_)
        for t in range(n):
            for e in range(start[t], start[t + 1] if rank[t] == level else 0):
                live[e] = taken[places[e]] <= 0.5
                chosen[t] |= live[e]
                claimed[places[e]] |= level == 0
            in_gate[t] |= chosen[t]
        if sharing != INDEPENDENT:
            approximate += _neighbours(chosen, pairs, m, max_shared, sharing, budget)
        for t in range(n):
            if chosen[t]:
                _alone(t, pairs, sharing)
        for t in range(n):
            for e in range(start[t], start[t + 1] if rank[t] == level else 0):
                left = 1.0 - taken[places[e]] if sharing == INDEPENDENT else 1.0
                taken[places[e]] += left * beta[e]
    return beta, beta_none, taken, claimed, in_gate, approximate


@compiled
def evidence(
    start: IntArray,
    places: IntArray,
    likelihood: FloatArray,
    density: FloatArray,
    factor: float,
    beta: FloatArray,
    beta_none: FloatArray,
) -> FloatArray:
    """How likely no measurement was against what the tracks (n,) took, for their scores.

    That is beta_none, and where one measurement was assigned for sure, 1 / its ratio.
    """
    none = beta_none.copy()
    for t in range(none.size):
        for e in range(start[t], start[t + 1]):
            if beta[e] == 1.0:
                none[t] = density[places[e]] / (factor * likelihood[e])
    return none


@compiled
def _neighbours(
    chosen: BoolArray, pairs: Pairs, m: int, max_shared: int, sharing: int, budget: IntArray
) -> int:
    """Fills beta and beta_none of the chosen tracks that share measurements, and takes them from `chosen`.

    Gives how many of their clusters are approximate.
    """
    start, places, live = pairs.start, pairs.places, pairs.live
    gating, shares, some = np.zeros(m, np.int64), np.zeros(chosen.size, np.bool_), False
    for t in range(chosen.size):
        for e in range(start[t], start[t + 1] if chosen[t] else 0):
            gating[places[e]] += live[e]
    for t in range(chosen.size):
        for e in range(start[t], start[t + 1] if chosen[t] else 0):
            shares[t] |= live[e] and gating[places[e]] > 1
        some |= shares[t]
        chosen[t] &= not shares[t]
    approximate = 0
    if some:
        work = np.full(m, -1)
        tracks, first = clusters(start, places, live, shares, m)
        for c in range(first.size - 1):
            members = tracks[first[c] : first[c + 1]]
            approximate += _cluster(members, pairs, work, max_shared, sharing, budget)
    return approximate


@compiled
def _cluster(
    members: IntArray, pairs: Pairs, work: IntArray, max_shared: int, sharing: int, budget: IntArray
) -> bool:
    """Fills beta and beta_none of one cluster's tracks; gives whether they are approximate.

    `work` (m,) is all -1, and so again afterwards.
    """
    if sharing == JOINT and members.size == 2:
        _two_tracks(members[0], members[1], pairs)
        return False
    start, places, ratio, live, beta, beta_none = pairs
    first, own, detection, m = cluster_pairs(members, start, places, live, work)
    if sharing == ASSIGNED:
        beta[own], beta_none[members] = most_probable(first, detection, ratio[own], m)
        return False
    sweep = plan(first, detection, m, max_shared)
    steps = (own.size + members.size) << min(sweep.width, 32)
    exact = sweep.width <= max_shared and steps <= budget[0]
    if exact:
        budget[0] -= steps
        b, none = all_events(first, ratio[own], sweep)
    else:
        b, none = bounded(first, detection, ratio[own], m, max_shared, budget)
    beta[own] = b
    beta_none[members] = none
    return not exact


@compiled
def _alone(t: int, pairs: Pairs, sharing: int) -> None:
    """Fills beta and beta_none of a track whose measurements no other one has."""
    start, ratio, live, beta, beta_none = pairs.start, pairs.ratio, pairs.live, pairs.beta, pairs.beta_none
    if sharing == ASSIGNED:  # its best measurement, unless a miss is more probable
        best, most = -1, 1.0
        for e in range(start[t], start[t + 1]):
            if live[e] and (ratio[e] > most or (ratio[e] == most and best < 0)):
                best, most = e, ratio[e]
        if best >= 0:
            beta[best], beta_none[t] = 1.0, 0.0
        return
    total = 1.0
    for e in range(start[t], start[t + 1]):
        total += ratio[e] if live[e] else 0.0
    beta_none[t] = 1.0 / total
    for e in range(start[t], start[t + 1]):
        beta[e] = ratio[e] / total if live[e] else 0.0


@compiled
def _two_tracks(s: int, t: int, pairs: Pairs) -> None:
    """The commonest cluster: what each track takes, times all that the other may take besides."""
    start, places, ratio, live, beta, beta_none = pairs
    total = 0.0
    for one, other in ((s, t), (t, s)):
        none = 1.0
        for e in range(start[other], start[other + 1]):
            none += ratio[e] if live[e] else 0.0
        weight = none
        for e in range(start[one], start[one + 1]):
            besides = 1.0
            for f in range(start[other], start[other + 1]):
                besides += ratio[f] if live[f] and places[f] != places[e] else 0.0
            beta[e] = ratio[e] * besides if live[e] else 0.0
            weight += beta[e]
        beta_none[one], total = none, weight
    for one in (s, t):
        beta_none[one] /= total
        for e in range(start[one], start[one + 1]):
            beta[e] /= total
