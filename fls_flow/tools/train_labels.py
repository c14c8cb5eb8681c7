"""What the tracks of a run are: the class of the target that each follows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.evaluate.table import Table, read

__all__ = ["Followed", "follow", "look_up", "throughout"]

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
    place: IntArray  # (n,) how many rows of its track come before it
    since: IntArray  # (n,) for how many rows of its track, with this one, that target has been the same


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
    place, since = np.zeros(track_id.size, np.int64), np.zeros(track_id.size, np.int64)
    for one in np.unique(track_id):
        rows = np.flatnonzero(track_id == one)
        chosen = _chosen(near[rows], distance[rows], share)
        free[rows] = not near[rows].any()
        if chosen is not None:
            sure = near[rows, chosen] & (distance[rows].argmin(axis=1) == chosen)
            target[rows[sure]] = names[chosen]
        place[rows] = np.arange(rows.size)
        since[rows] = _run_lengths(target[rows])
    classes = dict(zip(truth.columns["target_id"].tolist(), truth.columns["class"].tolist(), strict=True))
    word = np.array([classes.get(one, "") for one in target.tolist()], np.str_)
    return Followed(tracks.stamp_ns[tracks.ping], track_id, target, free, word, place, since)


def _run_lengths(values: IntArray) -> IntArray:
    """(n,) for how many values in a row, up to and with each, nothing has changed."""
    at = np.arange(values.size)
    begins = np.concatenate([[True], np.diff(values) != 0])[: values.size]
    return np.asarray(at - np.maximum.accumulate(np.where(begins, at, 0)) + 1)


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


def throughout(followed: Followed, at: IntArray, track_id: IntArray) -> npt.NDArray[np.bool_]:
    """(m,) whether the tracks of descriptions followed one target in all pings that these are made of.

    `at` (m,) are their rows of the track file, those of the newest ping; -1: none, and False. A description
    is made of as many pings as lie between two of one track, at least: one of static features, a whole block
    of temporal ones.
    """
    there = np.flatnonzero(at >= 0)
    order = there[np.lexsort((at[there], track_id[there]))]
    step = np.diff(followed.place[at[order]])[np.diff(track_id[order]) == 0]
    pings = int(step[step > 0].min()) if (step > 0).any() else 1
    whole = np.zeros(at.size, bool)
    whole[there] = (followed.since[at[there]] >= pings) & (followed.target[at[there]] != NOBODY)
    return whole
