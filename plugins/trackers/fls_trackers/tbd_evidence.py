"""What a ping says of a place that is known as two Gaussians: how probable it is, and where it must be."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen
from fls_trackers.tbd_grid import Grid
from fls_trackers.tbd_ratio import Codes, Plane

__all__ = ["LEAST", "evidence", "halves", "scratch", "wholes"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MOST_ROWS, MOST_BEAMS = 40, 20  # half cells and half beams that a scout looks at to either side of its place
EDGE = MOST_BEAMS + 4  # columns before the first beam's, and behind the last one's
INNER, OUTER = np.float32(0.5625), np.float32(0.0625)  # cubic interpolation half way
WIDE = 2.0  # standard deviations, in half cells or beams, from which whole ones are close enough
LEAST = 0.7  # standard deviation, in half cells or beams, that a Gaussian needs to be sampled there
BLUR = 0.14  # half cells or beams: what sums over them do not resolve


def halves(code: Codes, closed: bool) -> Codes:
    """A ping's codes (n_ranges, n_beams) at half cells and beams too, (2 n_ranges - 1, 2 n_beams + 2 EDGE).

    Those in between are interpolated, cubic, from the four cells or beams around. A closed ring goes on in
    the columns at the edges; else the outermost beams do.
    """
    n_beams = code.shape[1]
    beams = np.arange(-EDGE // 2 - 1, n_beams + EDGE // 2 + 2)
    return _halves(frozen(code), beams % n_beams if closed else np.clip(beams, 0, n_beams - 1))


def wholes(half: Codes) -> Codes:
    """The codes (n_ranges, n_beams) that `halves` were made of, as a copy."""
    return half[::2, EDGE:-EDGE:2].copy()


@compiled
def _halves(code: Codes, beams: IntArray) -> Codes:
    last, width = code.shape[0] - 1, 2 * (beams.size - 3)
    out = np.empty((2 * last + 1, width), np.uint8)
    lines = np.empty((4, width), np.float32)  # of the rows around
    line = np.empty(beams.size, np.float32)
    for i in range(-2, last + 1):
        if i + 2 <= last:
            _half_beams(lines[(i + 2) & 3], code[i + 2], beams, line)
        if i < 0:
            continue
        a, b = lines[max(i - 1, 0) & 3], lines[i & 3]
        c, d = lines[min(i + 1, last) & 3], lines[min(i + 2, last) & 3]
        for k in range(width):
            out[2 * i, k] = _rounded(b[k])
        for k in range(width if i < last else 0):
            out[2 * i + 1, k] = _rounded(INNER * (b[k] + c[k]) - OUTER * (a[k] + d[k]))
    return out


@compiled
def _half_beams(filled: Plane, code: Codes, beams: IntArray, line: Plane) -> None:
    for k in range(beams.size):
        line[k] = code[beams[k]]
    for k in range(beams.size - 3):
        filled[2 * k] = line[k + 1]
        filled[2 * k + 1] = INNER * (line[k + 1] + line[k + 2]) - OUTER * (line[k] + line[k + 3])


@compiled
def _rounded(x: np.float32) -> np.uint8:
    return np.uint8(min(max(x, np.float32(0.0)), np.float32(255.0)) + np.float32(0.5))


@compiled
def scratch() -> FloatArray:
    """Room for the weights of one sum after another."""
    return np.empty(2 * MOST_BEAMS + 1)


@compiled
def evidence(
    range_m: float,
    sd_r: float,
    bearing: float,
    sd_b: float,
    half: Codes,
    decoded: Plane,
    grid: Grid,
    weights: FloatArray,
) -> tuple[float, float, float, float, float]:
    """ln of the mean ratio under two Gaussians, and what it says of range and of bearing.

    Ratios are taken at half cells and half beams, of the codes `half`; where a Gaussian is wide, at whole
    ones only. Places count in halves from the first cell or beam. What is said are the information of an
    equivalent measurement, and that times its offset: the differences that the ratios make to 1 / variance
    and mean / variance of the Gaussians as they are summed, cut and sampled.
    """
    at_row = 2.0 * (range_m - grid.first_m) / grid.cell_m
    at_beam = 2.0 * (bearing - grid.first_rad) / grid.beam_rad
    if grid.closed:
        at_beam -= 2.0 * grid.n_beams * math.floor(0.5 * at_beam / grid.n_beams)
    sd_row, sd_beam = 2.0 * sd_r / grid.cell_m, 2.0 * sd_b / abs(grid.beam_rad)
    low, high, row_step = _within(at_row, sd_row, MOST_ROWS)
    left, right, beam_step = _within(at_beam, sd_beam, MOST_BEAMS)
    if not grid.closed:
        left, right = max(left, 0), min(right, 2 * grid.n_beams - 2)
    if low < 0 or high > 2 * grid.n_ranges - 2 or right < left:
        return -np.inf, 0.0, 0.0, 0.0, 0.0
    sum_b, prior_b1, prior_b2 = _gaussian(weights, left - at_beam, right - at_beam, beam_step, sd_beam)
    sum_r = prior_r1 = prior_r2 = total = r1 = r2 = b1 = b2 = 0.0
    w, fall, bend = _falling(low - at_row, row_step, sd_row)
    for i in range(low, high + 1, row_step):
        y = i - at_row
        at_i = at_bi = at_bbi = 0.0
        for n in range((right - left) // beam_step + 1):
            j = left + n * beam_step
            ratio = weights[n] * decoded[half[i, EDGE + j]]
            off = j - at_beam
            at_i += ratio
            at_bi += ratio * off
            at_bbi += ratio * off * off
        sum_r += w
        prior_r1 += w * y
        prior_r2 += w * y * y
        total += w * at_i
        r1 += w * at_i * y
        r2 += w * at_i * y * y
        b1 += w * at_bi
        b2 += w * at_bbi
        w *= fall
        fall *= bend
    by_r, by_b, by = 1.0 / sum_r, 1.0 / sum_b, 1.0 / total
    j_r, z_r = _said(prior_r1 * by_r, prior_r2 * by_r, r1 * by, r2 * by)
    j_b, z_b = _said(prior_b1 * by_b, prior_b2 * by_b, b1 * by, b2 * by)
    cell, beam = 2.0 / grid.cell_m, 2.0 / grid.beam_rad
    return math.log(total * by_r * by_b), j_r * cell * cell, z_r * cell, j_b * beam * beam, z_b * beam


@compiled
def _said(prior: float, prior_square: float, mean: float, square: float) -> tuple[float, float]:
    """Information, and that times offset, of what took the first two moments of a prior to others."""
    variance, before = square - mean * mean + BLUR * BLUR, prior_square - prior * prior + BLUR * BLUR
    after, earlier = 1.0 / variance, 1.0 / before
    if variance >= before:
        return 0.0, (mean - prior) * earlier
    return after - earlier, mean * after - prior * earlier


@compiled
def _gaussian(
    weights: FloatArray, first: float, last: float, step: int, sd: float
) -> tuple[float, float, float]:
    """Fill in exp(-x^2 / (2 sd^2)) from `first` to `last`; the sums of it, of it times x, and times x^2."""
    total = one = two = 0.0
    w, fall, bend = _falling(first, step, sd)
    for n in range(int((last - first) / step + 0.5) + 1):
        x = first + n * step
        weights[n] = w
        total += w
        one += w * x
        two += w * x * x
        w *= fall
        fall *= bend
    return total, one, two


@compiled
def _falling(x: float, step: int, sd: float) -> tuple[float, float, float]:
    """A Gaussian at x, its ratio to the next step's, and the ratio of that to the one after: products do."""
    one = 1.0 / (sd * sd)
    return (
        math.exp(-0.5 * x * x * one),
        math.exp(-(x + 0.5 * step) * step * one),
        math.exp(-step * step * one),
    )


@compiled
def _within(middle: float, sd: float, most: int) -> tuple[int, int, int]:
    """The first and last whole number within two standard deviations, or one step, and the step: 1 or 2."""
    near = math.floor(middle + 0.5)
    low, high = min(math.ceil(middle - 2.0 * sd), near - 1), max(math.floor(middle + 2.0 * sd), near + 1)
    low, high = max(low, near - most), min(high, near + most)
    if sd < WIDE:
        return low, high, 1
    return low + (low & 1), high - (high & 1), 2
