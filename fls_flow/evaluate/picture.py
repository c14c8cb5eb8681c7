"""Scores as one picture: tracks over truth, errors over time, and the curves of detector and classifier."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.evaluate.classifier import ClassifierScores
from fls_flow.evaluate.detector import DetectorScores
from fls_flow.evaluate.intensity import IntensityScores
from fls_flow.evaluate.scene import Points
from fls_flow.evaluate.scores import Scores, TrackScores

if TYPE_CHECKING:  # matplotlib is loaded when something is drawn
    from matplotlib.axes import Axes

__all__ = ["draw", "means"]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7b4fc9", "#8a6d00")
GREY = "#9a9a9a"
INSIDE_95 = 5.991  # chi^2 of 2 degrees
PANEL_INCH = (6.4, 4.2)
NAMED_TARGETS = 8  # with more, a legend hides the curves
NAMED_TRACKS = 40
POINTS = 1000  # of a curve; of a longer run each point is a mean


def draw(scores: Scores, path: Path) -> None:
    """Write a PNG with a panel for each thing that was scored; raises UserError when it cannot be written."""
    from matplotlib.figure import Figure

    panels = _panels(scores)
    rows = -(-len(panels) // 2)
    size = (PANEL_INCH[0] * min(len(panels), 2), PANEL_INCH[1] * rows)
    figure = Figure(figsize=size, layout="constrained", dpi=110)
    for number, panel in enumerate(panels, start=1):
        axes = figure.add_subplot(rows, min(len(panels), 2), number)
        axes.grid(alpha=0.25)
        panel(axes)
    try:
        with path.open("xb") as file:
            figure.savefig(file, format="png")
    except FileExistsError as error:
        raise UserError(f"--plot {path}: is there already; name another file") from error
    except OSError as error:
        raise UserError(f"--plot {path}: cannot be written ({error.strerror or error})") from error


def _panels(scores: Scores) -> list[Callable[[Axes], None]]:
    panels: list[Callable[[Axes], None]] = []
    cutoff_m = scores.settings.cutoff_m
    if scores.tracking is not None:
        one = scores.tracking
        panels += [
            lambda axes: _paths(axes, one),
            lambda axes: _distances(axes, one, cutoff_m),
            lambda axes: _position_errors(axes, one),
            lambda axes: _consistency(axes, one),
            lambda axes: _numbers(axes, one),
        ]
    if scores.intensity is not None:
        intensity = scores.intensity
        panels += [lambda axes: _mass(axes, intensity), lambda axes: _distances(axes, intensity, cutoff_m)]
    if scores.detector is not None:
        detector = scores.detector
        panels += [lambda axes: _detector_roc(axes, detector)]
    if scores.classifier is not None:
        classifier = scores.classifier
        panels += [lambda axes: _confusion(axes, classifier)]
        if classifier.roc is not None:
            panels += [lambda axes: _class_roc(axes, classifier)]
    return panels


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]


def _paths(axes: Axes, one: TrackScores) -> None:
    """Truth as broad grey lines, tracks as thin coloured ones; x forward is up."""
    for owner, rows in _by_owner(one.targets):
        x, y = one.targets.position_m[rows[:: _step(rows.size)]].T
        axes.plot(
            y, x, color=GREY, lw=5.0, alpha=0.5, solid_capstyle="round", label="truth" if not owner else None
        )
        axes.annotate(f"T{one.targets.name[owner]}", (y[0], x[0]), fontsize=8, color="#555555")
    for owner, rows in _by_owner(one.tracks):
        x, y = one.tracks.position_m[rows[:: _step(rows.size)]].T
        axes.plot(y, x, color=_colour(owner), lw=1.1, label="tracks" if not owner else None)
        if one.tracks.name.size > NAMED_TRACKS:
            continue
        axes.annotate(str(one.tracks.name[owner]), (y[-1], x[-1]), fontsize=8, color=_colour(owner))
    axes.set(title="tracks over truth", xlabel="y, m", ylabel="x, m")
    axes.set_aspect("equal", adjustable="datalim")
    _legend(axes)


def _distances(axes: Axes, one: TrackScores | IntensityScores, cutoff_m: float) -> None:
    curves = {"GOSPA": one.sets.gospa, "OSPA": one.sets.ospa}
    if isinstance(one, TrackScores):
        curves["OSPA(2)"] = one.ospa2_m
    for number, (name, values) in enumerate(curves.items()):
        axes.plot(means(one.pings.time_s), means(values), color=_colour(number), lw=1.1, label=name)
    of_what = "sets" if isinstance(one, TrackScores) else "estimates"
    axes.set(
        title=f"distance of the {of_what}, cut-off {cutoff_m:g} m{_of(one)}",
        xlabel="time, s",
        ylabel="m",
        ylim=(0, None),
    )
    _legend(axes)


def _position_errors(axes: Axes, one: TrackScores) -> None:
    _over_time(axes, one, one.errors.position_m)
    axes.set(
        title=f"position error of followed targets{_of(one)}", xlabel="time, s", ylabel="m", ylim=(0, None)
    )


def _consistency(axes: Axes, one: TrackScores) -> None:
    _over_time(axes, one, one.errors.nees)
    single = _step(len(one.pings)) == 1
    limit = INSIDE_95 if single else 2.0
    words = "95 % of consistent errors lie below" if single else "mean of consistent errors"
    axes.axhline(limit, color="black", lw=0.9, ls="--")
    axes.annotate(words, (0.02, limit), xycoords=("axes fraction", "data"), fontsize=8, va="bottom")
    if np.any(one.errors.nees > 0):
        axes.set_yscale("log")
    axes.set(title=f"NEES of the position{_of(one)}", xlabel="time, s", ylabel="e' P⁻¹ e")


def _over_time(axes: Axes, one: TrackScores, values: npt.NDArray[np.float64]) -> None:
    """A curve per target, with gaps where nothing follows it."""
    time = means(one.pings.time_s)
    curve = np.full(len(one.targets), np.nan)
    curve[one.errors.row] = values
    few = one.targets.name.size <= NAMED_TARGETS
    for owner, rows in _by_owner(one.targets):
        line = np.full(len(one.pings), np.nan)
        line[one.targets.ping[rows]] = curve[rows]
        name = f"target {one.targets.name[owner]}" if few else None
        axes.plot(time, means(line), color=_colour(owner), lw=1.0, label=name)
    _legend(axes)


def _step(n: int) -> int:
    return -(-n // POINTS) or 1


def _of(one: TrackScores | IntensityScores) -> str:
    """What a title adds when a point is not a ping."""
    step = _step(len(one.pings))
    return f", means of {step} pings" if step > 1 else ""


def means(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Means of runs of values, at most `POINTS`; of those that are known."""
    if values.size <= POINTS:
        return values
    begin = np.arange(0, values.size, _step(values.size))
    known = np.isfinite(values)
    count = np.add.reduceat(known.astype(np.int64), begin)
    total = np.add.reduceat(np.where(known, values, 0.0), begin)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _numbers(axes: Axes, one: TrackScores) -> None:
    from matplotlib.ticker import MaxNLocator

    time = one.pings.time_s
    axes.step(time, one.sets.n_targets, where="mid", color=GREY, lw=3.0, label="targets")
    axes.step(time, one.sets.n_tracks, where="mid", color=_colour(0), lw=1.1, label="tracks")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(title="how many", xlabel="time, s", ylim=(0, None))
    _legend(axes)


