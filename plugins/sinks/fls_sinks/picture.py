"""Draw scenes with matplotlib, without a display and without its global state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fls_flow import TrackStatus
from fls_sinks import marks
from fls_sinks.fan import Fan, decibels, fan, peak_reduced, raster
from fls_sinks.scene import Scene

if TYPE_CHECKING:  # matplotlib is loaded when something is drawn
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Look", "drawn", "levels", "when"]

FloatArray = npt.NDArray[np.float64]

PANEL_HEIGHT_IN = {1: 7.0, 2: 5.0}  # by number of columns
SMALL_PANEL_IN = 4.0
LEFT_IN, RIGHT_IN, ABOVE_IN, BELOW_IN, LEGEND_IN = 0.75, 1.05, 0.5, 0.5, 0.55
REACH = 100.0  # marks farther away than so many times the fan are left out


@dataclass(frozen=True, slots=True)
class Look:
    """How pictures look."""

    dynamic_range_db: float
    gate_probability: float
    colormap: str
    dpi: int


def drawn(scenes: Sequence[Scene], look: Look) -> Figure:
    """A figure with one panel per scene; without any it says that no ping came."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fans = [_fan(scene, look) for scene in scenes]
    sheet = _sheet(fans)
    figure = Figure((sheet.width, sheet.height), dpi=look.dpi)
    FigureCanvasAgg(figure)
    if not scenes:
        figure.text(0.5, 0.5, "no ping came", ha="center", va="center", fontsize=16)
        return figure
    handles: dict[str, Any] = {}
    for place, (scene, image) in enumerate(zip(scenes, fans, strict=True)):
        axes, bar = (figure.add_axes(box) for box in sheet.boxes(place))
        _panel(axes, bar, scene, image, look, pixels=int(sheet.panel_height * look.dpi))
        found, labels = axes.get_legend_handles_labels()
        handles.update(zip(labels, found, strict=True))
    if handles:
        figure.legend(
            handles.values(), handles.keys(), loc="lower center", ncols=sheet.legend_columns, fontsize=9,
            facecolor="#404048", labelcolor="w",
        )  # fmt: skip
    return figure


@dataclass(frozen=True, slots=True)
class _Sheet:
    """Where panels lie on the page, inches; placed by hand, so that nothing overlaps whatever the fan."""

    rows: int
    columns: int
    panel_width: float
    panel_height: float

    @property
    def width(self) -> float:
        return self.columns * (self.panel_width + LEFT_IN + RIGHT_IN)

    @property
    def height(self) -> float:
        return self.rows * (self.panel_height + ABOVE_IN + BELOW_IN) + LEGEND_IN

    @property
    def legend_columns(self) -> int:
        return max(2, min(9, int(self.width / 1.5)))

    def boxes(self, place: int) -> tuple[tuple[float, float, float, float], ...]:
        """Fractions (left, bottom, width, height) of a panel and of its colour bar."""
        row, column = divmod(place, self.columns)
        left = column * self.width / self.columns + LEFT_IN
        bottom = self.height - (row + 1) * (self.panel_height + ABOVE_IN + BELOW_IN) + BELOW_IN
        bar = left + self.panel_width + 0.12, bottom + 0.1 * self.panel_height, 0.18, 0.8 * self.panel_height
        panel = left, bottom, self.panel_width, self.panel_height
        return tuple(
            (x / self.width, y / self.height, w / self.width, h / self.height) for x, y, w, h in (panel, bar)
        )


def _sheet(fans: Sequence[tuple[Fan, float, float] | None]) -> _Sheet:
    extents = [entry[0].extent_m for entry in fans if entry is not None]
    ratios = [(right - left) / (top - bottom) for left, right, bottom, top in extents]
    columns = max(1, math.ceil(math.sqrt(len(fans))))
    rows = max(1, math.ceil(len(fans) / columns))
    height = PANEL_HEIGHT_IN.get(columns, SMALL_PANEL_IN)
    return _Sheet(rows, columns, height * float(np.clip(max(ratios, default=1.0), 0.6, 1.8)), height)


