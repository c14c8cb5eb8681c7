"""Which track follows which target from ping to ping, and the scores that count it: CLEAR MOT and IDF1."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.evaluate.assignment import Pairs, best, contests
from fls_flow.evaluate.scene import Points

__all__ = ["clear_scores", "identity_scores", "matched", "run_starts", "switches"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

FAITHFUL = 1000.0  # what keeping the partner of the ping before is worth, in pairs


def matched(targets: Points, tracks: Points, pairs: Pairs, gate_m: float) -> IntArray:
    """(n_target_rows,) the track row that follows each target row, or -1.

    A pair that held in the ping before is kept; beyond that, the pairs have the greatest sum of
    1 - d / (2 gate) (Bernardin & Stiefelhagen 2008, in the form of Luiten's TrackEval).
    """
    follows = np.full(len(targets), -1, np.int64)
    inside = pairs.distance_m <= gate_m
    follows[pairs.left[inside]] = pairs.right[inside]  # right where nothing is contested
    before = _row_before(targets)
    similarity = 1.0 - 0.5 * pairs.distance_m / gate_m
    for contest in contests(pairs.ping, pairs.left, pairs.right, inside):
        left, right = pairs.left[contest.rows], pairs.right[contest.rows]
        last = np.where(before[left] >= 0, follows[before[left]], -1)
        kept = (last >= 0) & (tracks.owner[last] == tracks.owner[right])
        chosen = contest.choose(similarity[contest.rows] + FAITHFUL * kept)
        follows[left] = -1
        follows[left[chosen]] = right[chosen]
    return follows


def _row_before(points: Points) -> IntArray:
    """(n,) the row of the same owner in the ping before, or -1."""
    order = np.lexsort((points.ping, points.owner))
    owner, ping = points.owner[order], points.ping[order]
    joined = (np.diff(owner) == 0) & (np.diff(ping) == 1)
    before = np.full(len(points), -1, np.int64)
    before[order[1:][joined]] = order[:-1][joined]
    return before


def switches(targets: Points, tracks: Points, follows: IntArray) -> IntArray:
    """(n_targets,) how often each target is followed by another track than the time before."""
    rows = np.flatnonzero(follows >= 0)
    rows = rows[np.lexsort((targets.ping[rows], targets.owner[rows]))]
    owner, track = targets.owner[rows], tracks.owner[follows[rows]]
    changed = (np.diff(owner) == 0) & (np.diff(track) != 0)
    return np.bincount(owner[1:][changed], minlength=targets.name.size)


def run_starts(targets: Points, follows: IntArray) -> IntArray:
    """(n_targets,) how often a target begins to be followed after it was there and was not: fragments.

    While a target is out of sight nobody misses it: who follows it before and after goes on.
    """
    order = np.lexsort((targets.ping, targets.owner))
    follow, owner = follows[order] >= 0, targets.owner[order]
    began = follow.copy()
    began[1:] &= ~(follow[:-1] & (np.diff(owner) == 0))
    return np.bincount(owner[began], minlength=targets.name.size)


def clear_scores(targets: Points, tracks: Points, follows: IntArray, pairs: Pairs) -> dict[str, float]:
    """MOTA = 1 - (missed + false + switches) / target rows; MOTP: mean distance of the pairs, m.

    MOTP is a distance, as in Bernardin & Stiefelhagen (2008, (1)): smaller is better.
    """
    hits = int(np.count_nonzero(follows >= 0))
    misses, false = len(targets) - hits, len(tracks) - hits
    switched = int(switches(targets, tracks, follows).sum())
    fragments = run_starts(targets, follows)
    distance = pairs.distance_m[follows[pairs.left] == pairs.right]
    return {
        "mota": 1.0 - (misses + false + switched) / len(targets) if len(targets) else math.nan,
        "motp_m": float(distance.mean()) if distance.size else math.nan,
        "id_switches": switched,
        "fragmentations": int(np.maximum(fragments - 1, 0).sum()),
        "misses": misses,
        "false_positives": false,
        "recall": hits / len(targets) if len(targets) else math.nan,
        "precision": hits / len(tracks) if len(tracks) else math.nan,
    }


def identity_scores(targets: Points, tracks: Points, pairs: Pairs, gate_m: float) -> dict[str, float]:
    """IDF1, ID precision and ID recall: one track per target all the time (Ristani et al. 2016, (8)-(10)).

    The identity true positives are the pings in which a target's own track is inside the gate, under the
    one-to-one choice of tracks that makes them most.
    """
    inside = pairs.distance_m <= gate_m
    owners = np.stack([targets.owner[pairs.left[inside]], tracks.owner[pairs.right[inside]]])
    both, together = np.unique(owners, axis=1, return_counts=True)
    own = best(np.zeros(together.size, np.int64), both[0], both[1], together.astype(float))
    true = float(together[own].sum())
    rows = len(targets) + len(tracks)
    return {
        "idf1": 2.0 * true / rows if rows else math.nan,
        "id_precision": true / len(tracks) if len(tracks) else math.nan,
        "id_recall": true / len(targets) if len(targets) else math.nan,
    }
