"""Which measurements lie in which track's gate, as rows of (track, measurement) pairs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["Gated", "gate", "pairs_in_gates"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Gated(NamedTuple):
    """Pairs of a track and a measurement in its gate: track t owns the places start[t] to start[t + 1]."""

    start: IntArray  # (n + 1,)
    places: IntArray  # (pairs,) measurement, increasing within a track
    likelihood: FloatArray  # (pairs,) N(y; H x, S), per m^2


def gate(state: FloatArray, covariance: FloatArray, R: FloatArray, y: FloatArray, gamma: float) -> Gated:
    """The pairs with nu^T S^-1 nu <= gamma, S = H P H^T + R (n, 2, 2), and their likelihoods.

    Source: Karoui 2015, section IV-B.
    """
    return Gated(*pairs_in_gates(state, covariance, R, y, gamma))


@compiled
def pairs_in_gates(
    state: FloatArray, covariance: FloatArray, R: FloatArray, y: FloatArray, gamma: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """The fields of `Gated`, in machine code."""
    n, m = state.shape[0], y.shape[0]
    start = np.zeros(n + 1, np.int64)
    room = 4 * n + m
    index, likelihood = np.empty(room, np.int64), np.empty(room)
    y1, y2 = y[:, 0].copy(), y[:, 1].copy()
    near = np.zeros((m + 7) // 8 * 8, np.uint8)
    words = near.view(np.uint64)
    k = 0
    for t in range(n):
        s11 = covariance[t, 0, 0] + R[t, 0, 0]
        s12 = covariance[t, 0, 1] + R[t, 0, 1]
        s22 = covariance[t, 1, 1] + R[t, 1, 1]
        det = s11 * s22 - s12 * s12
        peak = 1.0 / (2.0 * math.pi * math.sqrt(det))
        px, py = state[t, 0], state[t, 1]
        _around(y1, y2, px, py, math.sqrt(gamma * s11), math.sqrt(gamma * s22), near)
        if k + m > room:
            room = 2 * (k + m)
            index, likelihood = _longer(index, likelihood, k, room)
        for word in range(words.size):
            for j in range(8 * word, 8 * word + 8 if words[word] else 0):
                if not near[j]:
                    continue
                e1, e2 = y1[j] - px, y2[j] - py
                d2 = (e1 * (s22 * e1 - s12 * e2) + e2 * (s11 * e2 - s12 * e1)) / det
                if d2 <= gamma:
                    index[k] = j
                    likelihood[k] = peak * math.exp(-0.5 * d2)
                    k += 1
        start[t + 1] = k
    return start, index[:k].copy(), likelihood[:k].copy()


@compiled
def _around(
    y1: FloatArray,
    y2: FloatArray,
    x1: float,
    x2: float,
    reach1: float,
    reach2: float,
    near: npt.NDArray[np.uint8],
) -> None:
    """Flags the measurements in the rectangle around an ellipse with these half extents."""
    far1, far2 = reach1 * (1.0 + 1e-9), reach2 * (1.0 + 1e-9)
    for j in range(y1.size):
        near[j] = (abs(y1[j] - x1) <= far1) & (abs(y2[j] - x2) <= far2)


@compiled
def _longer(index: IntArray, likelihood: FloatArray, k: int, room: int) -> tuple[IntArray, FloatArray]:
    longer_index, longer_likelihood = np.empty(room, np.int64), np.empty(room)
    longer_index[:k] = index[:k]
    longer_likelihood[:k] = likelihood[:k]
    return longer_index, longer_likelihood
