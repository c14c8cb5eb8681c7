"""One scan over the tracks of divers, compiled as a whole, from events to new tracks.

The steps are those of the modules beside; one call instead of a dozen, and tables built in it,
take a quarter of the time when the tracks are few.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.clutter import cell_density
from fls_trackers.conversion import measured
from fls_trackers.encounters import Scan, encounters
from fls_trackers.fusion import fuse
from fls_trackers.grouping import grouped
from fls_trackers.initiation import starting
from fls_trackers.life import LOST, TENTATIVE
from fls_trackers.single_target import follow, settle_by_score
from fls_trackers.track_bank import Ledger, begun, renewed

__all__ = ["FIXED", "Row", "Scanned", "diver_scan"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Row = npt.NDArray[np.void]
Events = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

LARGEST = np.finfo(np.float64).max


# What is the same in all scans, as the kernel takes it: a row of an array costs a tenth of a tuple's time.
FIXED = np.dtype(
    [
        ("velocity_walk_mps", np.float64),
        ("group_m", np.float64),  # reach of a group of events, 0: none is made
        ("extent_sd_m", np.float64),
        ("amplitude_sd", np.float64),  # 0: not weighed
        ("resolution_m", np.float64),
        ("meeting_m", np.float64),  # 0: tracks are not told apart after they met
        ("gamma", np.float64),
        ("factor", np.float64),  # p_d / (1 - p_d p_g)
        ("miss", np.float64),  # 1 - p_d p_g
        ("one_event", np.int64),
        ("only_probable", np.int64),
        ("estimate_noise", np.int64),
        ("joint", np.int64),
        ("heard", np.int64),  # whether the strength of echoes matters
        ("m1", np.int64),
        ("n1", np.int64),
        ("start_score", np.float64),
        ("max_propagate", np.int64),
        ("max_sd_m", np.float64),
        ("max_common_events", np.int64),
        ("by_intersection", np.int64),  # fusion
        ("max_tracks", np.int64),
        ("speed_sd_mps", np.float64),
    ]
)


class Scanned(NamedTuple):
    """The tracks after a scan, with those that are lost or begin in it; a row each."""

    state: FloatArray  # (n, 4)
    covariance: FloatArray  # (n, 4, 4)
    ledger: Ledger
    noise: FloatArray  # (n, NOISE_COLUMNS)
    strength: FloatArray  # (n, STRENGTH_COLUMNS)
    meeting: FloatArray  # (n, columns)
    lost: int  # how many are lost
    begun: int
    unclaimed: int  # events outside the gates of confirmed tracks
    finite: bool  # whether the detections were; if not, nothing here means anything


@compiled
def diver_scan(
    state: FloatArray,
    covariance: FloatArray,
    ledger: Ledger,
    noise: FloatArray,
    strength: FloatArray,
    meeting: FloatArray,
    range_m: FloatArray,
    bearing_rad: FloatArray,
    amplitude: FloatArray,
    ln_amplitude: FloatArray,
    next_id: int,
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
) -> tuple[FloatArray, FloatArray, Ledger, FloatArray, FloatArray, FloatArray, int, int, int, bool]:
    """The fields of `Scanned`; `fixed`: a row (1,) of FIXED."""
    if not _finite(range_m, bearing_rad):
        return state, covariance, ledger, noise, strength, meeting, 0, 0, 0, False
    f, sensor = fixed[0], (range_sd_m, bearing_sd_rad, north_m, east_m, heading_rad)
    motion = (dt_s, f.velocity_walk_mps)
    r, b, level, ln = _events(range_m, bearing_rad, amplitude, ln_amplitude, f.group_m, f.heard)
    y, R0 = _placed(r, b, sensor, f.extent_sd_m)
    density = cell_density(r, p_fa, cell_m, spacing_rad, least_density)
    spread = (f.extent_sd_m, f.amplitude_sd, f.resolution_m)
    choices = (f.one_event != 0, f.only_probable != 0, f.estimate_noise != 0, f.joint != 0)
    weights = (f.gamma, f.factor, f.miss)
    x, P, rows, noises, levels, event, none, known, claimed = follow(
        state, covariance, ledger, noise, strength, y, ln, density, motion, sensor, spread, weights, choices
    )
    rows, keep = _settled(x, P, rows, event, none, f)
    met = meeting
    if f.meeting_m > 0.0:
        x, P, noises, levels, met = _told_apart(
            x, P, rows, noises, levels, meeting, keep, event, ln, motion, f.meeting_m, f.amplitude_sd
        )
    which, _ = starting(~known, r, b, level, f.max_tracks - keep.sum())
    ended = rows["status"] == LOST
    keep |= ended
    x, P, rows, noises, levels, met = _joined(
        x, P, rows, noises, levels, met, keep, y, R0, ln, which, next_id, f.speed_sd_mps
    )
    return x, P, rows, noises, levels, met, ended.sum(), which.size, claimed.size - claimed.sum(), True


@compiled
def _settled(
    x: FloatArray, P: FloatArray, rows: Ledger, event: IntArray, none: FloatArray, f: Any
) -> tuple[Ledger, BoolArray]:
    """The ledger with new statuses, and which tracks go on; fuses in x and P those that are one."""
    confirm = (f.m1, f.n1, f.start_score)
    table, keep, part = settle_by_score(
        rows, x, P, event, none, confirm, f.max_propagate, f.max_sd_m, f.max_common_events, f.joint != 0
    )
    for t in range(part.size):
        if part[t] >= 0:
            fuse(x, P, part[t], t, f.by_intersection != 0)
    return table, keep


@compiled
def _placed(
    range_m: FloatArray,
    bearing_rad: FloatArray,
    sensor: tuple[float, float, float, float, float],
    extent_sd_m: float,
) -> tuple[FloatArray, FloatArray]:
    """Positions (m, 2) and covariances (m, 2, 2), by the sensor and as the echo's centre wanders."""
    y, R0, _ = measured(range_m, bearing_rad, sensor)
    for j in range(range_m.size):
        for a in range(2):
            R0[j, a, a] += extent_sd_m * extent_sd_m
    return y, R0