def levels(amplitude: npt.NDArray[Any], dynamic_range_db: float) -> tuple[float, float, float]:
    """The reference amplitude and the lowest and highest level (dB re reference) of the colour scale.

    The reference is the median of the positive cells. The scale ends at the strongest cell, at most three
    quarters of the dynamic range above the median, and begins no lower than the weakest twentieth of cells.
    """
    value = np.asarray(amplitude, float)
    positive = value[np.isfinite(value) & (value > 0)]
    if not positive.size:
        return 1.0, -dynamic_range_db, 0.0
    reference = float(np.median(positive))
    weak, peak = decibels(np.array([np.percentile(positive, 5), positive.max()]), reference)
    highest = min(float(peak), 0.75 * dynamic_range_db)
    lowest = max(float(weak), highest - dynamic_range_db)
    return (
        (reference, lowest, highest) if highest - lowest > 1.0 else (reference, lowest - 1.0, highest + 1.0)
    )


def when(stamp_ns: int) -> str:
    """The stamp in words: UTC, or seconds where it counts from the start of a recording."""
    if stamp_ns < 365 * 86_400 * 10**9:
        return f"{stamp_ns / 1e9:.3f} s"
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=stamp_ns // 1000)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{moment.microsecond // 1000:03d} UTC"


def _fan(scene: Scene, look: Look) -> tuple[Fan, float, float] | None:
    if not scene.amplitude.size:
        return None
    reference, lowest, highest = levels(scene.amplitude, look.dynamic_range_db)
    image = fan(scene.amplitude, scene.range_m, scene.bearing_rad, scene.beamwidth_rad)
    small = peak_reduced(image, max_ranges=1000, max_beams=1000)
    level = decibels(small.level, reference)
    return Fan(level, small.range_edge_m, small.bearing_edge_rad), lowest, highest


def _panel(
    axes: Axes, bar: Axes, scene: Scene, image: tuple[Fan, float, float] | None, look: Look, pixels: int
) -> None:
    axes.set_facecolor("#202028")
    axes.set_title(_title(scene), fontsize=10)
    axes.set_xlabel("starboard, m")
    axes.set_ylabel("forward, m")
    if image is None:
        axes.text(0.5, 0.5, "the ping is empty", transform=axes.transAxes, ha="center", color="w")
        bar.set_axis_off()
        return
    _image(axes, bar, *image, look, pixels)
    scene = scene.within(REACH * max(map(abs, image[0].extent_m)))
    marks.wakes(axes, scene)
    marks.noisy_beams(axes, scene, image[0])
    marks.truth(axes, scene)
    marks.detections(axes, scene)
    marks.trails(axes, scene)
    marks.tracks(axes, scene, look.gate_probability)
    _frame(axes, image[0])
    if scene.notes:
        axes.text(
            0.01, 0.01, "; ".join(scene.notes), transform=axes.transAxes, color="w", fontsize=8, wrap=True
        )


def _title(scene: Scene) -> str:
    confirmed = int(np.count_nonzero(scene.track_status == TrackStatus.CONFIRMED))
    counts = f"{_counted(len(scene.detection_m), 'detection')}, {_counted(confirmed, 'confirmed track')}"
    return f"ping {scene.seq}, {when(scene.stamp_ns)}\n{counts}"


def _counted(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _image(axes: Axes, bar: Axes, image: Fan, lowest: float, highest: float, look: Look, pixels: int) -> None:
    picture = raster(image, pixels)
    shown = axes.imshow(
        np.ma.masked_invalid(np.clip(picture, lowest - 1.0, highest + 1.0)),
        extent=image.extent_m,
        origin="lower",
        interpolation="nearest",
        cmap=look.colormap,
        vmin=lowest,
        vmax=highest,
        zorder=0,
    )
    axes.figure.colorbar(shown, cax=bar, extend="both", label="amplitude, dB re median")
    axes.plot(image.outline_m[:, 1], image.outline_m[:, 0], color="#808088", lw=0.5, zorder=1)


def _frame(axes: Axes, image: Fan) -> None:
    """Limits around the fan that give both axes one scale, by widening one of them."""
    left, right, bottom, top = image.extent_m
    box = axes.get_window_extent()
    metres_per_dot = 1.04 * max((right - left) / box.width, (top - bottom) / box.height)
    half_width, half_height = 0.5 * metres_per_dot * box.width, 0.5 * metres_per_dot * box.height
    axes.set_aspect("auto")  # the limits do it
    axes.set_xlim(0.5 * (left + right) - half_width, 0.5 * (left + right) + half_width)
    axes.set_ylim(0.5 * (bottom + top) - half_height, 0.5 * (bottom + top) + half_height)
