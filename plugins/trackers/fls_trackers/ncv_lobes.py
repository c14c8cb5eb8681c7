"""Tracks that are lobes of a stronger one: a sparse array shows each target at several bearings."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import to_cartesian
from fls_flow.kernels import compiled

__all__ = ["companions", "lobe_response"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

LAGS = 33  # lags at which the response is looked for, per pair of bearings


def lobe_response(
    position_m: FloatArray,
    band_hz: tuple[float, float],
    sound_speed_mps: float,
    source_rad: FloatArray,
    beam_rad: FloatArray,
) -> FloatArray:
    """How strongly beams show sources at other bearings, (n,): amplitudes, 1 for a beam at its source.

    max over t of |1/M sum_m exp(j 2 pi f_c d_m) sinc(B (t - d_m))|, d_m = p_m . (u(source) - u(beam)) / c: a
    compressed pulse of bandwidth B through delay and sum. `position_m` (M, 2), bearings (n,).

    Source: Abu 2024 (2)-(4), with the pulse's autocorrelation.
    """
    f_c, bandwidth = 0.5 * (band_hz[0] + band_hz[1]), band_hz[1] - band_hz[0]
    u = to_cartesian(1.0, source_rad) - to_cartesian(1.0, beam_rad)
    delay = u @ position_m.T / sound_speed_mps
    low, high = delay.min(axis=1, keepdims=True), delay.max(axis=1, keepdims=True)
    lag = low + (high - low) * np.linspace(0.0, 1.0, LAGS)
    pulse = np.sinc(bandwidth * (lag[:, :, None] - delay[:, None, :]))
    total = (np.exp(2j * np.pi * f_c * delay)[:, None, :] * pulse).mean(axis=2)
    most: FloatArray = np.abs(total).max(axis=1)
    return most


def companions(
    range_m: FloatArray,
    range_rate_mps: FloatArray,
    level: FloatArray,
    chosen: BoolArray,
    within_m: float,
    within_mps: float,
) -> tuple[IntArray, IntArray]:
    """Pairs (weaker, stronger) of chosen tracks that keep their distance to the sonar alike.

    |r_i - r_j| <= within_m and |r'_i - r'_j| <= within_mps; of equal levels the first track is the stronger.
    """
    order = np.flatnonzero(chosen)
    order = order[np.argsort(range_m[order], kind="stable")]
    weaker, stronger = _companions(range_m, range_rate_mps, level, order, within_m, within_mps)
    return weaker, stronger


@compiled
def _companions(
    range_m: FloatArray,
    range_rate_mps: FloatArray,
    level: FloatArray,
    order: IntArray,
    within_m: float,
    within_mps: float,
) -> tuple[IntArray, IntArray]:
    weaker, stronger = [0 for _ in range(0)], [0 for _ in range(0)]
    for a in range(order.size):
        i = order[a]
        for b in range(a + 1, order.size):
            j = order[b]
            if range_m[j] - range_m[i] > within_m:
                break
            if abs(range_rate_mps[i] - range_rate_mps[j]) <= within_mps:
                i_wins = level[i] > level[j] or (level[i] == level[j] and i < j)
                weaker.append(j if i_wins else i)
                stronger.append(i if i_wins else j)
    return np.array(weaker, np.int64), np.array(stronger, np.int64)
