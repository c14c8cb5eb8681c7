"""How often labels are wrong, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

__all__ = ["Confusion", "Sides", "confusion", "interval"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class Sides:
    """What mistakes are counted between: classes, each by itself or several together."""

    names: tuple[str, ...]
    of: IntArray  # (c,) the side of each class

    @classmethod
    def each(cls, classes: Sequence[str]) -> Self:
        """Every class by itself."""
        return cls(tuple(classes), np.arange(len(classes)))

    @classmethod
    def against_rest(cls, classes: Sequence[str], positive: str) -> Self:
        """One class against all others together."""
        return cls((positive, "others"), np.array([0 if name == positive else 1 for name in classes]))

    def chance(self, probability: FloatArray) -> FloatArray:
        """(n, s) probabilities of the sides, from those of the classes (n, c)."""
        columns = [probability[:, self.of == side].sum(axis=1) for side in range(len(self.names))]
        return np.stack(columns, axis=1)


@dataclass(frozen=True, eq=False)
class Confusion:
    """Vectors by true class (rows) and label (columns), and whole targets by their most frequent label."""

    classes: tuple[str, ...]
    count: IntArray  # (c, c)
    group_count: IntArray  # (c, c) of groups

    @property
    def error(self) -> float:
        """Share of the vectors with a wrong label."""
        return _error(self.count)

    @property
    def group_error(self) -> float:
        """Share of the groups whose most frequent label is wrong."""
        return _error(self.group_count)

    @property
    def class_error(self) -> FloatArray:
        """(c,) share of each class's vectors with another label; nan without vectors."""
        total = self.count.sum(axis=1)
        with np.errstate(invalid="ignore"):
            return np.asarray(1.0 - np.diagonal(self.count) / total)

    @property
    def wrong(self) -> tuple[int, int]:
        """Wrong labels, and vectors."""
        total = int(self.count.sum())
        return total - int(np.trace(self.count)), total

    def missed(self, name: str, *, group: bool = False) -> tuple[int, int]:
        """Vectors (or groups) of a class with another label, and all of it."""
        one, count = self.classes.index(name), self.group_count if group else self.count
        total = int(count[one].sum())
        return total - int(count[one, one]), total

    def called(self, name: str, *, group: bool = False) -> tuple[int, int]:
        """Vectors (or groups) of the other classes with that label, and all of these."""
        one, count = self.classes.index(name), self.group_count if group else self.count
        others = np.delete(count, one, axis=0)
        return int(others[:, one].sum()), int(others.sum())

    @property
    def group_wrong(self) -> tuple[int, int]:
        """Wrongly labelled groups, and groups."""
        total = int(self.group_count.sum())
        return total - int(np.trace(self.group_count)), total


def _error(count: IntArray) -> float:
    total = int(count.sum())
    return 1.0 - int(np.trace(count)) / total if total else float("nan")


def confusion(classes: tuple[str, ...], true: IntArray, said: IntArray, group: IntArray) -> Confusion:
    """Counts of labelled vectors; a group is said to be what most of its vectors are, of equals the first."""
    size = len(classes)
    count = np.zeros((size, size), np.int64)
    np.add.at(count, (true, said), 1)
    names, number = np.unique(group, return_inverse=True)
    votes, known = np.zeros((names.size, size), np.int64), np.zeros((names.size, size), np.int64)
    np.add.at(votes, (number, said), 1)
    np.add.at(known, (number, true), 1)
    group_count = np.zeros((size, size), np.int64)
    np.add.at(group_count, (known.argmax(axis=1), votes.argmax(axis=1)), 1)
    return Confusion(classes, count, group_count)


def interval(wrong: int, n: int) -> tuple[float, float]:
    """Where the error lies with 95 % confidence, if the n trials are independent (Clopper & Pearson 1934)."""
    from scipy.special import betaincinv

    if n == 0:
        return 0.0, 1.0
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = float(betaincinv(wrong, n - wrong + 1, tail)) if wrong > 0 else 0.0
    high = float(betaincinv(wrong + 1, n - wrong, 1.0 - tail)) if wrong < n else 1.0
    return low, high
