"""Label tracks by any classifier of scikit-learn."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_classifiers.labels import Costs, TrackLabels
from fls_flow import Classes, Features, InputError, Tracks, hookimpl
from fls_flow.model_files import missing_features

__all__ = ["SklearnModel"]

FloatArray = npt.NDArray[np.float64]

LEAST = 1e-12  # a forest may give a class no probability at all; its logarithm stays finite


@dataclass
class SklearnModel:
    """A label for each track, by what a mistake would cost, and what a scikit-learn classifier expects.

    `model` is a fitted classifier (or pipeline) with `predict_proba`, written by `skops.io.dump`. Its feature
    names are `feature_names_in_` (scikit-learn keeps them when it is fitted to a table with named columns).
    Only types that skops trusts are loaded, and those that `trusted` names: name none that you have not
    looked at. Pickles are not read. Needs the extra `train`.

    Labels are kept as in `linear-discriminant`; `positive` is the first class where None.

    Raises InputError for a file that holds no such model, and at the first features that are not its own.
    """

    model: Path
    trusted: tuple[str, ...] = ()
    positive: str | None = None
    miss_cost: float = 1.0  # of taking the positive class for another
    false_alarm_cost: float = 1.0  # of taking another for the positive class
    memory: float = 0.0
    hold_pings: int = 100
    min_descriptions: int = 1
    handover: float = 0.0
    agreement: int = 1
    _estimator: Any = field(init=False, repr=False)
    _costs: Costs = field(init=False, repr=False)
    _labels: TrackLabels = field(init=False, repr=False)
    _needed: tuple[str, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._estimator = _loaded(Path(self.model), self.trusted)
        self._needed = tuple(map(str, self._estimator.feature_names_in_))
        classes = tuple(map(str, self._estimator.classes_))
        positive = classes[0] if self.positive is None else self.positive
        self._costs = Costs(classes, positive, self.miss_cost, self.false_alarm_cost)
        self._labels = TrackLabels(
            classes,
            np.zeros(len(classes)),
            self.memory,
            self.hold_pings,
            self.min_descriptions,
            self.handover,
            self.agreement,
        )

    def __call__(self, features: Features, tracks: Tracks | None = None) -> Classes:
        """The labels of all tracks that have been described."""
        missing = missing_features(self._needed, features.names) if features.names else ""
        if missing:
            raise InputError(f"{self.model}: {missing}; train a model on these, or rewire the graph")
        track_id, evidence = features.track_id[:0], np.zeros((0, len(self._costs.classes)))
        if len(features):
            columns = [features.names.index(name) for name in self._needed]
            values = features.values[:, columns]
            known = np.isfinite(values).all(axis=1)
            track_id, evidence = features.track_id[known], self._evidence(values[known])
        return self._labels.step(features, track_id, evidence, tracks, self._costs)

    def _evidence(self, values: FloatArray) -> FloatArray:
        import pandas  # named columns, as some estimators (ColumnTransformer) need them

        if not len(values):
            return np.zeros((0, len(self._costs.classes)))
        table = pandas.DataFrame(values, columns=list(self._needed))
        return np.asarray(np.log(np.maximum(self._estimator.predict_proba(table), LEAST)))

    def snapshot(self) -> dict[str, Any]:
        """What is known of the tracks."""
        return self._labels.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._labels.restore(snapshot)


def _loaded(path: Path, trusted: tuple[str, ...]) -> Any:
    try:
        import skops.io
        from skops.io.exceptions import UntrustedTypesFoundException
    except ImportError as error:
        raise InputError(f"{path}: needs skops; pip install 'fls-flow[train]'") from error
    if not path.is_file():
        raise InputError(f"{path}: no such file; write a fitted classifier with skops.io.dump")
    try:
        estimator = skops.io.load(path, trusted=list(trusted))
    except UntrustedTypesFoundException as error:
        unknown = ", ".join(sorted(set(skops.io.get_untrusted_types(file=path)) - set(trusted)))
        raise InputError(
            f"{path}: holds types that are not trusted: {unknown}; look at them, then name them in trusted"
        ) from error
    except Exception as error:  # a file that is no skops archive fails in many ways
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(f"{path}: is no model of skops ({reason}); write it with skops.io.dump") from error
    for name in ("predict_proba", "classes_", "feature_names_in_"):
        if not hasattr(estimator, name):
            raise InputError(
                f"{path}: {type(estimator).__name__} has no {name}; fit a classifier with probabilities to a "
                "table with named columns"
            )
    return estimator


@hookimpl
def fls_node() -> type[SklearnModel]:
    """Return the node of kind `sklearn-model`."""
    return SklearnModel
