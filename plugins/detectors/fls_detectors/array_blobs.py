"""Blobs of an angle-distance matrix: hits that touch by their sides, around the full circle."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Ping
from fls_flow.geometry import wrap
from fls_flow.kernels import compiled

__all__ = ["Blobs", "blobs_of", "closes_circle", "joined_hits"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Blobs(NamedTuple):
    """Connected regions of hits, in order of range, then beam, of their first cells."""

    range_m: FloatArray  # (n,) of the centroid
    bearing_rad: FloatArray  # (n,) of the centroid, in (-pi, pi]
    peak: FloatArray  # (n,) largest amplitude
    row: IntArray  # (n,) of its highest cell, the first of equals
    beam: IntArray  # (n,)
    cells: IntArray  # (n,)
    extent: FloatArray  # (n, 2) size in range (m) and bearing (rad), between the middles of the outer cells

    def select(self, which: npt.NDArray[Any]) -> Blobs:
        """Those that a mask or an index array selects."""
        return Blobs(*(part[which] for part in self))


def closes_circle(bearing_rad: FloatArray) -> bool:
    """Whether the last beam is a neighbour of the first: beams all round, none of them twice."""
    if bearing_rad.size < 3:
        return False
    steps = np.diff(bearing_rad)
    gap = 2.0 * np.pi - abs(float(bearing_rad[-1] - bearing_rad[0]))
    return bool((np.sign(steps) == np.sign(steps[0])).all() and 0.0 < gap < 1.5 * np.abs(steps).max())


def blobs_of(ping: Ping, hits: BoolArray, *, by_power: bool = False) -> Blobs:
    """The 4-connected blobs of `hits` (n_ranges, n_beams) in `ping`, each at the centroid of its cells.

    r = mean r_m and theta = theta_0 + mean of wrap(theta_n - theta_0), theta_0 the bearing of its first cell;
    plain means, or weighted `by_power`. If the beams close the circle, the last is a neighbour of the first.

    Source: Abu 2024 (10), (11); the weights and the closed circle are ours.
    """
    row, beam = np.divmod(np.flatnonzero(hits), max(hits.shape[1], 1))
    of, n = joined_hits(row, beam, hits.shape[1], closes_circle(ping.bearing_rad))
    amplitude = ping.amplitude[row, beam].astype(float)
    weight = amplitude**2 if by_power else np.ones(row.size)
    total = np.bincount(of, weight, n)
    first = np.zeros(n, np.int64)
    first[of[::-1]] = np.arange(row.size)[::-1]
    origin = ping.bearing_rad[beam[first]]
    turned = wrap(ping.bearing_rad[beam] - origin[of])
    distance = ping.range_m[row]
    order = np.lexsort((-np.arange(row.size), amplitude))
    top = np.zeros(n, np.int64)
    top[of[order]] = order
    return Blobs(
        np.bincount(of, weight * distance, n) / total,
        wrap(origin + np.bincount(of, weight * turned, n) / total),
        amplitude[top],
        row[top],
        beam[top],
        np.bincount(of, minlength=n),
        np.stack([_spread(of, distance, n), _spread(of, turned, n)], axis=1),
    )


def joined_hits(row: IntArray, beam: IntArray, n_beams: int, closed: bool) -> tuple[IntArray, int]:
    """The blob of each hit, numbered in order of the blobs' first hits, and the number of blobs.

    Hits come in order of row, then beam; two are joined when they are neighbours in range or in bearing.
    """
    of, n = _joined(row, beam, n_beams, closed)
    return of, int(n)


def _highest(of: IntArray, values: FloatArray, n: int) -> FloatArray:
    most = np.full(n, -np.inf)
    np.maximum.at(most, of, values)
    return most


def _spread(of: IntArray, values: FloatArray, n: int) -> FloatArray:
    return _highest(of, values, n) + _highest(of, -values, n)


@compiled
def _joined(row: IntArray, beam: IntArray, n_beams: int, closed: bool) -> tuple[IntArray, int]:
    n = row.size
    parent = np.arange(n)
    above = np.full(n_beams, -1)  # the last hit seen in each beam
    first_of_row = 0
    for i in range(n):
        if i and row[i] != row[i - 1]:
            first_of_row = i
        if i and row[i] == row[i - 1] and beam[i] == beam[i - 1] + 1:
            _join(parent, i, i - 1)
        k = above[beam[i]]
        if k >= 0 and row[k] == row[i] - 1:
            _join(parent, i, k)
        if closed and beam[i] == n_beams - 1 and beam[first_of_row] == 0 and first_of_row != i:
            _join(parent, i, first_of_row)
        above[beam[i]] = i
    number, of, count = np.full(n, -1), np.empty(n, np.int64), 0
    for i in range(n):
        root = _root(parent, i)
        if number[root] < 0:
            number[root] = count
            count += 1
        of[i] = number[root]
    return of, count


@compiled
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def _join(parent: IntArray, i: int, j: int) -> None:
    a, b = _root(parent, i), _root(parent, j)
    parent[max(a, b)] = min(a, b)
