"""From labelled vectors to the model that a file holds."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from fls_flow.discriminants import Scaling, linear, quadratic
from fls_flow.errors import UserError
from fls_flow.model_files import ClassModel, FeatureModel, Model
from fls_flow.tools.train_ranking import Judge, Rule
from fls_flow.tools.train_samples import Samples
from fls_flow.tools.train_scores import Sides

__all__ = ["Settings", "judge_of", "model_of", "positive_of", "unit_of"]

Discriminant = Literal["linear", "quadratic"]
RULES: dict[str, Rule] = {"linear": linear, "quadratic": quadratic}
SQUARED = (".variance", ".rate_variance")


@dataclass(frozen=True)
class Settings:
    """How to train; raises ValueError for what is out of range."""

    train_share: float = 0.5
    seed: int = 0
    features: int | None = None  # how many; None: what cross-validation finds best
    ridge: float = 1e-6  # added to variances of standardised features
    repeats: int = 100  # random splits that the ranking of single features is averaged over
    folds: int = 5
    positive: str | None = None
    miss_cost: float = 1.0
    false_alarm_cost: float = 1.0
    equal_priors: bool = False
    against_rest: bool = False  # count mistakes between the positive class and all others alone
    log: bool = False  # take logarithms of features that are less skew so
    discriminant: Discriminant = "linear"  # that features are chosen for

    def __post_init__(self) -> None:
        for name, value, good in (
            ("train_share", self.train_share, 0.0 < self.train_share < 1.0),
            ("seed", self.seed, self.seed >= 0),
            ("features", self.features, self.features is None or self.features >= 1),
            ("ridge", self.ridge, 0.0 <= self.ridge < np.inf),
            ("repeats", self.repeats, self.repeats >= 1),
            ("folds", self.folds, self.folds >= 2),
            ("miss_cost", self.miss_cost, 0.0 < self.miss_cost < np.inf),
            ("discriminant", self.discriminant, self.discriminant in RULES),
            ("false_alarm_cost", self.false_alarm_cost, 0.0 < self.false_alarm_cost < np.inf),
        ):
            if not good:
                raise ValueError(f"{name} is {value}: out of range")


def positive_of(classes: Sequence[str], settings: Settings) -> str:
    """The class whose miss has a cost of its own; raises UserError when it is none of the classes."""
    positive = settings.positive
    if positive is None:
        positive = "diver" if "diver" in classes else classes[0]
    if positive not in classes:
        raise UserError(f"--positive {positive}: is no class; there are {', '.join(classes)}")
    return positive


def judge_of(classes: Sequence[str], settings: Settings) -> Judge:
    """What errors are counted with, and between what."""
    positive = positive_of(classes, settings)
    sides = Sides.against_rest(classes, positive) if settings.against_rest else Sides.each(classes)
    return Judge(sides, RULES[settings.discriminant], settings.ridge, settings.equal_priors)


def model_of(
    learned: Samples,
    columns: Sequence[int],
    scaling: Scaling,
    settings: Settings,
    provenance: Mapping[str, Any],
) -> Model:
    """The model of these features."""
    found = judge_of(learned.classes, settings).fit(replace(learned, values=learned.values[:, list(columns)]))
    counts = learned.counts
    return Model(
        features=tuple(
            FeatureModel(
                name=learned.features[one],
                unit=unit_of(learned.features[one]),
                log_offset=None if np.isnan(scaling.offset[one]) else float(scaling.offset[one]),
                mean=float(scaling.mean[one]),
                scale=float(scaling.scale[one]),
            )
            for one in columns
        ),
        classes=tuple(
            ClassModel(
                name=name,
                prior=float(found.prior[number]),
                samples=counts[name][0],
                mean=tuple(found.mean[number].tolist()),
                covariance=tuple(tuple(row) for row in found.covariance[number].tolist()),
            )
            for number, name in enumerate(learned.classes)
        ),
        ridge=settings.ridge,
        positive=positive_of(learned.classes, settings),
        miss_cost=settings.miss_cost,
        false_alarm_cost=settings.false_alarm_cost,
        provenance={**provenance, **_learned_from(learned, settings)},
    )


def _learned_from(learned: Samples, settings: Settings) -> dict[str, Any]:
    versions = {name: importlib.metadata.version(name) for name in ("fls-flow", "numpy")}
    return {
        "versions": versions,
        "split": {"by": "track", "seed": settings.seed, "train_share": settings.train_share},
        "selection": {
            "features": settings.features,
            "folds": settings.folds,
            "for": settings.discriminant,
            "against_rest": settings.against_rest,
            "log": settings.log,
        },
        "trained_on": {
            name: {"vectors": vectors, "targets": targets}
            for name, (vectors, targets) in learned.counts.items()
        },
    }


def unit_of(feature: str) -> str:
    """The unit that a feature's name tells: by its ending or as a count of cells; often none."""
    base, _, statistic = feature.partition(".")
    unit = {"area": "cells", "perimeter": "cells", "major_axis": "cells", "minor_axis": "cells"}.get(base, "")
    if base.endswith("_m2"):
        unit = "m^2"
    elif base.endswith("_m"):
        unit = "m"
    elif base.endswith("_mps"):
        unit = "m/s"
    elif base in ("mean", "variance"):
        unit = "amplitude" if base == "mean" else "amplitude^2"
    if not unit:
        return ""
    if f".{statistic}" in SQUARED:
        unit = f"({unit})^2"
    return f"{unit} per ping" if statistic == "mean_rate" else unit
