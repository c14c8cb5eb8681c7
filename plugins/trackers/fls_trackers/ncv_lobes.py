"""Tracks that are lobes of a stronger one: a sparse array shows each target at several bearings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import Pose, to_cartesian, to_polar
from fls_flow.kernels import compiled

__all__ = ["Lobes", "companions", "lobe_response"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

LAGS = 33  # lags at which the response is looked for, per pair of bearings
MARGIN = float(np.log(2.0) / 2.0)  # 3 dB above what the array would show of the stronger one


@dataclass(frozen=True, slots=True)
class Lobes:
    """How tracks are told to be lobes of others.

    Raises ValueError for bad values.
    """

    lobe_range_m: float  # 0: never
    lobe_speed_mps: float
    hydrophones_m: tuple[tuple[float, float], ...]  # () : unknown, any bearing may be a lobe
    band_hz: tuple[float, float]

    def __post_init__(self) -> None:
        if not 0.0 <= self.lobe_range_m < np.inf:
            raise ValueError(f"lobe_range_m must be finite and not negative, not {self.lobe_range_m}")
        if not 0.0 < self.lobe_speed_mps < np.inf:
            raise ValueError(f"lobe_speed_mps must be positive and finite, not {self.lobe_speed_mps}")
        if not 0.0 <= self.band_hz[0] < self.band_hz[1] < np.inf:
            raise ValueError(f"band_hz must be two increasing frequencies, not {self.band_hz}")
        if len(self.hydrophones_m) == 1 or not np.isfinite(np.array(self.hydrophones_m, float)).all():
            raise ValueError(f"hydrophones_m must be two or more places, not {self.hydrophones_m}")

    def among(
        self, state: FloatArray, level: FloatArray, chosen: BoolArray, pose: Pose, sound_speed_mps: float
    ) -> BoolArray:
        """Which of the `chosen` tracks (n,) seem to be lobes of stronger ones; `level`: log amplitudes."""
        found = np.zeros(len(state), bool)
        if self.lobe_range_m == 0.0 or np.count_nonzero(chosen) < 2:
            return found
        range_m, bearing_rad = to_polar(pose.to_sensor(state[:, :2]))
        along = (state[:, :2] - pose.origin_m) / np.maximum(range_m, 1e-9)[:, None]
        rate = (along * state[:, 2:]).sum(axis=1)
        weaker, stronger = companions(range_m, rate, level, chosen, self.lobe_range_m, self.lobe_speed_mps)
        if self.hydrophones_m:
            response = lobe_response(
                np.array(self.hydrophones_m, float),
                self.band_hz,
                sound_speed_mps,
                bearing_rad[stronger],
                bearing_rad[weaker],
            )
            weaker = weaker[level[weaker] <= level[stronger] + np.log(response + 1e-12) + MARGIN]
        found[weaker] = True
        return found


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
