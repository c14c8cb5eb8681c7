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

CHUNK_CELLS = 1 << 13  # worked on at once, if there are not many beams: the planes fit the nearest caches
SIFT_CELLS = 256  # looked through once more, one by one, if any of them may be a hit
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
    cells, or, with floor 0, whose reference is nothing but zeros. Cells that are not finite must have flag 0.

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

    `sums` holds 2 reach rows of history, then the chunk, and so does `counts`, of the dtype of `kind`.
    """
    n_ranges, n_beams = amplitude.shape
    reach = window.guard + 1 + ((1 << window.levels) - 1) * window.stride
    rows = min(max(CHUNK_CELLS // n_beams, 64, 2 * reach), n_ranges + reach)  # reach rows are history
    new = rows * n_beams
    sums = np.zeros(2 * reach * n_beams + new, np.float32)
    reference = np.zeros(new, np.float32)
    usable = np.zeros(new if flags.size else 0, kind.dtype)
    counts = np.zeros(sums.size if flags.size else 0, kind.dtype)
    for front in range(0, n_ranges + reach, rows):
        _enter(amplitude, flags, front, reference, usable)
        _sum_window(reference, n_beams, window, new, sums)
        behind = sums[(reach + window.guard + 1) * n_beams :]
        if flags.size:
            _sum_window(usable, n_beams, window, new, counts)
        counts_behind = counts[(reach + window.guard + 1) * n_beams :] if flags.size else counts
        before, after = (sums, counts), (behind, counts_behind)
        _sift(
            amplitude, flags, front - reach, rows, window, factors, relative, floor_power, before, after, hits
        )
        sums[:-new] = sums[new:].copy()
        if flags.size:
            counts[:-new] = counts[new:].copy()


@compiled
def _sum_window(
    cells: npt.NDArray[Any], n_beams: int, window: Window, new: int, sums: npt.NDArray[Any]
) -> None:
    """Turn the last `new` of `sums` into sums over one side of the window that ends there."""
    _sum_beams(cells, n_beams, window.beams, sums[sums.size - new :])
    for level in range(window.levels):
        shift = (1 << level) * window.stride * n_beams
        _double(sums[sums.size - new - 2 * shift + window.stride * n_beams :], new, shift)


@compiled
def _enter(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    front: int,
    reference: npt.NDArray[np.float32],
    usable: npt.NDArray[Any],
) -> None:
    """Fill in the squares of the cells that may be reference, with a 1 for each."""
    n_ranges, n_beams = amplitude.shape
    count = min(reference.size, max(n_ranges - front, 0) * n_beams)
    cells = amplitude.reshape(-1)[front * n_beams :]
    reference[count:] = np.float32(0.0)
    usable[count:] = 0
    if flags.size:
        marks = flags.reshape(-1)[front * n_beams :]
        for i in range(count):
            x = np.float32(cells[i])
            reference[i] = x * x if marks[i] & REFERENCE else np.float32(0.0)
            usable[i] = marks[i] & REFERENCE
    else:
        for i in range(count):
            x = np.float32(cells[i])
            reference[i] = x * x


@compiled
def _sum_beams(squares: npt.NDArray[Any], n_beams: int, beams: int, total: npt.NDArray[Any]) -> None:
    """Sum over the neighbouring beams: first across the ends of rows too, then the ends again, rightly."""
    n = squares.size
    if beams == 1 and n > 2:
        left, middle, right, inner = squares[:-2], squares[1:-1], squares[2:], total[1:-1]
        for i in range(n - 2):
            inner[i] = left[i] + middle[i] + right[i]
    else:
        total[:] = squares
        for shift in range(1, min(beams, n_beams - 1) + 1):
            _add(total[shift:], squares[: n - shift])
            _add(total[: n - shift], squares[shift:])
    if beams == 1 and n_beams > 1:
        for start in range(0, n, n_beams):
            stop = start + n_beams
            total[start] = squares[start] + squares[start + 1]
            total[stop - 1] = squares[stop - 2] + squares[stop - 1]
    else:
        _sum_edges(squares, n_beams, beams, total)


@compiled
def _sum_edges(squares: npt.NDArray[Any], n_beams: int, beams: int, total: npt.NDArray[Any]) -> None:
    for start in range(0, squares.size, n_beams):
        for edge in range(min(beams, n_beams)):
            for beam in (edge, n_beams - 1 - edge):
                first = max(beam - beams, 0)
                total[start + beam] = squares[start + first]
                for j in range(first + 1, min(beam + beams + 1, n_beams)):
                    total[start + beam] += squares[start + j]


@compiled
def _add(target: npt.NDArray[Any], other: npt.NDArray[Any]) -> None:
    for i in range(target.size):
        target[i] += other[i]


@compiled
def _double(sums: npt.NDArray[Any], count: int, shift: int) -> None:
    """Add to each of the first `count` what stands `shift` behind it."""
    for start in range(0, count, shift):  # blocks that don't overlap, else it isn't vectorised
        stop = min(start + shift, count)
        _add(sums[start:stop], sums[start + shift : stop + shift])


@compiled
def _sift(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    first_row: int,
    rows: int,
    window: Window,
    factors: FloatArray,
    relative: FloatArray,
    floor_power: float,
    before: tuple[npt.NDArray[np.float32], npt.NDArray[Any]],
    behind: tuple[npt.NDArray[np.float32], npt.NDArray[Any]],
    hits: BoolArray,
) -> None:
    """Decide the cells whose power exceeds the least threshold that their sum, and their count, allow."""
    n_ranges, n_beams = amplitude.shape
    size = 2 * (1 << window.levels) * (2 * window.beams + 1)
    least = np.float32(factors[-1]) * MARGIN  # a(J) and J a(J) fall with J: no threshold lies below this
    floor_sum = np.float32(min(floor_power * size, float(HUGE)))
    lowest, floor = _least_by_count(window, factors), np.float32(floor_power)
    cells = amplitude.reshape(-1)
    stop = min(rows, n_ranges - first_row) * n_beams
    for start in range(max(-first_row, 0) * n_beams, stop, SIFT_CELLS):
        piece = slice(start, min(start + SIFT_CELLS, stop))
        tested = cells[first_row * n_beams + start : first_row * n_beams + piece.stop]
        one, other = before[0][piece], behind[0][piece]
        above = False
        if flags.size:
            count, more = before[1][piece], behind[1][piece]
            for i in range(tested.size):
                x, J = np.float32(tested[i]), count[i] + more[i]
                above |= x * x > lowest[J] * min(max(one[i] + other[i], np.float32(J) * floor), HUGE)
        else:
            for i in range(tested.size):
                x = np.float32(tested[i])
                above |= x * x > least * min(max(one[i] + other[i], floor_sum), HUGE)
        if not above:
            continue
        for i in range(tested.size):
            x = np.float32(tested[i])
            if flags.size:
                J = before[1][start + i] + behind[1][start + i]
                possible = x * x > lowest[J] * min(max(one[i] + other[i], np.float32(J) * floor), HUGE)
            else:
                possible = x * x > least * min(max(one[i] + other[i], floor_sum), HUGE)
            if possible:
                row, beam = first_row + (start + i) // n_beams, (start + i) % n_beams
                if flags.size == 0 or flags[row, beam] & TEST:
                    hits[row, beam] = _exceeds(
                        amplitude, flags, row, beam, window, factors, relative[beam], floor_power
                    )


@compiled
def _least_by_count(window: Window, factors: FloatArray) -> npt.NDArray[np.float32]:
    """The least threshold of cells with so many reference cells in the window."""
    least = np.empty(factors.size + 256, np.float32)
    wide = window.widest > 1 << window.levels
    for count in range(least.size):
        factor = factors[min(count, factors.size - 1)]
        # where the window holds too few cells, only a wider one can tell
        least[count] = np.float32(factor) * MARGIN if np.isfinite(factor) else 0.0 if wide else np.inf
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
    x = float(amplitude[row, beam])
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
                    total += float(amplitude[r, n]) ** 2
                    count += 1
        if x * x <= factors[-1] * total:  # more cells only raise this bound of the threshold
            return False
    total = max(total, count * floor_power)
    return total > 0.0 and x * x > factors[count] * relative * total
