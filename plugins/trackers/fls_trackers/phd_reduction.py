"""Fewer Gaussians for a mixture: pruned, merged, cut off."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.phd_gaussian import Mixture

__all__ = ["reduced"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


def reduced(
    mixture: Mixture, prune: float, merge: float, most: int, label: IntArray | None = None
) -> tuple[Mixture, IntArray]:
    """The mixture with fewer components, the heaviest first, and the mass of those it keeps or merges.

    Components lighter than `prune` fall away; the heaviest takes in all that have
    (x_j - x_i)^T P_j^-1 (x_j - x_i) <= `merge`, by moments, and so on; the `most` heaviest stay. It takes in
    components of another `label` (n,) only where all that are near have a mass of 1 at most. Gives the
    labels, too: each component's is that of the heaviest in it.

    Source: Vo & Ma 2006, table II; labels are ours.
    """
    names = np.zeros(mixture.weight.size, np.int64) if label is None else label
    heavy = np.flatnonzero(mixture.weight > prune)
    kept, names = mixture.select(heavy), names[heavy]
    if not kept.weight.size:
        return kept, names
    inverse = np.linalg.inv(kept.covariance).astype(float)
    *merged, names = _merged(*kept, inverse, np.ascontiguousarray(names), merge)
    order = np.argsort(-merged[0], kind="stable")[:most]
    return Mixture(*merged).select(order), names[order]


@compiled
def _merged(
    weight: FloatArray,
    state: FloatArray,
    covariance: FloatArray,
    inverse: FloatArray,
    label: IntArray,
    limit: float,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    n = weight.size
    w, x, P, names = np.zeros(n), np.zeros((n, 4)), np.zeros((n, 4, 4)), np.empty(n, np.int64)
    free, group = np.ones(n, np.bool_), np.empty(n, np.int64)
    k = 0
    for best in np.argsort(-weight, kind="mergesort"):
        if not free[best]:
            continue
        near, mass = 0, 0.0
        for j in range(n):
            if free[j] and _apart(state[j], state[best], inverse[j]) <= limit:
                group[near] = j
                near += 1
                mass += weight[j]
        size = 0
        for e in range(near):
            j = group[e]
            if mass <= 1.0 or label[j] == label[best]:
                group[size] = j
                size += 1
                w[k] += weight[j]
                free[j] = False
        _moments(group[:size], weight, state, covariance, w[k], x[k], P[k])
        names[k] = label[best]
        k += 1
    return w[:k].copy(), x[:k].copy(), P[:k].copy(), names[:k].copy()


@compiled
def _moments(
    group: IntArray,
    weight: FloatArray,
    state: FloatArray,
    covariance: FloatArray,
    total: float,
    mean: FloatArray,
    spread: FloatArray,
) -> None:
    """Adds the mean and covariance of the group's mixture to zeros."""
    for j in group:
        for a in range(4):
            mean[a] += weight[j] / total * state[j, a]
    for j in group:
        part = weight[j] / total
        for a in range(4):
            for o in range(4):
                apart = (state[j, a] - mean[a]) * (state[j, o] - mean[o])
                spread[a, o] += part * (covariance[j, a, o] + apart)


@compiled
def _apart(x: FloatArray, y: FloatArray, inverse: FloatArray) -> float:
    d2 = 0.0
    for a in range(4):
        for o in range(4):
            d2 += (x[a] - y[a]) * inverse[a, o] * (x[o] - y[o])
    return d2
