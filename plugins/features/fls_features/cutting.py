"""Which cells of a ping make the chip around a position, and the chips themselves."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import wrap

__all__ = ["Windows", "chip_size", "cut", "nearest_cells", "windows"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Windows(NamedTuple):
    """Where chips of `size` begin in an image, and the cell of each position inside its chip."""

    origin: IntArray  # (n, 2) row and column
    centre: IntArray  # (n, 2) row and column, from the origin
    size: tuple[int, int]


def chip_size(
    half_range_m: float, half_bearing_rad: float, cell_m: float, spacing_rad: float
) -> tuple[int, int]:
    """Odd numbers of rows and columns that reach the half sizes on both sides of a cell, to the nearest cell.

    A spacing that is not known (nan: one row, one beam) gives one cell.
    """
    halves = []
    for reach, step in ((half_range_m, cell_m), (half_bearing_rad, spacing_rad)):
        halves.append(int(np.floor(reach / step + 0.5)) if step > 0.0 else 0)
    return 2 * halves[0] + 1, 2 * halves[1] + 1


def nearest_cells(
    range_m: FloatArray, bearing_rad: FloatArray, at_range_m: FloatArray, at_bearing_rad: FloatArray
) -> IntArray:
    """(n, 2) row and column of the cells whose centres are nearest to polar positions (n,)."""
    above = np.clip(np.searchsorted(range_m, at_range_m), 1, max(range_m.size - 1, 1))
    below = above - 1
    above = np.minimum(above, range_m.size - 1)
    row = np.where(at_range_m - range_m[below] <= range_m[above] - at_range_m, below, above)
    column = np.abs(wrap(at_bearing_rad[:, None] - bearing_rad[None, :])).argmin(axis=1)
    return np.stack([row, column], axis=1).astype(np.int64)


def windows(cell: IntArray, size: tuple[int, int], shape: tuple[int, int]) -> Windows:
    """Windows around cells (n, 2) of an image of `shape`.

    At a border they are shifted and keep their size; an image smaller than the window bounds it. Source:
    Brinkmann 2010, listing chipExtract.
    """
    bounded = (min(size[0], shape[0]), min(size[1], shape[1]))
    last = np.array([shape[0] - bounded[0], shape[1] - bounded[1]])
    origin = np.clip(cell - np.array([size[0] // 2, size[1] // 2]), 0, last)
    return Windows(origin.astype(np.int64), (cell - origin).astype(np.int64), bounded)


def cut(image: npt.NDArray[Any], where: Windows) -> npt.NDArray[Any]:
    """(n, rows, columns) copies of the windows of an image."""
    row = where.origin[:, :1] + np.arange(where.size[0])
    column = where.origin[:, 1:] + np.arange(where.size[1])
    return np.asarray(image[row[:, :, None], column[:, None, :]])
