"""Pictures of a training: errors over the number of features, the classes in two features, the ROC."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.discriminants import Scaling, posterior
from fls_flow.model_files import Model
from fls_flow.tools.train import Outcome
from fls_flow.tools.train_model import Settings, judge_of
from fls_flow.tools.train_samples import Samples
from fls_flow.tools.train_scores import interval

if TYPE_CHECKING:  # matplotlib is loaded when something is drawn
    from matplotlib.axes import Axes

__all__ = ["pictures"]

FloatArray = npt.NDArray[np.float64]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7b4fc9", "#8a6d00")
LEAST = 1e-15  # probability whose logarithm is taken
GRID = 160  # points along each axis of the density
SHOWN = 1500  # vectors of one class
OUTLIERS = 0.5  # percent at each end that may lie outside the scatter


def pictures(outcome: Outcome, settings: Settings) -> dict[str, bytes]:
    """PNG files of one set of features, by what they show."""
    drawn = {"errors": _png(lambda axes: _errors(axes, outcome))}
    drawn["class_errors"] = _png(lambda axes: _class_errors(axes, outcome))
    if outcome.pair is not None:
        drawn["scatter"] = _png(lambda axes: _scatter(axes, outcome, settings))
    if outcome.roc is not None:
        drawn["roc"] = _png(lambda axes: _roc(axes, outcome))
    return drawn


def _png(draw: Callable[[Axes], None]) -> bytes:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.4), layout="constrained", dpi=110)
    axes = figure.add_subplot()
    axes.grid(alpha=0.25)
    draw(axes)
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def _numbers(axes: Axes, outcome: Outcome) -> FloatArray:
    """The abscissa of all curves, with the number that was chosen."""
    from matplotlib.ticker import MaxNLocator

    chosen = len(outcome.model.features)
    axes.axvline(chosen, color="#9a9a9a", lw=1.0, ls=":", label=f"chosen: {chosen}")
    axes.set_xlabel("number of features")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return np.arange(1, len(outcome.curve) + 1, dtype=float)


def _errors(axes: Axes, outcome: Outcome) -> None:
    n = _numbers(axes, outcome)
    held_out = 100.0 * np.array([one.error for one in outcome.curve])
    low, high = 100.0 * np.array([interval(*one.wrong) for one in outcome.curve]).T
    axes.fill_between(n, low, high, color=COLOURS[0], alpha=0.15, lw=0, label="95 % (independent vectors)")
    axes.plot(n, held_out, "o-", color=COLOURS[0], ms=4, label="held-out targets")
    kind = "cross-validation, by target" if outcome.forward.cross_validated else "training vectors"
    axes.plot(n, 100.0 * outcome.forward.error, "s--", color=COLOURS[1], ms=3, lw=1.0, label=kind)
    axes.set_ylabel("classification error (%)")
    axes.set_ylim(bottom=0.0)
    axes.set_title(f"{outcome.lesson.train.name}: error over the number of features", fontsize=10)
    axes.legend(fontsize=8)


def _class_errors(axes: Axes, outcome: Outcome) -> None:
    n = _numbers(axes, outcome)
    errors = 100.0 * np.stack([one.class_error for one in outcome.curve])
    for number, name in enumerate(outcome.plain.classes):
        axes.plot(n, errors[:, number], "o-", color=COLOURS[number % len(COLOURS)], ms=4, label=name)
    axes.set_ylabel("share of the class with another label (%)")
    axes.set_ylim(bottom=0.0)
    axes.set_title(f"{outcome.lesson.train.name}: error of each class, held-out targets", fontsize=10)
    axes.legend(fontsize=8)


def _scatter(axes: Axes, outcome: Outcome, settings: Settings) -> None:
    """Held-out vectors in the two features that part the classes best, with the decision in them.

    Densities and lines are worked out in scaled features; the axes show the features, or their logarithms
    where the model takes these.
    """
    train, test = outcome.lesson.train, outcome.lesson.test
    columns = list(outcome.pair or ())
    whole = outcome.scaling
    scaling = Scaling(whole.offset[columns], whole.mean[columns], whole.scale[columns])
    names = [train.features[one] for one in columns]
    learned, points = train.columns(names), scaling(test.columns(names).values)
    plane = _plane(points, scaling)
    for number, name in enumerate(test.classes):
        mine = points[test.label == number]
        colour = COLOURS[number % len(COLOURS)]
        every = -(-len(mine) // SHOWN) if len(mine) else 1
        shown = mine[::every] * scaling.scale + scaling.mean
        axes.plot(*shown.T, ".", ms=3.5, alpha=0.5, color=colour, label=f"{name} ({len(mine)})")
        _density(axes, plane, mine, colour)
    _lines(axes, plane, replace(learned, values=scaling(learned.values)), outcome.model, settings)
    axes.set_xlim(plane.x[0], plane.x[-1])
    axes.set_ylim(plane.y[0], plane.y[-1])
    labels = [
        name if np.isnan(one) else f"ln {name}" for name, one in zip(names, scaling.offset, strict=True)
    ]
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    axes.set_title(f"{train.name}: held-out vectors, density, and the decision", fontsize=10)
    axes.legend(fontsize=8)


class _Plane(NamedTuple):
    x: FloatArray  # (GRID,) as the axes show it
    y: FloatArray
    scaled: FloatArray  # (GRID * GRID, 2)


def _plane(points: FloatArray, scaling: Scaling) -> _Plane:
    low, high = np.percentile(points, [OUTLIERS, 100.0 - OUTLIERS], axis=0)
    margin = 0.08 * np.where(high > low, high - low, 1.0)
    axis = [np.linspace(a, b, GRID) for a, b in zip(low - margin, high + margin, strict=True)]
    x, y = (one * scale + mean for one, scale, mean in zip(axis, scaling.scale, scaling.mean, strict=True))
    return _Plane(x, y, np.stack(np.meshgrid(*axis), axis=-1).reshape(-1, 2))


def _contour(axes: Axes, plane: _Plane, level: FloatArray, at: FloatArray, colour: str, style: str) -> None:
    inside = at[(at > level.min()) & (at < level.max())]
    if inside.size:
        picture = level.reshape(GRID, GRID)
        axes.contour(
            plane.x, plane.y, picture, levels=inside, colors=colour, linewidths=1.0, linestyles=style
        )


def _density(axes: Axes, plane: _Plane, points: FloatArray, colour: str) -> None:
    from scipy.stats import gaussian_kde

    if len(points) < 5 or np.linalg.matrix_rank(np.cov(points.T)) < 2:
        return
    level = gaussian_kde(points.T)(plane.scaled.T)
    _contour(axes, plane, level, level.max() * np.array([0.1, 0.4, 0.7]), colour, "-")


def _lines(axes: Axes, plane: _Plane, learned: Samples, model: Model, settings: Settings) -> None:
    """Where the label of a discriminant of these two features alone changes: by chance, and by cost."""
    judge = judge_of(learned.classes, settings)
    try:
        rule = judge.rule(judge.fit(learned), settings.ridge)
    except ValueError:  # one feature is a multiple of the other
        return
    scores = rule.scores(plane.scaled)
    positive = learned.classes.index(model.positive)
    chance = np.clip(posterior(scores)[:, positive], LEAST, 1.0 - LEAST)
    odds = np.log(chance / (1.0 - chance)) + np.log(model.miss_cost / model.false_alarm_cost)
    zero = np.zeros(1)
    for number in range(len(learned.classes)):
        margin = scores[:, number] - np.delete(scores, number, axis=1).max(axis=1)
        _contour(axes, plane, margin, zero, "k", "-")
    _contour(axes, plane, odds, zero, "k", "--")


def _roc(axes: Axes, outcome: Outcome) -> None:
    roc = outcome.roc
    assert roc is not None
    axes.plot(100.0 * roc.false_alarm_rate, 100.0 * roc.hit_rate, "-", color=COLOURS[0], lw=1.5)
    at = roc.at_bayes
    axes.plot(
        100.0 * roc.false_alarm_rate[at], 100.0 * roc.hit_rate[at], "o", color=COLOURS[1],
        label=f"by cost: P({roc.positive}) >= {roc.bayes_threshold:.3g}",
    )  # fmt: skip
    axes.set_xlabel(f"others called {roc.positive} (%)")
    axes.set_ylabel(f"{roc.positive} called so (%)")
    axes.set_title(f"{outcome.lesson.train.name}: ROC on held-out targets, area {roc.area:.4f}", fontsize=10)
    axes.legend(fontsize=8, loc="lower right")
