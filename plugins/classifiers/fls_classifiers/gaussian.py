"""Tracks labelled by Gaussian discriminants that a model file holds."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fls_classifiers.labels import Costs, TrackLabels
from fls_flow import Classes, Features, InputError, Tracks
from fls_flow.discriminants import Scaling
from fls_flow.model_files import Model, load, missing_features

__all__ = ["Discriminants", "GaussianClassifier"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Discriminants(Protocol):
    """One function per class."""

    def scores(self, values: FloatArray) -> FloatArray:
        """(n, c) ln P(x | class) P(class), but for a term that all classes share."""


def _none() -> IntArray:
    return np.zeros(0, np.int64)


@dataclass
class GaussianClassifier:
    """What the classifiers by Gaussian discriminants share: all but how a model becomes discriminants."""

    model: Path
    positive: str | None = None
    miss_cost: float | None = None  # of taking the positive class for another
    false_alarm_cost: float | None = None  # of taking another for the positive class
    memory: float = 0.0
    hold_pings: int = 100
    min_descriptions: int = 1
    handover: float = 0.0
    agreement: int = 1
    _model: Model = field(init=False, repr=False)
    _scaling: Scaling = field(init=False, repr=False)
    _log_prior: FloatArray = field(init=False, repr=False)
    _discriminants: Discriminants = field(init=False, repr=False)
    _costs: Costs = field(init=False, repr=False)
    _labels: TrackLabels = field(init=False, repr=False)
    _names: tuple[str, ...] = field(default=(), init=False, repr=False)  # of the features that come
    _columns: IntArray = field(default_factory=_none, init=False, repr=False)  # those that the model takes

    def __post_init__(self) -> None:
        self._model = load(Path(self.model))
        self._scaling = self._model.scaling
        self._log_prior = np.log(self._model.gaussians.prior)
        try:
            self._discriminants = self._of(self._model)
        except ValueError as error:
            raise InputError(f"{self.model}: {error}") from error
        self._costs = Costs(
            self._model.class_names,
            self._model.positive if self.positive is None else self.positive,
            self._model.miss_cost if self.miss_cost is None else self.miss_cost,
            self._model.false_alarm_cost if self.false_alarm_cost is None else self.false_alarm_cost,
        )
        self._labels = TrackLabels(
            self._model.class_names,
            self._log_prior,
            self.memory,
            self.hold_pings,
            self.min_descriptions,
            self.handover,
            self.agreement,
        )

    def _of(self, model: Model) -> Discriminants:
        """The discriminants of a model; raises ValueError where a covariance is singular."""
        raise NotImplementedError

    def __call__(self, features: Features, tracks: Tracks | None = None) -> Classes:
        """The labels of all tracks that have been described."""
        if features.names and features.names != self._names:
            self._meet(features.names)
        track_id, evidence = features.track_id[:0], np.zeros((0, len(self._model.classes)))
        if len(features):
            values = features.values[:, self._columns]
            known = np.isfinite(values).all(axis=1)
            scores = self._discriminants.scores(self._scaling(values[known]))
            track_id, evidence = features.track_id[known], scores - self._log_prior
        return self._labels.step(features, track_id, evidence, tracks, self._costs)

    def _meet(self, names: tuple[str, ...]) -> None:
        missing = missing_features(self._model.feature_names, names)
        if missing:
            raise InputError(f"{self.model}: {missing}; train a model on these, or rewire the graph")
        self._names = names
        self._columns = np.array([names.index(name) for name in self._model.feature_names])

    def snapshot(self) -> dict[str, Any]:
        """What is known of the tracks."""
        return self._labels.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._labels.restore(snapshot)
