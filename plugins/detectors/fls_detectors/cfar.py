"""Constant false-alarm rate in Rayleigh clutter: thresholds, and the kernel that applies them.

A float32 screen passes over all cells and leaves those that can exceed their threshold; each of them is then
decided in float64 from its reference cells one by one. The screen only adds positive numbers (no running
sum, which drifts), so it is right to a few units in 1e-7 and its margin makes up for that.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.reference import NO_FLAGS, REFERENCE, TEST, Flags, Window
from fls_detectors.window_sums import blank_planes, history_rows, sum_window
from fls_flow.kernels import compiled, frozen

__all__ = [
    "NO_FLAGS",
    "REFERENCE",
    "TEST",
    "Flags",
    "Window",
    "rayleigh_factors",
    "rayleigh_hits",
]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

CHUNK_CELLS = 1 << 14  # worked on at once, if there are not many beams: the planes fit the nearer caches
MARGIN = np.float32(1.0 - 1e-5)  # of the screen, over float32 rounding
HUGE = np.float32(1e38)  # sums beyond it would overflow the screen


@lru_cache(maxsize=64)
def rayleigh_factors(pfa: float, min_ref: int, size: int) -> FloatArray:
    """a(J) = pfa^(-1/J) - 1 for J = 0 .. size - 1; infinite below `min_ref`, where nothing is decided.

    In Rayleigh clutter P(x^2 > a sum x_j^2) = (1 + a)^-J, exact for every J.

    Source: Karoui 2015 (4).
    """
    count = np.arange(size)
    with np.errstate(over="ignore"):  # few cells and a small pfa: infinite, which is what it means
        factors = np.expm1(-np.log(pfa) / np.maximum(count, 1))
    return frozen(np.where(count < max(min_ref, 1), np.inf, factors))


def rayleigh_hits(
    amplitude: npt.NDArray[Any],
    window: Window,
    *,
    pfa: float,
    min_ref: int = 8,
    floor: float = 0.0,
    flags: Flags = NO_FLAGS,
    scale: FloatArray | None = None,
) -> BoolArray:
    """Which cells (n_ranges, n_beams) exceed T = scale sqrt(a(J) max(sum x_j^2, J floor^2)), strictly.

    J and the sum run over the reference cells that exist and carry `REFERENCE` in `flags`; `scale` has an
    entry per beam and is 1 by default. No hit is given by cells without `TEST`, without `min_ref` reference
    cells, or, with floor 0, whose reference is nothing but zeros: no more than that are amplitudes below
    1e-22, whose squares float32 does not hold. Cells that are not finite must have flag 0.

    Source: Karoui 2015 (4).
    """
    n_ranges, n_beams = amplitude.shape
    window = window.within(n_ranges)
    scale = np.ones(n_beams) if scale is None else scale
    least = float(scale.min(initial=np.inf))
    hits = np.zeros((n_ranges, n_beams), bool)
    factors = rayleigh_factors(pfa, min_ref, window.most)
    if amplitude.size and np.isfinite(factors[window.size]):
        relative = frozen(np.square(scale / least))
        factors = factors * (least * least)
        kind = np.zeros(0, np.uint8 if window.size < 256 else np.uint32)
        _screen(frozen(amplitude), frozen(flags), window, factors, relative, floor * floor, kind, hits)
    return hits


@compiled
def _screen(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    window: Window,
    factors: FloatArray,
    relative: FloatArray,
    floor_power: float,
    kind: npt.NDArray[Any],
    hits: BoolArray,
) -> None:
    """Go along the ranges in chunks of rows, kept flat: loops are long even when the beams are few.

    Reference cells, if some are excluded, are counted in the dtype of `kind` the way that squares are summed.
    """
    n_ranges, n_beams = amplitude.shape
    reach = window.guard + 1 + ((1 << window.levels) - 1) * window.stride
    steps = n_ranges + reach  # the last cells are decided `reach` rows after they have entered
    most = max(CHUNK_CELLS // n_beams, 64, 2 * reach)
    rows = -(-steps // -(-steps // most))  # chunks of one length: none is nearly empty
    new = rows * n_beams
    history = history_rows(window, reach) * n_beams
    squares, usable = np.empty(new, np.float32), np.empty(new if flags.size else 0, kind.dtype)
    sums, counts = blank_planes(squares, history), blank_planes(usable, history)
    possible = np.zeros((new + 31) // 32 * 32, np.uint8)
    least = _least_by_count(window, factors)
    for front in range(0, steps, rows):
        _enter(amplitude, flags, front, squares, usable)
        total = sum_window(squares, n_beams, window, history, sums)
        count = sum_window(usable, n_beams, window, history, counts) if flags.size else counts
        _sift(
            amplitude,
            flags,
            front - reach,
            rows,
            window,
            factors,
            least,
            relative,
            floor_power,
            (total, count),
            possible,
            squares.view(np.int32),
            hits,
        )


@compiled
def _enter(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    front: int,
    squares: npt.NDArray[np.float32],
    usable: npt.NDArray[Any],
) -> None:
    """Fill in the squares of the cells that may be reference, with a 1 for each."""
    n_ranges, n_beams = amplitude.shape
    count = min(squares.size, max(n_ranges - front, 0) * n_beams)
    cells = amplitude.reshape(-1)[front * n_beams :]
    squares[count:] = np.float32(0.0)
    usable[count:] = 0
    if flags.size:
        marks = flags.reshape(-1)[front * n_beams :]
        for i in range(count):
            x = np.float32(cells[i])
            squares[i] = x * x if marks[i] & REFERENCE else np.float32(0.0)
        for i in range(count):
            usable[i] = marks[i] & REFERENCE
    else:
        for i in range(count):
            x = np.float32(cells[i])
            squares[i] = x * x


@compiled
def _sift(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    first_row: int,
    rows: int,
    window: Window,
    factors: FloatArray,
    least: npt.NDArray[np.float32],
    relative: FloatArray,
    floor_power: float,
    summed: tuple[npt.NDArray[np.float32], npt.NDArray[Any]],
    possible: npt.NDArray[np.uint8],
    places: npt.NDArray[np.int32],
    hits: BoolArray,
) -> None:
    """Decide the cells whose power exceeds the least threshold that their sum, then their count, allows."""
    n_ranges, n_beams = amplitude.shape
    sums, counts = summed
    first = max(-first_row, 0) * n_beams
    size = max(min(rows, n_ranges - first_row) * n_beams - first, 0)
    cells = amplitude.reshape(-1)[first_row * n_beams + first :][:size]
    ahead = first + (2 * (window.guard + 1) + ((1 << window.levels) - 1) * window.stride) * n_beams
    one, other = sums[first:][:size], sums[ahead:][:size]
    _compare(cells, one, other, window, least[-1], floor_power, flags.size > 0, possible)
    possible[size:] = 0
    for i in places[: _places(possible, places)]:
        row, beam = first_row + (first + i) // n_beams, (first + i) % n_beams
        if flags.size:
            x, J = np.float32(cells[i]), counts[first + i] + counts[ahead + i]
            total = max(one[i] + other[i], np.float32(J) * np.float32(floor_power))
            if not (x * x > least[J] * min(total, HUGE) and flags[row, beam] & TEST):
                continue
        hits[row, beam] = _exceeds(amplitude, flags, row, beam, window, factors, relative[beam], floor_power)


@compiled
def _places(possible: npt.NDArray[np.uint8], places: npt.NDArray[np.int32]) -> int:
    """Fill in where `possible` is not 0, looked for 32 cells at a time, then 8; returns how often."""
    words = possible.view(np.uint64)
    count = 0
    for block in range(0, words.size, 4):
        if not (words[block] | words[block + 1] | words[block + 2] | words[block + 3]):
            continue
        for word in range(block, block + 4):
            for i in range(8 * word, 8 * word + 8 if words[word] else 0):
                if possible[i]:
                    places[count] = i
                    count += 1
    return count


@compiled
def _compare(
    cells: npt.NDArray[Any],
    one: npt.NDArray[np.float32],
    other: npt.NDArray[np.float32],
    window: Window,
    least: np.float32,
    floor_power: float,
    excluding: bool,
    possible: npt.NDArray[np.uint8],
) -> None:
    """Whether the power of cells exceeds the least threshold of any count, given their sums."""
    # a(J) and J a(J) fall with J: no threshold lies below that of the largest count with the least sum
    size = 2 * (1 << window.levels) * (2 * window.beams + 1)
    floor_sum = np.float32(min(floor_power * size, float(HUGE)))
    # where all cells of the window are excluded, only a wider one can tell
    some = np.float32(0.0 if excluding and window.widest <= 1 << window.levels else -1.0)
    for i in range(cells.size):
        x, total = np.float32(cells[i]), max(one[i] + other[i], floor_sum)
        possible[i] = (x * x > least * min(total, HUGE)) & (total > some)


@compiled
def _least_by_count(window: Window, factors: FloatArray) -> npt.NDArray[np.float32]:
    """The least factor of cells with so many reference cells in the window."""
    least = np.empty(factors.size, np.float32)
    # where the window holds too few cells, only a wider one can tell
    few = 0.0 if window.widest > 1 << window.levels else np.inf
    for count in range(least.size):
        least[count] = np.float32(factors[count]) * MARGIN if np.isfinite(factors[count]) else few
    return least


@compiled
def _exceeds(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    row: int,
    beam: int,
    window: Window,
    factors: FloatArray,
    relative: float,
    floor_power: float,
) -> bool:
    """Decide one cell in float64, its reference cells taken from the guard outwards."""
    n_ranges, n_beams = amplitude.shape
    guard, stride, levels, beams, widest = window
    per_side = 1 << levels
    size = 2 * per_side * (2 * beams + 1)
    x = np.float64(amplitude[row, beam])
    if not (x > 0.0):
        return False
    total, count = 0.0, 0
    for k in range(max(per_side, widest)):
        if k >= per_side and (count >= size or (k == per_side and np.isfinite(factors[count]))):
            break
        for side in (-1, 1):
            r = row + side * (guard + 1 + k * stride)
            if r < 0 or r >= n_ranges:
                continue
            for n in range(max(beam - beams, 0), min(beam + beams + 1, n_beams)):
                if flags.size == 0 or flags[r, n] & REFERENCE:
                    total += np.float64(amplitude[r, n]) ** 2
                    count += 1
        if x * x <= factors[-1] * total:  # more cells only raise this bound of the threshold
            return False
    total = max(total, count * floor_power)
    return total > 0.0 and x * x > factors[count] * relative * total
