"""What the tracks of a run are: the class of the target that each follows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.evaluate.table import Table, read

__all__ = ["Followed", "follow", "look_up"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

NOBODY = -1


@dataclass(frozen=True, eq=False)
class Followed:
    """Which target each row of a track file follows."""

    stamp_ns: IntArray  # (n,)
    track_id: IntArray  # (n,)
    target: IntArray  # (n,) its id; NOBODY
    free: npt.NDArray[np.bool_]  # (n,) whether the whole track follows no target
    word: npt.NDArray[np.str_]  # (n,) the target's class


def follow(tracks_path: Path, truth_path: Path, *, gate_m: float, share: float) -> Followed:
    """The target of each track: that which lies within the gate in most pings of it.

    That must be `share` of its pings at least. Rows in which this target is beyond the gate, or another one
    nearer, follow nobody. Raises UserError for files in two frames.
    """
    tracks, truth = read(tracks_path, "tracks"), read(truth_path, "truth")
    if tracks.frame != truth.frame and tracks.ping.size and truth.ping.size:
        raise UserError(
            f"{tracks_path}: frame is '{tracks.frame}', that of {truth_path} '{truth.frame}'; convert one"
        )
    if "class" not in truth.columns:
        raise UserError(f"{truth_path}: lacks the column class; it says what the targets are")
    names, distance = _distances(tracks, truth)
    track_id = tracks.columns["track_id"]
    near = distance <= gate_m
    target = np.full(track_id.size, NOBODY, np.int64)
    free = np.zeros(track_id.size, bool)
    for one in np.unique(track_id):
        rows = np.flatnonzero(track_id == one)
        chosen = _chosen(near[rows], distance[rows], share)
        free[rows] = not near[rows].any()
        if chosen is not None:
            sure = near[rows, chosen] & (distance[rows].argmin(axis=1) == chosen)
            target[rows[sure]] = names[chosen]
    classes = dict(zip(truth.columns["target_id"].tolist(), truth.columns["class"].tolist(), strict=True))
    word = np.array([classes.get(one, "") for one in target.tolist()], np.str_)
    return Followed(tracks.stamp_ns[tracks.ping], track_id, target, free, word)


def _distances(tracks: Table, truth: Table) -> tuple[IntArray, FloatArray]:
    """Ids of the targets, and the distance (n_rows, n_targets) of each track row to each; inf: not there."""
    names = np.unique(truth.columns["target_id"])
    at = _places(tracks)
    distance = np.full((len(at), names.size), np.inf)
    stamps, place = truth.stamp_ns[truth.ping], _places(truth)
    wanted = tracks.stamp_ns[tracks.ping]
    for number, name in enumerate(names.tolist()):
        rows = np.flatnonzero(truth.columns["target_id"] == name)
        found = np.minimum(np.searchsorted(stamps[rows], wanted), rows.size - 1)
        there = stamps[rows][found] == wanted
        apart = np.hypot(*(at - place[rows[found]]).T)
        distance[:, number] = np.where(there, apart, np.inf)
    return names.astype(np.int64), distance


def _places(table: Table) -> FloatArray:
    return np.stack([np.asarray(table.columns[name], float) for name in ("x_m", "y_m")], axis=1)


def _chosen(near: npt.NDArray[np.bool_], distance: FloatArray, share: float) -> int | None:
    """The target that is near in most rows, of equal ones the nearer; None if too few."""
    count = near.sum(axis=0)
    if not count.size or count.max() < max(share * len(near), 1):
        return None
    mean = np.where(near, distance, 0.0).sum(axis=0) / np.maximum(count, 1)
    return int(np.lexsort((mean, -count))[0])


def look_up(followed: Followed, stamp_ns: IntArray, track_id: IntArray) -> IntArray:
    """(m,) the row of the track file for each ping and track; -1 where it has none."""
    if not followed.track_id.size:
        return np.full(track_id.size, -1, np.int64)
    order = np.lexsort((followed.stamp_ns, followed.track_id))
    known = np.rec.fromarrays([followed.track_id[order], followed.stamp_ns[order]])
    wanted = np.rec.fromarrays([track_id, stamp_ns])
    at = np.minimum(np.searchsorted(known, wanted), order.size - 1)
    return np.where(known[at] == wanted, order[at], -1).astype(np.int64)
