"""Constant false-alarm rate in the log domain: mean and spread of the logarithms of the reference cells.

A float32 screen sums logarithms and their squares for all cells side by side and leaves those that can be
hits; each of these is then decided in float64 from its own reference cells.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fls_detectors.log_factors import FEWEST, log_factors
from fls_detectors.reference import (
    NO_FLAGS,
    REFERENCE,
    TEST,
    Flags,
    Window,
    existing_cells,
    gathered_cells,
    reference_offsets,
    window_reach,
)
from fls_flow.kernels import compiled, frozen

__all__ = ["Clutter", "log_hits", "log_ratio"]

Clutter = Literal["weibull", "lognormal"]
FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Screen = npt.NDArray[np.float32]

TILE_CELLS = 4096  # screened at once: sums and counts stay in the nearest caches
SLACK = np.float32(2e-5)  # of the screen's mean and variance, over the rounding of float32 sums


def log_hits(
    amplitude: npt.NDArray[Any],
    window: Window,
    *,
    pfa: float,
    clutter: Clutter = "weibull",
    min_ref: int = 8,
    floor: float = 0.0,
    flags: Flags = NO_FLAGS,
    scale: FloatArray | None = None,
) -> BoolArray:
    """Which cells (n_ranges, n_beams) exceed T = scale max(exp(m + t(J) s), floor sqrt(-ln pfa)), strictly.

    m and s are mean and standard deviation (J - 1 in the denominator) of ln max(x_j, floor) over the J
    reference cells that exist and carry `REFERENCE` in `flags`; with floor 0 only positive cells are
    reference. `scale` has an entry per beam. No hit is given by cells without `TEST` or without `min_ref`
    reference cells. Cells that are not finite must have flag 0.
    """
    n_ranges, n_beams = amplitude.shape
    window = window.within(n_ranges)
    hits = np.zeros((n_ranges, n_beams), bool)
    if not amplitude.size:
        return hits
    factors = _factors(pfa, clutter, max(min_ref, FEWEST), window.most + 1)
    scale = np.ones(n_beams) if scale is None else scale
    given, marks = frozen(amplitude), frozen(_positive(amplitude, flags, floor))
    # where the window holds too few cells, only a wider one can tell
    wide = window.widest > 2**window.levels
    least = floor * np.sqrt(-np.log(pfa))
    height = np.log(scale.min())
    planes = _planes(given, marks, window, floor)
    screened = np.where(np.isfinite(factors), factors, -np.inf if wide else np.inf).astype(np.float32)
    _screen(given, marks, window, *planes, screened, np.float32(height), hits)
    _decide(given, marks, window, max(min_ref, FEWEST), factors, frozen(scale), floor, least, hits)
    return hits


def log_ratio(
    amplitude: npt.NDArray[Any],
    window: Window,
    *,
    pfa: float,
    clutter: Clutter = "weibull",
    min_ref: int = 8,
    floor: float = 0.0,
    flags: Flags = NO_FLAGS,
) -> FloatArray:
    """x / T (n_ranges, n_beams) with scale 1, nan where `log_hits` decides nothing."""
    window = window.within(amplitude.shape[0])
    ratio = np.full(amplitude.shape, np.nan)
    if amplitude.size:
        factors = _factors(pfa, clutter, max(min_ref, FEWEST), window.most + 1)
        given, marks = frozen(amplitude), frozen(_positive(amplitude, flags, floor))
        least = floor * np.sqrt(-np.log(pfa))
        _ratios(given, marks, window, max(min_ref, FEWEST), factors, floor, least, ratio)
    return ratio


@lru_cache(maxsize=64)
def _factors(pfa: float, clutter: Clutter, min_ref: int, size: int) -> FloatArray:
    """t(J) for J = 0 .. size - 1; infinite below `min_ref`."""
    factors = np.full(size, np.inf)
    if size > min_ref:
        factors[min_ref:] = log_factors(pfa, np.arange(min_ref, size), clutter)
    return frozen(factors)


def _positive(amplitude: npt.NDArray[Any], flags: Flags, floor: float) -> Flags:
    """The flags, those that have no logarithm not reference."""
    if floor > 0.0 or (amplitude > 0).all():
        return flags
    marks = np.full(amplitude.shape, REFERENCE | TEST, np.uint8) if not flags.size else flags.copy()
    marks[~(amplitude > 0)] &= TEST
    return marks


def _planes(
    amplitude: npt.NDArray[Any], flags: Flags, window: Window, floor: float
) -> tuple[Screen, Screen, float]:
    """Logarithms less their mean, padded with 0; where they are reference (nothing: everywhere); the mean."""
    n_ranges, n_beams = amplitude.shape
    reach = window_reach(window, n_ranges)
    shape = (n_ranges + 2 * reach, n_beams + 2 * window.beams)
    inner = (slice(reach, reach + n_ranges), slice(window.beams, window.beams + n_beams))
    usable = (flags & REFERENCE) != 0 if flags.size else None
    logs = _logs(amplitude, usable, floor)
    middle = float(logs.mean()) if usable is None else float(logs.sum() / max(np.count_nonzero(usable), 1))
    plane, mark = np.zeros(shape, np.float32), np.zeros(shape if flags.size else (0, 0), np.float32)
    np.subtract(logs, np.float32(middle), out=plane[inner])
    if usable is not None:
        plane[inner][~usable] = 0.0
        mark[inner] = usable
    return plane, mark, middle


def _logs(amplitude: npt.NDArray[Any], usable: BoolArray | None, floor: float) -> Screen:
    """ln max(x, floor), 0 where it is not to be used."""
    if amplitude.dtype == np.uint8:
        level = np.arange(256, dtype=np.float32)
        table = np.log(np.maximum(level, np.float32(floor if floor > 0.0 else 1.0)))
        logs = table[amplitude]
    else:
        x = np.maximum(amplitude, np.float32(floor)).astype(np.float32, copy=False)
        logs = np.log(x if usable is None else np.where(usable, x, np.float32(1.0)))
    if usable is not None:
        logs[~usable] = 0.0
    return np.asarray(logs, np.float32)


@compiled
def _screen(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    window: Window,
    plane: Screen,
    mark: Screen,
    middle: float,
    factors: Screen,
    height: np.float32,
    hits: BoolArray,
) -> None:
    """Mark the cells whose logarithm may exceed height + m + t(J) s."""
    n_ranges, n_beams = amplitude.shape
    width = plane.shape[1]
    reach = (plane.shape[0] - n_ranges) // 2
    rows = max(1, TILE_CELLS // width)
    total = np.empty(rows * width, np.float32)
    square = np.empty(rows * width, np.float32)
    count = np.empty(rows * width, np.float32)
    spare = np.empty(rows * width if mark.size else 0, np.float32)
    for first in range(0, n_ranges, rows):
        stop = min(first + rows, n_ranges)
        _sum(plane.reshape(-1), window, first, stop, width, reach, total, square)
        if mark.size:
            _sum(mark.reshape(-1), window, first, stop, width, reach, count, spare)
        else:
            existing_cells(window, first, stop, n_ranges, n_beams, count)
        for row in range(first, stop):
            for beam in range(n_beams):
                x = float(amplitude[row, beam])
                if not x > 0.0 or (flags.size and not flags[row, beam] & TEST):
                    continue
                i = (row - first) * width + window.beams + beam
                factor = factors[int(count[i])]
                if not np.isfinite(factor):
                    hits[row, beam] = factor < 0.0
                    continue
                mean = total[i] / count[i]
                power = square[i] / count[i]
                variance = (square[i] - total[i] * mean) / (count[i] - np.float32(1.0))
                low = np.sqrt(max(variance - SLACK * power * np.float32(2.0), np.float32(0.0)))
                high = np.sqrt(max(variance, np.float32(0.0)) + SLACK * power * np.float32(2.0))
                reached = mean + factor * (low if factor > 0.0 else high) + height
                slack = SLACK * (np.float32(1.0) + np.sqrt(power))
                y = plane[row + reach, window.beams + beam]
                if mark.size and mark[row + reach, window.beams + beam] == 0.0:
                    y = np.float32(np.log(x) - middle)
                hits[row, beam] = y > reached - slack


@compiled
def _sum(
    flat: Screen,
    window: Window,
    first: int,
    stop: int,
    width: int,
    reach: int,
    total: Screen,
    square: Screen,
) -> None:
    """Sums over the reference cells of each cell, and of their squares; of marks both are the same."""
    size = (stop - first) * width - 2 * window.beams  # the first and last columns are padding
    one, two = total[window.beams :][:size], square[window.beams :][:size]
    one[:] = np.float32(0.0)
    two[:] = np.float32(0.0)
    start = (first + reach) * width + window.beams
    for offset in reference_offsets(window, reach, width):
        other = flat[start + offset :][:size]
        for i in range(size):
            one[i] += other[i]
            two[i] += other[i] * other[i]


@compiled
def _decide(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    window: Window,
    min_ref: int,
    factors: FloatArray,
    scale: FloatArray,
    floor: float,
    least: float,
    hits: BoolArray,
) -> None:
    """Decide the marked cells in float64."""
    cells = np.empty(factors.size)
    for row in range(hits.shape[0]):
        for beam in range(hits.shape[1]):
            if hits[row, beam]:
                count = gathered_cells(amplitude, flags, row, beam, window, min_ref, cells)
                height = _height(cells[:count], factors[count], floor, least)
                hits[row, beam] = count >= min_ref and amplitude[row, beam] > scale[beam] * height


@compiled
def _height(cells: FloatArray, factor: float, floor: float, least: float) -> float:
    """max(exp(m + t s), least) of these reference cells."""
    if cells.size < 2:
        return np.inf
    lowest, highest = np.inf, -np.inf
    for i in range(cells.size):
        cells[i] = max(cells[i], floor)
        lowest, highest = min(lowest, cells[i]), max(highest, cells[i])
    if lowest == highest:  # exactly so: no rounding of logarithms lifts their equals above them
        return float(max(lowest, least))
    mean, square = 0.0, 0.0
    for i in range(cells.size):
        cells[i] = np.log(cells[i])
        mean += cells[i] / cells.size
    for i in range(cells.size):
        square += (cells[i] - mean) ** 2
    return float(max(np.exp(mean + factor * np.sqrt(square / (cells.size - 1))), least))


@compiled
def _ratios(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    window: Window,
    min_ref: int,
    factors: FloatArray,
    floor: float,
    least: float,
    ratio: FloatArray,
) -> None:
    cells = np.empty(factors.size)
    for row in range(ratio.shape[0]):
        for beam in range(ratio.shape[1]):
            if flags.size and not flags[row, beam] & TEST:
                continue
            count = gathered_cells(amplitude, flags, row, beam, window, min_ref, cells)
            if count >= min_ref:
                height = _height(cells[:count], factors[count], floor, least)
                ratio[row, beam] = float(amplitude[row, beam]) / height
