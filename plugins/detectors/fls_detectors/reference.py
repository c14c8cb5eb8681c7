"""The reference window around a cell under test, and the cells that lie in it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = [
    "NO_FLAGS",
    "REFERENCE",
    "TEST",
    "Flags",
    "Window",
    "existing_cells",
    "gathered_cells",
    "nearest_cells",
    "reference_offsets",
    "window_reach",
]

FloatArray = npt.NDArray[np.float64]
Flags = npt.NDArray[np.uint8]

REFERENCE, TEST = 1, 2  # bits of a cell's flag: it may serve as reference, it is to be tested
NO_FLAGS: Flags = np.zeros((0, 0), np.uint8)  # stands for: every cell is both


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

    @property
    def most(self) -> int:
        """The largest J there can be: widening stops at the first row with `size` cells or more."""
        return self.size + 2 * (2 * self.beams + 1)

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
        stride = max(1, nearest_cells(reference_m / cell_m / 2**levels))
        return cls(
            nearest_cells(guard_m / cell_m),
            stride,
            levels,
            guard_beams,
            nearest_cells(widen_m / (cell_m * stride)),
        )

    def within(self, n_ranges: int) -> Window:
        """The same for a ping of `n_ranges` rows: what lies beyond its end may lie anywhere there."""
        return self._replace(guard=min(self.guard, n_ranges), stride=min(self.stride, max(n_ranges, 1)))


def nearest_cells(cells: float) -> int:
    """A number of cells made whole, halves up, whatever rounding has left of a table of ranges."""
    return int(cells + 0.5 + 1e-9)


@compiled
def gathered_cells(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    row: int,
    beam: int,
    window: Window,
    min_ref: int,
    cells: FloatArray,
) -> int:
    """Fill `cells` with the usable reference cells of one cell, from the guard outwards; returns J.

    `cells` has room for `window.most`.
    """
    n_ranges, n_beams = amplitude.shape
    guard, stride, levels, beams, widest = window
    per_side = 1 << levels
    size = 2 * per_side * (2 * beams + 1)
    count = 0
    for k in range(max(per_side, widest)):
        if k >= per_side and (count >= size or (k == per_side and count >= min_ref)):
            break
        for side in (-1, 1):
            r = row + side * (guard + 1 + k * stride)
            if r < 0 or r >= n_ranges:
                continue
            for n in range(max(beam - beams, 0), min(beam + beams + 1, n_beams)):
                if flags.size == 0 or flags[r, n] & REFERENCE:
                    cells[count] = amplitude[r, n]
                    count += 1
    return count


@compiled
def window_reach(window: Window, n_ranges: int) -> int:
    """How far from a cell its reference ends, in rows, as far as the ping has them."""
    last = (1 << window.levels) - 1
    while last > 0 and window.guard + 1 + last * window.stride >= n_ranges:
        last -= 1
    return int(window.guard + 1 + last * window.stride)


@compiled
def reference_offsets(window: Window, reach: int, width: int) -> npt.NDArray[np.int64]:
    """How far from a cell its reference cells lie in a flat image of `width` columns, from the guard on."""
    sides = (reach - window.guard - 1) // window.stride + 1
    offsets = np.empty(2 * sides * (2 * window.beams + 1), np.int64)
    count = 0
    for distance in range(window.guard + 1, reach + 1, window.stride):
        for side in (-1, 1):
            for shift in range(-window.beams, window.beams + 1):
                offsets[count] = side * distance * width + shift
                count += 1
    return offsets


@compiled
def existing_cells(
    window: Window, first: int, stop: int, n_ranges: int, n_beams: int, total: npt.NDArray[Any]
) -> None:
    """Fill in J of the cells of rows `first` to `stop` where nothing but the edges cuts the reference.

    `total` is flat, each row of it with `window.beams` more columns at both ends.
    """
    beams = window.beams
    width = n_beams + 2 * beams
    for row in range(first, stop):
        rows = 0
        for k in range(1 << window.levels):
            distance = window.guard + 1 + k * window.stride
            rows += (1 if row >= distance else 0) + (1 if row + distance < n_ranges else 0)
        for beam in range(n_beams):
            columns = min(beam + beams, n_beams - 1) - max(beam - beams, 0) + 1
            total[(row - first) * width + beams + beam] = rows * columns
