"""What a sweep found: the metrics over the parameters, averaged over repetitions."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from fls_flow.tools.cell import Row
from fls_flow.tools.grid import Axis, Grid
from fls_flow.tools.sweep import Sweep

__all__ = ["Group", "Mean", "csv_text", "groups", "known_metrics", "table"]


@dataclass(frozen=True, slots=True)
class Mean:
    """A metric over the repetitions of one setting."""

    mean: float
    error: float  # standard error of the mean; nan of a single value
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Mean:
        """Mean and standard error s / sqrt(n), s with n - 1; nan for what there is too little for."""
        n = len(values)
        if not n:
            return cls(math.nan, math.nan, 0)
        error = float(np.std(values, ddof=1)) / math.sqrt(n) if n > 1 else math.nan
        return cls(float(np.mean(values)), error, n)

    def __str__(self) -> str:
        if not self.count:
            return "-"
        if not self.error > 0.0:
            return f"{self.mean:.4g}"
        decimals = max(0, -math.floor(math.log10(self.error)))
        return f"{self.mean:.{decimals}f} ± {self.error:.{decimals}f}"


@dataclass(frozen=True, slots=True)
class Group:
    """The cells that differ in repeated axes only."""

    labels: dict[str, str]  # of the axes that tell groups apart
    cells: tuple[int, ...]
    done: int
    failed: int
    metrics: dict[str, Mean]


def groups(sweep: Sweep, rows: Mapping[int, Row], over: Iterable[str] = ()) -> list[Group]:
    """One group per setting, in the order of the grid; averaged over seeds and over the axes `over`."""
    apart = _apart(sweep.grid, over)
    members: dict[tuple[int, ...], list[int]] = {}
    for index in range(len(sweep.grid)):
        places = sweep.grid.places(index)
        members.setdefault(tuple(places[a] for a in apart), []).append(index)
    return [
        _group(sweep, rows, [sweep.grid.axes[a] for a in apart], key, cells) for key, cells in members.items()
    ]


def _apart(grid: Grid, over: Iterable[str]) -> list[int]:
    """The axes that are not averaged over."""
    averaged = set(over)
    return [
        place
        for place, axis in enumerate(grid.axes)
        if len(axis.values) > 1 and not axis.is_repeat and axis.name not in averaged
    ]


def _group(
    sweep: Sweep, rows: Mapping[int, Row], axes: list[Axis], places: tuple[int, ...], cells: list[int]
) -> Group:
    found = [rows[index] for index in cells if index in rows]
    good = [row for row in found if row.status == "ok"]
    means = {
        name: Mean.of([value for row in good if (value := row.scores.get(name)) is not None])
        for name in sweep.metrics
    }
    labels = {axis.name: axis.labels[place] for axis, place in zip(axes, places, strict=True)}
    return Group(labels, tuple(cells), len(good), len(found) - len(good), means)


def known_metrics(rows: Iterable[Row]) -> list[str]:
    """The names of all scores that cells have."""
    return sorted({name for row in rows for name in row.scores})


def table(sweep: Sweep, found: Sequence[Group]) -> Table:
    """A row per setting: metrics as mean ± standard error."""
    shown = Table(box=None, header_style="bold", pad_edge=False)
    for name in found[0].labels:
        shown.add_column(name, justify="right", overflow="fold")
    repeated = any(len(group.cells) > 1 for group in found)
    if repeated or not found[0].labels:
        shown.add_column("cells", justify="right")
    if any(group.failed for group in found):
        shown.add_column("failed", justify="right")
    for name in sweep.metrics:
        shown.add_column(name, justify="right")
    for group in found:
        cells = [f"{group.done}/{len(group.cells)}"] if repeated or not group.labels else []
        failed = [str(group.failed)] if any(other.failed for other in found) else []
        metrics = [str(group.metrics[name]) for name in sweep.metrics]
        shown.add_row(*group.labels.values(), *cells, *failed, *metrics)
    return shown


def csv_text(sweep: Sweep, rows: Mapping[int, Row]) -> str:
    """A line per cell that is done, in the order of the grid: parameters, status, every score."""
    names = known_metrics(rows.values())
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["cell", *(axis.name for axis in sweep.grid.axes), "status", *names])
    for index in sorted(rows):
        row = rows[index]
        scores = ["" if (value := row.scores.get(name)) is None else repr(value) for name in names]
        writer.writerow([index, *sweep.grid.labels(index).values(), row.status, *scores])
    return text.getvalue()
