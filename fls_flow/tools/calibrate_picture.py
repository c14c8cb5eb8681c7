"""Wished against measured false-alarm rates as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fls_flow.errors import UserError
from fls_flow.tools.calibrate import Calibration, Point
from fls_flow.tools.calibrate_rates import Measured

if TYPE_CHECKING:  # matplotlib is loaded when something is drawn
    from matplotlib.axes import Axes

__all__ = ["draw", "draw_panel"]

BEFORE, AFTER, GREY = "#d55e00", "#0072b2", "#9a9a9a"
PANEL_INCH = (5.2, 4.4)


def draw(found: Sequence[tuple[str, Calibration] | None], path: Path, columns: int = 2) -> None:
    """Write a PNG with a panel per calibration, None for a gap; UserError when it cannot be written."""
    from matplotlib.figure import Figure

    columns = min(columns, len(found))
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(PANEL_INCH[0] * columns, PANEL_INCH[1] * rows), layout="constrained", dpi=110)
    for number, panel in enumerate(found, start=1):
        if panel is not None:
            draw_panel(figure.add_subplot(rows, columns, number), *panel)
    try:
        with path.open("xb") as file:
            figure.savefig(file, format="png")
    except FileExistsError as error:
        raise UserError(f"--plot {path}: is there already; name another file") from error
    except OSError as error:
        raise UserError(f"--plot {path}: cannot be written ({error.strerror or error})") from error


def draw_panel(axes: Axes, title: str, found: Calibration) -> None:
    """Measured over wished rate, with threshold scale 1 and calibrated; bars hold the rate with 95 %."""
    points = sorted((*found.curve, found.point), key=lambda point: point.pfa)
    rates = [point.pfa for point in points]
    ends = [min(rates) / 2.0, min(max(rates) * 2.0, 1.0)]
    axes.plot(ends, ends, color=GREY, lw=1.0, ls="--", label="as wished")
    _curve(axes, points, [point.before for point in points], BEFORE, "o", "before: threshold_scale 1")
    _curve(axes, points, [point.after for point in points], AFTER, "s", "after, on what was not fitted to")
    axes.set(xscale="log", yscale="log", xlabel="wished false-alarm rate", ylabel="measured", title=title)
    axes.grid(alpha=0.25)
    axes.legend(loc="lower right", fontsize=8)


def _curve(
    axes: Axes, points: Sequence[Point], rates: Sequence[Measured], colour: str, marker: str, label: str
) -> None:
    """Points with bars; a rate of zero stands at the upper end of its bar, as an arrow down."""
    wished = np.array([point.pfa for point in points])
    rate, low, high = (np.array([getattr(one, name) for one in rates]) for name in ("rate", "low", "high"))
    seen = rate > 0.0
    low = np.maximum(low, 0.1 * rate)
    bars = np.stack([rate - low, high - rate])[:, seen]
    axes.errorbar(
        wished[seen], rate[seen], bars, color=colour, marker=marker, ms=4, lw=1.2, capsize=2, label=label
    )
    axes.plot(wished[~seen], high[~seen], color=colour, marker="v", ms=6, ls="none")
