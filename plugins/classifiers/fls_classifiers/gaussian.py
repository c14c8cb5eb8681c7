"""Tracks labelled by Gaussian discriminants that a model file holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fls_classifiers.labels import Costs, TrackLabels
from fls_flow import Classes, Features, InputError, Tracks
from fls_flow.model_files import Model, missing_features

__all__ = ["Discriminants", "GaussianLabels"]

FloatArray = npt.NDArray[np.float64]


class Discriminants(Protocol):
    """One function per class."""

    def scores(self, values: FloatArray) -> FloatArray:
        """(n, c) ln P(x | class) P(class), but for a term that all classes share."""


class GaussianLabels:
    """The labels of tracks by the discriminants of a model."""

    def __init__(
        self,
        path: Path,
        model: Model,
        discriminants: Discriminants,
        costs: tuple[str | None, float | None, float | None],
        memory: float,
        hold_pings: int,
    ) -> None:
        positive, miss, false_alarm = costs
        self._path, self._model, self._discriminants = path, model, discriminants
        self._costs = Costs(
            model.class_names,
            model.positive if positive is None else positive,
            model.miss_cost if miss is None else miss,
            model.false_alarm_cost if false_alarm is None else false_alarm,
        )
        self._scaling = model.scaling
        self._log_prior = np.log(model.gaussians.prior)
        self._labels = TrackLabels(model.class_names, self._log_prior, memory, hold_pings)
        self._names: tuple[str, ...] = ()  # of the features that come
        self._columns = np.zeros(0, np.int64)  # those that the model takes

    def step(self, features: Features, tracks: Tracks | None) -> Classes:
        """The classes of one ping; raises InputError when the features are not those of the model."""
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
            raise InputError(f"{self._path}: {missing}; train a model on these, or rewire the graph")
        self._names = names
        self._columns = np.array([names.index(name) for name in self._model.feature_names])

    def snapshot(self) -> dict[str, Any]:
        """What is known of the tracks."""
        return self._labels.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._labels.restore(snapshot)