@compiled
def _told_apart(
    x: FloatArray,
    P: FloatArray,
    rows: Ledger,
    noise: FloatArray,
    strength: FloatArray,
    meeting: FloatArray,
    keep: BoolArray,
    event: IntArray,
    ln_amplitude: FloatArray,
    motion: tuple[float, float],
    meeting_m: float,
    amplitude_sd: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """What is known of the tracks, exchanged between those that met and parted with the wrong one."""
    status = np.where(keep, rows["status"], LOST)
    scan = Scan(rows["id"].copy(), status, x, P, strength, event, ln_amplitude)
    met, path = encounters(meeting, scan, motion, meeting_m, amplitude_sd)
    return x[path], P[path], noise[path], strength[path], met


@compiled
def _joined(
    x: FloatArray,
    P: FloatArray,
    rows: Ledger,
    noise: FloatArray,
    strength: FloatArray,
    meeting: FloatArray,
    keep: BoolArray,
    y: FloatArray,
    R0: FloatArray,
    ln_amplitude: FloatArray,
    which: IntArray,
    next_id: int,
    speed_sd_mps: float,
) -> tuple[FloatArray, FloatArray, Ledger, FloatArray, FloatArray, FloatArray]:
    """The tracks that `keep` selects, then those that begin at the events `which`, with their tables."""
    new = np.zeros(which.size, rows.dtype)
    new_x, new_P = begun(y, R0, which, speed_sd_mps, speed_sd_mps, TENTATIVE, new)
    noise, strength = _more(noise, keep, which.size), _more(strength, keep, which.size)
    first = strength.shape[0] - which.size
    for k in range(which.size):
        new[k].id = next_id + k
        if math.isfinite(ln_amplitude[which[k]]):
            strength[first + k, 0], strength[first + k, 1] = ln_amplitude[which[k]], 1.0
    x, P, rows = renewed(x, P, rows, keep, new_x, new_P, new)
    return x, P, rows, noise, strength, _more(meeting, keep, which.size)


@compiled
def _more(table: FloatArray, keep: BoolArray, n: int) -> FloatArray:
    """The rows that `keep` selects, then `n` of zeros."""
    columns, k = table.shape[1], 0
    after = np.zeros((keep.sum() + n, columns))
    for t in range(keep.size):
        if keep[t]:
            for c in range(columns):
                after[k, c] = table[t, c]
            k += 1
    return after


@compiled
def _finite(range_m: FloatArray, bearing_rad: FloatArray) -> bool:
    finite = True
    for j in range(range_m.size):
        finite &= math.isfinite(range_m[j]) & math.isfinite(bearing_rad[j])
    return finite


@compiled
def _events(
    range_m: FloatArray,
    bearing_rad: FloatArray,
    amplitude: FloatArray,
    ln_amplitude: FloatArray,
    group_m: float,
    heard: int,
) -> Events:
    """What a ping has seen, one event per object: range, bearing, amplitude and its logarithm (nan: unknown).

    A group is as strong as its strongest event.
    """
    ln = ln_amplitude.copy() if heard else np.full(range_m.size, np.nan)
    if group_m <= 0.0:
        return range_m.copy(), bearing_rad.copy(), amplitude.copy(), ln
    r, b, group = grouped(range_m, bearing_rad, amplitude, group_m)
    most, ln_most = np.full(r.size, -np.inf), np.full(r.size, np.nan)
    for j in range(group.size):
        level = min(max(amplitude[j], -LARGEST), LARGEST) if amplitude[j] == amplitude[j] else -np.inf
        if level > most[group[j]]:
            most[group[j]], ln_most[group[j]] = level, ln[j]
    return r, b, most, ln_most
