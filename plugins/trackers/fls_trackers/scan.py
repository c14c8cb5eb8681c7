"""One scan over all tracks, compiled as a whole, from measurements to new tracks.

The steps are those of the modules beside; one call instead of a dozen saves more than half of a scan's time
when the tracks are few.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Detections
from fls_flow.geometry import Pose
from fls_flow.kernels import compiled, frozen
from fls_trackers.association import ASSIGNED, INDEPENDENT, JOINT, LINEAR, evidence, shared_out
from fls_trackers.clutter import cell_density
from fls_trackers.conversion import measured, noise_of
from fls_trackers.exchanges import exchanged
from fls_trackers.existence import chances, given_existence, weighted
from fls_trackers.gating import pairs_in_gates
from fls_trackers.initiation import starting
from fls_trackers.kalman import predict, update
from fls_trackers.life import TENTATIVE, Rules, judge
from fls_trackers.linear import against_others
from fls_trackers.settings import Grain, Settings
from fls_trackers.track_bank import Ledger, TrackBank, begun, renewed

__all__ = ["Method", "Scanned", "Starts", "fixed_of", "row", "scan"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Row = npt.NDArray[np.void]

LOST = 2  # TrackStatus, as the compiler takes it


class Method(NamedTuple):
    """How measurements are shared out: see `association`."""

    sharing: int
    max_shared: int


# What is the same in all scans, as the kernel takes it: a row of an array costs a tenth of a tuple's time.
FIXED = np.dtype(
    [
        ("sigma_v_mps2", np.float64),
        ("gamma", np.float64),
        ("factor", np.float64),  # p_d / (1 - p_d p_g)
        ("miss", np.float64),  # 1 - p_d p_g
        ("sharing", np.int64),
        ("max_shared", np.int64),
        ("merge_pings", np.int64),
        ("only_probable", np.int64),
        ("m1", np.int64),
        ("n1", np.int64),
        ("start_score", np.float64),
        ("m2", np.int64),
        ("n2", np.int64),
        ("max_sd_m", np.float64),
        ("speed_sd_mps", np.float64),
    ]
)


def fixed_of(s: Settings, method: Method) -> Row:
    """The row (1,) of `FIXED` that follows from settings and method."""
    miss = 1.0 - s.p_d * s.gate_probability
    derived = {"factor": s.p_d / miss, "miss": miss, "only_probable": s.hit == "probable"}
    given = {**asdict(s), **method._asdict(), **derived}
    return np.array([tuple(given[name] for name in FIXED.names or ())], FIXED)


class Starts(NamedTuple):
    """Which tracks begin in a scan, at detections that more likely are no track's."""

    room: int  # at most so many; 0 leaves starting to the caller
    next_id: int


class Scanned(NamedTuple):
    """The tracks after a scan."""

    bank: TrackBank  # those that go on, are lost, or begin
    lost: int  # how many are lost
    begun: int
    cut: bool  # whether more would have begun
    approximate: int  # clusters that fell back to belief propagation
    finite: bool  # whether the detections were; if not, nothing here means anything
    unclaimed: BoolArray  # (m,) detections outside the gates of all tracks but tentative ones, and not barred
    free: int  # how many these are


def scan(
    bank: TrackBank,
    detections: Detections,
    barred: BoolArray | None,
    dt_s: float,
    grain: Grain,
    pose: Pose,
    fixed: Row,
    clutter: tuple[float, float],
    starts: Starts,
) -> Scanned:
    """What a ping makes of the tracks, `dt_s` after the last one.

    `barred` (m,) are detections that start nothing; `clutter` are p_fa and the least density of false
    measurements. Confirmed tracks take first.
    """
    unclaimed = np.ones(len(detections), bool) if barred is None else ~barred
    x, P, rows, lost, born, free, cut, approximate, finite = _scan(
        bank.state,
        bank.covariance,
        bank.ledger,
        row(detections.range_m),
        row(detections.bearing_rad),
        row(detections.amplitude),
        unclaimed,
        dt_s,
        grain.range_sd_m,
        grain.bearing_sd_rad,
        pose.north_m,
        pose.east_m,
        pose.heading_rad,
        clutter[0],
        clutter[1],
        grain.cell_m,
        grain.spacing_rad,
        fixed,
        starts[0],
        starts[1],
    )
    return Scanned(TrackBank(x, P, rows), lost, born, cut, approximate, finite, unclaimed, free)


