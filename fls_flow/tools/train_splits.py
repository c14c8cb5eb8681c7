"""Splits that never part what belongs to one target or track."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.tools.train_samples import Samples

__all__ = ["fold_count", "folds", "halves"]

IntArray = npt.NDArray[np.int64]


def halves(samples: Sequence[Samples], share: float, rng: np.random.Generator) -> IntArray:
    """The groups that are trained on: `share` of each class's, at least one, never all; alike in all sets.

    Raises UserError for a class with one group, and where there is no class.
    """
    words = sorted({name for one in samples for name in one.classes})
    if not words:
        raise UserError("no row of the tables has a class; do labels or truth name tracks that are in them?")
    chosen: list[IntArray] = []
    for word in words:
        groups = np.unique(np.concatenate([_groups(one, word) for one in samples]))
        if groups.size < 2:
            raise UserError(
                f"class '{word}' comes from {groups.size} target; a split by track needs two at least: add "
                "runs, or name others with --test"
            )
        taken = int(np.clip(np.floor(share * groups.size + 0.5), 1, groups.size - 1))
        chosen.append(rng.permutation(groups)[:taken])
    return np.concatenate(chosen)


def _groups(samples: Samples, word: str) -> IntArray:
    if word not in samples.classes:
        return np.zeros(0, np.int64)
    return np.unique(samples.group[samples.label == samples.classes.index(word)])


def fold_count(samples: Samples, wanted: int) -> int:
    """How many folds there can be, so that each class is trained on in all of them; 0 with one group."""
    fewest = min(groups for _, groups in samples.counts.values())
    return min(wanted, fewest) if fewest >= 2 else 0


def folds(samples: Samples, count: int, rng: np.random.Generator) -> IntArray:
    """(n,) the fold in which each vector is held out; every class has groups in all folds."""
    fold = np.zeros(len(samples), np.int64)
    for number in range(len(samples.classes)):
        groups = rng.permutation(np.unique(samples.group[samples.label == number]))
        for place, group in enumerate(groups.tolist()):
            fold[samples.group == group] = place % count
    return fold
