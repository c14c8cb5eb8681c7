"""The steps of a scan of the blob tracker, over all tracks at once; compiled."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["blobs_in_gates", "log_likelihoods", "predict_each"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


def log_likelihoods(nu: FloatArray, P: FloatArray, R: FloatArray) -> FloatArray:
    """ln N(nu; 0, H P H^T + R), (n,), of the innovations (n, 2) of tracks."""
    S = P[:, :2, :2] + R
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
    d2 = S[:, 1, 1] * nu[:, 0] ** 2 - 2.0 * S[:, 0, 1] * nu[:, 0] * nu[:, 1] + S[:, 0, 0] * nu[:, 1] ** 2
    log_likelihood: FloatArray = -0.5 * d2 / det - np.log(2.0 * np.pi * np.sqrt(det))
    return log_likelihood


@compiled
def predict_each(
    state: FloatArray, covariance: FloatArray, dt_s: FloatArray, sigma_v_mps2: float
) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) after nearly constant velocity over each track's own dt_s (n,).

    A negative interval goes back, and its noise is that of the same interval forward.

    Source: Abu 2024 (16)-(18), (21).
    """
    x, P = state.copy(), covariance.copy()
    q = sigma_v_mps2 * sigma_v_mps2
    for t in range(dt_s.size):
        dt = dt_s[t]
        q_pp, q_pv, q_vv = q * dt**4 / 4.0, q * dt**3 / 2.0, q * dt**2
        p = P[t]
        for a in range(2):
            x[t, a] += dt * x[t, a + 2]
            for b in range(a, 2):
                pv, vp, vv = p[a, b + 2], p[a + 2, b], p[a + 2, b + 2]
                p[a, b] += dt * (pv + vp) + dt * dt * vv
                p[a, b + 2] = pv + dt * vv
                p[b, a + 2] = vp + dt * vv
                if a == b:
                    p[a, a] += q_pp
                    p[a, a + 2] += q_pv
                    p[a + 2, a + 2] += q_vv
        for a in range(4):
            for b in range(a):
                p[a, b] = p[b, a]
    return x, P


@compiled
def blobs_in_gates(
    state: FloatArray,
    covariance: FloatArray,
    R: FloatArray,
    y: FloatArray,
    axis: FloatArray,
    track_polar: FloatArray,
    blob_polar: FloatArray,
    coarse: tuple[float, float],
    gamma: float,
    gain: FloatArray,
    miss: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs of a track and a blob in both of its gates, as `auction.Pairs`.

    Coarse: ranges and bearings of `track_polar` (n, 2) and `blob_polar` (m, 2) differ by at most
    `coarse`. Fine: d2 = nu^T S^-1 nu <= gamma, S = H P H^T + R, with nu = y - H x or, with an `axis` (n, 2)
    for each track, the unit vector from the sonar, the differences of range and bearing along and across it.
    The cost is d2; or, with a `gain` (m,) for each blob, less the log likelihood ratio gain_j + ln N(nu; S),
    from the largest of all pairs on, and pairs that say less for a target than the `miss` of all blobs are
    left out. `blob_polar` comes in order of range.

    Source: Abu 2024 (24)-(27).
    """
    n, m = state.shape[0], y.shape[0]
    start = np.zeros(n + 1, np.int64)
    room = 4 * n + m
    places, cost = np.empty(room, np.int64), np.empty(room)
    k = 0
    for t in range(n):
        s11 = covariance[t, 0, 0] + R[t, 0, 0]
        s12 = covariance[t, 0, 1] + R[t, 0, 1]
        s22 = covariance[t, 1, 1] + R[t, 1, 1]
        det = s11 * s22 - s12 * s12
        volume = np.log(2.0 * np.pi * np.sqrt(det))
        if k + m > room:
            room = 2 * (k + m)
            longer_places, longer_cost = np.empty(room, np.int64), np.empty(room)
            longer_places[:k], longer_cost[:k] = places[:k], cost[:k]
            places, cost = longer_places, longer_cost
        j = np.searchsorted(blob_polar[:, 0], track_polar[t, 0] - coarse[0])
        while j < m and blob_polar[j, 0] - track_polar[t, 0] <= coarse[0]:
            off = abs(blob_polar[j, 1] - track_polar[t, 1]) % (2.0 * np.pi)
            if min(off, 2.0 * np.pi - off) <= coarse[1]:
                e1, e2 = y[j, 0] - state[t, 0], y[j, 1] - state[t, 1]
                if axis.size:
                    along = blob_polar[j, 0] - track_polar[t, 0]
                    turn = blob_polar[j, 1] - track_polar[t, 1]
                    turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
                    across = track_polar[t, 0] * turn
                    e1 = axis[t, 0] * along - axis[t, 1] * across
                    e2 = axis[t, 1] * along + axis[t, 0] * across
                d2 = (e1 * (s22 * e1 - s12 * e2) + e2 * (s11 * e2 - s12 * e1)) / det
                if d2 <= gamma and gain.size == 0:
                    places[k], cost[k] = j, d2
                    k += 1
                elif d2 <= gamma and gain[j] - 0.5 * d2 - volume > miss:
                    places[k], cost[k] = j, 0.5 * d2 + volume - gain[j]
                    k += 1
            j += 1
        start[t + 1] = k
    places, cost = places[:k].copy(), cost[:k].copy()
    if gain.size and k:
        cost -= cost.min()
    return start, places, cost