def row(values: FloatArray) -> FloatArray:
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
    unclaimed: BoolArray,
    dt_s: float,
    range_sd_m: float,
    bearing_sd_rad: float,
    north_m: float,
    east_m: float,
    heading_rad: float,
    p_fa: float,
    least_density: float,
    cell_m: float,
    spacing_rad: float,
    fixed: Row,
    room: int,
    next_id: int,
) -> tuple[FloatArray, FloatArray, Ledger, int, int, int, bool, int, bool]:
    """Tracks, how many are lost and begun, detections that may begin one, and whether more would.

    Then the clusters that are approximate, and whether all is finite. `unclaimed` (m,) comes with what is not
    barred, and goes without what a track claims.
    """
    f, sensor = fixed[0], (range_sd_m, bearing_sd_rad, north_m, east_m, heading_rad)
    y, R0, finite = measured(range_m, bearing_rad, sensor)
    if not finite:
        return state, covariance, ledger, 0, 0, 0, False, 0, False
    density = cell_density(range_m, p_fa, cell_m, spacing_rad, least_density)
    x, P, rows, keep, taken, claimed, approximate = _followed(
        state, covariance, ledger, y, density, dt_s, sensor, f
    )
    lost = count = 0
    for t in range(rows.size):
        lost += rows[t].status == LOST
        keep[t] |= rows[t].status == LOST
    free = np.empty(taken.size, np.bool_)
    for j in range(taken.size):
        free[j] = taken[j] <= 0.5 and unclaimed[j] and room > 0
        unclaimed[j] &= not claimed[j]
        count += unclaimed[j]
    which, cut = starting(free, range_m, bearing_rad, amplitude, room - (keep.sum() - lost))
    new = np.zeros(which.size, ledger.dtype)
    new_x, new_P = begun(y, R0, which, f.speed_sd_mps, f.speed_sd_mps, TENTATIVE, new)
    for k in range(which.size):
        new[k].id = next_id + k
    x, P, rows = renewed(x, P, rows, keep, new_x, new_P, new)
    return x, P, rows, lost, which.size, count, cut, approximate, True


@compiled
def _followed(
    state: FloatArray,
    covariance: FloatArray,
    ledger: Ledger,
    y: FloatArray,
    density: FloatArray,
    dt_s: float,
    sensor: tuple[float, float, float, float, float],
    f: Any,
) -> tuple[FloatArray, FloatArray, Ledger, BoolArray, FloatArray, BoolArray, int]:
    """The tracks after their update, which go on, and which detections are taken and claimed."""
    sharing, factor, miss = f.sharing, f.factor, f.miss
    x, P = (state, covariance) if dt_s == 0.0 else predict(state, covariance, dt_s, f.sigma_v_mps2)
    R = noise_of(x, sensor[0], sensor[1], sensor[2], sensor[3], sensor[4])
    start, places, likelihood = pairs_in_gates(x, P, R, y, f.gamma)
    rank = np.zeros(ledger.size, np.int64)
    for t in range(ledger.size):
        rank[t] = ledger[t].status == TENTATIVE
    chance = chances(ledger, f.start_score)
    weight, way = likelihood, sharing
    if sharing == JOINT:
        weight = weighted(start, likelihood, chance, miss)
    elif sharing == LINEAR:
        weight, way = (
            against_others(start, places, likelihood, density, rank, chance, 1.0 - miss),
            INDEPENDENT,
        )
    beta, none, taken, claimed, in_gate, approximate = shared_out(
        start, places, weight, density, factor, rank, f.max_shared, way
    )
    if sharing == JOINT:
        given_existence(start, places, beta, none, taken, chance, miss)
    shares, rest, score = beta, none, none
    if sharing == ASSIGNED:
        shares, rest = exchanged(start, places, likelihood, density, factor, rank, beta, none)
        score = evidence(start, places, likelihood, density, factor, beta, none)
    x, P = update(x, P, R, y, start, places, shares, rest)
    both = beta.copy()  # of tracks that may take the same measurement: two tentative ones, each if it exists
    for t in range(ledger.size if sharing != INDEPENDENT else 0):
        if rank[t] == 0:
            both[start[t] : start[t + 1]] = 0.0
    shared = (start, places, both)
    rules = Rules(f.m1, f.n1, f.start_score, f.m2, f.n2, f.max_sd_m)
    rows, keep = judge(
        ledger, x, P, in_gate, none, score, miss, f.only_probable, f.merge_pings, rules, shared
    )
    return x, P, rows, keep, taken, claimed, approximate
