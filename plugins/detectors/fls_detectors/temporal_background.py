"""The running mean and variance of every cell, and the cells of a ping that rise above them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = ["Rates", "learn", "rayleigh_threshold"]

FloatImage = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

RAYLEIGH_MEAN = math.sqrt(math.pi) / 2.0  # of an amplitude whose mean square is 1
RAYLEIGH_SD = math.sqrt(1.0 - math.pi / 4.0)
HUGE = np.float32(1e18)  # its square is still a float32
BLOCK = 512  # cells between two looks for events


class Rates(NamedTuple):
    """How one ping is judged and learnt from."""

    mean: float
    variance: float
    event_mean: float  # the same in cells that rise above the threshold
    event_variance: float
    threshold: float  # in standard deviations; inf: nothing is an event
    floor: float  # of the standard deviation


def rayleigh_threshold(pfa: float) -> float:
    """The height z, in standard deviations over the mean, that a Rayleigh amplitude exceeds with `pfa`.

    z = (sqrt(-ln pfa) - sqrt(pi)/2) / sqrt(1 - pi/4), for known mean and variance.
    """
    return (math.sqrt(-math.log(pfa)) - RAYLEIGH_MEAN) / RAYLEIGH_SD


def learn(
    amplitude: npt.NDArray[Any],
    valid: npt.NDArray[np.bool_] | None,
    mean: FloatImage,
    variance: FloatImage,
    rates: Rates,
) -> tuple[IntArray, FloatImage]:
    """Indices of the cells with z > threshold, increasing, and the height max(0, X - mean) of all (r, b).

    z = (X - mean) / max(sd, floor) with mean and sd as they were before this ping; then both are updated in
    place: mean += a (X - mean), variance += b ((X - mean)^2 - variance). Cells without data, or beyond any
    sensible number, are no events, have height 0 and are left as they are.
    """
    if valid is not None:
        amplitude = np.where(valid, amplitude, np.float32(np.nan)).astype(np.float32)
    height = np.empty(amplitude.shape, np.float32)
    found = np.empty(amplitude.size if math.isfinite(rates.threshold) else 0, np.int64)
    numbers = np.array(rates, np.float32)
    flat = (frozen(amplitude).reshape(-1), mean.reshape(-1), variance.reshape(-1))
    n = _learn(*flat, frozen(numbers), height.reshape(-1), found)
    return found[:n].copy(), height


@compiled
def _learn(
    amplitude: npt.NDArray[Any],
    mean: FloatImage,
    variance: FloatImage,
    rates: FloatImage,
    height: FloatImage,
    found: IntArray,
) -> int:
    a, b, event_a, event_b, threshold, floor = rates[0], rates[1], rates[2], rates[3], rates[4], rates[5]
    square, least, zero = threshold * threshold, floor * floor, np.float32(0.0)
    event = np.empty(BLOCK, np.uint8)
    n = 0
    for first in range(0, amplitude.size, BLOCK):
        last = min(first + BLOCK, amplitude.size)
        X, mu, var, rise = amplitude[first:last], mean[first:last], variance[first:last], height[first:last]
        hits = 0
        for i in range(X.size):  # without branches, so that it becomes vector instructions
            x = np.float32(X[i])
            known = abs(x) < HUGE  # neither nan nor infinite
            d = x - mu[i] if known else zero
            v = var[i]
            high = (d > zero) & (d * d > square * max(v, least))
            rise[i] = max(d, zero)
            mu[i] += (event_a if high else a) * d
            step = (event_b if high else b) * (d * d - v)
            var[i] = v + (step if known else zero)
            event[i] = high
            hits += high
        if hits > 0 and found.size > 0:
            for i in range(X.size):
                if event[i]:
                    found[n] = first + i
                    n += 1
    return n
