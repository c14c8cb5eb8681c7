"""Sums over one side of the reference window of all cells, chunk by chunk along the ranges, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.reference import Window
from fls_flow.kernels import compiled

__all__ = ["blank_planes", "history_rows", "sum_window"]

IntArray = npt.NDArray[np.int64]


@compiled
def sum_window(
    cells: npt.NDArray[Any],
    n_beams: int,
    window: Window,
    history: IntArray,
    planes: npt.NDArray[Any],
) -> npt.NDArray[Any]:
    """Sums over one side of the window, of the chunk `cells` and 2 reach rows before, by where that begins.

    `planes` holds, one after the other, the sums over beams, over 4 rows of the window, over 16 and so on;
    what is left of the chunk before is moved out of the way first.
    """
    new, start = cells.size, 0
    for level in range(history.size):
        plane = planes[start : start + history[level] + new]
        plane[: history[level]] = plane[new:].copy()
        fresh = plane[history[level] :]
        if level == 0:
            _sum_beams(cells, n_beams, window.beams, fresh)
        else:
            shift = (window.stride << (2 * level - 2)) * n_beams
            _sum_rows(planes[start - history[level - 1] - new : start], shift, fresh)
        start += plane.size
    return planes[start - history[-1] - new :]


@compiled
def blank_planes(cells: npt.NDArray[Any], history: IntArray) -> npt.NDArray[Any]:
    """The `planes` of `sum_window` before its first chunk, for chunks like `cells`, with nothing before."""
    new, start = cells.size, 0
    planes = np.empty(history.sum() + history.size * new, cells.dtype)
    for kept in history:
        planes[start + new : start + new + kept] = 0
        start += kept + new
    return planes


@compiled
def history_rows(window: Window, reach: int) -> IntArray:
    """How many rows before a chunk each plane of `sum_window` holds: those that the next one needs."""
    planes = (window.levels + 1) // 2
    history = np.empty(planes + 1, np.int64)
    for k in range(planes):
        single = k == planes - 1 and window.levels % 2
        history[k] = (1 if single else 3) * (window.stride << (2 * k))
    history[planes] = 2 * reach - ((1 << window.levels) - 1) * window.stride
    return history


@compiled
def _sum_rows(plane: npt.NDArray[Any], shift: int, total: npt.NDArray[Any]) -> None:
    """Sum to each of `total` what stands in `plane` at its place and `shift` on, up to the plane's end."""
    n = total.size
    if plane.size - n == shift:
        one, two = plane[:n], plane[shift:]
        for i in range(n):
            total[i] = one[i] + two[i]
    else:
        one, two, three, four = plane[:n], plane[shift:][:n], plane[2 * shift :][:n], plane[3 * shift :]
        for i in range(n):
            total[i] = (one[i] + two[i]) + (three[i] + four[i])


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
