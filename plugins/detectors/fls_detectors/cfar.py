"""Constant false-alarm rate in Rayleigh clutter: thresholds, and the kernel that applies them.

A float32 screen passes over all cells and leaves those that can exceed their threshold; each of them is then
decided in float64 from its reference cells one by one. The screen only adds positive numbers (no running
sum, which drifts), so it is right to a few units in 1e-7 and its margin makes up for that.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = ["NO_FLAGS", "REFERENCE", "TEST", "Window", "rayleigh_factors", "rayleigh_hits"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Flags = npt.NDArray[np.uint8]

REFERENCE, TEST = 1, 2  # bits of a cell's flag: it may serve as reference, it is to be tested
NO_FLAGS: Flags = np.zeros((0, 0), np.uint8)  # stands for: every cell is both
CHUNK_CELLS = 1 << 16  # worked on at once: the float32 planes of a chunk fit the second-level cache
SIFT_CELLS = 256  # looked through once more, one by one, if any of them may be a hit
MARGIN = np.float32(1.0 - 1e-5)  # of the screen, over float32 rounding
HUGE = np.float32(1e38)  # sums beyond it would overflow the screen


class Window(NamedTuple):
    """Which cells around the one under test are its reference, in cells and beams.

    They lie in the beams |dn| <= `beams`, at the rows guard + 1 + k stride, k = 0 .. 2^levels - 1, before
    and behind. Where fewer than the least number are usable, k goes on to `widest`.
    """

    guard: int
    stride: int
    levels: int
    beams: int
    widest: int

    @property
    def size(self) -> int:
        """J, the number of reference cells of a cell far from all edges."""
        return int(2 ** (self.levels + 1) * (2 * self.beams + 1))

    @classmethod
    def of(
        cls,
        cell_m: float,
        *,
        guard_m: float,
        guard_beams: int,
        reference_m: float,
        max_ref: int,
        widen_m: float,
    ) -> Window:
        """The window for range cells of `cell_m`: at most `max_ref`, spread over `reference_m` a side."""
        levels = int(np.log2(max_ref // (2 * (2 * guard_beams + 1))))
        stride = max(1, int(reference_m / cell_m / 2**levels + 0.5))
        return cls(
            int(guard_m / cell_m + 0.5), stride, levels, guard_beams, int(widen_m / (cell_m * stride) + 0.5)
        )


def rayleigh_factors(pfa: float, min_ref: int, size: int) -> FloatArray:
    """a(J) = pfa^(-1/J) - 1 for J = 0 .. size - 1; infinite below `min_ref`, where nothing is decided.

    In Rayleigh clutter P(x^2 > a sum x_j^2) = (1 + a)^-J, exact for every J.

    Source: Karoui 2015 (4).
    """
    count = np.arange(size)
    with np.errstate(over="ignore"):  # few cells and a small pfa: infinite, which is what it means
        factors = np.expm1(-np.log(pfa) / np.maximum(count, 1))
    return np.where(count < max(min_ref, 1), np.inf, factors)


def rayleigh_hits(
    amplitude: npt.NDArray[Any],
    window: Window,
    *,
    pfa: float,
    min_ref: int = 8,
    floor: float = 0.0,
    flags: Flags = NO_FLAGS,
) -> BoolArray:
    """Which cells (n_ranges, n_beams) exceed T = sqrt(a(J) max(sum x_j^2, J floor^2)), strictly.

    J and the sum run over the reference cells that exist and carry `REFERENCE` in `flags`. No hit is given by
    cells without `TEST`, without `min_ref` reference cells, or, with floor 0, whose reference is nothing but
    zeros. Cells that are not finite must have flag 0.

    Source: Karoui 2015 (4).
    """
    n_ranges, n_beams = amplitude.shape
    window = window._replace(guard=min(window.guard, n_ranges), stride=min(window.stride, max(n_ranges, 1)))
    factors = rayleigh_factors(pfa, min_ref, window.size + 2 * (2 * window.beams + 1))
    hits = np.zeros((n_ranges, n_beams), bool)
    if amplitude.size and np.isfinite(factors[window.size]):
        _screen(frozen(amplitude), frozen(flags), window, factors, floor * floor, hits)
    return hits


@compiled
def _screen(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    window: Window,
    factors: FloatArray,
    floor_power: float,
    hits: BoolArray,
) -> None:
    """Go along the ranges in chunks of rows, kept flat: loops are long even when the beams are few.

    `sums` holds 2 reach rows of history, then the chunk; `power`, whose rows wait for their reference
    behind, reach rows and the chunk.
    """
    n_ranges, n_beams = amplitude.shape
    reach = window.guard + 1 + ((1 << window.levels) - 1) * window.stride
    rows = min(max(CHUNK_CELLS // n_beams, 64), n_ranges + reach)
    new = rows * n_beams
    sums = np.zeros(2 * reach * n_beams + new, np.float32)
    power = np.zeros(reach * n_beams + new, np.float32)
    reference = np.zeros(new if flags.size else 0, np.float32)
    for front in range(0, n_ranges + reach, rows):
        entered = power[reach * n_beams :]
        _enter(amplitude, flags, front, entered, reference)
        chosen = reference if flags.size else entered
        _sum_beams(chosen, n_beams, window.beams, sums[2 * reach * n_beams :])
        for level in range(window.levels):
            shift = (1 << level) * window.stride * n_beams
            _double(sums[sums.size - new - 2 * shift + window.stride * n_beams :], new, shift)
        behind = sums[(reach + window.guard + 1) * n_beams :]
        _sift(amplitude, flags, front - reach, rows, window, factors, floor_power, power, sums, behind, hits)
        sums[:-new] = sums[new:].copy()
        power[:-new] = power[new:].copy()


@compiled
def _enter(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    front: int,
    power: npt.NDArray[np.float32],
    reference: npt.NDArray[np.float32],
) -> None:
    """Fill in squares: of the cells to be tested, and of those that may be reference."""
    n_ranges, n_beams = amplitude.shape
    count = min(power.size, max(n_ranges - front, 0) * n_beams)
    cells = amplitude.reshape(-1)[front * n_beams :]
    power[count:] = np.float32(0.0)
    reference[count:] = np.float32(0.0)
    if flags.size:
        marks = flags.reshape(-1)[front * n_beams :]
        for i in range(count):
            x = np.float32(cells[i])
            power[i] = x * x if marks[i] & TEST else np.float32(0.0)
            reference[i] = x * x if marks[i] & REFERENCE else np.float32(0.0)
    else:
        for i in range(count):
            x = np.float32(cells[i])
            power[i] = x * x


@compiled
def _sum_beams(
    squares: npt.NDArray[np.float32], n_beams: int, beams: int, total: npt.NDArray[np.float32]
) -> None:
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
    for start in range(0, n, n_beams):
        for edge in range(min(beams, n_beams)):
            for beam in (edge, n_beams - 1 - edge):
                one = np.float32(0.0)
                for j in range(max(beam - beams, 0), min(beam + beams + 1, n_beams)):
                    one += squares[start + j]
                total[start + beam] = one


@compiled
def _add(target: npt.NDArray[np.float32], other: npt.NDArray[np.float32]) -> None:
    for i in range(target.size):
        target[i] += other[i]


@compiled
def _double(sums: npt.NDArray[np.float32], count: int, shift: int) -> None:
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
    floor_power: float,
    power: npt.NDArray[np.float32],
    before: npt.NDArray[np.float32],
    behind: npt.NDArray[np.float32],
    hits: BoolArray,
) -> None:
    """Decide the cells whose power exceeds the least threshold that their sum allows."""
    n_beams = amplitude.shape[1]
    size = 2 * (1 << window.levels) * (2 * window.beams + 1)
    least = np.float32(factors[-1]) * MARGIN  # a(J) and J a(J) fall with J: no threshold lies below this
    floor_sum = np.float32(min(floor_power * size, float(HUGE)))
    stop = rows * n_beams
    for start in range(max(-first_row, 0) * n_beams, stop, SIFT_CELLS):
        piece = slice(start, min(start + SIFT_CELLS, stop))
        tested, one, other = power[piece], before[piece], behind[piece]
        above = False
        for i in range(tested.size):
            above |= tested[i] > least * min(max(one[i] + other[i], floor_sum), HUGE)
        if above:
            for i in range(tested.size):
                if tested[i] > least * min(max(one[i] + other[i], floor_sum), HUGE):
                    row, beam = first_row + (start + i) // n_beams, (start + i) % n_beams
                    hits[row, beam] = _exceeds(amplitude, flags, row, beam, window, factors, floor_power)


@compiled
def _exceeds(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    row: int,
    beam: int,
    window: Window,
    factors: FloatArray,
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
    return total > 0.0 and x * x > factors[count] * total
