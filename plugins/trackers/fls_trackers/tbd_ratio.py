"""How much more probable a target makes each cell of a ping than clutter alone."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = [
    "STEPS",
    "Codes",
    "RatioMap",
    "candidates",
    "encoded",
    "power_correlation",
    "ratio_map",
    "ratio_table",
]

FloatArray = npt.NDArray[np.float64]
Plane = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Codes = npt.NDArray[np.uint8]

STEPS = 32  # entries of the table per unit of normalised power
LARGEST = 64  # normalised power beyond which the table is flat
STEADY = 0.7  # weight of a steady echo; the rest is that of a fluctuating one
OLD_STEPS, NEW_STEPS = (
    8,
    8,
)  # entries of what is expected, per unit of the last ping's power and of this one's
LEAST_TOTAL = 1e-300  # power that is not divided by
ENOUGH = 200_000  # cells for a correlation
ALL_VALID: BoolArray = np.zeros((0, 0), bool)
NO_PLANE: Plane = np.zeros((0, 0), np.float32)


class RatioMap(NamedTuple):
    """A ping as likelihood ratios."""

    power: Plane  # (n_ranges, n_beams) z, over the mean of the clutter around; 1 where nothing is known
    excess: Plane  # (n_ranges, n_beams) u, over what the last ping lets expect; 1 where nothing is known
    code: Codes  # (n_ranges, n_beams) rows of `decoded`, so that many pings can be remembered
    decoded: Plane  # (256,) ratios of target plus clutter against clutter, even in their logarithms

    @property
    def ratio(self) -> Plane:
        """The ratios (n_ranges, n_beams), 1 where nothing is known."""
        return self.decoded[self.code]


def ratio_table(snr: float, references: float, max_gain: float) -> Plane:
    """Likelihood ratios of normalised powers u = 0, 1 / STEPS, .. LARGEST, at most exp(max_gain).

    With the clutter's mean estimated from J cells, J ln(1 + u / J) is exponential, and of it the ratio is a
    mixture of exp(-s) I0(2 sqrt(s u)) for a steady target of power s = `snr` and of
    exp(u s / (1 + s)) / (1 + s) for a fluctuating one; its mean over clutter is 1, less what the bound takes.

    Source: densities of Rice and Rayleigh amplitudes.
    """
    u = np.arange(LARGEST * STEPS + 1) / STEPS
    u = references * np.log1p(u / references)
    table = STEADY * np.exp(-snr) * np.i0(2.0 * np.sqrt(snr * u))
    table += (1.0 - STEADY) * np.exp(u * snr / (1.0 + snr)) / (1.0 + snr)
    bounded: Plane = np.minimum(table, math.exp(max_gain)).astype(np.float32)
    return bounded


def encoded(table: Plane) -> tuple[Codes, Plane]:
    """The codes of a table's ratios, and the ratio of each code (256,); one of them is exactly 1."""
    low, high = min(math.log(float(table.min())), 0.0), max(math.log(float(table.max())), 0.0)
    step = max(high - low, 1e-6) / 254.0
    one = math.ceil(-low / step)
    code = np.clip(np.rint(np.log(table) / step) + one, 0, 255).astype(np.uint8)
    decoded: Plane = np.exp((np.arange(256) - one) * step).astype(np.float32)
    return code, decoded


def ratio_map(
    amplitude: npt.NDArray[Any],
    valid: BoolArray | None,
    previous: Plane,
    expected: Plane,
    guard: int,
    reach: int,
    table: Plane,
) -> RatioMap:
    """The likelihood ratios of a ping (n_ranges, n_beams) whose clutter may persist from ping to ping.

    z is the power over the mean of `reach` cells before and behind a guard in the same beam, and u = z, or
    what the table `expected` makes of z and of the `previous` ping's z in the cell (empty: not known). Cells
    without data have ratio 1.
    """
    coded, decoded = encoded(table)
    power, excess, code = _ratio_map(
        frozen(amplitude),
        frozen(ALL_VALID if valid is None else valid),
        frozen(previous if expected.size else NO_PLANE),
        frozen(expected),
        guard,
        reach,
        frozen(coded),
        np.uint8(int(np.flatnonzero(decoded == 1.0)[0])),
    )
    return RatioMap(power, excess, code, decoded)


