"""How well features part the classes: analysis of variance, alone, and joined one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.discriminants import Gaussians, Linear, Quadratic, fit, linear, posterior
from fls_flow.tools.train_samples import Samples
from fls_flow.tools.train_scores import Sides
from fls_flow.tools.train_splits import fold_count, folds, halves

__all__ = ["Forward", "Judge", "Variance", "alone", "anova", "forward"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

Rule = Callable[[Gaussians, float], Linear | Quadratic]

LEAST = 1e-12  # probability whose logarithm is taken


@dataclass(frozen=True, eq=False)
class Judge:
    """What errors are counted with, and between what."""

    sides: Sides
    rule: Rule = linear
    ridge: float = 0.0
    equal_priors: bool = False

    def fit(self, samples: Samples) -> Gaussians:
        """The classes of training vectors, with the priors to take."""
        found = fit(samples.values, samples.label, len(samples.classes))
        if not self.equal_priors:
            return found
        return Gaussians(np.full(found.prior.size, 1.0 / found.prior.size), found.mean, found.covariance)


@dataclass(frozen=True, eq=False)
class Variance:
    """One-way analysis of variance of each feature."""

    f_number: FloatArray  # (p,) variance between the classes over that within them
    probability: FloatArray  # (p,) of a larger one, were the means equal


@dataclass(frozen=True, eq=False)
class Forward:
    """Features in the order in which they help most, and the errors with the first 1, 2, ... of them."""

    order: tuple[int, ...]  # index into the features
    error: FloatArray  # (k,) share of wrong labels in cross-validation
    log_loss: FloatArray  # (k,) mean -ln P(the true class)
    log_loss_sd: FloatArray  # (k,) its standard error, from the scatter between groups
    cross_validated: bool  # False: one group in a class, errors are those on the training vectors

    @property
    def best(self) -> int:
        """How many features give the fewest errors; of equal ones the fewest that are nearly as sure as any.

        That is: with a log loss within a standard error of the least, since where targets part well the first
        feature that makes no error may do so by a hair.
        """
        least = np.flatnonzero(self.error == self.error.min())
        surest = least[int(np.argmin(self.log_loss[least]))]
        sure = self.log_loss[least] <= self.log_loss[surest] + self.log_loss_sd[surest]
        return int(least[int(np.argmax(sure))]) + 1


def anova(samples: Samples) -> Variance:
    """One-way ANOVA between the classes; F is nan for a constant feature. Source: Fisher 1925."""
    from scipy.stats import f_oneway

    f_number = np.full(len(samples.features), np.nan)
    probability = f_number.copy()
    for number in range(len(samples.features)):
        column = samples.values[:, number]
        if np.ptp(column) > 0.0:
            parts = [column[samples.label == one] for one in range(len(samples.classes))]
            with np.errstate(divide="ignore"):  # classes without spread: F is infinite
                f_number[number], probability[number] = f_oneway(*parts)
    return Variance(f_number, probability)


def alone(samples: Samples, judge: Judge, repeats: int, share: float, seed: int) -> FloatArray:
    """(p,) mean held-out error of a discriminant on each feature alone, over random splits by track.

    nan where a class has one group. Source: Brinkmann 2010, 5.2.2.1.
    """
    if fold_count(samples, 2) < 2:
        return np.full(len(samples.features), np.nan)
    rng = np.random.default_rng(seed)
    total = np.zeros(len(samples.features))
    for _ in range(repeats):
        train = np.isin(samples.group, halves([samples], share, rng))
        total += _single_errors(samples.rows(train), samples.rows(~train), judge)
    return total / repeats


def _single_errors(train: Samples, test: Samples, judge: Judge) -> FloatArray:
    """(p,) errors of a discriminant on each feature alone."""
    whole, error = judge.fit(train), np.full(len(train.features), np.nan)
    for number in range(error.size):
        trial = _Trial(whole, test.values, test.label, test.group)
        error[number] = _judged([trial], [number], judge).error
    return np.where(np.isfinite(error), error, np.nan)


def forward(
    samples: Samples,
    judge: Judge,
    *,
    most: int,
    fold_limit: int,
    seed: int,
    told: Callable[[int], None] = lambda done: None,
) -> Forward:
    """Join the feature that gives the fewest errors in cross-validation by track, up to `most` of them.

    Of features that give as many errors, the one with the least log loss joins. `told` hears how many are in.
    Source: Brinkmann 2010, 4.4.3, with errors on other tracks than those that the classifier is fitted to.
    """
    count = fold_count(samples, fold_limit)
    trials = _trials(samples, judge, count, seed)
    order: list[int] = []
    judged: list[_Judged] = []
    left = list(range(len(samples.features)))
    while left and len(order) < most:
        found = [(_judged(trials, [*order, one], judge), one) for one in left]
        best, chosen = min(found, key=lambda one: (one[0].error, one[0].log_loss))
        if not np.isfinite(best.error):
            break  # every further feature is a combination of those that are in
        order.append(chosen)
        left.remove(chosen)
        judged.append(best)
        told(len(order))
    table = np.array(judged).reshape(len(judged), len(_Judged._fields)).T
    return Forward(tuple(order), table[0], table[1], table[2], count > 0)


@dataclass(frozen=True, eq=False)
class _Trial:
    classes: Gaussians
    values: FloatArray
    label: IntArray
    group: IntArray


class _Judged(NamedTuple):
    error: float
    log_loss: float
    log_loss_sd: float


def _trials(samples: Samples, judge: Judge, count: int, seed: int) -> list[_Trial]:
    if not count:
        return [_Trial(judge.fit(samples), samples.values, samples.label, samples.group)]
    fold = folds(samples, count, np.random.default_rng(seed))
    trials = []
    for number in range(count):
        train, test = samples.rows(fold != number), samples.rows(fold == number)
        trials.append(_Trial(judge.fit(train), test.values, test.label, test.group))
    return trials


def _judged(trials: list[_Trial], columns: list[int], judge: Judge) -> _Judged:
    """Errors over all trials; inf where the features are dependent."""
    wrong, loss = [], []
    for trial in trials:
        whole = trial.classes
        part = Gaussians(whole.prior, whole.mean[:, columns], whole.covariance[:, columns][:, :, columns])
        try:
            scores = judge.rule(part, judge.ridge).scores(trial.values[:, columns])
        except ValueError:
            return _Judged(np.inf, np.inf, np.inf)
        chance, side = judge.sides.chance(posterior(scores)), judge.sides.of[trial.label]
        wrong.append(chance.argmax(axis=1) != side)
        loss.append(-np.log(np.maximum(chance[np.arange(side.size), side], LEAST)))
    group = np.concatenate([trial.group for trial in trials])
    log_loss = np.concatenate(loss)
    error = float(np.mean(np.concatenate(wrong)))
    return _Judged(error, float(log_loss.mean()), _mean_sd(log_loss, group))


def _mean_sd(values: FloatArray, group: IntArray) -> float:
    """The standard error of a mean over vectors, those of one group counted as one (sandwich estimate)."""
    _, number = np.unique(group, return_inverse=True)
    sums = np.bincount(number, values - values.mean())
    if sums.size < 2:
        return 0.0
    return float(np.sqrt(sums.size / (sums.size - 1.0) * np.sum(sums**2)) / values.size)
