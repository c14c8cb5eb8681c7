"""Statistics of overlapping snippets of an image, and the areas that they make."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = ["RATIO_SD", "RAYLEIGH_RATIO", "Areas", "Snippets", "areas", "painted", "snippets", "starts"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

RAYLEIGH_RATIO = float(np.sqrt(4.0 / np.pi - 1.0))  # std / mean of Rayleigh amplitudes, of any scale
RATIO_SD = 0.3713  # sampling sd of that ratio, times sqrt(cells)


@dataclass(frozen=True, eq=False)
class Snippets:
    """A grid of equal snippets; those without a finite, valid cell have mean and ratio nan."""

    row: IntArray  # (n_rows,) first range cell of each row of the grid
    beam: IntArray  # (n_columns,) first beam of each column
    shape: tuple[int, int]  # cells of one snippet
    cells: FloatArray  # (n_rows, n_columns) valid ones
    mean: FloatArray  # (n_rows, n_columns)
    ratio: FloatArray  # (n_rows, n_columns) population std / mean


class Areas(NamedTuple):
    """Connected areas of cells, in order of range, then beam."""

    cells: IntArray  # (n,)
    weight: FloatArray  # (n,) sum of amplitudes
    row: FloatArray  # (n,) amplitude-weighted centroid, in cells
    beam: FloatArray  # (n,)
    height: IntArray  # (n,) rows of the bounding box
    width: IntArray  # (n,)


def starts(size: int, snippet: int, overlap: float) -> IntArray:
    """First cells of snippets along an axis: evenly with the overlap, the last one flush with the end."""
    if size <= snippet:
        return np.zeros(1 if size else 0, np.int64)
    step = max(1, int(np.floor(snippet * (1.0 - overlap) + 0.5)))
    first = np.arange(0, size - snippet + 1, step)
    return first if first[-1] == size - snippet else np.append(first, size - snippet)


def snippets(
    amplitude: npt.NDArray[np.float32], valid: BoolArray | None, shape: tuple[int, int], overlap: float
) -> Snippets:
    """The statistics of all snippets of an image (n_ranges, n_beams) of finite amplitudes.

    mean = S1 / n, ratio = sqrt(S2 / n - mean^2) / mean, with the sums S1, S2 and n over the valid cells; a
    snippet is cut where the image is smaller.
    """
    rows, beams = (starts(size, s, overlap) for size, s in zip(amplitude.shape, shape, strict=True))
    height, width = (min(size, s) for size, s in zip(amplitude.shape, shape, strict=True))
    known = np.zeros((0, 0), bool) if valid is None else valid
    n, S1, S2 = _sums(frozen(amplitude), frozen(known), frozen(rows), frozen(beams), height, width)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = S1 / n
        ratio = np.sqrt(np.maximum(S2 / n - mean * mean, 0.0)) / mean
    return Snippets(rows, beams, (height, width), n, mean, ratio)


@compiled
def _sums(
    amplitude: npt.NDArray[np.float32],
    valid: BoolArray,
    row: IntArray,
    beam: IntArray,
    height: int,
    width: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Number, sum and sum of squares of the valid cells of each snippet, (n_rows, n_columns).

    Columns first, then along the snippet: no cell counts in a snippet that it is not in. Differences of an
    integral image would carry the rounding of one huge cell into all snippets behind it.
    """
    shape = (row.size, beam.size)
    n, S1, S2 = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    beams = amplitude.shape[1]
    count, total, squares = np.empty(beams), np.empty(beams), np.empty(beams)
    for i in range(row.size):
        count[:], total[:], squares[:] = 0.0, 0.0, 0.0
        for a in range(row[i], row[i] + height):
            for b in range(beams):
                known = valid.size == 0 or valid[a, b]
                x = float(amplitude[a, b]) if known else 0.0
                count[b] += known
                total[b] += x
                squares[b] += x * x
        for j in range(beam.size):
            for b in range(beam[j], beam[j] + width):
                n[i, j] += count[b]
                S1[i, j] += total[b]
                S2[i, j] += squares[b]
    return n, S1, S2


def painted(grid: Snippets, flagged: BoolArray, shape: tuple[int, int]) -> BoolArray:
    """The cells (n_ranges, n_beams) that a flagged snippet covers."""
    mask = np.zeros(shape, bool)
    _paint(mask, frozen(grid.row), frozen(grid.beam), frozen(flagged), grid.shape[0], grid.shape[1])
    return mask


@compiled
def _paint(
    mask: BoolArray, row: IntArray, beam: IntArray, flagged: BoolArray, height: int, width: int
) -> None:
    for i in range(row.size):
        for j in range(beam.size):
            if flagged[i, j]:
                for a in range(row[i], row[i] + height):
                    for b in range(beam[j], beam[j] + width):
                        mask[a, b] = True


def areas(mask: BoolArray, amplitude: npt.NDArray[np.float32]) -> Areas:
    """The 8-connected areas of a mask, with centroids weighted by amplitude (plain ones where that is 0)."""
    rows = np.flatnonzero(mask.any(axis=1))
    if not rows.size:
        none = np.zeros(0, np.int64)
        return Areas(none, np.zeros(0), np.zeros(0), np.zeros(0), none, none)
    first = int(rows[0])
    part = np.s_[first : int(rows[-1]) + 1]
    found = cv2.connectedComponentsWithStats(mask[part].view(np.uint8), connectivity=8)
    count, labels, stats, plain = found
    sums = _weighted(np.asarray(labels, np.int32), frozen(amplitude[part]), count)
    weight = sums[0]
    safe = np.where(weight > 0.0, weight, 1.0)
    row = first + np.where(weight > 0.0, sums[1] / safe, plain[:, 1])
    beam = np.where(weight > 0.0, sums[2] / safe, plain[:, 0])
    which: IntArray = np.arange(1, count)
    which = which[np.lexsort((beam[1:], row[1:]))]
    return Areas(
        stats[which, cv2.CC_STAT_AREA].astype(np.int64),
        weight[which],
        row[which],
        beam[which],
        stats[which, cv2.CC_STAT_HEIGHT].astype(np.int64),
        stats[which, cv2.CC_STAT_WIDTH].astype(np.int64),
    )


@compiled
def _weighted(labels: npt.NDArray[np.int32], amplitude: npt.NDArray[np.float32], count: int) -> FloatArray:
    """Sums (3, count) over each label of the amplitudes, and of these times row and beam."""
    sums = np.zeros((3, count))
    for a in range(labels.shape[0]):
        for b in range(labels.shape[1]):
            k = labels[a, b]
            if k:
                x = float(amplitude[a, b])
                sums[0, k] += x
                sums[1, k] += x * a
                sums[2, k] += x * b
    return sums
