"""One scan over all tracks, compiled as a whole, from measurements to new tracks.

The steps are those of the modules beside; one call instead of a dozen saves more than half of a scan's time
when the tracks are few.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Detections
from fls_flow.geometry import Pose
from fls_flow.kernels import compiled, frozen
from fls_trackers.association import ASSIGNED, INDEPENDENT, JOINT, LINEAR, evidence, shared_out
from fls_trackers.clutter import cell_density
from fls_trackers.conversion import measured, noise_of
from fls_trackers.existence import chances, given_existence, weighted
from fls_trackers.gating import pairs_in_gates
from fls_trackers.initiation import by_place, strongest
from fls_trackers.kalman import predict, update
from fls_trackers.life import TENTATIVE, Rules, judge
from fls_trackers.linear import against_others
from fls_trackers.settings import Grain, Settings
from fls_trackers.track_bank import Ledger, TrackBank, begun, renewed

__all__ = ["Fixed", "Method", "Scanned", "Starts", "scan"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

LOST = 2  # TrackStatus, as the compiler takes it


class Method(NamedTuple):
    """How measurements are shared out: see `association`."""

    sharing: int
    max_shared: int


class Fixed(NamedTuple):
    """What is the same in all scans, as the kernel takes it."""

    sigma_v_mps2: float
    weights: tuple[float, float, float]  # gamma, p_d / (1 - p_d p_g), 1 - p_d p_g
    choices: tuple[int, int, int, bool]  # sharing, max_shared, merge_pings, only_probable
    rules: tuple[int, int, float, int, int, float]  # the fields of `Rules`

    @classmethod
    def of(cls, s: Settings, method: Method) -> Fixed:
        """What follows from settings and method."""
        miss = 1.0 - s.p_d * s.gate_probability
        return cls(
            s.sigma_v_mps2,
            (s.gamma, s.p_d / miss, miss),
            (method.sharing, method.max_shared, s.merge_pings, s.hit == "probable"),
            (s.m1, s.n1, s.start_score, s.m2, s.n2, s.max_sd_m),
        )


class Starts(NamedTuple):
    """Which tracks begin in a scan, at detections that more likely are no track's."""

    room: int  # at most so many; 0 leaves starting to the caller
    next_id: int
    speed_sd_mps: float


class Scanned(NamedTuple):
    """The tracks after a scan."""

    bank: TrackBank  # those that go on, are lost, or begin
    lost: int  # how many are lost
    begun: int
    cut: bool  # whether more would have begun
    approximate: int  # clusters that fell back to belief propagation
    finite: bool  # whether the detections were; if not, nothing here means anything
    unclaimed: BoolArray  # (m,) detections outside the gates of all tracks but tentative ones, and not barred


def scan(
    bank: TrackBank,
    detections: Detections,
    barred: BoolArray | None,
    dt_s: float,
    grain: Grain,
    pose: Pose,
    fixed: Fixed,
    clutter: tuple[float, float],
    starts: Starts,
) -> Scanned:
    """What a ping makes of the tracks, `dt_s` after the last one.

    `barred` (m,) are detections that start nothing; `clutter` are p_fa and the least density of false
    measurements. Confirmed tracks take first.
    """
    m = len(detections)
    unclaimed = np.zeros(m, bool)
    x, P, rows, lost, born, cut, approximate, finite = _scan(
        bank.state,
        bank.covariance,
        bank.ledger,
        _row(detections.range_m),
        _row(detections.bearing_rad),
        _row(detections.amplitude),
        np.zeros(m, bool) if barred is None else barred,
        unclaimed,
        (dt_s, fixed.sigma_v_mps2),
        (grain.range_sd_m, grain.bearing_sd_rad, pose.north_m, pose.east_m, pose.heading_rad),
        (*clutter, grain.cell_m, grain.spacing_rad),
        fixed.weights,
        fixed.choices,
        fixed.rules,
        (starts.room, starts.next_id, starts.speed_sd_mps),
    )
    return Scanned(TrackBank(x, P, rows), lost, born, cut, approximate, finite, unclaimed)


def _row(values: FloatArray) -> FloatArray:
    """As the kernel takes it: a message's arrays are read-only, but may be strided."""
    return values if values.flags.c_contiguous else frozen(values)


