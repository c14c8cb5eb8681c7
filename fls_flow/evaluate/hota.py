"""Higher-order tracking accuracy."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.evaluate.assignment import Pairs, best
from fls_flow.evaluate.scene import Points

__all__ = ["ALPHAS", "hota_scores"]

FloatArray = npt.NDArray[np.float64]

ALPHAS = np.arange(1, 20) * 0.05  # thresholds of the similarity
ROUNDING = np.finfo(float).eps  # a similarity of exactly alpha counts


def hota_scores(targets: Points, tracks: Points, pairs: Pairs, cutoff_m: float) -> dict[str, float]:
    """HOTA, DetA, AssA and LocA, means over the thresholds alpha = 0.05 .. 0.95 of s = max(0, 1 - d / c).

    HOTA = sqrt(DetA AssA), DetA = TP / (TP + FN + FP), AssA = mean over TP of TPA / (TPA + FNA + FPA)
    (Luiten et al. 2021, (1)-(10)); pairs are chosen once per ping, by s times how well the whole target and
    track agree, as their TrackEval does.
    """
    if not len(targets) and not len(tracks):
        return dict.fromkeys(("hota", "deta", "assa", "loca"), math.nan)
    pairs = pairs.select(pairs.distance_m < cutoff_m)
    similarity = 1.0 - pairs.distance_m / cutoff_m
    owners = targets.owner[pairs.left], tracks.owner[pairs.right]
    # trajectories that ever come close, numbered
    both, number = np.unique(owners[0] * max(tracks.name.size, 1) + owners[1], return_inverse=True)
    lengths = (
        _lengths(targets)[both // max(tracks.name.size, 1)]
        + _lengths(tracks)[both % max(tracks.name.size, 1)]
    )
    agreement = np.bincount(number, weights=_shared(pairs, similarity, len(targets), len(tracks)))
    agreement = agreement / (lengths - agreement)
    chosen = best(pairs.ping, pairs.left, pairs.right, agreement[number] * similarity)
    similarity, number = similarity[chosen], number[chosen]
    scores = np.array(
        [_at(alpha, similarity, number, lengths, len(targets) + len(tracks)) for alpha in ALPHAS]
    )
    return dict(zip(("hota", "deta", "assa", "loca"), scores.mean(axis=0).tolist(), strict=True))


def _lengths(points: Points) -> npt.NDArray[np.int64]:
    return np.bincount(points.owner, minlength=points.name.size)


def _shared(pairs: Pairs, similarity: FloatArray, n_left: int, n_right: int) -> FloatArray:
    """(n,) similarity over all that either row has in its ping: s / (row sum + column sum - s)."""
    row = np.bincount(pairs.left, weights=similarity, minlength=n_left)
    column = np.bincount(pairs.right, weights=similarity, minlength=n_right)
    return np.asarray(similarity / (row[pairs.left] + column[pairs.right] - similarity))


def _at(
    alpha: float,
    similarity: FloatArray,
    number: npt.NDArray[np.int64],
    lengths: npt.NDArray[np.int64],
    rows: int,
) -> tuple[float, float, float, float]:
    hit = similarity >= alpha - ROUNDING
    true = int(np.count_nonzero(hit))
    together = np.bincount(number[hit], minlength=lengths.size)
    detection = true / max(rows - true, 1)
    association = float((together * (together / np.maximum(lengths - together, 1))).sum()) / max(true, 1)
    location = float(similarity[hit].mean()) if true else 1.0
    return math.sqrt(detection * association), detection, association, location
