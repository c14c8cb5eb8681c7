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
    row, beam = _local_maxima(frozen(power), np.float32(least), closed)
    if row.size > most:
        keep = np.argsort(-power[row, beam], kind="stable")[:most]
        row, beam = row[keep], beam[keep]
    order = np.lexsort((row, beam))
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
    power, code = np.empty((n_ranges, n_beams), np.float32), np.empty((n_ranges, n_beams), np.uint8)
    excess = np.empty((n_ranges, n_beams), np.float32)
    total, count = np.zeros(n_beams), np.zeros(n_beams)
    squares = np.zeros((n_ranges, n_beams), np.float32)
    known = np.ones((n_ranges, n_beams), np.bool_)
    for r in range(n_ranges):
        for b in range(n_beams):
            x = np.float32(amplitude[r, b])
            good = np.isfinite(x) and (valid.size == 0 or valid[r, b])
            known[r, b] = good
            squares[r, b] = x * x if good else np.float32(0.0)
    last = np.float32(table.size - 1)
    last_old, last_new = np.float32(expected.shape[0] - 1), np.float32(expected.shape[1] - 1)
    for r in range(-reach - guard - 1, n_ranges):
        _move(total, count, squares, known, r + guard + reach, 1.0)
        _move(total, count, squares, known, r + guard, -1.0)
        _move(total, count, squares, known, r - guard - 1, 1.0)
        _move(total, count, squares, known, r - guard - 1 - reach, -1.0)
        if r < 0:
            continue
        for b in range(n_beams):
            z = np.float32(1.0)
            if known[r, b] and count[b] >= 8.0 and total[b] > 0.0:
                z = squares[r, b] * np.float32(count[b] / total[b])
            power[r, b] = z
            u = z
            if previous.size and known[r, b]:
                old = min(previous[r, b] * np.float32(OLD_STEPS), last_old)
                new = min(z * np.float32(NEW_STEPS), last_new)
                u = expected[int(old + np.float32(0.5)), int(new + np.float32(0.5))]
            excess[r, b] = u
            place = min(u * np.float32(STEPS), last)
            code[r, b] = table[int(place)] if known[r, b] else unknown
    return power, excess, code


@compiled
def _move(
    total: FloatArray, count: FloatArray, squares: Plane, known: BoolArray, row: int, sign: float
) -> None:
    """Add a row's powers to the running reference, or take them away."""
    if 0 <= row < squares.shape[0]:
        for b in range(total.size):
            total[b] = max(total[b] + sign * squares[row, b], 0.0)
            count[b] += sign * known[row, b]


@compiled
def _local_maxima(power: Plane, least: np.float32, closed: bool) -> tuple[IntArray, IntArray]:
    n_ranges, n_beams = power.shape
    room, n = 4096, 0
    rows, beams = np.empty(room, np.int64), np.empty(room, np.int64)
    for r in range(1, n_ranges - 1):
        for b in range(n_beams):
            z = power[r, b]
            if z < least or z < power[r - 1, b] or z <= power[r + 1, b]:
                continue
            left, right = b - 1, b + 1
            if closed:
                left, right = left % n_beams, right % n_beams
            if left >= 0 and z < power[r, left]:
                continue
            if right < n_beams and z <= power[r, right]:
                continue
            if n == room:
                room *= 2
                more_rows, more_beams = np.empty(room, np.int64), np.empty(room, np.int64)
                more_rows[:n], more_beams[:n] = rows, beams
                rows, beams = more_rows, more_beams
            rows[n], beams[n] = r, b
            n += 1
    return rows[:n].copy(), beams[:n].copy()
