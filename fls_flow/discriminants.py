"""Gaussian discriminants: classes from feature vectors, as `train` fits them and classifiers use them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

__all__ = ["Gaussians", "Linear", "Quadratic", "Scaling", "decide", "fit", "linear", "posterior", "quadratic"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Gaussians:
    """What is known of c classes in p features."""

    prior: FloatArray  # (c,)
    mean: FloatArray  # (c, p)
    covariance: FloatArray  # (c, p, p), maximum likelihood: sums over n


@dataclass(frozen=True, eq=False)
class Scaling:
    """What is done to p features before they meet a discriminant."""

    offset: FloatArray  # (p,) x becomes ln(max(x, 0) + offset); nan: x stays as it is
    mean: FloatArray  # (p,)
    scale: FloatArray  # (p,)

    def __call__(self, values: FloatArray) -> FloatArray:
        """Features (n, p) with the mean taken out, over the scale."""
        return np.asarray((_bent(values, self.offset) - self.mean) / self.scale)

    @classmethod
    def of(cls, values: FloatArray, log: bool = False) -> Self:
        """What gives these vectors (n, p) a mean of 0 and a deviation of 1 (or 0, where they are all equal).

        With `log`, features that are never negative become logarithms where that makes them less skew: sizes
        and variances spread by factors, not by sums. The offset is 1 % of the median.
        """
        middle = np.median(values, axis=0)
        offset = np.where((values.min(axis=0) >= 0.0) & (middle > 0.0) & log, 0.01 * middle, np.nan)
        skewer = np.abs(_skewness(_bent(values, offset))) > np.abs(_skewness(values))
        offset = np.where(skewer, np.nan, offset)
        bent = _bent(values, offset)
        spread = bent.std(axis=0)
        return cls(offset, bent.mean(axis=0), np.where(spread > 0.0, spread, 1.0))


def _bent(values: FloatArray, offset: FloatArray) -> FloatArray:
    straight = np.isnan(offset)
    logarithm = np.log(np.maximum(values, 0.0) + np.where(straight, 1.0, offset))
    return np.where(straight, values, logarithm)


def _skewness(values: FloatArray) -> FloatArray:
    e = values - values.mean(axis=0)
    sd = np.sqrt(np.mean(e * e, axis=0))
    return np.asarray(np.mean(e**3, axis=0) / np.where(sd > 0.0, sd, 1.0) ** 3)


@dataclass(frozen=True, eq=False)
class Linear:
    """g_i(x) = w_i' x + w_i0."""

    weight: FloatArray  # (p, c)
    offset: FloatArray  # (c,)

    def scores(self, values: FloatArray) -> FloatArray:
        """(n, c) ln P(x | class) P(class), but for a term that all classes share."""
        return np.asarray(values @ self.weight + self.offset)


@dataclass(frozen=True, eq=False)
class Quadratic:
    """g_i(x) = -(x - mu_i)' Sigma_i^-1 (x - mu_i) / 2 - ln|Sigma_i| / 2 + ln P_i."""

    mean: FloatArray  # (c, p)
    whitening: FloatArray  # (c, p, p) W with W' W = Sigma^-1
    offset: FloatArray  # (c,)

    def scores(self, values: FloatArray) -> FloatArray:
        """(n, c) ln P(x | class) P(class), but for a term that all classes share."""
        e = np.einsum("cij,ncj->nci", self.whitening, values[:, None, :] - self.mean)
        return np.asarray(self.offset - 0.5 * np.sum(e * e, axis=2))


def fit(values: FloatArray, label: IntArray, classes: int) -> Gaussians:
    """Class means, covariances and frequencies of labelled vectors (n, p).

    Raises ValueError for a class without a vector.
    """
    count = np.bincount(label, minlength=classes)
    if count.size > classes or not count.all():
        raise ValueError(f"the {classes} classes have {count.tolist()} vectors; each needs one")
    mean = np.stack([values[label == one].mean(axis=0) for one in range(classes)])
    centred = values - mean[label]
    covariance = np.stack([centred[label == one].T @ centred[label == one] for one in range(classes)])
    return Gaussians(count / count.sum(), mean, covariance / count[:, None, None])


def linear(classes: Gaussians, ridge: float = 0.0) -> Linear:
    """w_i = Sigma^-1 mu_i, w_i0 = -mu_i' Sigma^-1 mu_i / 2 + ln P_i, Sigma = sum P_i Sigma_i + ridge I.

    Equal to scikit-learn's LDA with solver lsqr for ridge 0. Raises ValueError where Sigma is singular.
    Source: Duda, Hart & Stork 2001, 2.6.2; Brinkmann 2010, (3.64)-(3.66).
    """
    pooled = np.einsum("c,cij->ij", classes.prior, classes.covariance)
    inverse = _whitening(pooled, ridge)
    weight = inverse.T @ (inverse @ classes.mean.T)
    offset = np.log(classes.prior) - 0.5 * np.sum(classes.mean.T * weight, axis=0)
    return Linear(weight, offset)


def quadratic(classes: Gaussians, ridge: float = 0.0) -> Quadratic:
    """The discriminants of classes with covariances of their own, each with `ridge` I added.

    Raises ValueError where one is singular. Source: Duda, Hart & Stork 2001, 2.6.3; Brinkmann 2010, (3.67)
    with ln|Sigma_i| where it prints |Sigma_i|.
    """
    whitening = np.stack([_whitening(one, ridge) for one in classes.covariance])
    half_log_det = -np.sum(np.log(np.diagonal(whitening, axis1=1, axis2=2)), axis=1)
    return Quadratic(classes.mean, whitening, np.log(classes.prior) - half_log_det)


def _whitening(covariance: FloatArray, ridge: float) -> FloatArray:
    """W (p, p), lower triangular, with W' W = (covariance + ridge I)^-1."""
    size = len(covariance)
    if not size:
        return np.zeros((0, 0))
    regular = 0.5 * (covariance + covariance.T) + ridge * np.eye(size)
    try:
        lower = np.linalg.cholesky(regular)
    except np.linalg.LinAlgError:
        lower = np.zeros((size, size))
    scale = np.sqrt(np.diagonal(regular))
    if not (np.diagonal(lower) > 1e-7 * scale).all():  # nearly a combination of other features
        raise ValueError(
            f"the covariance of {size} features is singular; take fewer features or more samples, or a ridge"
        )
    return np.asarray(np.linalg.solve(lower, np.eye(size)))


def posterior(scores: FloatArray) -> FloatArray:
    """(n, c) probabilities of the classes, from the logarithms of their joint densities."""
    lifted = np.exp(scores - scores.max(axis=1, initial=-np.inf, keepdims=True))
    return np.asarray(lifted / lifted.sum(axis=1, keepdims=True))


def decide(probability: FloatArray, positive: int, miss_cost: float, false_alarm_cost: float) -> IntArray:
    """(n,) classes by what mistakes cost, from the probabilities (n, c) of all.

    The positive class iff miss_cost P(positive) >= false_alarm_cost (1 - P(positive)), else the most probable
    of the others: mistakes among these cost nothing. Source: Duda, Hart & Stork 2001, 2.2.
    """
    chance = probability[:, positive]
    others = probability.copy()
    others[:, positive] = -1.0
    called = miss_cost * chance >= false_alarm_cost * (1.0 - chance)
    return np.where(called, positive, others.argmax(axis=1)).astype(np.int64)
