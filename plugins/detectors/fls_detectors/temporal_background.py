"""The running mean and variance of every cell, and the cells of a ping that rise above them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = ["Latecomers", "Rates", "learn", "rayleigh_threshold"]

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


def _no_cells() -> IntArray:
    return np.zeros(0, np.int64)


@dataclass
class Latecomers:
    """Cells that had no data at the first ping: each has a warm-up of its own when its data begin.

    `cells` are their flat indices, `pings` how many with data each has seen.
    """

    cells: IntArray = field(default_factory=_no_cells)
    pings: IntArray = field(default_factory=_no_cells)

    @classmethod
    def of(cls, amplitude: npt.NDArray[Any], valid: npt.NDArray[np.bool_] | None) -> Latecomers:
        """Those of the first ping."""
        cells = np.flatnonzero(~_known(amplitude, valid))
        return cls(cells, np.zeros(cells.size, np.int64))

    def learn(
        self,
        amplitude: npt.NDArray[Any],
        valid: npt.NDArray[np.bool_] | None,
        before: tuple[FloatImage, FloatImage],
        after: tuple[FloatImage, FloatImage],
        rates: tuple[float, float],
        warm_up_pings: int,
    ) -> IntArray:
        """Write what they know after a ping; gives those that cannot be judged yet.

        `before` are their means and variances before the ping, `after` the images of both, to be mended:
        they learn by max(rate, 1 / (k + 1)) at their own k.
        """
        young, flat = self.cells, amplitude.reshape(-1)[self.cells].astype(np.float32)
        known = _known(flat, None if valid is None else valid.reshape(-1)[young])
        mean, variance = before
        ramp = 1.0 / (self.pings + 1.0)
        d = np.where(known & (self.pings > 0), flat - mean, np.float32(0.0))
        mean = np.where(known & (self.pings == 0), flat, mean) + np.maximum(rates[0], ramp) * d
        variance = variance + np.maximum(rates[1], ramp) * np.where(known, d * d - variance, 0.0)
        after[0].reshape(-1)[young], after[1].reshape(-1)[young] = mean, variance
        self.pings = self.pings + known
        still = self.pings < warm_up_pings
        self.cells, self.pings = young[still], self.pings[still]
        return young


def _known(amplitude: npt.NDArray[Any], valid: npt.NDArray[np.bool_] | None) -> npt.NDArray[np.bool_]:
    """Where there is a sensible number."""
    known = np.abs(amplitude.astype(np.float32)) < HUGE
    return known if valid is None else known & valid


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
