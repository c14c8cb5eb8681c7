"""A picture of a sweep: each metric over the first axis, a line for each setting of the others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fls_flow.tools.summary import Group
from fls_flow.tools.sweep import Sweep

__all__ = ["figure", "save"]

MAX_LINES = 10  # more cannot be told apart
WIDE_RATIO = 30.0  # of the largest to the smallest value, from which the axis is logarithmic


def save(path: Path, sweep: Sweep, found: Sequence[Group]) -> None:
    """Write the picture as PNG, whole or not at all."""
    draft = path.with_name(f".{path.name}.part")
    drawing = figure(sweep, found)
    FigureCanvasAgg(drawing)
    drawing.savefig(draft, format="png", dpi=120)
    draft.replace(path)


def figure(sweep: Sweep, found: Sequence[Group]) -> Figure:
    """One panel per metric; bars are standard errors."""
    drawing = Figure(figsize=(7.5, 1.2 + 3.0 * len(sweep.metrics)), layout="constrained")
    panels = drawing.subplots(len(sweep.metrics), 1, squeeze=False, sharex=True)[:, 0]
    axis = next(iter(found[0].labels), "")
    places, words = _places(list(dict.fromkeys(group.labels.get(axis, "") for group in found)))
    lines = _lines(found, axis)
    for panel, metric in zip(panels, sweep.metrics, strict=True):
        for name, line in list(lines.items())[:MAX_LINES]:
            groups = sorted(line, key=lambda group: places[group.labels.get(axis, "")])
            x = [places[group.labels.get(axis, "")] for group in groups]
            y = [group.metrics[metric].mean for group in groups]
            error = [np.nan_to_num(group.metrics[metric].error) for group in groups]
            panel.errorbar(x, y, yerr=error, marker="o", markersize=4, capsize=2, label=name)
        panel.set_ylabel(metric)
        panel.grid(alpha=0.3)
        _scale(panel, places, words=words)
    panels[-1].set_xlabel(axis)
    if len(lines) > 1:
        shown = f"{MAX_LINES} of {len(lines)} settings" if len(lines) > MAX_LINES else None
        panels[0].legend(fontsize="small", title=shown)
    drawing.suptitle(sweep.name)
    return drawing


def _lines(found: Sequence[Group], axis: str) -> dict[str, list[Group]]:
    """The groups by their setting of all axes but `axis`."""
    lines: dict[str, list[Group]] = {}
    for group in found:
        rest = ", ".join(f"{name} = {label}" for name, label in group.labels.items() if name != axis)
        lines.setdefault(rest, []).append(group)
    return lines


def _places(labels: list[str]) -> tuple[dict[str, float], bool]:
    """Where each value stands on the axis, and whether it needs its label there: words do."""
    try:
        return {label: float(label) for label in labels}, False
    except ValueError:
        return {label: float(place) for place, label in enumerate(labels)}, True


def _scale(panel: Any, places: dict[str, float], *, words: bool) -> None:
    at = list(places.values())
    if words:
        panel.set_xticks(at, list(places), rotation=30, ha="right")
    elif min(at) > 0.0 and max(at) > WIDE_RATIO * min(at):
        panel.set_xscale("log")
