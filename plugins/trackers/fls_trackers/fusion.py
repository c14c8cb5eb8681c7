"""Two tracks of one object made one."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
from numpy.linalg import inv

__all__ = ["Fusion", "fused"]

FloatArray = npt.NDArray[np.float64]
Fusion = Literal["algebraic", "covariance-intersection"]
SHARES = np.linspace(0.0, 1.0, 101)


def fused(
    x1: FloatArray, P1: FloatArray, x2: FloatArray, P2: FloatArray, fusion: Fusion = "algebraic"
) -> tuple[FloatArray, FloatArray]:
    """State (4,) and covariance (4, 4) of the object that both tracks follow.

    `algebraic`: P = (P1^-1 + P2^-1)^-1, x = P (P1^-1 x1 + P2^-1 x2), right for independent errors; of tracks
    that share events P is up to twice too small. `covariance-intersection`: the same with weights w and 1 - w
    on the inverses, w such that the trace of P over position is least: never too small, whatever they share.

    Source: Brinkmann 2010 (3.33)-(3.35); Julier & Uhlmann 1997.
    """
    J1, J2 = inv(P1), inv(P2)
    w = np.ones(1) if fusion == "algebraic" else SHARES
    v = np.ones(1) if fusion == "algebraic" else 1.0 - SHARES
    P = inv(w[:, None, None] * J1 + v[:, None, None] * J2)
    best = int(np.argmin(P[:, 0, 0] + P[:, 1, 1]))
    P_best = 0.5 * (P[best] + P[best].T)
    return P_best @ (w[best] * (J1 @ x1) + v[best] * (J2 @ x2)), P_best
