"""How likely each number of targets is, and the weights of a cardinalised PHD filter."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["cardinality_predicted", "cardinality_updated", "elementary_symmetric"]

FloatArray = npt.NDArray[np.float64]


def cardinality_predicted(p: FloatArray, survival: float, born: float) -> FloatArray:
    """P(n targets), n = 0 ... N, after each survived with `survival` and a Poisson number, mean `born`, came.

    Numbers beyond N are counted as N. Source: Vo, Vo & Cantoni 2007 (13).
    """
    whole: FloatArray = _predicted(p, survival, born)
    return whole


@compiled
def _predicted(p: FloatArray, survival: float, born: float) -> FloatArray:
    n = p.size
    stay, out = np.zeros(n), np.zeros(n)
    row = np.zeros(n)  # binomial probabilities of those that stay, out of `before`
    row[0] = 1.0
    for before in range(n):
        if before:
            for k in range(before, 0, -1):
                row[k] = row[k] * (1.0 - survival) + row[k - 1] * survival
            row[0] *= 1.0 - survival
        for k in range(before + 1):
            stay[k] += row[k] * p[before]
    arrive = math.exp(-born)
    for new in range(n):
        for k in range(n):
            out[min(k + new, n - 1)] += stay[k] * arrive
        arrive *= born / (new + 1)
    whole: FloatArray = out / out.sum()
    return whole


def cardinality_updated(
    p: FloatArray, ratio: FloatArray, detected: float, mass: float
) -> tuple[FloatArray, float, FloatArray]:
    """P(n) after a ping, the factor on missed components, and the factors on each measurement's pairs (m,).

    `ratio` is C_i / kappa_i of each measurement, `mass` the predicted mass and `detected` its part pD D. With
    Poisson clutter and e_j the elementary symmetric functions of the ratios,
    Y_u(n) = sum_j n! / (n - j - u)! (mass - detected)^(n - j - u) / mass^n e_j;
    p' = Y_0 p / <Y_0, p>, the missed factor is <Y_1, p> / <Y_0, p>, that of measurement i the same with
    Y_1 from all ratios but the i-th.

    Source: Vo, Vo & Cantoni 2007 (14)-(20), with Poisson clutter.
    """
    updated: tuple[FloatArray, float, FloatArray] = _updated(p, ratio, detected, mass)
    return updated


@compiled
def _updated(
    p: FloatArray, ratio: FloatArray, detected: float, mass: float
) -> tuple[FloatArray, float, FloatArray]:
    most = p.size - 1
    missed = math.log(max(mass - detected, 1e-300) / mass)
    # scaled, so that neither many nor large ratios overflow
    scale = max(ratio.sum() / max(most, 1), 1e-300)
    scaled, step = ratio / scale, math.log(scale / mass)
    e = np.log(elementary_symmetric(scaled, most, -1))
    prior = np.log(p)
    zero = prior + _log_upsilon(e, most, 0, missed, step)
    total = _log_sum(zero)
    one = prior + _log_upsilon(e, most, 1, missed, step)
    each = np.empty(ratio.size)
    for i in range(ratio.size):
        others = np.log(elementary_symmetric(scaled, most, i))
        without = prior + _log_upsilon(others, most, 1, missed, step)
        each[i] = math.exp(_log_sum(without) - total) / mass
    return np.exp(zero - total), math.exp(_log_sum(one) - total) / mass, each


@compiled
def _log_upsilon(e: FloatArray, most: int, u: int, missed: float, step: float) -> FloatArray:
    """log of Y_u(n) mass^u, n = 0 ... most, from log e_j of the scaled ratios."""
    out = np.full(most + 1, -np.inf)
    terms = np.empty(e.size)
    for n in range(u, most + 1):
        k = min(e.size - 1, n - u) + 1
        for j in range(k):
            falling = math.lgamma(n + 1.0) - math.lgamma(n - j - u + 1.0)
            terms[j] = falling + (n - j - u) * missed + j * step + e[j]
        out[n] = _log_sum(terms[:k])
    return out


@compiled
def _log_sum(logs: FloatArray) -> float:
    largest = logs.max()
    if largest == -np.inf:
        return float(largest)
    return float(largest + math.log(np.exp(logs - largest).sum()))


@compiled
def elementary_symmetric(values: FloatArray, most: int, without: int) -> FloatArray:
    """e_0 ... e_k of the values (m,) but the one at `without` (-1: all), k = min(most, their number)."""
    m = values.size - (1 if without >= 0 else 0)
    e = np.zeros(min(m, most) + 1)
    e[0] = 1.0
    for i in range(values.size):
        if i == without:
            continue
        for j in range(e.size - 1, 0, -1):
            e[j] += values[i] * e[j - 1]
    return e
