"""Beams that a ship's own noise fills, and the peaks in them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = [
    "adjacent_groups",
    "beam_medians",
    "guard_beams",
    "loud_beams",
    "median_normalised",
    "strongest_peaks",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]
BoolArray = npt.NDArray[np.bool_]

BLOCK = 32  # beams and cells that are worked on at once


def beam_medians(amplitude: npt.NDArray[Any], valid: BoolArray | None = None) -> FloatArray:
    """d (n_beams,): the median over range of each beam's valid, finite cells; nan for a beam without any."""
    n_ranges, n_beams = amplitude.shape
    if not amplitude.size:
        return np.full(n_beams, np.nan)
    if valid is None and amplitude.dtype == np.uint8:
        return _histogram_medians(frozen(amplitude))
    columns = _columns(frozen(amplitude))
    if valid is None and (columns.dtype != np.float32 or np.isfinite(columns).all()):
        middle = n_ranges // 2
        columns.partition(middle, axis=1)
        upper = columns[:, middle].astype(float)
        lower = columns[:, :middle].max(axis=1).astype(float) if n_ranges % 2 == 0 else upper
        medians: FloatArray = 0.5 * (lower + upper)
        return medians
    usable = np.isfinite(columns) if valid is None else np.isfinite(columns) & valid.T
    return _usable_medians(columns.astype(float), usable)


def _usable_medians(columns: FloatArray, usable: BoolArray) -> FloatArray:
    ordered = np.sort(np.where(usable, columns, np.inf), axis=1)
    count = np.count_nonzero(usable, axis=1)
    beam = np.arange(count.size)
    middle = 0.5 * (
        ordered[beam, np.maximum(count - 1, 0) // 2]
        + ordered[beam, np.minimum(count // 2, ordered.shape[1] - 1)]
    )
    return np.where(count > 0, middle, np.nan)


@compiled
def _columns(amplitude: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The transposed image as a contiguous copy, made in blocks that fit the first-level cache."""
    n_ranges, n_beams = amplitude.shape
    columns = np.empty((n_beams, n_ranges), amplitude.dtype)
    for top in range(0, n_ranges, BLOCK):
        for left in range(0, n_beams, BLOCK):
            for beam in range(left, min(left + BLOCK, n_beams)):
                for row in range(top, min(top + BLOCK, n_ranges)):
                    columns[beam, row] = amplitude[row, beam]
    return columns


@compiled
def _histogram_medians(amplitude: npt.NDArray[np.uint8]) -> FloatArray:
    n_ranges, n_beams = amplitude.shape
    counts = np.zeros((n_beams, 256), np.int32)
    for left in range(0, n_beams, BLOCK):
        for row in range(n_ranges):
            for beam in range(left, min(left + BLOCK, n_beams)):
                counts[beam, amplitude[row, beam]] += 1
    medians = np.empty(n_beams)
    for beam in range(n_beams):
        level, below = 0, counts[beam, 0]
        while below < (n_ranges + 1) // 2:
            level += 1
            below += counts[beam, level]
        lower = level
        while below < n_ranges // 2 + 1:
            level += 1
            below += counts[beam, level]
        medians[beam] = 0.5 * (lower + level)
    return medians


def guard_beams(beamwidth_rad: float, spacing_rad: float) -> int:
    """n_g = 3 floor(beamwidth / spacing), and 3 where one of them is not known.

    Source: Karoui 2015 (2).
    """
    ratio = beamwidth_rad / spacing_rad if spacing_rad > 0.0 else np.nan
    return 3 * int(ratio + 1e-9) if np.isfinite(ratio) else 3


def loud_beams(median: FloatArray, xi: float, window: int, guard: int, floor: float = 0.0) -> BoolArray:
    """Beams j with d(j) > xi max(mean{ d(i): guard < |i - j| <= window }, floor), over existing beams i.

    Never where there is no such beam, or where their mean and `floor` are both zero.

    Source: Karoui 2015 (1), with the mean over existing beams at the edges.
    """
    n = median.size
    known = np.isfinite(median)
    total = np.concatenate([[0.0], np.cumsum(np.where(known, median, 0.0))])
    count = np.concatenate([[0], np.cumsum(known)])
    beam = np.arange(n)
    ends = [np.clip(beam + k, 0, n) for k in (-window, -guard, guard + 1, window + 1)]
    inner = total[ends[1]] - total[ends[0]] + total[ends[3]] - total[ends[2]]
    terms = count[ends[1]] - count[ends[0]] + count[ends[3]] - count[ends[2]]
    reference = np.maximum(inner / np.maximum(terms, 1), floor)
    loud: BoolArray = (
        known & (terms > 0) & (reference > 0.0) & (np.where(known, median, 0.0) > xi * reference)
    )
    return loud


def adjacent_groups(flagged: BoolArray) -> list[slice]:
    """The runs of adjacent flagged beams, in order."""
    steps = np.diff(np.concatenate([[False], flagged, [False]]).astype(np.int8))
    pairs = zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1), strict=True)
    return [slice(int(first), int(last)) for first, last in pairs]


def median_normalised(beam: npt.NDArray[Any], half_width: int) -> FloatArray:
    """x(m) / median{ x(m - half_width) .. x(m + half_width) }, the window cut at the ends.

    Cells that are nan count in no window; they, and those whose median is zero, become zero.

    Source: Karoui 2015 (3).
    """
    return _median_normalised(frozen(np.where(np.isfinite(beam), beam, np.nan).astype(float)), half_width)


@compiled
def _median_normalised(beam: FloatArray, half_width: int) -> FloatArray:
    """Keep the window sorted: one value leaves, one enters."""
    n = beam.size
    window = np.empty(2 * half_width + 2)
    count = 0
    normalised = np.zeros(n)
    for entering in range(n + half_width):
        if entering < n and not np.isnan(beam[entering]):
            at = np.searchsorted(window[:count], beam[entering])
            for i in range(count, at, -1):
                window[i] = window[i - 1]
            window[at] = beam[entering]
            count += 1
        leaving = entering - 2 * half_width - 1
        if leaving >= 0 and not np.isnan(beam[leaving]):
            at = np.searchsorted(window[:count], beam[leaving])
            for i in range(at, count - 1):
                window[i] = window[i + 1]
            count -= 1
        cell = entering - half_width
        if cell >= 0 and not np.isnan(beam[cell]):
            median = 0.5 * (window[(count - 1) // 2] + window[count // 2])
            if median > 0.0:
                normalised[cell] = beam[cell] / median
    return normalised


def strongest_peaks(beam: FloatArray, n_peaks: int, separation: int) -> IntArray:
    """Cells of the strongest local maxima, x(m) > x(m - 1) and x(m) >= x(m + 1), in order of range.

    The stronger suppresses those less than `separation` cells away; of equals the nearer wins. The first and
    the last cell are none.
    """
    inner = beam[1:-1]
    cells = np.flatnonzero((inner > beam[:-2]) & (inner >= beam[2:])) + 1
    chosen: list[int] = []
    for cell in cells[np.argsort(-beam[cells], kind="stable")]:
        if len(chosen) == n_peaks:
            break
        if all(abs(int(cell) - other) >= separation for other in chosen):
            chosen.append(int(cell))
    return np.array(sorted(chosen), np.intp)
