"""Kalman prediction, and the update with several weighted measurements per track, over all tracks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["predict", "update"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@compiled
def predict(
    state: FloatArray, covariance: FloatArray, dt_s: float, sigma_v_mps2: float
) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) after `dt_s` of nearly constant velocity.

    x = F x, P = F P F^T + sigma_v^2 G G^T, written out for F = [[1, dt], [0, 1]] per axis.

    Source: Karoui 2015 (12), (13).
    """
    x, P = state.copy(), covariance.copy()
    q = sigma_v_mps2 * sigma_v_mps2
    q_pp, q_pv, q_vv = q * dt_s**4 / 4.0, q * dt_s**3 / 2.0, q * dt_s**2
    for t in range(x.shape[0]):
        x[t, 0] += dt_s * x[t, 2]
        x[t, 1] += dt_s * x[t, 3]
        p = P[t]
        for a in range(2):
            for b in range(a, 2):
                pv, vp, vv = p[a, b + 2], p[a + 2, b], p[a + 2, b + 2]
                p[a, b] += dt_s * (pv + vp) + dt_s * dt_s * vv
                p[a, b + 2] = pv + dt_s * vv
                p[b, a + 2] = vp + dt_s * vv
                if a == b:
                    p[a, a] += q_pp
                    p[a, a + 2] += q_pv
                    p[a + 2, a + 2] += q_vv
        _mirror(p)
    return x, P


@compiled
def update(
    state: FloatArray,
    covariance: FloatArray,
    R: FloatArray,
    y: FloatArray,
    start: IntArray,
    index: IntArray,
    beta: FloatArray,
    beta_none: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """States and covariances after the measurements `y` (m, 2), each weighted by its probability.

    Track t has the measurements index[start[t]:start[t + 1]] with the probabilities beta of the same places,
    and none with beta_none[t]. With nu_j = y_j - H x and nu = sum_j beta_j nu_j:
    x = x + K nu, P = P - (1 - beta_none) K S K^T + K (sum_j beta_j nu_j nu_j^T - nu nu^T) K^T.

    Source: Karoui 2015 (16)-(19), (23); (17) with a minus, (23) with innovations in the spread.
    """
    x, P = state.copy(), covariance.copy()
    K = np.empty((4, 2))
    for t in range(x.shape[0]):
        if start[t] == start[t + 1]:
            continue
        p = P[t]
        s11, s12, s22 = p[0, 0] + R[t, 0, 0], p[0, 1] + R[t, 0, 1], p[1, 1] + R[t, 1, 1]
        det = s11 * s22 - s12 * s12
        for a in range(4):
            K[a, 0] = (p[a, 0] * s22 - p[a, 1] * s12) / det
            K[a, 1] = (p[a, 1] * s11 - p[a, 0] * s12) / det
        n1 = n2 = c11 = c12 = c22 = 0.0
        for e in range(start[t], start[t + 1]):
            w = beta[e]
            e1, e2 = y[index[e], 0] - x[t, 0], y[index[e], 1] - x[t, 1]
            n1 += w * e1
            n2 += w * e2
            c11 += w * e1 * e1
            c12 += w * e1 * e2
            c22 += w * e2 * e2
        some = 1.0 - beta_none[t]
        m11, m12, m22 = c11 - n1 * n1 - some * s11, c12 - n1 * n2 - some * s12, c22 - n2 * n2 - some * s22
        for a in range(4):
            x[t, a] += K[a, 0] * n1 + K[a, 1] * n2
            for b in range(a, 4):
                p[a, b] += K[a, 0] * (m11 * K[b, 0] + m12 * K[b, 1]) + K[a, 1] * (
                    m12 * K[b, 0] + m22 * K[b, 1]
                )
        _mirror(p)
    return x, P


@compiled
def _mirror(p: FloatArray) -> None:
    for a in range(4):
        for b in range(a):
            p[a, b] = p[b, a]
