"""Tracks that share gated measurements, cluster by cluster: clusters are independent of each other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["cluster_pairs", "clusters"]

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@compiled
def clusters(
    start: IntArray, places: IntArray, live: BoolArray, chosen: BoolArray, m: int
) -> tuple[IntArray, IntArray]:
    """The chosen tracks, cluster by cluster, and where each cluster begins."""
    n = chosen.size
    parent, owner = np.arange(n), np.full(m, -1)
    for t in range(n):
        for e in range(start[t], start[t + 1] if chosen[t] else 0):
            if live[e] and owner[places[e]] < 0:
                owner[places[e]] = t
            elif live[e]:
                a, b = _root(parent, owner[places[e]]), _root(parent, t)
                parent[max(a, b)] = min(a, b)
    number, place = np.full(n, -1), np.zeros(n + 1, np.int64)
    k = 0
    for t in range(n):
        if not chosen[t]:
            continue
        root = _root(parent, t)
        if number[root] < 0:
            number[root] = k
            k += 1
        number[t] = number[root]
        place[number[t] + 1] += 1
    first = np.cumsum(place[: k + 1])
    place[: k + 1] = first
    tracks = np.empty(first[k], np.int64)
    for t in range(n):
        if chosen[t]:
            tracks[place[number[t]]] = t
            place[number[t]] += 1
    return tracks, first


@compiled
def cluster_pairs(
    members: IntArray, start: IntArray, places: IntArray, live: BoolArray, work: IntArray
) -> tuple[IntArray, IntArray, IntArray, int]:
    """The cluster's live pairs: first (n + 1,) of each track, their places, their detections from 0 on."""
    n = members.size
    first, room = np.zeros(n + 1, np.int64), 0
    for i in range(n):
        room += start[members[i] + 1] - start[members[i]]
    pairs, detection = np.empty(room, np.int64), np.empty(room, np.int64)
    k = m = 0
    for i in range(n):
        for e in range(start[members[i]], start[members[i] + 1]):
            if live[e]:
                if work[places[e]] < 0:
                    work[places[e]] = m
                    m += 1
                pairs[k], detection[k] = e, work[places[e]]
                k += 1
        first[i + 1] = k
    for e in pairs[:k]:
        work[places[e]] = -1
    return first, pairs[:k].copy(), detection[:k].copy(), m


@compiled
def _root(parent: IntArray, t: int) -> int:
    while parent[t] != t:
        parent[t] = parent[parent[t]]
        t = parent[t]
    return t
