"""Labels of tracks against the classes of the targets they follow."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.evaluate.scene import Points

__all__ = ["ClassifierScores", "Groups", "Roc", "classifier_scores", "grouped", "parse_group", "roc_of"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Words = npt.NDArray[np.str_]
Groups = tuple[tuple[str, tuple[str, ...]], ...]  # a class, and the patterns of what counts as it


@dataclass(frozen=True, eq=False)
class Roc:
    """Operating points of one class against the others, from the highest threshold to the lowest."""

    positive: str
    threshold: FloatArray  # (n,) of the probability of the positive class; begins at inf: nothing is positive
    hit_rate: FloatArray  # (n,) share of the positive rows that are called positive
    false_alarm_rate: FloatArray  # (n,) share of the other rows that are
    cost: FloatArray  # (n,) mean per row
    bayes_threshold: float  # where the costs balance, if the probabilities are right
    area: float  # under the curve

    @property
    def at_bayes(self) -> int:
        """The operating point of `bayes_threshold`."""
        return int(np.count_nonzero(self.threshold >= self.bayes_threshold)) - 1

    @property
    def cheapest(self) -> int:
        """The operating point of least cost on these rows; the highest threshold of those."""
        return int(np.argmin(self.cost))


@dataclass(frozen=True, eq=False)
class ClassifierScores:
    """Counts of followed rows, and of tracks, by true class and label."""

    classes: tuple[str, ...]  # rows: of the truth
    labels: tuple[str, ...]  # columns: of the tracks
    confusion: IntArray  # (n_classes, n_labels)
    track_confusion: IntArray  # (n_classes, n_labels), a track by its most frequent label
    class_error: dict[str, float]  # share of the rows of a class with another label
    roc: Roc | None
    overall: dict[str, float]


def parse_group(text: str) -> tuple[str, tuple[str, ...]]:
    """Class and patterns of `CLASS=A,B*`; raises UserError for another text."""
    name, equals, patterns = text.partition("=")
    found = tuple(one.strip() for one in patterns.split(",") if one.strip())
    if not (equals and name.strip() and found):
        raise UserError(f"--group {text}: write CLASS=A,B")
    return name.strip(), found


def grouped(words: Words, groups: Groups) -> Words:
    """The words (n,), each replaced by the first class that has a pattern for it; empty ones stay empty."""
    unique, where = np.unique(words, return_inverse=True)
    named = [
        next((name for name, patterns in groups for one in patterns if word and fnmatchcase(word, one)), word)
        for word in unique.tolist()
    ]
    return np.array(named, np.str_)[where] if named else words


def classifier_scores(
    targets: Points,
    tracks: Points,
    follows: IntArray,
    *,
    positive: str | None,
    miss_cost: float,
    false_alarm_cost: float,
) -> ClassifierScores | None:
    """Confusion, errors and ROC over the rows that follow a target of known class; None without labels.

    Raises UserError when `positive` is no class of the truth.
    """
    rows = np.flatnonzero((follows >= 0) & (targets.word != ""))
    rows = rows[tracks.word[follows[rows]] != ""]
    if not rows.size:
        return None
    other = follows[rows]
    known, said, track = targets.word[rows], tracks.word[other], tracks.owner[other]
    classes, i = np.unique(known, return_inverse=True)
    labels = np.union1d(classes, said)
    j = np.searchsorted(labels, said)
    confusion = np.zeros((classes.size, labels.size), np.int64)
    np.add.at(confusion, (i, j), 1)
    right = confusion[np.arange(classes.size), np.searchsorted(labels, classes)]
    roc = _roc(known, said, tracks.probability[other], positive, miss_cost, false_alarm_cost)
    by_track = _of_tracks(track, i, j, confusion.shape)
    agreed = by_track[np.arange(classes.size), np.searchsorted(labels, classes)].sum()
    overall = {
        "class_error": 1.0 - float(right.sum()) / rows.size,
        "class_error_tracks": 1.0 - float(agreed) / max(int(by_track.sum()), 1),
        "class_labelled": rows.size / max(int(np.count_nonzero((follows >= 0) & (targets.word != ""))), 1),
    }
    return ClassifierScores(
        tuple(classes.tolist()),
        tuple(labels.tolist()),
        confusion,
        by_track,
        dict(zip(classes.tolist(), (1.0 - right / confusion.sum(axis=1)).tolist(), strict=True)),
        roc,
        overall | (_roc_figures(roc) if roc is not None else {}),
    )


def _of_tracks(track: IntArray, i: IntArray, j: IntArray, shape: tuple[int, ...]) -> IntArray:
    """(n_classes, n_labels) tracks by the class they follow most and the label they carry most."""
    _, number = np.unique(track, return_inverse=True)
    n = int(number.max()) + 1
    true, label = np.zeros((n, shape[0]), np.int64), np.zeros((n, shape[1]), np.int64)
    np.add.at(true, (number, i), 1)
    np.add.at(label, (number, j), 1)
    count = np.zeros(shape, np.int64)
    np.add.at(count, (true.argmax(axis=1), label.argmax(axis=1)), 1)
    return count


def _roc(
    known: npt.NDArray[np.str_],
    said: npt.NDArray[np.str_],
    probability: FloatArray,
    positive: str | None,
    miss_cost: float,
    false_alarm_cost: float,
) -> Roc | None:
    """The ROC of the positive class, by default the first by name; None with one class or no probability.

    With two classes and labels, P(positive) is the label's probability or what it lacks to one; with more, a
    row with another label says nothing of it and counts as 0.
    """
    words = np.union1d(known, said)
    if positive is not None and positive not in words:
        raise UserError(f"--positive {positive}: is no class here; there are {', '.join(words.tolist())}")
    rated = np.isfinite(probability)
    chosen = positive if positive is not None else str(words[0])
    is_positive = known[rated] == chosen
    if not is_positive.any() or is_positive.all():
        return None
    others = 1.0 - probability[rated] if words.size == 2 else 0.0
    value = np.where(said[rated] == chosen, probability[rated], others)
    return roc_of(chosen, value, is_positive, miss_cost, false_alarm_cost)


def roc_of(
    positive: str, value: FloatArray, is_positive: BoolArray, miss_cost: float, false_alarm_cost: float
) -> Roc:
    """The ROC of `value`, the probability of the positive class.

    A row is called positive when value >= threshold. Costs balance where P(positive) miss_cost =
    (1 - P(positive)) false_alarm_cost: at false_alarm_cost / (miss_cost + false_alarm_cost) (Duda, Hart &
    Stork 2001, 2.2). The area is the chance that a positive row outranks another (ties: half).
    """
    order = np.argsort(-value, kind="stable")
    last = np.append(np.flatnonzero(np.diff(value[order])), value.size - 1)  # of rows with equal value
    hits = np.concatenate([[0], np.cumsum(is_positive[order])[last]])
    false = np.concatenate([[0], np.cumsum(~is_positive[order])[last]])
    hit_rate, false_rate = hits / hits[-1], false / false[-1]
    cost = (miss_cost * (hits[-1] - hits) + false_alarm_cost * false) / value.size
    return Roc(
        positive,
        np.concatenate([[math.inf], value[order][last]]),
        hit_rate,
        false_rate,
        cost,
        false_alarm_cost / (miss_cost + false_alarm_cost),
        float(np.sum(np.diff(false_rate) * 0.5 * (hit_rate[1:] + hit_rate[:-1]))),
    )


def _roc_figures(roc: Roc) -> dict[str, float]:
    at, cheapest = roc.at_bayes, roc.cheapest
    return {
        "class_roc_area": roc.area,
        "class_threshold": roc.bayes_threshold,
        "class_hit_rate": float(roc.hit_rate[at]),
        "class_false_alarm_rate": float(roc.false_alarm_rate[at]),
        "class_cost": float(roc.cost[at]),
        "class_best_threshold": float(roc.threshold[cheapest]),
        "class_best_cost": float(roc.cost[cheapest]),
    }
