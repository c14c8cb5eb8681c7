"""The file that holds a trained classifier: JSON that `fls-flow train` writes and classifiers read."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, model_validator

from fls_flow.discriminants import Gaussians, Scaling
from fls_flow.errors import InputError

__all__ = ["ClassModel", "FeatureModel", "Model", "load", "missing_features", "save"]

Name = Annotated[str, Field(min_length=1, max_length=200)]
NAMED = 4  # features that an error lists


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class FeatureModel(_Strict):
    """A feature as the model takes it: (value - mean) / scale, or ln(max(value, 0) + log_offset) instead."""

    name: Name
    unit: str
    log_offset: float | None = Field(default=None, gt=0.0)  # None: the value itself
    mean: float
    scale: float = Field(gt=0.0)


class ClassModel(_Strict):
    """A class in standardised features."""

    name: Name
    prior: float = Field(gt=0.0, le=1.0)
    samples: int = Field(ge=0)
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]


class Model(_Strict):
    """Gaussian classes over named features, and what their mistakes cost."""

    format: Literal["fls-flow-classifier"] = "fls-flow-classifier"
    version: Literal[1] = 1
    features: tuple[FeatureModel, ...] = Field(min_length=1)
    classes: tuple[ClassModel, ...] = Field(min_length=2)
    ridge: float = Field(ge=0.0)  # added to the variances of standardised features
    positive: str  # the class whose miss has a cost of its own
    miss_cost: float = Field(gt=0.0)
    false_alarm_cost: float = Field(gt=0.0)
    provenance: dict[str, JsonValue] = {}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        size = len(self.features)
        for one in self.classes:
            if len(one.mean) != size or len(one.covariance) != size:
                raise ValueError(f"class '{one.name}' has not {size} means and rows of covariance")
            if any(len(row) != size for row in one.covariance):
                raise ValueError(f"the covariance of class '{one.name}' is not {size} x {size}")
        _refuse_twice("features", [one.name for one in self.features])
        _refuse_twice("classes", [one.name for one in self.classes])
        if self.positive not in self.class_names:
            raise ValueError(f"positive '{self.positive}' is none of {', '.join(self.class_names)}")
        if not math.isclose(sum(one.prior for one in self.classes), 1.0, rel_tol=1e-6):
            raise ValueError("the priors do not sum to 1")
        return self

    @property
    def feature_names(self) -> tuple[str, ...]:
        """The names of the features, in the order of all vectors here."""
        return tuple(one.name for one in self.features)

    @property
    def class_names(self) -> tuple[str, ...]:
        """The names of the classes."""
        return tuple(one.name for one in self.classes)

    @property
    def gaussians(self) -> Gaussians:
        """The classes as arrays."""
        return Gaussians(
            np.array([one.prior for one in self.classes]),
            np.array([one.mean for one in self.classes]),
            np.array([one.covariance for one in self.classes]),
        )

    @property
    def scaling(self) -> Scaling:
        """What is done to features (n, p), in the order of `feature_names`."""
        offset = [np.nan if one.log_offset is None else one.log_offset for one in self.features]
        return Scaling(
            np.array(offset),
            np.array([one.mean for one in self.features]),
            np.array([one.scale for one in self.features]),
        )


def _refuse_twice(what: str, names: Sequence[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{what} has {', '.join(twice)} twice")


def load(path: Path) -> Model:
    """The model in a file; raises InputError in one line for what is none."""
    try:
        return Model.model_validate_json(path.read_bytes())
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot be read ({reason}); `fls-flow train` makes a model") from error
    except ValidationError as error:
        raise InputError(f"{path}: is no model: {_first(error)}; `fls-flow train` makes one") from error


def _first(error: ValidationError) -> str:
    one = error.errors(include_url=False)[0]
    place = ".".join(map(str, one["loc"]))
    return f"{place}: {one['msg']}" if place else str(one["msg"])


def save(path: Path, model: Model) -> None:
    """Write a model, the same one with the same bytes; raises InputError when the file is there already."""
    document: dict[str, Any] = model.model_dump(mode="json")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(json.dumps(document, indent=1, allow_nan=False) + "\n")
    except FileExistsError as error:
        raise InputError(f"{path}: exists already; choose another path, or move it away") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


def missing_features(needed: Sequence[str], given: Sequence[str]) -> str:
    """What a model needs and its input lacks, in words; empty when nothing is missing."""
    missing = [name for name in needed if name not in given]
    if not missing:
        return ""
    return f"the model needs {_listed(missing)}; the features that come are {_listed(given) or 'none'}"


def _listed(names: Sequence[str]) -> str:
    rest = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + rest