def _mass(axes: Axes, one: IntensityScores) -> None:
    time = one.pings.time_s
    axes.step(time, one.sets.n_targets, where="mid", color=GREY, lw=3.0, label="targets")
    axes.plot(time, one.expected_targets, color=_colour(0), lw=1.1, label="expected")
    axes.plot(time, one.sets.n_tracks, ".", color=_colour(1), ms=3, label="estimates")
    axes.set(title="PHD: how many", xlabel="time, s", ylim=(0, None))
    _legend(axes)


def _detector_roc(axes: Axes, found: DetectorScores) -> None:
    axes.step(found.false_alarms, found.pd, where="post", color=_colour(0), lw=1.3)
    axes.plot(found.false_alarms[-1:], found.pd[-1:], "o", color=_colour(0), ms=5)
    axes.set(
        title="detector", xlabel="false alarms per ping", ylabel="probability of detection", ylim=(0, 1.02)
    )
    positive = found.false_alarms[found.false_alarms > 0]
    if positive.size and positive.max() > 30 * positive.min():
        axes.set_xscale("log")


def _confusion(axes: Axes, found: ClassifierScores) -> None:
    axes.grid(visible=False)
    share = found.confusion / found.confusion.sum(axis=1, keepdims=True)
    axes.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for i, counts in enumerate(found.confusion.tolist()):
        for j, count in enumerate(counts):
            colour = "white" if share[i, j] > 0.5 else "black"
            axes.text(j, i, f"{count}\n{share[i, j]:.0%}", ha="center", va="center", color=colour, fontsize=9)
    axes.set_xticks(range(len(found.labels)), found.labels)
    axes.set_yticks(range(len(found.classes)), found.classes)
    axes.set(title="classes, rows of tracks", xlabel="label", ylabel="true class")


def _class_roc(axes: Axes, found: ClassifierScores) -> None:
    roc = found.roc
    if roc is None:
        return
    axes.plot(roc.false_alarm_rate, roc.hit_rate, color=_colour(0), lw=1.3, label=f"area {roc.area:.3f}")
    for marker, at, name in (("o", roc.at_bayes, "costs ask for"), ("s", roc.cheapest, "least cost")):
        place = (
            f"{name}: {roc.threshold[at]:.3g}"
            if name == "least cost"
            else f"{name}: {roc.bayes_threshold:.3g}"
        )
        axes.plot(
            roc.false_alarm_rate[at],
            roc.hit_rate[at],
            marker,
            mfc="none",
            ms=9,
            color=_colour(1),
            label=place,
        )
    axes.set(
        title=f"'{roc.positive}' against the others",
        xlabel="false-alarm rate",
        ylabel="hit rate",
        xlim=(-0.02, 1.02),
        ylim=(0, 1.02),
    )
    _legend(axes)


def _by_owner(points: Points) -> list[tuple[int, npt.NDArray[np.int64]]]:
    """The rows of each owner, in order of ping."""
    order = np.argsort(points.owner, kind="stable")
    if not order.size:
        return []
    rows = np.split(order, np.flatnonzero(np.diff(points.owner[order])) + 1)
    return [(int(points.owner[one[0]]), one) for one in rows]


def _legend(axes: Axes) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, loc="best", framealpha=0.7)
