"""How well each target is followed: continuity, time to confirm, errors and their consistency."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from fls_flow.evaluate.assignment import Pairs
from fls_flow.evaluate.clear import run_starts, switches
from fls_flow.evaluate.scene import Pings, Points

__all__ = [
    "Errors",
    "error_scores",
    "errors_of",
    "follow_scores",
    "nees_bounds",
    "target_scores",
    "track_counts",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of the target rows that a track follows, (n,) each."""

    row: IntArray  # of the target
    position_m: FloatArray  # distance
    velocity_mps: FloatArray  # of the velocities; nan: one is unknown
    nees: FloatArray  # e' P^-1 e of the position; nan: no positive definite P


def errors_of(targets: Points, tracks: Points, follows: IntArray) -> Errors:
    """Distance, velocity error and normalised estimation error squared of each followed target row."""
    row = np.flatnonzero(follows >= 0)
    other = follows[row]
    e = tracks.position_m[other] - targets.position_m[row]
    speed = tracks.velocity_mps[other] - targets.velocity_mps[row]
    return Errors(row, np.hypot(*e.T), np.hypot(*speed.T), _nees(e, tracks.covariance[other]))


def _nees(e: FloatArray, P: FloatArray) -> FloatArray:
    a, b, d = P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]
    determinant = a * d - b * b
    with np.errstate(all="ignore"):  # what is no covariance gives nan or inf
        value = (d * e[:, 0] ** 2 - 2.0 * b * e[:, 0] * e[:, 1] + a * e[:, 1] ** 2) / determinant
        return np.where((determinant > 0.0) & (a > 0.0) & np.isfinite(value), value, np.nan)


def nees_bounds(n: int, dimension: int = 2) -> tuple[float, float]:
    """Where the mean of n independent NEES lies with 95 % probability: chi^2 of n d degrees, over n.

    Errors of one track are alike from ping to ping, so that the true interval is wider
    (Bar-Shalom, Li & Kirubarajan 2001, (5.4.2-10)).
    """
    if n == 0:
        return math.nan, math.nan
    tail = 0.5 * (1.0 - CONFIDENCE)
    return float(chdtri(n * dimension, 1.0 - tail)) / n, float(chdtri(n * dimension, tail)) / n


def error_scores(errors: Errors) -> dict[str, float]:
    """RMSE of position and velocity, mean NEES with its bounds, and the share inside the 95 % ellipse."""
    nees = errors.nees[np.isfinite(errors.nees)]
    low, high = nees_bounds(nees.size)
    return {
        "position_rmse_m": _rms(errors.position_m),
        "velocity_rmse_mps": _rms(errors.velocity_mps[np.isfinite(errors.velocity_mps)]),
        "nees": float(nees.mean()) if nees.size else math.nan,
        "nees_low": low,
        "nees_high": high,
        "nees_inside": float(np.mean(nees <= chdtri(2, 1.0 - CONFIDENCE))) if nees.size else math.nan,
    }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def target_scores(
    pings: Pings, targets: Points, tracks: Points, follows: IntArray, errors: Errors
) -> dict[int, dict[str, float]]:
    """The scores of each target, by its id."""
    switched, starts = switches(targets, tracks, follows), run_starts(targets, follows)
    scores: dict[int, dict[str, float]] = {}
    for owner, name in enumerate(targets.name.tolist()):
        mine = np.flatnonzero(targets.owner == owner)
        own = targets.owner[errors.row] == owner
        part = Errors(errors.row[own], errors.position_m[own], errors.velocity_mps[own], errors.nees[own])
        scores[name] = {
            **_continuity(pings, targets.ping[mine], tracks, follows[mine]),
            "id_switches": int(switched[owner]),
            "fragmentations": max(int(starts[owner]) - 1, 0),
            **error_scores(part),
        }
    return scores


def _continuity(pings: Pings, ping: IntArray, tracks: Points, follows: IntArray) -> dict[str, float]:
    """Tracked time over life time (Abu et al. 2024), by any track and by the best one; time to confirm, s."""
    share = pings.share_s[ping]
    followed = follows >= 0
    per_track = np.bincount(tracks.owner[follows[followed]], weights=share[followed], minlength=1)
    life, time = float(share.sum()), pings.time_s[ping]
    return {
        "continuity": float(share[followed].sum()) / life,
        "continuity_one_track": float(per_track.max()) / life,
        "time_to_confirm_s": float(time[followed][0] - time[0]) if followed.any() else math.nan,
    }


def follow_scores(of_target: dict[int, dict[str, float]]) -> dict[str, float]:
    """Means over the targets; the mean time to confirm is of those that are ever followed."""
    names = ("continuity", "continuity_one_track", "time_to_confirm_s")
    columns = {name: np.array([one[name] for one in of_target.values()], float) for name in names}
    columns = {name: values[np.isfinite(values)] for name, values in columns.items()}
    found = {name: float(values.mean()) if values.size else math.nan for name, values in columns.items()}
    return {**found, "targets": len(of_target), "targets_found": columns["time_to_confirm_s"].size}


def track_counts(
    targets: Points, tracks: Points, follows: IntArray, pairs: Pairs, gate_m: float
) -> dict[str, float]:
    """How many confirmed tracks there are, and how many of them are false or redundant.

    By what holds in most of its pings, a track follows a target, is redundant (in the gate of a target that
    another track follows) or false (in no gate).
    """
    near = np.zeros(len(tracks), bool)
    near[pairs.right[pairs.distance_m <= gate_m]] = True
    follow = np.zeros(len(tracks), bool)
    follow[follows[follows >= 0]] = True
    count = np.stack(
        [
            np.bincount(tracks.owner[rows], minlength=tracks.name.size)
            for rows in (follow, near & ~follow, ~near)
        ]
    )
    what = np.argmax(count, axis=0) if tracks.name.size else np.zeros(0, np.int64)
    return {
        "confirmed_tracks": tracks.name.size,
        "redundant_tracks": int(np.count_nonzero(what == 1)),
        "false_tracks": int(np.count_nonzero(what == 2)),
    }
