"""Threshold factors for the mean and spread of logarithms: how far above the mean, in spreads, pfa lies.

In Weibull clutter, of which Rayleigh is one, (y - m) / s has the same distribution whatever scale and shape:
y = ln x is a location plus a scale times the logarithm of an exponential. So the factor depends on the
false-alarm rate and the number of reference cells alone.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import numpy.typing as npt

__all__ = ["FEWEST", "HIGHEST_PFA", "LOWEST_PFA", "known_spread", "log_factors", "places"]

FloatArray = npt.NDArray[np.float64]

FEWEST = 6  # reference cells
LOWEST_PFA, HIGHEST_PFA = 1e-12, 0.1

# Chebyshev coefficients of ln(t / t_inf) / (v + 1), degrees in v = 1 / J (rows) and u = ln(-ln pfa)
# (columns), both stretched to -1 .. 1; benchmarks/log_factors.py finds them
COEFFICIENTS = np.array(
    [
        [8.214126e-01, 9.764981e-01, 3.189904e-01, 6.441688e-02, 9.372213e-03, 1.102042e-03],
        [-4.415037e-02, -4.278176e-02, 1.294758e-03, 9.249216e-03, 2.917743e-03, 1.843423e-04],
        [1.008380e-01, 1.379494e-01, 4.701052e-02, 4.341456e-03, -1.799258e-03, -4.389592e-04],
        [-5.449527e-02, -8.003946e-02, -3.391863e-02, -6.565312e-03, 3.319615e-04, 3.690520e-04],
        [2.909981e-02, 4.391336e-02, 2.045293e-02, 5.107347e-03, 3.077080e-04, -1.546152e-04],
        [-1.493031e-02, -2.302666e-02, -1.120587e-02, -3.061307e-03, -3.165480e-04, 3.473446e-05],
        [6.329544e-03, 9.937384e-03, 4.906157e-03, 1.368907e-03, 1.639453e-04, 2.121744e-06],
        [-3.150505e-03, -4.688641e-03, -2.236939e-03, -5.794828e-04, -6.483183e-05, -1.283658e-05],
    ]
)


def log_factors(
    pfa: float, count: npt.ArrayLike, clutter: Literal["weibull", "lognormal"] = "weibull"
) -> FloatArray:
    """t(J) with P(ln x > m + t s) = pfa, for J = `count` reference cells from `FEWEST` on.

    m and s are mean and standard deviation (J - 1 in the denominator) of the logarithms of J independent
    cells. Log-normal: t = q sqrt(1 + 1/J), q the quantile of Student's t with J - 1 degrees of freedom,
    exactly. Weibull: a polynomial, right to 0.5 % of t for pfa from `LOWEST_PFA` to `HIGHEST_PFA`.

    Source: Goldstein 1973 (the log-t detector); the factors for Weibull clutter are computed, see
    benchmarks/log_factors.py.
    """
    count = np.asarray(count, float)
    if clutter == "lognormal":
        from scipy.special import stdtrit  # slow to load

        quantile: FloatArray = -stdtrit(count - 1.0, pfa) * np.sqrt(1.0 + 1.0 / count)
        return quantile
    v, u = places(np.full(count.shape, pfa), count)
    height = np.polynomial.chebyshev.chebval2d(v, u, COEFFICIENTS) * (v + 1.0)
    found: FloatArray = known_spread(np.full(count.shape, pfa)) * np.exp(height)
    return found


def known_spread(pfa: FloatArray) -> FloatArray:
    """t for ever more reference cells: (ln(-ln pfa) + gamma) sqrt(6) / pi."""
    factor: FloatArray = (np.log(-np.log(pfa)) + np.euler_gamma) * math.sqrt(6.0) / math.pi
    return factor


def places(pfa: FloatArray, count: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where 1 / J and ln(-ln pfa) lie between their ends, -1 to 1."""
    low, high = (math.log(-math.log(end)) for end in (HIGHEST_PFA, LOWEST_PFA))
    return 2.0 * FEWEST / count - 1.0, 2.0 * (np.log(-np.log(pfa)) - low) / (high - low) - 1.0
