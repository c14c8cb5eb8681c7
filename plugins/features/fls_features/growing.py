"""Smooth chips, find where an object begins, and grow its region from there."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = ["Rule", "central", "grown", "reach", "seeds", "smoothed", "thresholds", "within"]

Rule = Literal["seed", "histogram", "percentile"]
FloatArray = npt.NDArray[np.float64]
SampleArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

HISTOGRAM_BINS = 100


def smoothed(amplitude: npt.NDArray[np.generic], size: tuple[int, int]) -> FloatArray:
    """Adaptive Wiener filter of chips (n, rows, columns), over `size` cells with zeros outside.

    f = mu + max(v - noise, 0) / max(v, noise) (x - mu), with the local mean mu and variance v, and their
    noise the mean of v over the chip. An even size has one more cell after the centre than before it. Equal
    to scipy.signal.wiener for odd sizes. Source: Lim 1990, 9.2; Brinkmann 2010, listing region.
    """
    chips = np.ascontiguousarray(amplitude, np.float32)
    out = np.empty(chips.shape)
    _wiener(frozen(chips), size[0], size[1], out)
    return out


@compiled
def _wiener(chips: SampleArray, height: int, width: int, out: FloatArray) -> None:
    n, rows, columns = chips.shape
    before, after = (height - 1) // 2, height // 2
    variance = np.empty((rows, columns))
    sums = np.empty((2, columns))  # of the amplitudes in the window's rows, and of their squares
    for k in range(n):
        sums[:] = 0.0
        for i in range(min(after, rows)):
            _shift(sums, chips[k, i], 1.0)
        noise = 0.0
        for i in range(rows):
            if i + after < rows:
                _shift(sums, chips[k, i + after], 1.0)
            if i - before - 1 >= 0:
                _shift(sums, chips[k, i - before - 1], -1.0)
            noise += _local(sums, height, width, out[k, i], variance[i])
        noise /= rows * columns
        for i in range(rows):
            for j in range(columns):
                v = variance[i, j]
                if v > noise:
                    mean = out[k, i, j]
                    out[k, i, j] = mean + (v - noise) / v * (np.float64(chips[k, i, j]) - mean)


@compiled
def _shift(sums: FloatArray, row: SampleArray, sign: float) -> None:
    for j in range(row.size):
        x = np.float64(row[j])  # float() would stay in single precision
        sums[0, j] += sign * x
        sums[1, j] += sign * (x * x)


@compiled
def _local(sums: FloatArray, height: int, width: int, mean: FloatArray, variance: FloatArray) -> float:
    """Fill in mean and variance of the windows along a row; gives the sum of the variances."""
    left, right = (width - 1) // 2, width // 2
    columns, count = mean.size, float(height * width)
    summed = 0.0
    for j in range(columns):
        total, square = 0.0, 0.0
        for m in range(max(j - left, 0), min(j + right + 1, columns)):
            total += sums[0, m]
            square += sums[1, m]
        mean[j] = total / count
        variance[j] = max(square / count - mean[j] * mean[j], 0.0)
        summed += variance[j]
    return summed


def central(shape: tuple[int, int]) -> BoolArray:
    """(rows, columns) the cells from 10 to 90 % of both sides of a chip, at least one."""
    inside = []
    for length in shape:
        low = max(int(np.floor(0.1 * length + 0.5)) - 1, 0)
        high = max(int(np.floor(0.9 * length + 0.5)), low + 1)
        one = np.zeros(length, bool)
        one[low:high] = True
        inside.append(one)
    return np.asarray(inside[0][:, None] & inside[1][None, :])


def within(distance_m: float, range_m: FloatArray, bearing_rad: FloatArray, centre: IntArray) -> BoolArray:
    """(n, rows, columns) the cells of chips that are at most so far from the centre cell, and that itself."""
    n = np.arange(centre.shape[0])
    r0, b0 = range_m[n, centre[:, 0]], bearing_rad[n, centre[:, 1]]
    r, turn = range_m[:, :, None], (bearing_rad - b0[:, None])[:, None, :]
    square = r**2 + r0[:, None, None] ** 2 - 2.0 * r * r0[:, None, None] * np.cos(turn)
    near = np.asarray(square <= distance_m**2)
    near[n, centre[:, 0], centre[:, 1]] = True
    return near


def seeds(filtered: FloatArray, candidate: BoolArray) -> IntArray:
    """(n, 2) row and column of the largest candidate cell of each chip; the first of equal ones."""
    n, _, columns = filtered.shape
    flat = np.where(candidate, filtered, -np.inf).reshape(n, -1).argmax(axis=1)
    return np.stack([flat // columns, flat % columns], axis=1).astype(np.int64)


def thresholds(filtered: FloatArray, seed: IntArray, rule: Rule, level: float) -> FloatArray:
    """(n,) what a cell must exceed to belong to the object.

    seed:        level * the seed's amplitude, so that a seed above zero always belongs to its region
    histogram:   the centre of bin 100 level, of 100 bins over the chip's amplitudes
    percentile:  the percentile 100 level of the chip

    Source: Brinkmann 2010, 4.3.2: the text says "at most 22 % from the seed" and "a high percentile", the
    listing takes the histogram.
    """
    n = filtered.shape[0]
    if rule == "seed":
        return np.asarray(level * filtered[np.arange(n), seed[:, 0], seed[:, 1]])
    cells = filtered.reshape(n, -1)
    if rule == "percentile":
        return np.asarray(np.percentile(cells, 100.0 * level, axis=1))
    low, high = cells.min(axis=1), cells.max(axis=1)
    part = (np.floor(HISTOGRAM_BINS * level + 0.5) - 0.5) / HISTOGRAM_BINS
    return np.asarray(low + part * (high - low))


def reach(gap_m: float, range_m: FloatArray, cell_m: float, beam_spacing_rad: float) -> FloatArray:
    """(n, 2) how many rows and columns a gap spans in chips whose objects are at ranges (n,); 0: unknown."""
    rows = gap_m / cell_m if cell_m > 0.0 else 0.0
    across_m = range_m * beam_spacing_rad
    with np.errstate(divide="ignore", invalid="ignore"):
        columns = np.where(across_m > 0.0, gap_m / across_m, 0.0)
    return np.stack([np.full(columns.shape, rows), columns], axis=1)


def grown(
    filtered: FloatArray, seed: IntArray, threshold: FloatArray, reach: FloatArray | None = None
) -> BoolArray:
    """(n, rows, columns) the cells above the threshold that are connected with the seed.

    Connected are the 8 neighbours of a cell, and with `reach` (n, 2) those in an ellipse of so many rows and
    columns about it. Empty where the seed itself is not above the threshold.
    """
    mask = np.zeros(filtered.shape, bool)
    spans = np.ones((filtered.shape[0], 2)) if reach is None else np.ascontiguousarray(reach, float)
    _flood(frozen(filtered), frozen(seed), frozen(threshold), frozen(spans), mask)
    return mask


@compiled
def _flood(
    filtered: FloatArray, seed: IntArray, threshold: FloatArray, reach: FloatArray, mask: BoolArray
) -> None:
    n, rows, columns = filtered.shape
    stack = np.empty(rows * columns, np.int64)
    for k in range(n):
        i, j = seed[k, 0], seed[k, 1]
        if not filtered[k, i, j] > threshold[k]:
            continue
        high, wide = max(reach[k, 0], 1.0), max(reach[k, 1], 1.0)
        up, aside = int(min(high, rows)), int(min(wide, columns))
        mask[k, i, j] = True
        stack[0] = i * columns + j
        depth = 1
        while depth > 0:
            depth -= 1
            i, j = stack[depth] // columns, stack[depth] % columns
            for a in range(max(i - up, 0), min(i + up + 1, rows)):
                u = (a - i) / high
                for b in range(max(j - aside, 0), min(j + aside + 1, columns)):
                    if mask[k, a, b] or not filtered[k, a, b] > threshold[k]:
                        continue
                    v = (b - j) / wide
                    if u * u + v * v <= 1.0 or (abs(a - i) <= 1 and abs(b - j) <= 1):
                        mask[k, a, b] = True
                        stack[depth] = a * columns + b
                        depth += 1
