"""Scouts: what might be a target, from pairs of peaks on, followed through the ratios of later pings.

A scout is a Gaussian over range and range rate, another over bearing, and the log likelihood ratio of that
path against clutter. All are rows of one array, whose columns are named below.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["COLUMNS", "Grid", "Motion", "best_of_cells", "born", "followed", "predicted"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Plane = npt.NDArray[np.float32]

RANGE, RATE, P_RR, P_RV, P_VV = range(5)
BEARING, TURN, P_BB, P_BT, P_TT = range(5, 10)
SCORE, AGE = 10, 11
COLUMNS = 12


class Grid(NamedTuple):
    """Where the cells of a ping lie; ranges and bearings are even."""

    first_m: float
    cell_m: float
    n_ranges: int
    first_rad: float
    beam_rad: float  # signed spacing
    n_beams: int
    closed: bool
    resolution_m: float
    beamwidth_rad: float


class Motion(NamedTuple):
    """How targets may move."""

    dt_s: float
    v_max_mps: float
    sigma_v_mps2: float
    cross_mps: float  # spread of speeds across the line of sight
    own_x_m: float  # the sonar's own way since the last ping, in its axes of then
    own_y_m: float
    own_turn_rad: float  # and its turn


@compiled
def predicted(scouts: FloatArray, motion: Motion) -> FloatArray:
    """The scouts (n, COLUMNS) after a step of nearly constant velocity, seen from where the sonar is then.

    Means move in Cartesian coordinates; covariances along and across the line of sight as if each were
    straight, with the noise of white acceleration.
    """
    new = scouts.copy()
    dt, q = motion.dt_s, motion.sigma_v_mps2**2
    for s in new:
        r, turn = s[RANGE], s[TURN]
        # Along and across the old line of sight: the velocity is (rate, r turn).
        c, n = math.cos(s[BEARING]), math.sin(s[BEARING])
        along = r + dt * s[RATE] - (motion.own_x_m * c + motion.own_y_m * n)
        across = dt * r * turn - (motion.own_y_m * c - motion.own_x_m * n)
        distance, angle = max(math.hypot(along, across), 1e-3), math.atan2(across, along)
        c, n = math.cos(angle), math.sin(angle)
        s[RANGE] = distance
        s[BEARING] = s[BEARING] + angle - motion.own_turn_rad
        s[RATE], s[TURN] = s[RATE] * c + r * turn * n, (r * turn * c - s[RATE] * n) / distance
        _spread(s[P_RR : P_VV + 1], dt, q)
        _spread(s[P_BB : P_TT + 1], dt, q / max(distance, 1.0) ** 2)
    return new


@compiled
def _spread(p: FloatArray, dt: float, q: float) -> None:
    p[0] += 2.0 * dt * p[1] + dt * dt * p[2] + q * dt**4 / 4.0
    p[1] += dt * p[2] + q * dt**3 / 2.0
    p[2] += q * dt * dt


@compiled
def followed(scouts: FloatArray, ratio: Plane, grid: Grid) -> FloatArray:
    """The predicted scouts after a ping: scored by their mean ratio, moved to where it says.

    With weights w_ij of the cells under the two Gaussians, the score grows by ln sum w_ij ratio_ij; range and
    bearing get the moments of w_ij ratio_ij, and the range rate those that it has given the range. Scouts
    that leave the ping have a score of -inf.

    Source: Bayes' rule on a grid, collapsed to Gaussians after each ping.
    """
    new = scouts.copy()
    rows, columns = np.empty(64), np.empty(64)
    for s in new:
        sd_r = math.sqrt(s[P_RR] + (0.3 * grid.resolution_m) ** 2)
        sd_b = math.sqrt(s[P_BB])
        low = math.ceil((s[RANGE] - 2.5 * sd_r - grid.first_m) / grid.cell_m)
        high = min(math.floor((s[RANGE] + 2.5 * sd_r - grid.first_m) / grid.cell_m), low + 63)
        left = math.ceil((s[BEARING] - 2.0 * sd_b - grid.first_rad) / grid.beam_rad)
        right = math.floor((s[BEARING] + 2.0 * sd_b - grid.first_rad) / grid.beam_rad)
        middle = math.floor((s[BEARING] - grid.first_rad) / grid.beam_rad + 0.5)
        left, right = max(min(left, middle - 1), middle - 31), min(max(right, middle + 1), middle + 31)
        if low < 0 or high >= grid.n_ranges or high < low:
            s[SCORE] = -np.inf
            continue
        if not grid.closed:
            left, right = max(left, 0), min(right, grid.n_beams - 1)
            if right < left:
                s[SCORE] = -np.inf
                continue
        sum_r = sum_b = 0.0
        for i in range(low, high + 1):
            rows[i - low] = math.exp(-0.5 * ((grid.first_m + i * grid.cell_m - s[RANGE]) / sd_r) ** 2)
            sum_r += rows[i - low]
        for j in range(left, right + 1):
            off = (grid.first_rad + j * grid.beam_rad - s[BEARING]) / sd_b
            columns[j - left] = math.exp(-0.5 * off * off)
            sum_b += columns[j - left]
        total = r1 = r2 = b1 = b2 = 0.0
        for i in range(low, high + 1):
            dr = grid.first_m + i * grid.cell_m - s[RANGE]
            for j in range(left, right + 1):
                w = rows[i - low] * columns[j - left] * ratio[i, j % grid.n_beams]
                db = grid.first_rad + j * grid.beam_rad - s[BEARING]
                total += w
                r1 += w * dr
                r2 += w * dr * dr
                b1 += w * db
                b2 += w * db * db
        r1, r2, b1, b2 = r1 / total, r2 / total, b1 / total, b2 / total
        s[SCORE] += math.log(total / (sum_r * sum_b))
        _moved(s[RANGE : P_VV + 1], r1, max(r2 - r1 * r1, 0.0) + grid.cell_m**2 / 12.0)
        _moved(s[BEARING : P_TT + 1], b1, max(b2 - b1 * b1, 0.0) + grid.beam_rad**2 / 12.0)
        s[AGE] += 1.0
    return new


@compiled
def _moved(s: FloatArray, mean: float, variance: float) -> None:
    """Give a place its new moments, and its rate those that follow."""
    variance = min(variance, s[2] + 1e-12)
    gain = s[3] / s[2]
    s[0] += mean
    s[1] += gain * mean
    s[4] -= gain * gain * (s[2] - variance)
    s[3] = gain * variance
    s[2] = variance


@compiled
def born(
    row: IntArray,
    beam: IntArray,
    old_row: IntArray,
    old_beam: IntArray,
    ratio: FloatArray,
    old_ratio: FloatArray,
    grid: Grid,
    motion: Motion,
    least: float,
) -> FloatArray:
    """Scouts (n, COLUMNS) of pairs of peaks, of the last ping and of this, that one target may have made.

    Seen from where the sonar was then, ranges differ by at most v_max dt, bearings by v_max dt / r and half a
    beamwidth. The score is the sum of
    both log ratios, less ln W, the resolution cells that the second might have been in; pairs below `least`
    are left out. Peaks come in order of beam, then row.
    """
    first, old_first = _of_beams(beam, grid.n_beams), _of_beams(old_beam, grid.n_beams)
    half_m = motion.v_max_mps * motion.dt_s
    reach = half_m / grid.cell_m
    turned = math.floor(motion.own_turn_rad / grid.beam_rad + 0.5)
    room, n = 4096, 0
    scouts = np.empty((room, COLUMNS))
    for b in range(grid.n_beams):
        for a in range(first[b], first[b + 1]):
            range_m = grid.first_m + row[a] * grid.cell_m
            half_rad = half_m / max(range_m, 1.0) + 0.5 * grid.beamwidth_rad
            side = min(int(half_rad / abs(grid.beam_rad)), (grid.n_beams - 1) // 2)
            window = (2.0 * half_m / grid.resolution_m + 1.0) * max(2.0 * half_rad / grid.beamwidth_rad, 1.0)
            here = ratio[a] - math.log(window)
            bearing = grid.first_rad + b * grid.beam_rad
            own_m = motion.own_x_m * math.cos(bearing) + motion.own_y_m * math.sin(bearing)
            middle = row[a] + own_m / grid.cell_m
            for k in range(b + turned - side, b + turned + side + 1):
                if not grid.closed and not 0 <= k < grid.n_beams:
                    continue
                c = k % grid.n_beams
                low, high = old_first[c], old_first[c + 1]
                e = low + np.searchsorted(old_row[low:high], middle - reach)
                while e < high and old_row[e] - middle <= reach:
                    score = here + old_ratio[e]
                    if score >= least:
                        if n == room:
                            room *= 2
                            more = np.empty((room, COLUMNS))
                            more[:n] = scouts
                            scouts = more
                        rate = (middle - old_row[e]) * grid.cell_m / motion.dt_s
                        between = bearing + 0.5 * (k - turned - b) * grid.beam_rad
                        _begin(scouts[n], range_m, rate, between, score, grid, motion)
                        n += 1
                    e += 1
    return scouts[:n].copy()


@compiled
def _begin(
    s: FloatArray, range_m: float, rate: float, bearing: float, score: float, grid: Grid, motion: Motion
) -> None:
    """Fill in a scout that two peaks began."""
    variance = (0.3 * grid.resolution_m) ** 2
    s[RANGE], s[RATE] = range_m, rate
    s[P_RR], s[P_RV] = variance, variance / motion.dt_s
    s[P_VV] = 2.0 * variance / motion.dt_s**2 + (motion.sigma_v_mps2 * motion.dt_s) ** 2 / 4.0
    s[BEARING], s[TURN], s[P_BB], s[P_BT] = bearing, 0.0, (0.4 * grid.beamwidth_rad) ** 2, 0.0
    s[P_TT] = (motion.cross_mps / max(range_m, 1.0)) ** 2
    s[SCORE], s[AGE] = score, 1.0


@compiled
def _of_beams(beam: IntArray, n_beams: int) -> IntArray:
    """Where each beam's peaks begin, (n_beams + 1,)."""
    first = np.zeros(n_beams + 1, np.int64)
    for b in beam:
        first[b + 1] += 1
    return np.cumsum(first)


