"""One scan over all tracks, compiled as a whole: predicted, gated, associated, updated, judged.

The steps are those of the modules beside; one call instead of six saves more than half of a scan's time when
the tracks are few.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import Pose
from fls_flow.kernels import compiled
from fls_trackers.association import shared_out
from fls_trackers.conversion import noise_of
from fls_trackers.gating import pairs_in_gates
from fls_trackers.kalman import predict, update
from fls_trackers.life import TENTATIVE, Rules, judge
from fls_trackers.settings import Grain, Settings
from fls_trackers.track_bank import Ledger, TrackBank

__all__ = ["Scanned", "scan"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


class Scanned(NamedTuple):
    """The tracks after a scan, and what is left over of its measurements."""

    bank: TrackBank
    keep: BoolArray  # (n,) which tracks go on
    taken: FloatArray  # (m,) that the measurement is some track's
    claimed: BoolArray  # (m,) whether it lies in the gate of a track that is not tentative
    approximate: int  # clusters that fell back to belief propagation


def scan(
    bank: TrackBank,
    y: FloatArray,
    density: FloatArray,
    dt_s: float,
    grain: Grain,
    pose: Pose,
    settings: Settings,
    rules: Rules,
    max_shared: int,
) -> Scanned:
    """What a ping with the measurements `y` (m, 2), m, makes of the tracks, `dt_s` after the last one.

    `density` (m,) is that of false measurements, per m^2. Confirmed tracks take first.
    """
    s = settings
    p_g = s.gate_probability
    state, covariance, ledger, keep, taken, claimed, approximate = _scan(
        bank.state,
        bank.covariance,
        bank.ledger,
        y,
        density,
        (dt_s, s.sigma_v_mps2),
        (grain.range_sd_m, grain.bearing_sd_rad, pose.north_m, pose.east_m, pose.heading_rad),
        (s.gamma, s.p_d / (1.0 - s.p_d * p_g), 1.0 - s.p_d * p_g),
        max_shared,
        s.hit == "probable",
        s.merge_pings,
        rules,
    )
    return Scanned(TrackBank(state, covariance, ledger), keep, taken, claimed, approximate)


@compiled
def _scan(
    state: FloatArray,
    covariance: FloatArray,
    ledger: Ledger,
    y: FloatArray,
    density: FloatArray,
    motion: tuple[float, float],
    sensor: tuple[float, float, float, float, float],
    weights: tuple[float, float, float],
    max_shared: int,
    only_probable: bool,
    merge_pings: int,
    rules: Rules,
) -> tuple[FloatArray, FloatArray, Ledger, BoolArray, FloatArray, BoolArray, int]:
    gamma, factor, miss = weights
    x, P = (state, covariance) if motion[0] == 0.0 else predict(state, covariance, motion[0], motion[1])
    R = noise_of(x, sensor[0], sensor[1], sensor[2], sensor[3], sensor[4])
    start, places, likelihood = pairs_in_gates(x, P, R, y, gamma)
    rank = np.zeros(ledger.size, np.int64)
    for t in range(ledger.size):
        rank[t] = ledger[t].status == TENTATIVE
    beta, none, taken, claimed, in_gate, approximate = shared_out(
        start, places, likelihood, density, factor, rank, max_shared
    )
    x, P = update(x, P, R, y, start, places, beta, none)
    rows, keep = judge(ledger, x, P, in_gate, none, miss, only_probable, merge_pings, rules)
    return x, P, rows, keep, taken, claimed, approximate
