"""The coefficients of `fls_detectors.log_factors` and how well they fit, from a conditional Monte Carlo.

    python -m benchmarks.log_factors [--samples 30000]

For ln of exponentials, y_j, and another one y with distribution function 1 - exp(-e^y), the probability of
y > m + t s depends on t and J alone. Given the configuration u_j = (y_j - m) / s it is a ratio of integrals
over ln s, since the integral over m is one of a gamma function:

    P(t | u) = int s^(J-1) (sum e^(s u_j) + e^(t s))^-J dln s / int s^(J-1) (sum e^(s u_j))^-J dln s

Its mean over sampled configurations converges: some ten thousand give probabilities of 1e-12 to a few %.
Printed are Chebyshev coefficients of ln(t / t_inf) / (v + 1), t_inf = (ln(-ln pfa) + gamma) sqrt(6) / pi.
Takes some five minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.special import logsumexp

from fls_detectors.log_factors import FEWEST, HIGHEST_PFA, LOWEST_PFA, known_spread, places

FloatArray = npt.NDArray[np.float64]

COUNTS = (4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 20, 24, 32, 40, 48, 64, 96, 128, 192, 256)
RATES = (0.3, 0.2, 0.1, 0.05, 0.02, 1e-2, 3e-3, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
DEGREES = (7, 5)  # in 1 / J, in ln(-ln pfa)
NODES = 110


def log_tail(count: int, samples: int, seed: int = 100) -> Callable[[float], float]:
    """ln P(y > m + t s) as a function of t."""
    rng = np.random.default_rng(seed)
    y = np.log(rng.exponential(size=(samples, count)))
    u = (y - y.mean(1, keepdims=True)) / y.std(1, ddof=1, keepdims=True)
    low = 0.25 - 45.0 / (count - 1) - 3.0 / np.sqrt(count)
    log_s = np.linspace(low, 0.25 + min(2.35, 12.0 / np.sqrt(count)), NODES)
    s = np.exp(log_s)
    power = np.empty((samples, NODES))
    for node, value in enumerate(s):
        power[:, node] = logsumexp(value * u, axis=1)
    weight = (count - 1) * log_s
    below = logsumexp(weight - count * power, axis=1)

    def found(t: float) -> float:
        above = logsumexp(weight - count * np.logaddexp(power, t * s), axis=1)
        return float(logsumexp(above - below) - np.log(samples))

    return found


def table(samples: int) -> FloatArray:
    """ln t (count, rate) for all counts and rates."""
    found = np.zeros((len(COUNTS), len(RATES)))
    for row, count in enumerate(COUNTS):
        tail = log_tail(count, samples)
        low = -4.0
        for column, pfa in enumerate(RATES):
            high = low + 0.5
            while tail(np.exp(high)) > np.log(pfa):
                low, high = high, high + 0.5
            low = brentq(lambda x, p=pfa, tail=tail: tail(np.exp(x)) - np.log(p), low, high, xtol=1e-4)
            found[row, column] = low
    return found


def main() -> None:
    """Print the coefficients, and the largest error of the fit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--samples", type=int, default=30_000)
    log_t = table(parser.parse_args().samples)
    count, rate = np.meshgrid(np.array(COUNTS, float), np.array(RATES), indexing="ij")
    used = (count >= FEWEST) & (rate <= HIGHEST_PFA) & (rate >= LOWEST_PFA)
    v, u = places(rate[used], count[used])
    height = log_t[used] - np.log(known_spread(rate[used]))
    basis = np.polynomial.chebyshev.chebvander2d(v, u, list(DEGREES)) * (v + 1.0)[:, None]
    coefficients, *_ = np.linalg.lstsq(basis, height, rcond=None)
    print(np.array2string(coefficients.reshape(DEGREES[0] + 1, -1), precision=6, separator=", "))
    print(f"largest error of ln t: {np.abs(basis @ coefficients - height).max():.2g}")


if __name__ == "__main__":
    main()
