"""Label tracks by quadratic discriminants."""

from __future__ import annotations

from dataclasses import dataclass

from fls_classifiers.gaussian import GaussianClassifier
from fls_flow import hookimpl
from fls_flow.discriminants import Quadratic, quadratic
from fls_flow.model_files import Model

__all__ = ["QuadraticDiscriminant"]


@dataclass
class QuadraticDiscriminant(GaussianClassifier):
    """A label for each track, by what a mistake would cost, and the posterior of each class.

    The classes are Gaussian, each with a covariance of its own, and P(class i | x) is proportional to
    exp g_i(x) of `fls_flow.discriminants.Quadratic`. Parameters, labels and the model file are those of
    `linear-discriminant`. Source: Brinkmann 2010, (3.67) with ln|Sigma_i|.

    Raises InputError for a file that holds no model, and at the first features that are not the model's.
    """

    def _of(self, model: Model) -> Quadratic:
        return quadratic(model.gaussians, model.ridge)


@hookimpl
def fls_node() -> type[QuadraticDiscriminant]:
    """Return the node of kind `quadratic-discriminant`."""
    return QuadraticDiscriminant
