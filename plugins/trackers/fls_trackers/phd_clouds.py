"""Particles by identity: one cloud per label, with its moments; clouds of one target joined.

Labels are numbers from 0, older clouds first. What a label's mass means: see `phd_existence`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.phd_existence import MOST_CERTAIN

__all__ = ["Clouds", "clouds"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Clouds(NamedTuple):
    """Weighted particles with labels, and what the particles of each label say together."""

    weight: FloatArray  # (n,)
    label: IntArray  # (n,)
    existence: FloatArray  # (k,) the sum of a label's weights, at most 1
    mean: FloatArray  # (k, 4)
    covariance: FloatArray  # (k, 4, 4)

    def strongest(self, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Means (j, 4), covariances and existences of the `n` likeliest, j <= n; the older of two equals."""
        order = np.argsort(-self.existence, kind="stable")[:n]
        return self.mean[order], self.covariance[order], self.existence[order]


def clouds(
    state: FloatArray, weight: FloatArray, label: IntArray, prune: float, limit: float, floor_sd: float
) -> Clouds:
    """The clouds of particles (n, 4); those lighter than `prune` lose their particles' weight.

    A cloud joins a likelier one when (x_j - x_i)^T P_j^-1 (x_j - x_i) <= `limit`, with its own mean and
    covariance, and both are one target at most; the likeliest first. `floor_sd` (m, m/s) is added to every
    covariance. Labels are counted anew, without the empty ones.
    """
    labels = int(label.max()) + 1 if label.size else 0
    r, mean, P = _moments(state, weight, label, labels, floor_sd**2)
    target = _joined(r, mean, np.linalg.inv(P).astype(float), prune, limit)
    left, number = np.flatnonzero(target == np.arange(labels)), np.full(labels + 1, -1, np.int64)
    number[left] = np.arange(left.size)
    place = number[target][label]  # a target of -1 is the last place: no label
    mass = np.bincount(place + 1, weight, left.size + 1)[1:]
    scale = np.concatenate([[0.0], np.minimum(1.0, MOST_CERTAIN / mass)])
    weight, place = weight * scale[place + 1], np.maximum(place, 0)
    return Clouds(weight, place, *_moments(state, weight, place, left.size, floor_sd**2))


@compiled
def _moments(
    state: FloatArray, weight: FloatArray, label: IntArray, labels: int, floor: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    r, mean, P = np.zeros(labels), np.zeros((labels, 4)), np.zeros((labels, 4, 4))
    for s in range(weight.size):
        r[label[s]] += weight[s]
        for a in range(4):
            mean[label[s], a] += weight[s] * state[s, a]
    for k in range(labels):
        mean[k] /= max(r[k], 1e-300)
    for s in range(weight.size):
        k = label[s]
        for a in range(4):
            e = weight[s] / max(r[k], 1e-300) * (state[s, a] - mean[k, a])
            for o in range(4):
                P[k, a, o] += e * (state[s, o] - mean[k, o])
    for k in range(labels):
        for a in range(4):
            P[k, a, a] += floor
    return r, mean, P


@compiled
def _joined(r: FloatArray, mean: FloatArray, inverse: FloatArray, prune: float, limit: float) -> IntArray:
    """The label that each becomes; -1: none."""
    target, mass = np.full(r.size, -1, np.int64), r.copy()
    for best in np.argsort(-r, kind="mergesort"):
        if target[best] >= 0 or not r[best] > prune:
            continue
        target[best] = best
        for j in range(r.size):
            if target[j] >= 0 or not r[j] > prune or mass[best] + r[j] > 1.0:
                continue
            e = mean[j] - mean[best]
            if (e * (inverse[j] * e).sum(axis=1)).sum() <= limit:
                target[j] = best
                mass[best] += r[j]
    return target
