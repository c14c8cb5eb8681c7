"""One event per object: events near each other, around the strongest of them."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["grouped"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

LOUDEST = 1e150  # of which sums are still finite


@compiled
def grouped(
    range_m: FloatArray, bearing_rad: FloatArray, amplitude: FloatArray, reach_m: float
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Range (k,) and bearing (k,) of groups, their leaders first found first, and each event's group (m,).

    The strongest event that is in no group yet leads the next one, which takes all events within `reach_m` of
    it that are in none. A group lies at the mean of its events, weighted by amplitude (equally where that is
    not positive; none counts for more than `LOUDEST`). The result does not depend on the order of the
    events, unless amplitudes are equal.
    """
    m = range_m.size
    group = np.full(m, -1)
    x, y = np.empty(m), np.empty(m)
    level = np.empty(m)
    for j in range(m):
        x[j], y[j] = range_m[j] * math.cos(bearing_rad[j]), range_m[j] * math.sin(bearing_rad[j])
        level[j] = min(amplitude[j], LOUDEST) if amplitude[j] > 0.0 else 0.0
    k = 0
    weight, total_r, total_b = np.zeros(m), np.zeros(m), np.zeros(m)
    for leader in np.argsort(-level, kind="mergesort"):
        if group[leader] >= 0:
            continue
        for j in range(m):
            if group[j] < 0 and (x[j] - x[leader]) ** 2 + (y[j] - y[leader]) ** 2 <= reach_m * reach_m:
                group[j] = k
                w = level[j] if level[leader] > 0.0 else 1.0
                weight[k] += w
                total_r[k] += w * range_m[j]
                # About the leader: bearings near +-pi are averaged as the angles they are.
                apart = bearing_rad[j] - bearing_rad[leader]
                total_b[k] += w * (apart - 2.0 * math.pi * math.floor(apart / (2.0 * math.pi) + 0.5))
        total_r[k] /= weight[k]
        total_b[k] = bearing_rad[leader] + total_b[k] / weight[k]
        k += 1
    return total_r[:k].copy(), total_b[:k].copy(), group
