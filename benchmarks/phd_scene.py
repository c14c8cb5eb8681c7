"""The scene of the PHD benchmarks: targets that come through a narrow sector, among clutter."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, View

FloatArray = npt.NDArray[np.float64]
Estimate = tuple[FloatArray, float]  # positions (n, 2), expected number
Filter = Callable[[Detections], Estimate]

HALF_RAD, NEAR_M, FAR_M = math.radians(5.0), 20.0, 60.0
RANGE_SD_M, BEARING_SD_RAD = 0.25, math.radians(0.5)
P_D, P_S, P_B, SIGMA_V, SPEED_SD = 0.9, 0.99, 0.1, 0.1, 0.5
PINGS = 100


def scene(seed: int, clutter: float) -> tuple[list[Detections], list[FloatArray]]:
    """Detections and true states, ping by ping."""
    rng = np.random.default_rng(seed)
    view = View(NEAR_M, FAR_M, 0.25, np.radians((np.arange(20) - 9.5) * 0.5), math.radians(0.5))
    live, pings, truth = np.zeros((0, 4)), [], []
    for k in range(PINGS):
        live = live + np.array([-1.0, 0.0, 0.0, 0.0])
        r, b = np.hypot(live[:, 0], live[:, 1]), np.arctan2(live[:, 1], live[:, 0])
        live = live[(r >= NEAR_M) & (np.abs(b) <= HALF_RAD)]
        while len(live) < 1 or (len(live) < 4 and rng.random() < 0.08):
            at = rng.uniform(-0.9 * HALF_RAD, 0.9 * HALF_RAD)
            live = np.vstack([live, [59.9 * math.cos(at), 59.9 * math.sin(at), -1.0, 0.0]])
        truth.append(live.copy())
        pings.append(_observed(k, live, clutter, view, rng))
    return pings, truth


def _observed(k: int, live: FloatArray, clutter: float, view: View, rng: np.random.Generator) -> Detections:
    seen = live[rng.random(len(live)) < P_D]
    n = int(rng.poisson(clutter))
    r = np.hypot(seen[:, 0], seen[:, 1]) + RANGE_SD_M * rng.standard_normal(len(seen))
    b = np.arctan2(seen[:, 1], seen[:, 0]) + BEARING_SD_RAD * rng.standard_normal(len(seen))
    r, b = np.append(r, rng.uniform(NEAR_M, FAR_M, n)), np.append(b, rng.uniform(-HALF_RAD, HALF_RAD, n))
    noise = np.broadcast_to(np.diag([RANGE_SD_M**2, BEARING_SD_RAD**2]), (r.size, 2, 2))
    none, kind = np.zeros((r.size, 2)), np.zeros(r.size, np.uint8)
    return Detections(k, (k + 1) * 10**9, r, b, np.ones(r.size), none, noise, kind, view)
