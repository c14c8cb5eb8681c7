"""Two tracks of one object made one."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["Fusion", "fuse", "fused"]

FloatArray = npt.NDArray[np.float64]
Fusion = Literal["algebraic", "covariance-intersection"]
SHARES = 100  # steps of the weight that the intersection looks at


def fused(
    x1: FloatArray, P1: FloatArray, x2: FloatArray, P2: FloatArray, fusion: Fusion = "algebraic"
) -> tuple[FloatArray, FloatArray]:
    """State (4,) and covariance (4, 4) of the object that both tracks follow.

    `algebraic`: P = (P1^-1 + P2^-1)^-1, x = P (P1^-1 x1 + P2^-1 x2), right for independent errors; of tracks
    that share events P is up to twice too small. `covariance-intersection`: the same with weights w and 1 - w
    on the inverses, w such that the trace of P over position is least: never too small, whatever they share.

    Source: Brinkmann 2010 (3.33)-(3.35); Julier & Uhlmann 1997.
    """
    x, P = np.stack([x1, x2]), np.stack([P1, P2])
    fuse(x, P, 0, 1, fusion == "covariance-intersection")
    return x[0], P[0]


@compiled
def fuse(x: FloatArray, P: FloatArray, i: int, j: int, intersection: bool) -> None:
    """Sets track i of states (n, 4) and covariances (n, 4, 4) to what `fused` gives of tracks i and j."""
    J1, J2 = _inverse(P[i]), _inverse(P[j])
    w, v = 1.0, 1.0
    best = _inverse(J1 + J2)
    if intersection:
        least = np.inf
        for k in range(SHARES + 1):
            share = k / SHARES
            joined = _inverse(share * J1 + (1.0 - share) * J2)
            if joined[0, 0] + joined[1, 1] < least:
                best, least, w, v = joined, joined[0, 0] + joined[1, 1], share, 1.0 - share
    told = np.zeros(4)
    for a in range(4):
        for b in range(4):
            told[a] += w * J1[a, b] * x[i, b] + v * J2[a, b] * x[j, b]
    for a in range(4):
        x[i, a] = 0.0
        for b in range(4):
            x[i, a] += best[a, b] * told[b]
            P[i, a, b] = best[a, b]


@compiled
def _inverse(P: FloatArray) -> FloatArray:
    """That of a positive definite matrix, symmetric to the bit, by its Cholesky factor."""
    n = P.shape[0]
    L = np.zeros((n, n))  # P = L L^T
    M = np.zeros((n, n))  # L^-1
    for a in range(n):
        for b in range(a + 1):
            left = P[a, b]
            for c in range(b):
                left -= L[a, c] * L[b, c]
            L[a, b] = np.sqrt(max(left, 1e-300)) if a == b else left / L[b, b]
        M[a, a] = 1.0 / L[a, a]
        for b in range(a):
            total = 0.0
            for c in range(b, a):
                total += L[a, c] * M[c, b]
            M[a, b] = -total * M[a, a]
    result = np.zeros((n, n))
    for a in range(n):
        for b in range(a + 1):
            for c in range(a, n):
                result[a, b] += M[c, a] * M[c, b]
            result[b, a] = result[a, b]
    return result
