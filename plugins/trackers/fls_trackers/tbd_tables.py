"""Likelihood ratios by power, for clutter as it is: of any level, and persistent from ping to ping."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_trackers.tbd_ratio import (
    LARGEST,
    NEW_STEPS,
    NO_PLANE,
    OLD_STEPS,
    STEADY,
    STEPS,
    Plane,
    encoded,
    ratio_table,
)

__all__ = ["Tables", "excess_table", "tables_of"]

FloatArray = npt.NDArray[np.float64]

LARGEST_OLD = 12  # power of the last ping at which the table ends
PHASES = (np.arange(8) + 0.5) * math.pi / 8.0  # between target and clutter: not known
STRONGEST_DB = 15  # up to which the ratios of a track follow its own echoes
LOBE_GAIN = 20.0  # bound of a track's log ratios: at max_gain, the lobes of a strong echo would be alike


class Tables(NamedTuple):
    """Ratios by power, for clutter as it is."""

    references: float
    correlation: float
    weakest: Plane  # for a target of `snr_db`
    levels: Plane  # a row per decibel of target, from 1 on; all alike in clutter that persists
    decoded: Plane  # (n_levels, 256) the same by the codes of a ping, bounded as they are
    expected: Plane  # what a ping is worth after the last one; empty without correlation


def tables_of(snr_db: float, references: float, max_gain: float, correlation: float) -> Tables:
    """All tables for clutter whose mean is estimated from `references` cells, of a correlation of powers."""
    snr = 10.0 ** (snr_db / 10.0)
    weakest = ratio_table(snr, references, max_gain)
    levels = 10.0 ** (np.arange(1, STRONGEST_DB + 1) / 10.0)
    levels[0] = min(levels[0], snr)
    if correlation > 0.0:  # what is expected is made up for that strength: others would be too sure of lobes
        levels[:] = snr
    rows = np.stack([ratio_table(float(one), references, LOBE_GAIN) for one in levels])
    expected = excess_table(weakest, snr, references, correlation) if correlation > 0.0 else NO_PLANE
    return Tables(references, correlation, weakest, rows, _decoded(weakest, rows, max_gain), expected)


def _decoded(weakest: Plane, rows: Plane, max_gain: float) -> Plane:
    """Ratios (n_levels, 256) of all levels by a power's code in `weakest`, at most exp(max_gain)."""
    code, _ = encoded(weakest)
    codes, first = np.unique(code, return_index=True)
    last = np.append(first[1:], first[-1] + 1) - 1
    place = np.interp(np.arange(256), codes, 0.5 * (first + last))
    logs = [np.interp(place, np.arange(row.size), np.log(row.astype(float))) for row in rows]
    decoded: Plane = np.exp(np.minimum(logs, max_gain)).astype(np.float32)
    return decoded


def excess_table(table: Plane, snr: float, references: float, correlation: float) -> Plane:
    """Powers u whose ratio in `table` is that of a power z after one of z': (OLD_STEPS .., NEW_STEPS ..).

    Of jointly Gaussian clutter with the correlation rho^2 of powers, the amplitude of a cell is rho times its
    last one plus new clutter of power 1 - rho^2. So without a target z is Rician about rho^2 z', and with one
    about |rho sqrt(z') + sqrt(snr) exp(i phi)|^2, phi even; the ratio is that of both densities, with the
    mixture of `ratio_table`. A quiet cell stays quiet: there a target stands out by up to 1 / (1 - rho^2).

    Source: conditional density of a Gauss-Markov sequence; Rice 1945 for its modulus.
    """
    old = np.arange(OLD_STEPS * LARGEST_OLD + 1)[:, None] / OLD_STEPS
    root = np.linspace(0.0, math.sqrt(LARGEST), 129)  # even in amplitude: densities are smooth there
    new = references * np.log1p(root**2 / references)
    kept, var = correlation * references * np.log1p(old / references), 1.0 - correlation
    clutter = _log_rice(new, kept, var)
    places = [kept + snr + 2.0 * np.sqrt(kept * snr) * math.cos(phase) for phase in PHASES]
    steady = np.mean([np.exp(_log_rice(new, one, var) - clutter) for one in places], axis=0)
    ratio = STEADY * steady + (1.0 - STEADY) * np.exp(_log_rice(new, kept, var + snr) - clutter)
    even = np.arange(NEW_STEPS * LARGEST + 1) / NEW_STEPS
    known = np.log(table[: int(np.argmax(table == table[-1])) + 1])
    wanted = np.stack([np.interp(even, root**2, row) for row in np.log(ratio)])
    excess = np.interp(wanted, known, np.arange(known.size) / STEPS)
    beyond = wanted >= known[-1]  # the table does not tell these apart
    excess[beyond] = np.maximum(excess, even / (var + correlation * old))[beyond]
    found: Plane = excess.astype(np.float32)
    return found


def _log_rice(power: FloatArray, centre: FloatArray, variance: float) -> FloatArray:
    """ln of the density of |a|^2, a complex Gaussian of `variance` about a mean of power `centre`."""
    x = 2.0 * np.sqrt(power * centre) / variance
    near = np.minimum(x, 30.0)
    far = np.maximum(x, 30.0)
    bessel = np.where(
        x < 30.0, np.log(np.i0(near)) - near, np.log1p(0.125 / far) - 0.5 * np.log(2.0 * math.pi * far)
    )
    density: FloatArray = bessel - (np.sqrt(power) - np.sqrt(centre)) ** 2 / variance - math.log(variance)
    return density
