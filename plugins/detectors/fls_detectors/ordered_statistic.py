"""Constant false-alarm rate by an ordered statistic: a multiple of the k-th smallest reference cell.

x exceeds a multiple of the k-th smallest cell exactly if at least k cells, so multiplied, are smaller than x:
nothing is sorted. A float32 screen counts them for all cells side by side and leaves those that can be hits;
each of these is then decided in float64.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

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

__all__ = ["ordered_factors", "ordered_hits", "ordered_ratio"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Screen = npt.NDArray[np.float32]

TILE_CELLS = 4096  # screened at once: level and count stay in the first-level cache
WIDER = np.float32(1.0 + 1e-6)  # of the screen, over float32 rounding
NEVER = np.int32(1 << 30)


@lru_cache(maxsize=64)
def ordered_factors(pfa: float, rank: float, min_ref: int, size: int) -> tuple[FloatArray, IntArray]:
    """a(J) and k(J) for J = 0 .. size - 1: in Rayleigh clutter P(x^2 > a x_(k)^2) = pfa, exactly.

    k = max(1, floor(rank J + 1/2)); a solves pfa = prod_i (J - i) / (J - i + a), i = 0 .. k - 1. Below
    `min_ref`, where nothing is decided, a is infinite.

    Source: Rohling 1983 (exponential power).
    """
    count = np.arange(size)
    k = np.clip(np.floor(rank * count + 0.5).astype(np.int64), 1, np.maximum(count, 1))
    left = (count[:, None] - np.arange(max(size, 1))).astype(float)
    used = np.arange(max(size, 1)) < k[:, None]
    left = np.where(used, np.maximum(left, 1.0), 1.0)
    # with a = e^b, sum log(1 + a / (J - i)) is convex in b; Newton's steps from above never overshoot
    log_left, wanted = np.log(left), -np.log(pfa)
    b = (wanted + log_left.sum(axis=1)) / k
    for _ in range(60):
        term = b[:, None] - log_left
        excess = np.where(used, np.logaddexp(0.0, term), 0.0).sum(axis=1) - wanted
        b = b - excess / np.where(used, 1.0 / (1.0 + np.exp(-term)), 0.0).sum(axis=1)
    factor = np.where(count < max(min_ref, 1), np.inf, np.exp(b))
    return frozen(factor), frozen(k)


def ordered_hits(
    amplitude: npt.NDArray[Any],
    window: Window,
    *,
    pfa: float,
    rank: float = 0.75,
    min_ref: int = 8,
    floor: float = 0.0,
    flags: Flags = NO_FLAGS,
    scale: FloatArray | None = None,
) -> BoolArray:
    """Which cells (n_ranges, n_beams) exceed T = scale sqrt(a(J)) max(x_(k), floor), strictly.

    x_(k) is the k(J)-th smallest of the J reference cells that exist and carry `REFERENCE` in `flags`;
    `scale` has an entry per beam. No hit is given by cells without `TEST`, without `min_ref` reference cells,
    or, with floor 0, whose x_(k) is 0. Cells that are not finite must have flag 0.
    """
    n_ranges, n_beams = amplitude.shape
    window = window.within(n_ranges)
    factors, k = ordered_factors(pfa, rank, min_ref, window.most + 1)
    hits = np.zeros((n_ranges, n_beams), bool)
    if not amplitude.size:
        return hits
    scale = np.ones(n_beams) if scale is None else scale
    root = np.sqrt(factors)
    decided = np.isfinite(root)
    inverse = np.where(decided, 1.0 / (root * scale.min()), 0.0).astype(np.float32) * WIDER
    # where the window holds too few cells, only a wider one can tell
    few = 0 if window.widest > 2**window.levels else NEVER
    need = np.where(decided, k, few).astype(np.int32)
    given, marks = frozen(amplitude), frozen(flags)
    least = np.float32((root[decided] * scale.min() * floor).min(initial=np.inf)) / WIDER
    _screen(given, marks, window, _padded(given, marks, window), inverse, need, least, hits)
    _decide(given, marks, window, max(min_ref, 1), root, k, frozen(scale), floor, hits)
    return hits


def ordered_ratio(
    amplitude: npt.NDArray[Any],
    window: Window,
    *,
    pfa: float,
    rank: float = 0.75,
    min_ref: int = 8,
    floor: float = 0.0,
    flags: Flags = NO_FLAGS,
) -> FloatArray:
    """x / T (n_ranges, n_beams) with scale 1, nan where `ordered_hits` decides nothing."""
    window = window.within(amplitude.shape[0])
    factors, k = ordered_factors(pfa, rank, min_ref, window.most + 1)
    ratio = np.full(amplitude.shape, np.nan)
    if amplitude.size:
        given, marks = frozen(amplitude), frozen(flags)
        _ratios(given, marks, window, max(min_ref, 1), np.sqrt(factors), k, floor, ratio)
    return ratio


def _padded(amplitude: npt.NDArray[Any], flags: Flags, window: Window) -> Screen:
    """The reference cells, infinite where there is none to use: beyond the edges and where flags say so."""
    n_ranges, n_beams = amplitude.shape
    reach = window_reach(window, n_ranges)
    padded = np.full((n_ranges + 2 * reach, n_beams + 2 * window.beams), np.inf, np.float32)
    inner = padded[reach : reach + n_ranges, window.beams : window.beams + n_beams]
    inner[:] = amplitude
    if flags.size:
        inner[(flags & REFERENCE) == 0] = np.inf
    return padded


@compiled
def _screen(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    window: Window,
    padded: Screen,
    inverse: Screen,
    need: npt.NDArray[np.int32],
    least: np.float32,
    hits: BoolArray,
) -> None:
    """Mark the cells with at least need(J) reference cells below x inverse(J)."""
    n_ranges, n_beams = amplitude.shape
    width = padded.shape[1]
    reach = (padded.shape[0] - n_ranges) // 2
    beams = window.beams
    rows = max(1, TILE_CELLS // width)
    level = np.empty(rows * width, np.float32)
    below = np.empty(rows * width, np.int32)
    total = np.empty(rows * width, np.int32)
    dirty = np.zeros(n_ranges + 1, np.int64)  # rows before each that have cells which are no reference
    for row in range(n_ranges if flags.size else 0):
        clean = True
        for beam in range(n_beams):
            clean &= (flags[row, beam] & REFERENCE) != 0
        dirty[row + 1] = dirty[row] + (0 if clean else 1)
    flat = padded.reshape(-1)
    for first in range(0, n_ranges, rows):
        stop = min(first + rows, n_ranges)
        if dirty[min(stop + reach, n_ranges)] > dirty[max(first - reach, 0)]:
            _count_usable(flat, window, first, stop, width, reach, total)
        else:
            existing_cells(window, first, stop, n_ranges, n_beams, total)
        for row in range(first, stop):
            at = (row - first) * width
            level[at : at + width] = np.float32(-1.0)
            for beam in range(n_beams):
                i = at + beams + beam
                x = np.float32(amplitude[row, beam])
                if x > least and (flags.size == 0 or flags[row, beam] & TEST):
                    level[i] = x * inverse[total[i]]
        _count_below(flat, window, first, stop, width, reach, level, below)
        for row in range(first, stop):
            for beam in range(n_beams):
                i = (row - first) * width + beams + beam
                hits[row, beam] = level[i] >= 0.0 and below[i] >= need[total[i]]


@compiled
def _count_below(
    flat: Screen,
    window: Window,
    first: int,
    stop: int,
    width: int,
    reach: int,
    level: Screen,
    below: npt.NDArray[np.int32],
) -> None:
    """How many reference cells of each cell are below its level."""
    below[:] = 0
    size = (stop - first) * width - 2 * window.beams  # the first and last columns are padding
    here, count = level[window.beams :][:size], below[window.beams :][:size]
    start = (first + reach) * width + window.beams
    for offset in reference_offsets(window, reach, width):
        other = flat[start + offset :][:size]
        for i in range(size):
            count[i] += np.int32(other[i] < here[i])


@compiled
def _count_usable(
    flat: Screen,
    window: Window,
    first: int,
    stop: int,
    width: int,
    reach: int,
    total: npt.NDArray[np.int32],
) -> None:
    everything = np.full(total.size, np.inf, np.float32)
    _count_below(flat, window, first, stop, width, reach, everything, total)


@compiled
def _decide(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    window: Window,
    min_ref: int,
    root: FloatArray,
    k: IntArray,
    scale: FloatArray,
    floor: float,
    hits: BoolArray,
) -> None:
    """Decide the marked cells in float64, each from its own reference cells."""
    cells = np.empty(root.size)
    for row in range(hits.shape[0]):
        for beam in range(hits.shape[1]):
            if not hits[row, beam]:
                continue
            x = float(amplitude[row, beam])
            count = gathered_cells(amplitude, flags, row, beam, window, min_ref, cells)
            below, silent = 0, 0
            for i in range(count):
                below += 1 if scale[beam] * root[count] * max(cells[i], floor) < x else 0
                silent += 0 if max(cells[i], floor) > 0.0 else 1
            hits[row, beam] = count >= min_ref and below >= k[count] and silent < k[count]


@compiled
def _ratios(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    window: Window,
    min_ref: int,
    root: FloatArray,
    k: IntArray,
    floor: float,
    ratio: FloatArray,
) -> None:
    cells = np.empty(root.size)
    for row in range(ratio.shape[0]):
        for beam in range(ratio.shape[1]):
            if flags.size and not flags[row, beam] & TEST:
                continue
            count = gathered_cells(amplitude, flags, row, beam, window, min_ref, cells)
            if count >= min_ref:
                middle = max(_kth_smallest(cells, count, k[count] - 1), floor)
                if middle > 0.0:
                    ratio[row, beam] = float(amplitude[row, beam]) / (root[count] * middle)


@compiled
def _kth_smallest(cells: FloatArray, count: int, k: int) -> float:
    """The k-th smallest, from 0, of the first `count` cells, which change their order (Hoare 1961)."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = cells[k], low, high
        while i <= j:
            while cells[i] < pivot:
                i += 1
            while pivot < cells[j]:
                j -= 1
            if i <= j:
                cells[i], cells[j] = cells[j], cells[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return float(cells[k])
