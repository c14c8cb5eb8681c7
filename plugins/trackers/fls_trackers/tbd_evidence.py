"""What a ping says of a place that is known as two Gaussians: how probable it is, and where it must be."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.tbd_grid import Grid
from fls_trackers.tbd_ratio import Codes, Plane

__all__ = ["LEAST", "Room", "evidence", "room"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MOST_ROWS, MOST_BEAMS = 40, 20  # half cells and half beams that a scout looks at to either side of its place
INNER, OUTER = np.float32(0.5625), np.float32(0.0625)  # cubic interpolation half way
WIDE = 3.0  # standard deviations, in half cells or beams, from which whole ones are close enough
LEAST = 0.7  # standard deviation, in half cells or beams, that a Gaussian needs to be sampled there
BLUR = 0.14  # half cells or beams: what sums over them do not resolve


class Room(NamedTuple):
    """Where the sums are made."""

    codes: Plane  # rows by half beams
    weights: FloatArray  # of the half beams
    beams: IntArray  # the columns of whole ones


@compiled
def room() -> Room:
    """Room for one sum after another."""
    codes = np.empty((MOST_ROWS + 5, 2 * MOST_BEAMS + 1), np.float32)
    return Room(codes, np.empty(2 * MOST_BEAMS + 1), np.empty(MOST_BEAMS + 5, np.int64))


@compiled
def evidence(
    range_m: float,
    sd_r: float,
    bearing: float,
    sd_b: float,
    code: Codes,
    decoded: Plane,
    grid: Grid,
    room: Room,
) -> tuple[float, float, float, float, float]:
    """ln of the mean ratio under two Gaussians, and what it says of range and of bearing.

    Log ratios are taken at half cells and half beams too, between those of the four cells and beams around;
    where a Gaussian is wide, at whole ones only. Places count in halves from the first cell or beam. What is
    said are the information of an equivalent measurement, and that times its offset: the differences that the
    ratios make to 1 / variance and mean / variance of the Gaussians as they are summed, cut and sampled.
    """
    at_row = 2.0 * (range_m - grid.first_m) / grid.cell_m
    at_beam = 2.0 * (bearing - grid.first_rad) / grid.beam_rad
    sd_row, sd_beam = 2.0 * sd_r / grid.cell_m, 2.0 * sd_b / abs(grid.beam_rad)
    low, high, row_step = _within(at_row, sd_row, MOST_ROWS)
    left, right, beam_step = _within(at_beam, sd_beam, MOST_BEAMS)
    if not grid.closed:
        left, right = max(left, 0), min(right, 2 * grid.n_beams - 2)
    if low < 0 or high > 2 * grid.n_ranges - 2 or right < left:
        return -np.inf, 0.0, 0.0, 0.0, 0.0
    codes, weights = room.codes, room.weights
    top = _look(low, high, left, right, beam_step, code, grid, room)
    sum_b, prior_b1, prior_b2 = _gaussian(room.weights, left - at_beam, right - at_beam, beam_step, sd_beam)
    sum_r = prior_r1 = prior_r2 = total = r1 = r2 = b1 = b2 = 0.0
    w, fall, bend = _falling(low - at_row, row_step, sd_row)
    for i in range(low, high + 1, row_step):
        k, y = (i >> 1) - top, i - at_row
        at_i = at_bi = at_bbi = 0.0
        for n in range((right - left) // beam_step + 1):
            x = codes[k, n]
            if i & 1:
                x = INNER * (x + codes[k + 1, n]) - OUTER * (codes[k - 1, n] + codes[k + 2, n])
            ratio = (
                weights[n] * decoded[int(min(max(x, np.float32(0.0)), np.float32(255.0)) + np.float32(0.5))]
            )
            off = left + n * beam_step - at_beam
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
def _look(
    low: int,
    high: int,
    left: int,
    right: int,
    step: int,
    code: Codes,
    grid: Grid,
    room: Room,
) -> int:
    """Fill `room` with the codes at half beams `left` to `right`, from the row that is returned on."""
    top, first = (low >> 1) - 1, (left >> 1) - 1
    codes, beams = room.codes, room.beams
    turn = first % grid.n_beams - first
    for k in range((right >> 1) + 3 - first):
        beam = first + k
        if not grid.closed:
            beams[k] = min(max(beam, 0), grid.n_beams - 1)
            continue
        while beam + turn >= grid.n_beams:
            turn -= grid.n_beams
        beams[k] = beam + turn
    for i in range(top, (high >> 1) + 3):
        line, filled = code[min(max(i, 0), grid.n_ranges - 1)], codes[i - top]
        for n in range((right - left) // step + 1):
            j = left + n * step
            k = (j >> 1) - first
            x = np.float32(line[beams[k]])
            if j & 1:
                outer = np.float32(line[beams[k - 1]]) + np.float32(line[beams[k + 2]])
                x = INNER * (x + np.float32(line[beams[k + 1]])) - OUTER * outer
            filled[n] = x
    return top


@compiled
def _within(middle: float, sd: float, most: int) -> tuple[int, int, int]:
    """The first and last whole number within two standard deviations, or one step, and the step: 1 or 2."""
    near = math.floor(middle + 0.5)
    low, high = min(math.ceil(middle - 2.0 * sd), near - 1), max(math.floor(middle + 2.0 * sd), near + 1)
    low, high = max(low, near - most), min(high, near + most)
    if sd < WIDE:
        return low, high, 1
    return low + (low & 1), high - (high & 1), 2
