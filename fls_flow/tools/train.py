"""Train classifiers on the features of tracks, and find out how well they do on other tracks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow.discriminants import Scaling, decide, posterior
from fls_flow.errors import UserError
from fls_flow.evaluate.classifier import Roc, roc_of
from fls_flow.model_files import Model
from fls_flow.tools.train_model import Settings, judge_of, model_of
from fls_flow.tools.train_ranking import Forward, Judge, Variance, alone, anova, forward
from fls_flow.tools.train_samples import Samples
from fls_flow.tools.train_scores import Confusion, confusion
from fls_flow.tools.train_splits import halves

__all__ = ["Lesson", "Outcome", "Settings", "lessons", "train"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

VECTORS_PER_FEATURE = 3  # fewer make a covariance nearly singular


@dataclass(frozen=True, eq=False)
class Lesson:
    """One set of features: what is trained on, and what is held out."""

    train: Samples
    test: Samples
    notes: tuple[str, ...] = ()

    def most_features(self, settings: Settings) -> int:
        """As many as the vectors carry that a covariance is made of; or as many as are asked for."""
        vectors = [n for n, _ in self.train.counts.values()]
        carrying = min(vectors) if settings.discriminant == "quadratic" else sum(vectors)
        most = max(carrying // VECTORS_PER_FEATURE, settings.features or 1)
        return min(most, len(self.train.features))


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one set of features gave."""

    lesson: Lesson
    scaling: Scaling  # of all features
    variance: Variance
    alone: FloatArray  # (p,) held-out error of each feature alone
    forward: Forward
    curve: tuple[Confusion, ...]  # held-out labels with the first 1, 2, ... features of `forward`
    model: Model
    plain: Confusion  # held-out labels of the model, most probable class
    weighted: Confusion  # held-out labels of the model, by cost
    roc: Roc | None

    @property
    def pair(self) -> tuple[int, int] | None:
        """The two features that part the classes best together; None where there are not two."""
        order = self.forward.order
        return (order[0], order[1]) if len(order) > 1 else None


def lessons(
    sets: Mapping[str, Samples], tests: Mapping[str, Samples] | None, settings: Settings
) -> dict[str, Lesson]:
    """What is trained on and what is held out of each set: other runs, or other targets of the same runs.

    Raises UserError where there are no two classes, or one of them is missing on one side.
    """
    if tests is None:
        groups = halves(list(sets.values()), settings.train_share, np.random.default_rng(settings.seed))
        pairs = {
            name: (one.rows(np.isin(one.group, groups)), one.rows(~np.isin(one.group, groups)))
            for name, one in sets.items()
        }
    else:
        absent = sorted(set(sets) - set(tests))
        if absent:
            raise UserError(f"--test: has no table {', '.join(absent)}; it has {', '.join(sorted(tests))}")
        pairs = {name: _alike(one, tests[name]) for name, one in sets.items()}
    return {name: _lesson(*pair) for name, pair in pairs.items()}


def _alike(train: Samples, test: Samples) -> tuple[Samples, Samples]:
    if test.features != train.features:
        raise UserError(f"--test: table {test.name} has other columns than the one to train on")
    strange = sorted(set(test.classes) - set(train.classes))
    if strange:
        raise UserError(f"--test: class {', '.join(strange)} of {test.name} is not in what is trained on")
    return train, test.of_classes(train.classes)


def _lesson(train: Samples, test: Samples) -> Lesson:
    if len(train.classes) < 2:
        raise UserError(f"{train.name}: holds {list(train.classes)}; it takes two classes, see --group")
    for side, samples in (("to train on", train), ("to test with", test)):
        for name, (vectors, _) in samples.counts.items():
            if not vectors:
                raise UserError(f"{train.name}: has no '{name}' {side}; add runs, or take another --seed")
    notes = []
    dropped = [
        name
        for name, spread in zip(train.features, np.ptp(train.values, axis=0), strict=True)
        if not spread > 0.0
    ]
    if dropped:
        notes.append(f"constant, left out: {', '.join(dropped)}")
        kept = [name for name in train.features if name not in dropped]
        train, test = train.columns(kept), test.columns(kept)
    if not train.features:
        raise UserError(f"{train.name}: every feature is constant; nothing can be learned")
    if train.unlabelled:
        notes.append(f"rows that follow no target of known class: {train.unlabelled}")
    if train.broken:
        notes.append(f"rows with a feature that is no number: {train.broken}")
    return Lesson(train, test, tuple(notes))


def train(
    lesson: Lesson,
    settings: Settings,
    provenance: Mapping[str, Any],
    told: Callable[[int], None] = lambda done: None,
) -> Outcome:
    """Rank the features, choose some, fit a model to the training side and judge it on the other.

    Nothing is chosen by what the held-out side shows. Raises UserError for features that depend on each
    other.
    """
    scaling = Scaling.of(lesson.train.values, settings.log)
    learned = replace(lesson.train, values=scaling(lesson.train.values))
    held_out = replace(lesson.test, values=scaling(lesson.test.values))
    judge = judge_of(learned.classes, settings)
    ranking = forward(
        learned,
        judge,
        most=lesson.most_features(settings),
        fold_limit=settings.folds,
        seed=settings.seed,
        told=told,
    )
    if not ranking.order:
        raise UserError(f"{learned.name}: no feature parts the classes; is each class of one value?")
    curve = tuple(
        _confused(judge, held_out, _chance(learned, held_out, ranking.order[: n + 1], judge))
        for n in range(len(ranking.order))
    )
    chosen = ranking.order[: settings.features or ranking.best]
    model = model_of(learned, chosen, scaling, settings, provenance)
    chance = _chance(learned, held_out, chosen, judge)
    positive = judge.sides.names.index(model.positive)
    costs = model.miss_cost, model.false_alarm_cost
    is_positive = judge.sides.of[held_out.label] == positive
    return Outcome(
        lesson,
        scaling,
        anova(learned),
        alone(learned, judge, settings.repeats, settings.train_share, settings.seed),
        ranking,
        curve,
        model,
        _confused(judge, held_out, chance),
        _confused(judge, held_out, chance, decide(chance, positive, *costs)),
        roc_of(model.positive, chance[:, positive], is_positive, *costs),
    )


def _chance(learned: Samples, held_out: Samples, columns: Sequence[int], judge: Judge) -> FloatArray:
    """(n, s) the probabilities that held-out vectors have by a rule of these features."""
    taken = list(columns)
    try:
        rule = judge.rule(judge.fit(replace(learned, values=learned.values[:, taken])), judge.ridge)
    except ValueError as error:
        raise UserError(f"{learned.name}: {error}") from error
    return judge.sides.chance(posterior(rule.scores(held_out.values[:, taken])))


def _confused(judge: Judge, held_out: Samples, chance: FloatArray, said: IntArray | None = None) -> Confusion:
    """Held-out vectors by side and by what is said of them, by default the more probable side."""
    label = chance.argmax(axis=1) if said is None else said
    return confusion(judge.sides.names, judge.sides.of[held_out.label], label, held_out.group)