@compiled
def _scan(
    state: FloatArray,
    covariance: FloatArray,
    ledger: Ledger,
    range_m: FloatArray,
    bearing_rad: FloatArray,
    amplitude: FloatArray,
    barred: BoolArray,
    unclaimed: BoolArray,
    motion: tuple[float, float],
    sensor: tuple[float, float, float, float, float],
    clutter: tuple[float, float, float, float],
    weights: tuple[float, float, float],
    choices: tuple[int, int, int, bool],
    rules: tuple[int, int, float, int, int, float],
    starts: tuple[int, int, float],
) -> tuple[FloatArray, FloatArray, Ledger, int, int, bool, int, bool]:
    y, R0, finite = measured(range_m, bearing_rad, sensor)
    if not finite:
        return state, covariance, ledger, 0, 0, False, 0, False
    density = cell_density(range_m, clutter[0], clutter[2], clutter[3], clutter[1])
    x, P, rows, keep, taken, claimed, approximate = _followed(
        state, covariance, ledger, y, density, motion, sensor, weights, choices, rules
    )
    lost = 0
    for t in range(rows.size):
        lost += rows[t].status == LOST
        keep[t] |= rows[t].status == LOST
    free = np.empty(taken.size, np.bool_)
    for j in range(taken.size):
        unclaimed[j] = not (claimed[j] or barred[j])
        free[j] = taken[j] <= 0.5 and not barred[j] and starts[0] > 0
    which, cut = _chosen(free, range_m, bearing_rad, amplitude, starts[0] - (keep.sum() - lost))
    new = np.zeros(which.size, ledger.dtype)
    new_x, new_P = begun(y, R0, which, starts[2], starts[2], TENTATIVE, new)
    for k in range(which.size):
        new[k].id = starts[1] + k
    x, P, rows = renewed(x, P, rows, keep, new_x, new_P, new)
    return x, P, rows, lost, which.size, cut, approximate, True


@compiled
def _chosen(
    free: BoolArray, range_m: FloatArray, bearing_rad: FloatArray, amplitude: FloatArray, room: int
) -> tuple[IntArray, bool]:
    """Where tracks begin, by place, and whether there was no room for all."""
    count = free.sum()
    if count <= room:
        return by_place(free, range_m, bearing_rad), False
    best = np.zeros(free.size, np.bool_)
    best[strongest(np.flatnonzero(free), amplitude, max(room, 0))] = True
    return by_place(best, range_m, bearing_rad), count > 0


@compiled
def _followed(
    state: FloatArray,
    covariance: FloatArray,
    ledger: Ledger,
    y: FloatArray,
    density: FloatArray,
    motion: tuple[float, float],
    sensor: tuple[float, float, float, float, float],
    weights: tuple[float, float, float],
    choices: tuple[int, int, int, bool],
    rules: tuple[int, int, float, int, int, float],
) -> tuple[FloatArray, FloatArray, Ledger, BoolArray, FloatArray, BoolArray, int]:
    gamma, factor, miss = weights
    sharing, max_shared, merge_pings, only_probable = choices
    x, P = (state, covariance) if motion[0] == 0.0 else predict(state, covariance, motion[0], motion[1])
    R = noise_of(x, sensor[0], sensor[1], sensor[2], sensor[3], sensor[4])
    start, places, likelihood = pairs_in_gates(x, P, R, y, gamma)
    rank = np.zeros(ledger.size, np.int64)
    for t in range(ledger.size):
        rank[t] = ledger[t].status == TENTATIVE
    chance = chances(ledger, rules[2])
    weight, way = likelihood, sharing
    if sharing == JOINT:
        weight = weighted(start, likelihood, chance, miss)
    elif sharing == LINEAR:
        weight, way = (
            against_others(start, places, likelihood, density, rank, chance, 1.0 - miss),
            INDEPENDENT,
        )
    beta, none, taken, claimed, in_gate, approximate = shared_out(
        start, places, weight, density, factor, rank, max_shared, way
    )
    if sharing == JOINT:
        given_existence(start, places, beta, none, taken, chance, miss)
    x, P = update(x, P, R, y, start, places, beta, none)
    score = none
    if sharing == ASSIGNED:
        score = evidence(start, places, likelihood, density, factor, beta, none)
    both = beta.copy()  # of tracks that may take the same measurement: two tentative ones, each if it exists
    for t in range(ledger.size if sharing != INDEPENDENT else 0):
        if rank[t] == 0:
            both[start[t] : start[t + 1]] = 0.0
    shared = (start, places, both)
    rows, keep = judge(
        ledger, x, P, in_gate, none, score, miss, only_probable, merge_pings, Rules(*rules), shared
    )
    return x, P, rows, keep, taken, claimed, approximate
