"""How strong the echo of each track's object is, and how well events agree with it."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["STRENGTH_COLUMNS", "agreeing", "begun_strength", "learned", "strengths"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

# Columns of the table (n, STRENGTH_COLUMNS) that goes with the tracks.
LEVEL, EVENTS = 0, 1  # mean of ln(amplitude); of how many events, 0: not known
STRENGTH_COLUMNS = 2

MEMORY_S = 5.0  # a swimmer who turns changes its echo within some seconds
BROAD = 0.3  # density of ln(amplitude) of false events: evenly over a factor of 28
ANY = 0.1  # share of an object's events whose strength tells nothing: hidden, joined with others


def strengths(amplitude: FloatArray) -> FloatArray:
    """ln(amplitude) (m,), nan where it is not positive and finite."""
    known = np.isfinite(amplitude) & (amplitude > 0.0)
    return np.where(known, np.log(np.where(known, amplitude, 1.0)), np.nan)


def begun_strength(ln_amplitude: FloatArray) -> FloatArray:
    """The table (n, STRENGTH_COLUMNS) of tracks that begin with one event each."""
    known = np.isfinite(ln_amplitude)
    return np.stack([np.where(known, ln_amplitude, 0.0), known.astype(float)], axis=1)


@compiled
def agreeing(
    likelihood: FloatArray,
    start: IntArray,
    places: IntArray,
    table: FloatArray,
    ln_amplitude: FloatArray,
    sd: float,
) -> FloatArray:
    """The likelihoods (pairs,) times p(ln a | track) / p(ln a | false), a the amplitude of the event.

    p(ln a | track) is normal about the track's level with `sd`, mixed with a tenth of p(ln a | false), which
    is even. An event or a track of unknown strength keeps its likelihood.

    Source: Lerro & Bar-Shalom 1990, with a learned level in the place of a fluctuation law.
    """
    weighed = likelihood.copy()
    peak = (1.0 - ANY) / (math.sqrt(2.0 * math.pi) * sd * BROAD)
    for t in range(table.shape[0]):
        for e in range(start[t], start[t + 1] if table[t, EVENTS] > 0.0 else 0):
            z = (ln_amplitude[places[e]] - table[t, LEVEL]) / sd
            if math.isfinite(z):
                weighed[e] *= ANY + peak * math.exp(-0.5 * z * z)
    return weighed


@compiled
def learned(
    table: FloatArray,
    start: IntArray,
    places: IntArray,
    beta: FloatArray,
    ln_amplitude: FloatArray,
    dt_s: float,
) -> FloatArray:
    """The table after a ping: levels go to the events' mean by dt / MEMORY_S, faster while there are few."""
    after = table.copy()
    for t in range(table.shape[0]):
        row = after[t]
        total = mean = 0.0
        for e in range(start[t], start[t + 1]):
            a = ln_amplitude[places[e]]
            if math.isfinite(a):
                total += beta[e]
                mean += beta[e] * a
        if total > 0.0:
            row[EVENTS] += total
            share = min(1.0, max(dt_s / MEMORY_S, 1.0 / row[EVENTS]) * total)
            row[LEVEL] += share * (mean / total - row[LEVEL])
    return after
