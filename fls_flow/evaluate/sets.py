"""Distances between the set of targets and the set of tracks: OSPA and GOSPA of each ping, OSPA(2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.evaluate.assignment import Pairs, best
from fls_flow.evaluate.scene import Points

__all__ = ["SetDistances", "ospa2", "set_distances"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SetDistances:
    """Per ping, (n_pings,) each; the parts are to the power of the order, so that they add up."""

    n_targets: IntArray
    n_tracks: IntArray
    ospa: FloatArray  # m
    gospa: FloatArray  # m
    localisation: FloatArray  # m^p, of the pairs
    missed: FloatArray  # m^p, c^p / 2 per target
    false: FloatArray  # m^p, c^p / 2 per track


def set_distances(
    targets: Points, tracks: Points, pairs: Pairs, n_pings: int, cutoff_m: float, order: float
) -> SetDistances:
    """OSPA and GOSPA of each ping; `pairs` holds all that are closer than the cut-off.

    With k pairs of distance d_i < c, m targets and n tracks:
    OSPA = ((sum d_i^p + c^p (max(m, n) - k)) / max(m, n))^(1/p) (Schuhmacher, Vo & Vo 2008, (3));
    GOSPA = (sum d_i^p + c^p/2 (m - k) + c^p/2 (n - k))^(1/p) (Rahmathullah et al. 2017, (3), alpha = 2).
    A pair at distance c costs as much as none, so that both have the same best pairs: those of greatest
    sum (c^p - d_i^p). Two empty sets are at distance 0.
    """
    c = cutoff_m**order
    cost = pairs.distance_m**order
    chosen = best(pairs.ping, pairs.left, pairs.right, c - cost)
    m = np.bincount(targets.ping, minlength=n_pings)
    n = np.bincount(tracks.ping, minlength=n_pings)
    k = np.bincount(pairs.ping[chosen], minlength=n_pings)
    localisation: FloatArray = np.bincount(
        pairs.ping[chosen], weights=cost[chosen], minlength=n_pings
    ).astype(float)
    missed, false = 0.5 * c * (m - k), 0.5 * c * (n - k)
    larger = np.maximum(m, n)
    ospa = ((localisation + c * (larger - k)) / np.maximum(larger, 1)) ** (1.0 / order)
    gospa = (localisation + missed + false) ** (1.0 / order)
    return SetDistances(m, n, ospa, gospa, localisation, missed, false)


def ospa2(
    targets: Points,
    tracks: Points,
    pairs: Pairs,
    n_pings: int,
    cutoff_m: float,
    order: float,
    window_pings: int,
) -> FloatArray:
    """(n_pings,) OSPA(2), m, over the window of pings that ends at each ping: an OSPA between trajectories.

    The base distance of two trajectories is the mean, over the pings at which either lives, of min(d, c)
    where both live and c where one does (Beard, Vo & Vo 2020, (12)-(14), without weights).
    """
    rows = _windows(targets, tracks, pairs, n_pings, cutoff_m, window_pings)
    window, target, track, base = rows
    c = cutoff_m**order
    # a trajectory is another one in each window
    left, right = window * targets.name.size + target, window * tracks.name.size + track
    gain = c - base**order
    chosen = best(window, left, right, gain)
    saved = np.bincount(window[chosen], weights=gain[chosen], minlength=n_pings)
    m = _alive(targets, n_pings, window_pings)
    n = _alive(tracks, n_pings, window_pings)
    larger = np.maximum(m, n)
    total = np.maximum(c * larger - saved, 0.0)
    return np.asarray((total / np.maximum(larger, 1)) ** (1.0 / order))


def _windows(
    targets: Points, tracks: Points, pairs: Pairs, n_pings: int, cutoff_m: float, window_pings: int
) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Window, target, track and base distance of all trajectories that come closer than the cut-off."""
    target, track = targets.owner[pairs.left], tracks.owner[pairs.right]
    order = np.lexsort((pairs.ping, track, target))
    key = (target * max(tracks.name.size, 1) + track)[order]
    lives = (_lives(targets), _lives(tracks))
    found: list[tuple[IntArray, int, int, FloatArray]] = []
    for rows in np.split(order, np.flatnonzero(np.diff(key)) + 1) if order.size else []:
        i, j = int(target[rows[0]]), int(track[rows[0]])
        ping = pairs.ping[rows]
        begin, end = int(ping[0]), min(int(ping[-1]) + window_pings, n_pings)
        early = max(begin - window_pings + 1, 0)  # the first window looks back to here
        saved = np.zeros(end - early)
        saved[ping - early] = cutoff_m - pairs.distance_m[rows]
        either = np.zeros(end - early, bool)
        for alive in (lives[0][i], lives[1][j]):
            either[alive[(alive >= early) & (alive < end)] - early] = True
        saved, lived = (_sums(values, window_pings)[begin - early :] for values in (saved, either))
        near = saved > 1e-9 * cutoff_m  # running sums end near zero, not at it
        base = np.maximum(cutoff_m - saved[near] / lived[near], 0.0)  # rounded below 0 it has no p-th power
        found.append((np.arange(begin, end)[near], i, j, base))
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    size = [one[0].size for one in found]
    window = np.concatenate([one[0] for one in found])
    owners = [np.repeat([one[side] for one in found], size) for side in (1, 2)]
    sequence = np.argsort(window, kind="stable")
    bases = np.concatenate([one[3] for one in found])
    return window[sequence], owners[0][sequence], owners[1][sequence], bases[sequence]


def _lives(points: Points) -> list[IntArray]:
    """The pings of each owner."""
    order = np.lexsort((points.ping, points.owner))
    return np.split(points.ping[order], np.searchsorted(points.owner[order], np.arange(1, points.name.size)))


def _sums(values: npt.NDArray[np.float64 | np.bool_], window_pings: int) -> FloatArray:
    """Sums over the last `window_pings` values."""
    sums = np.cumsum(values, dtype=np.float64)
    sums[window_pings:] -= sums[:-window_pings].copy()
    return sums


def _alive(points: Points, n_pings: int, window_pings: int) -> IntArray:
    """(n_pings,) how many owners have a row in the window that ends at each ping."""
    change = np.zeros(n_pings + 1, np.int64)
    for pings in _lives(points) if len(points) else []:
        # a row counts until window_pings later, or until the next row takes over
        until = np.minimum(pings + window_pings, np.append(pings[1:], n_pings))
        np.add.at(change, pings, 1)
        np.add.at(change, until, -1)
    return np.cumsum(change)[:n_pings]
