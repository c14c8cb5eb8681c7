"""Label tracks by quadratic discriminants."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fls_classifiers.gaussian import GaussianLabels
from fls_flow import Classes, Features, InputError, Tracks, hookimpl
from fls_flow.discriminants import quadratic
from fls_flow.model_files import load

__all__ = ["QuadraticDiscriminant"]


@dataclass
class QuadraticDiscriminant:
    """A label for each track, by what a mistake would cost, and the posterior of each class.

    The classes are Gaussian, each with a covariance of its own, and P(class i | x) is proportional to
    exp g_i(x) of `fls_flow.discriminants.Quadratic`. Label and costs are those of `linear-discriminant`, and
    so is the model file. Source: Brinkmann 2010, (3.67) with ln|Sigma_i|.

    A track keeps its label in pings that do not describe it, and has no row before it was described once.
    With `tracks` wired, labels end with their tracks; without, `hold_pings` pings after the last
    description. `memory` is the share of the earlier evidence (log likelihood) that joins the new one: 0
    takes the newest description alone, 1 all as if they were independent. `positive`, `miss_cost` and
    `false_alarm_cost` are the model's where None.

    Raises InputError for a file that holds no model, and at the first features that are not the model's.
    """

    model: Path
    positive: str | None = None
    miss_cost: float | None = None  # of taking the positive class for another
    false_alarm_cost: float | None = None  # of taking another for the positive class
    memory: float = 0.0
    hold_pings: int = 100
    _labels: GaussianLabels = field(init=False, repr=False)

    def __post_init__(self) -> None:
        model = load(Path(self.model))
        try:
            discriminants = quadratic(model.gaussians, model.ridge)
        except ValueError as error:
            raise InputError(f"{self.model}: {error}") from error
        costs = self.positive, self.miss_cost, self.false_alarm_cost
        self._labels = GaussianLabels(self.model, model, discriminants, costs, self.memory, self.hold_pings)

    def __call__(self, features: Features, tracks: Tracks | None = None) -> Classes:
        """The labels of all tracks that have been described."""
        return self._labels.step(features, tracks)

    def snapshot(self) -> dict[str, Any]:
        """What is known of the tracks."""
        return self._labels.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._labels.restore(snapshot)


@hookimpl
def fls_node() -> type[QuadraticDiscriminant]:
    """Return the node of kind `quadratic-discriminant`."""
    return QuadraticDiscriminant
