"""A sheet of chips: a row per track, its chips over time with the outline of the object and its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:  # matplotlib is loaded when something is drawn
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Shown", "Strip", "drawn"]

FloatArray = npt.NDArray[np.float64]

CELL_INCH = 1.15
TEXT_LINE_INCH = 0.14
DARKEST = 1.0  # percentile of the amplitudes that is black
OUTLINE = "#ff5a5a"


@dataclass(frozen=True, eq=False)
class Shown:
    """One chip of a track."""

    time_s: float
    amplitude: npt.NDArray[Any]  # (rows, columns)
    mask: npt.NDArray[np.bool_]  # (rows, columns)
    range_m: tuple[float, float]  # of the first and the last row
    bearing_deg: tuple[float, float]
    values: tuple[float, ...]  # of the features that are shown; nan: none


@dataclass
class Strip:
    """Chips of one track, thinned evenly in time so that there are never more than twice `wanted`."""

    wanted: int
    count: int = 0  # chips that came
    stride: int = 1
    shown: list[Shown] = field(default_factory=list)

    def add(self, one: Shown) -> None:
        """Keep every `stride`-th chip."""
        if self.count % self.stride == 0:
            self.shown.append(one)
        self.count += 1
        if len(self.shown) >= 2 * self.wanted:
            self.shown = self.shown[::2]
            self.stride *= 2

    def chosen(self) -> list[Shown]:
        """At most `wanted` of them, from the first to the last."""
        if len(self.shown) <= self.wanted:
            return self.shown
        return [self.shown[n] for n in np.linspace(0, len(self.shown) - 1, self.wanted).round().astype(int)]


def drawn(strips: Sequence[tuple[str, Strip]], names: Sequence[str], columns: int) -> Figure:
    """The sheet: a title and a strip per row, the features `names` under each chip."""
    from matplotlib.figure import Figure

    rows = max(len(strips), 1)
    height = CELL_INCH + TEXT_LINE_INCH * (len(names) + 2)
    figure = Figure(figsize=(CELL_INCH * columns + 0.6, height * rows + 0.2), layout="constrained", dpi=130)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
    for line, (title, strip) in zip(grid, strips, strict=False):
        for axes, one in zip(line, strip.chosen(), strict=False):
            _chip(axes, one, names)
        first = line[0]
        first.text(
            -0.14, 0.5, title, rotation=90, va="center", ha="right", fontsize=7, transform=first.transAxes
        )
    if not strips:
        grid[0, 0].text(0.0, 0.5, "no chips came")
    return figure


def _chip(axes: Axes, one: Shown, names: Sequence[str]) -> None:
    level = np.asarray(one.amplitude, float)
    black, white = np.percentile(level, [DARKEST, 100.0])
    axes.imshow(
        level, cmap="gray", vmin=black, vmax=max(white, black + 1e-12), aspect="auto", origin="lower",
        interpolation="nearest",
    )  # fmt: skip
    if one.mask.any() and not one.mask.all():
        axes.contour(one.mask.astype(float), levels=[0.5], colors=OUTLINE, linewidths=0.8)
    near, far = one.range_m
    left, right = one.bearing_deg
    axes.set_title(f"{one.time_s:.1f} s\n{near:.1f}-{far:.1f} m  {left:.0f}..{right:.0f}°", fontsize=5, pad=2)
    text = "\n".join(
        f"{name} {value:.3g}" for name, value in zip(names, one.values, strict=True) if np.isfinite(value)
    )
    axes.text(0.0, -0.03, text, va="top", fontsize=5, transform=axes.transAxes)
