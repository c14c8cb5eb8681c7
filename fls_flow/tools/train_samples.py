"""Labelled feature vectors, with the target that each comes from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.evaluate.classifier import Groups, grouped
from fls_flow.tools.train_labels import NOBODY, Followed, follow, look_up, throughout
from fls_flow.tools.train_tables import FeatureTable, Run, read_labels, read_table, run_record

__all__ = ["Labelling", "Samples", "gather", "only"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Words = npt.NDArray[np.str_]


@dataclass(frozen=True)
class Labelling:
    """How tracks get their classes; raises ValueError for what is out of range."""

    groups: Groups = ()  # classes that count as one
    gate_m: float = 5.0
    share: float = 0.5
    clutter: str | None = None  # class of tracks that follow no target

    def __post_init__(self) -> None:
        if not 0.0 < self.gate_m < np.inf:
            raise ValueError(f"gate_m is {self.gate_m}; it must be positive")
        if not 0.0 < self.share <= 1.0:
            raise ValueError(f"share is {self.share}; it lies between 0 and 1")


@dataclass(frozen=True, eq=False)
class Samples:
    """Vectors of one set of features; those of one target or track share a group."""

    name: str
    features: tuple[str, ...]
    values: FloatArray  # (n, p), finite
    classes: tuple[str, ...]
    label: IntArray  # (n,) index into classes
    group: IntArray  # (n,) the same number in all sets; never on both sides of a split
    unlabelled: int = 0  # rows that follow no target of known class
    broken: int = 0  # rows with a feature that is no finite number

    def __len__(self) -> int:
        return self.label.size

    def rows(self, which: npt.NDArray[Any]) -> Samples:
        """Those that a mask or an index array selects."""
        return replace(self, values=self.values[which], label=self.label[which], group=self.group[which])

    def columns(self, names: Sequence[str]) -> Samples:
        """The same vectors with these features alone, in this order."""
        at = [self.features.index(name) for name in names]
        return replace(self, features=tuple(names), values=self.values[:, at])

    def of_classes(self, classes: Sequence[str]) -> Samples:
        """The same vectors, labelled by another list of classes that has all of theirs."""
        new = np.array([classes.index(name) for name in self.classes], np.int64)
        return replace(self, classes=tuple(classes), label=new[self.label])

    @property
    def counts(self) -> dict[str, tuple[int, int]]:
        """Vectors and groups of each class."""
        return {
            name: (int(np.count_nonzero(mine)), int(np.unique(self.group[mine]).size))
            for name, mine in ((name, self.label == one) for one, name in enumerate(self.classes))
        }


@dataclass(frozen=True, eq=False)
class _Part:
    table: FeatureTable
    word: Words
    owner: list[tuple[Any, ...]]  # of each row: what it must not be parted from


def gather(runs: Iterable[Run], labelling: Labelling) -> tuple[dict[str, Samples], dict[str, Any]]:
    """The samples of each set of features, by the stem of their files, and where they come from.

    A column `class` says what a row is, or `labels.csv` what a track is, or else the target that it follows.
    Raises UserError where none is there, and where tables of one name have different columns.
    """
    parts: dict[str, list[_Part]] = {}
    records: list[dict[str, Any]] = []
    for number, run in enumerate(runs):
        followed = None
        for path in run.tables:
            table = read_table(path)
            owner: list[tuple[Any, ...]] = [(number, "track", one) for one in table.track_id.tolist()]
            if table.word is not None:
                word = table.word
            elif run.labels is not None:
                said = read_labels(run.labels)
                word = np.array([said.get(one, "") for one in table.track_id.tolist()], np.str_)
            else:
                followed = followed or _followed(run, path, labelling)
                word, owner = _by_target(table, followed, number, labelling.clutter)
            parts.setdefault(path.stem, []).append(_Part(table, grouped(word, labelling.groups), owner))
        record = run_record(run)
        records += [record] if record is not None else []
    every = (one for some in parts.values() for part in some for one in part.owner)
    numbers = {one: number for number, one in enumerate(dict.fromkeys(every))}
    sets = {name: _joined(name, some, numbers) for name, some in parts.items()}
    digests = sorted(part.table.digest for some in parts.values() for part in some)
    return sets, {"runs": records, "tables_sha256": digests}


def _followed(run: Run, path: Path, labelling: Labelling) -> Followed:
    if run.tracks is None:
        raise UserError(
            f"{path}: has no column class, and no tracks.csv lies beside it; let the graph write one"
        )
    if run.truth is None:
        raise UserError(
            f"{path}: has no column class, and no truth.csv lies beside it; name it with --truth, or write "
            "what the tracks are into labels.csv beside it: track_id,class"
        )
    return follow(run.tracks, run.truth, gate_m=labelling.gate_m, share=labelling.share)


def _by_target(
    table: FeatureTable, followed: Followed, run: int, clutter: str | None
) -> tuple[Words, list[tuple[Any, ...]]]:
    at = look_up(followed, table.stamp_ns, table.track_id)
    there = at >= 0
    whole = throughout(followed, at, table.track_id)
    target = np.where(whole, followed.target[at], NOBODY) if followed.target.size else at
    word = np.where(target != NOBODY, followed.word[at] if followed.word.size else "", "")
    if clutter is not None and followed.free.size:
        word = np.where(there & followed.free[at], clutter, word)
    owner = [
        (run, "target", one) if one != NOBODY else (run, "track", track)
        for one, track in zip(target.tolist(), table.track_id.tolist(), strict=True)
    ]
    return word.astype(np.str_), owner


def _joined(name: str, parts: Sequence[_Part], numbers: Mapping[tuple[Any, ...], int]) -> Samples:
    first = parts[0].table
    for part in parts[1:]:
        if part.table.names != first.names:
            raise UserError(f"{part.table.path} and {first.path}: have different columns; train on one kind")
    values = np.concatenate([part.table.values for part in parts])
    word = np.concatenate([part.word for part in parts])
    owners = [one for part in parts for one in part.owner]
    known, finite = word != "", np.isfinite(values).all(axis=1)
    kept = known & finite
    classes, label = np.unique(word[kept], return_inverse=True)
    group = np.array([numbers[one] for one in owners], np.int64)[kept]
    return Samples(
        name,
        first.names,
        values[kept],
        tuple(classes.tolist()),
        label.astype(np.int64),
        group,
        int(np.count_nonzero(~known)),
        int(np.count_nonzero(known & ~finite)),
    )


def only(samples: Samples, patterns: str) -> Samples:
    """The samples with the features that match one of the patterns, separated by commas.

    Raises UserError where none does.
    """
    wanted = [one.strip() for one in patterns.split(",") if one.strip()]
    kept = [name for name in samples.features if any(fnmatchcase(name, one) for one in wanted)]
    if not kept:
        raise UserError(f"--only {patterns}: matches none of {', '.join(samples.features)}")
    return samples.columns(kept)