@compiled
def best_of_cells(scouts: FloatArray, grid: Grid, rate_mps: float, least: float, most: int) -> FloatArray:
    """The best scout of each cell of range, bearing and range rate, those above `least`, at most `most`.

    Cells are a resolution cell long, half a beamwidth wide and `rate_mps` deep. Order stays that of the rows.
    """
    n = scouts.shape[0]
    mask = 1
    while mask < 2 * n + 2:
        mask *= 2
    table = np.full(mask, -1)
    keys = np.empty(n, np.int64)
    keep = np.zeros(n, np.bool_)
    width = 0.5 * grid.beamwidth_rad
    around = max(int(2.0 * math.pi / width), 1)
    for i in range(n):
        s = scouts[i]
        if not s[SCORE] >= least:
            continue
        r = math.floor(s[RANGE] / grid.resolution_m)
        b = math.floor(s[BEARING] / width) % around
        v = math.floor(s[RATE] / rate_mps + 0.5) + 512
        keys[i] = (r * 1024 + v) * 4096 + b
        slot = (keys[i] * 0x9E3779B97F4A7C1 >> 20) & (mask - 1)
        while table[slot] >= 0 and keys[table[slot]] != keys[i]:
            slot = (slot + 1) & (mask - 1)
        if table[slot] < 0:
            table[slot] = i
            keep[i] = True
        elif scouts[table[slot], SCORE] < s[SCORE]:
            keep[table[slot]] = False
            table[slot] = i
            keep[i] = True
    chosen = np.flatnonzero(keep)
    if chosen.size > most:
        order = np.argsort(-scouts[chosen, SCORE], kind="mergesort")[:most]
        chosen = np.sort(chosen[order])
    return scouts[chosen]