def power_correlation(power: Plane, previous: Plane) -> float:
    """rho^2 of clutter: the correlation of normalised powers, bounded at 8, from one ping to the next.

    For jointly complex Gaussian clutter it is the squared modulus of the correlation of its amplitudes.
    """
    if power.shape != previous.shape or power.size < 1000:
        return 0.0
    step = max(power.size // ENOUGH, 1)
    one, other = np.minimum(power[::step], 8.0), np.minimum(previous[::step], 8.0)
    spread = float(one.std(dtype=np.float64) * other.std(dtype=np.float64))
    if spread == 0.0:
        return 0.0
    both = float(np.mean(one * other, dtype=np.float64))
    mean = float(one.mean(dtype=np.float64) * other.mean(dtype=np.float64))
    return min(max((both - mean) / spread, 0.0), 0.95)


def candidates(power: Plane, least: float, closed: bool, most: int) -> tuple[IntArray, IntArray]:
    """Rows and beams of local maxima of normalised power from `least` on, in order of beam, then row.

    Of more than `most` the highest are kept.
    """
    row, beam = np.divmod(np.flatnonzero(power >= np.float32(least)), power.shape[1])
    peak = _local_maxima(frozen(power), row, beam, closed)
    row, beam = row[peak], beam[peak]
    if row.size > most:
        keep = np.sort(np.argsort(-power[row, beam], kind="stable")[:most])
        row, beam = row[keep], beam[keep]
    order = np.argsort(beam.astype(np.int16), kind="stable")  # of two bytes: by radix
    return row[order], beam[order]


@compiled
def _ratio_map(
    amplitude: npt.NDArray[Any],
    valid: BoolArray,
    previous: Plane,
    expected: Plane,
    guard: int,
    reach: int,
    table: Codes,
    unknown: np.uint8,
) -> tuple[Plane, Plane, Codes]:
    n_ranges, n_beams = amplitude.shape
    squares, known = _squares(amplitude, valid)
    power, code = np.empty((n_ranges, n_beams), np.float32), np.empty((n_ranges, n_beams), np.uint8)
    excess = np.empty((n_ranges, n_beams), np.float32) if previous.size else power
    total, count = np.zeros(n_beams), np.zeros(n_beams)
    last = np.float32(table.size - 1)
    for r in range(-reach - guard - 1, n_ranges):
        _move(total, count, squares, known, r, guard, reach)
        if r < 0:
            continue
        for b in range(n_beams):
            z = squares[r, b] * np.float32(count[b] / max(total[b], LEAST_TOTAL))
            power[r, b] = z if count[b] >= 8.0 and total[b] > 0.0 else np.float32(1.0)
        if previous.size:
            _exceed(excess, power, previous, expected, r)
        for b in range(n_beams):
            code[r, b] = table[int(min(excess[r, b] * np.float32(STEPS), last))]
        for b in range(n_beams if known.size else 0):
            if not known[r, b]:
                power[r, b] = excess[r, b] = np.float32(1.0)
                code[r, b] = unknown
    return power, excess, code


@compiled
def _exceed(excess: Plane, power: Plane, previous: Plane, expected: Plane, row: int) -> None:
    """Fill in a row of what powers are worth after those of the last ping."""
    last_old, last_new = np.float32(expected.shape[0] - 1), np.float32(expected.shape[1] - 1)
    for b in range(power.shape[1]):
        old = min(previous[row, b] * np.float32(OLD_STEPS), last_old)
        new = min(power[row, b] * np.float32(NEW_STEPS), last_new)
        excess[row, b] = expected[int(old + np.float32(0.5)), int(new + np.float32(0.5))]


@compiled
def _squares(amplitude: npt.NDArray[Any], valid: BoolArray) -> tuple[Plane, BoolArray]:
    """Powers (n_ranges, n_beams), 0 where there are none, and where there are; empty if everywhere."""
    n_ranges, n_beams = amplitude.shape
    squares, all_known = np.empty((n_ranges, n_beams), np.float32), valid.size == 0
    for r in range(n_ranges):
        beyond = 0
        for b in range(n_beams):
            x = np.float32(amplitude[r, b])
            squares[r, b] = x * x
            beyond += not squares[r, b] < np.inf
        all_known &= beyond == 0
    if all_known:
        return squares, np.zeros((0, 0), np.bool_)
    known = np.ones((n_ranges, n_beams), np.bool_)
    for r in range(n_ranges):
        for b in range(n_beams):
            good = squares[r, b] < np.inf and (valid.size == 0 or valid[r, b])
            known[r, b] = good
            squares[r, b] = squares[r, b] if good else np.float32(0.0)
    return squares, known


@compiled
def _move(
    total: FloatArray, count: FloatArray, squares: Plane, known: BoolArray, row: int, guard: int, reach: int
) -> None:
    """Move the running reference on to a row: of two stretches, a row enters each, and one leaves."""
    for at, sign in (
        (row + guard + reach, 1.0),
        (row + guard, -1.0),
        (row - guard - 1, 1.0),
        (row - guard - 1 - reach, -1.0),
    ):
        if not 0 <= at < squares.shape[0]:
            continue
        for b in range(total.size):
            total[b] = max(total[b] + sign * squares[at, b], 0.0)
        if known.size:
            for b in range(total.size):
                count[b] += sign * known[at, b]
        else:
            count += sign


@compiled
def _local_maxima(power: Plane, row: IntArray, beam: IntArray, closed: bool) -> BoolArray:
    """Which of the cells given are local maxima."""
    n_ranges, n_beams = power.shape
    found = np.zeros(row.size, np.bool_)
    for i in range(row.size):
        r, b = row[i], beam[i]
        z = power[r, b]
        if not 0 < r < n_ranges - 1 or z < power[r - 1, b] or z <= power[r + 1, b]:
            continue
        left, right = b - 1, b + 1
        if closed:
            left, right = left % n_beams, right % n_beams
        found[i] = not (left >= 0 and z < power[r, left]) and not (right < n_beams and z <= power[r, right])
    return found
