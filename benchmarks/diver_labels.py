"""The labels that the classifier of the diver graph gives to the tracks of runs, beside what they follow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fls_flow import Features
from fls_flow import graph as graphs
from fls_flow.model_files import load
from fls_flow.tools.train_labels import NOBODY, follow, look_up, throughout
from fls_flow.tools.train_scores import Confusion, confusion
from fls_flow.tools.train_tables import read_table

GATE_M = 1.5  # a track that follows a target is this close to its centre


def labelling() -> graphs.Node:
    """The classifier of the graph."""
    return graphs.load("diver_classification").node("label")


def decided(runs: Sequence[Path], model: Path, **parameters: Any) -> Confusion:
    """What the graph's classifier calls followed tracks, block after block, where it has a label.

    `parameters` take the place of the graph's.
    """
    label = labelling()
    given = {**label.parameters(), "model": model, **parameters}
    return _counted(load(model).class_names, [_labels(run, label.kind.cls(**given)) for run in runs])


def _labels(run: Path, classifier: Any) -> list[tuple[str, str, int]]:
    """Class, label and target of each block that a run has described, where there is a label."""
    table = read_table(run / "temporal.csv")
    followed = follow(run / "tracks.csv", run / "truth.csv", gate_m=GATE_M, share=0.5)
    at = look_up(followed, table.stamp_ns, table.track_id)
    whole = throughout(followed, at, table.track_id)
    rows = []
    for seq, stamp_ns in enumerate(np.unique(table.stamp_ns).tolist()):
        here = np.flatnonzero(table.stamp_ns == stamp_ns)
        said = classifier(Features(seq, stamp_ns, table.track_id[here], table.names, table.values[here]))
        names = {
            track: said.names[n] for track, n in zip(said.track_id.tolist(), said.label.tolist(), strict=True)
        }
        for row in here.tolist():
            track, target = int(table.track_id[row]), int(followed.target[at[row]])
            if track in names and whole[row] and target != NOBODY:
                rows.append((str(followed.word[at[row]]), names[track], target))
    return rows


def _counted(classes: tuple[str, ...], runs: Sequence[list[tuple[str, str, int]]]) -> Confusion:
    rows = [(*row, number) for number, run in enumerate(runs) for row in run]
    true, said = (np.array([classes.index(row[n]) for row in rows]) for n in (0, 1))
    group = np.unique(np.array([(row[3], row[2]) for row in rows]), axis=0, return_inverse=True)[1]
    return confusion(classes, true, said, group.ravel())
