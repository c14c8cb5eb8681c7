"""Label tracks by linear discriminants."""

from __future__ import annotations

from dataclasses import dataclass

from fls_classifiers.gaussian import GaussianClassifier
from fls_flow import hookimpl
from fls_flow.discriminants import Linear, linear
from fls_flow.model_files import Model

__all__ = ["LinearDiscriminant"]


@dataclass
class LinearDiscriminant(GaussianClassifier):
    """A label for each track, by what a mistake would cost, and the posterior of each class.

    The classes are Gaussian with one covariance: g_i(x) = w_i' x + w_i0, and P(class i | x) is proportional
    to exp g_i. A track is the positive class iff its odds are at least false_alarm_cost / miss_cost (of two
    classes: iff g, its discriminant less the other's, is at least the logarithm of that), else the most
    probable of the others. Source: Brinkmann 2010, 3.4.2, with the cost that its 5.2.4 asks for.

    A track keeps its label in pings that do not describe it, and has no row before it was described
    `min_descriptions` times.
    With `tracks` wired, labels end with their tracks; without, `hold_pings` pings after the last
    description. `memory` is the share of the earlier evidence (log likelihood) that joins the new one: 0
    takes the newest description alone, 1 all as if they were independent. `handover` is the chance that a
    track has gone over to something else since its last description: then no history outweighs what is
    clearly seen now. With `agreement` n > 1, a track has a row only while its last n descriptions agree:
    after each of them all evidence so far spoke for the same side (the positive class, or the others), and
    so does the newest one alone. Without a row, a track may be anything. `positive`, `miss_cost` and
    `false_alarm_cost` are the model's where None.

    Raises InputError for a file that holds no model, and at the first features that are not the model's.
    """

    def _of(self, model: Model) -> Linear:
        return linear(model.gaussians, model.ridge)


@hookimpl
def fls_node() -> type[LinearDiscriminant]:
    """Return the node of kind `linear-discriminant`."""
    return LinearDiscriminant
