"""Tracks on likelihood ratios: a path in range and bearing, and beside it what speaks for every bearing.

A sparse array shows a target at several bearings, nearly equally strong, at one range. So each track keeps
the probabilities of all bearings, over its whole life: lobes compete inside the track instead of becoming
tracks of their own, and the track goes over to another lobe when that has become far more probable.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import wrap
from fls_flow.kernels import compiled
from fls_trackers.tbd_grid import Grid
from fls_trackers.tbd_ratio import STEPS
from fls_trackers.tbd_scouts import BEARING, P_BB, P_BT, P_RR, P_RV, P_TT, P_VV, RANGE, RATE, TURN

__all__ = ["bearings_of", "cartesian", "first_bearings", "likeliest_bearing", "spread_bearings"]

FloatArray = npt.NDArray[np.float64]
Plane = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

FLOOR = 1e-2  # of the probability of all bearings together that is spread evenly: none is ever ruled out
LEAST_STEP = 0.6  # beams: a narrower Gaussian, sampled, would not move as far as it should
UNKNOWN = 0.2  # the same when a track begins: its scouts have not seen all lobes


def first_bearings(bearing_rad: FloatArray, score: FloatArray, grid: Grid) -> FloatArray:
    """Probabilities of all beams (n_beams,) from scouts that follow one target: Gaussians by their scores."""
    table = grid.first_rad + grid.beam_rad * np.arange(grid.n_beams)
    weight = np.exp(score - score.max())
    off = wrap(table[None, :] - bearing_rad[:, None]) / (0.4 * grid.beamwidth_rad)
    total = weight @ np.exp(-0.5 * off**2)
    belief: FloatArray = (1.0 - UNKNOWN) * total / total.sum() + UNKNOWN / grid.n_beams
    return belief


def spread_bearings(belief: FloatArray, shift_rad: FloatArray, sd_rad: FloatArray, grid: Grid) -> FloatArray:
    """Probabilities (n, n_beams) after each has moved by `shift_rad` (n,), as its track has, and diffused.

    What diffuses is at least LEAST_STEP beams wide, else probability could not pass from beam to beam.
    """
    if not len(belief):
        return belief
    n = grid.n_beams
    sd_rad = np.maximum(sd_rad, LEAST_STEP * abs(grid.beam_rad))
    if grid.closed:
        kernel = _kernel(wrap(np.arange(n) * grid.beam_rad - shift_rad[:, None]), sd_rad)
        spread = np.fft.irfft(np.fft.rfft(belief, axis=1) * np.fft.rfft(kernel, axis=1), n, axis=1)
    else:
        kernel = _kernel(np.arange(-n + 1, n) * grid.beam_rad - shift_rad[:, None], sd_rad)
        padded = np.pad(belief, ((0, 0), (n - 1, n - 1)))
        spread = np.stack([np.convolve(p, k, "valid") for p, k in zip(padded, kernel, strict=True)])
    spread = np.maximum(spread, 0.0)
    return _floored(spread / np.maximum(spread.sum(axis=1, keepdims=True), 1e-300))


def _kernel(off_rad: FloatArray, sd_rad: FloatArray) -> FloatArray:
    kernel: FloatArray = np.exp(-0.5 * (off_rad / sd_rad[:, None]) ** 2)
    kernel /= np.maximum(kernel.sum(axis=1, keepdims=True), 1e-300)
    return kernel


def _floored(belief: FloatArray) -> FloatArray:
    floored: FloatArray = (1.0 - FLOOR) * belief + FLOOR / belief.shape[-1]
    return floored


def bearings_of(
    tracks: FloatArray, belief: FloatArray, level: FloatArray, excess: Plane, tables: Plane, grid: Grid
) -> tuple[FloatArray, FloatArray]:
    """The beliefs (n, n_beams) after a ping, and each track's echo, (n,).

    Row l of `tables` holds the ratios for targets of l + 1 dB; that of a track is its `level` (n,), learnt
    from earlier pings: a strong target tells its lobes apart sooner. For a track's rows i with weights w_i of
    its Gaussian over range, L_j = sum_i w_i ratio_ij; the new belief is belief_j L_j over their sum, and the
    echo the mean of the power under the cells' probabilities after the ping, less the clutter.
    """
    row = np.clip(np.rint(10.0 * np.log10(np.maximum(level, 1.0))), 1, len(tables)).astype(np.int64) - 1
    likelihood, power = _bearing_likelihood(tracks, row, excess, tables, grid)
    mean = (belief * likelihood).sum(axis=1)
    echo = (belief * power).sum(axis=1) / mean - 1.0
    return _floored(belief * likelihood / mean[:, None]), echo


@compiled
def _bearing_likelihood(
    tracks: FloatArray, level: IntArray, excess: Plane, tables: Plane, grid: Grid
) -> tuple[FloatArray, FloatArray]:
    """L (n, n_beams) and sum_i w_i ratio_ij u_ij; both 1 where a track's rows lie outside the ping."""
    found, power = np.ones((tracks.shape[0], excess.shape[1])), np.ones((tracks.shape[0], excess.shape[1]))
    last = np.float32(tables.shape[1] - 1)
    for t in range(tracks.shape[0]):
        sd = math.sqrt(tracks[t, P_RR] + grid.cell_m**2 / 12.0)
        middle = (tracks[t, RANGE] - grid.first_m) / grid.cell_m
        half = 2.5 * sd / grid.cell_m
        low, high = max(math.ceil(middle - half), 0), min(math.floor(middle + half), grid.n_ranges - 1)
        if high < low:
            continue
        found[t], power[t] = 0.0, 0.0
        total = 0.0
        for i in range(low, high + 1):
            w = math.exp(-0.5 * ((i - middle) * grid.cell_m / sd) ** 2)
            total += w
            for j in range(excess.shape[1]):
                u = excess[i, j]
                ratio = w * tables[level[t], int(min(u * np.float32(STEPS), last))]
                found[t, j] += ratio
                power[t, j] += ratio * u
        found[t] /= total
        power[t] /= total
    return found, power


def likeliest_bearing(tracks: FloatArray, belief: FloatArray, odds: FloatArray, grid: Grid) -> FloatArray:
    """The tracks (n, COLUMNS), those on a lobe `odds` (n,) less probable than another moved over to that one.

    A lobe's probability is that of the beams within 1.5 beamwidths. The rate of bearing stays: lobes move
    along with the target.
    """
    if not len(tracks):
        return tracks
    width = max(int(1.5 * grid.beamwidth_rad / abs(grid.beam_rad) + 0.5), 1)
    steps = np.arange(-width, width + 1)
    mass = np.sum([np.roll(belief, int(step), axis=1) for step in steps], axis=0)
    best = mass.argmax(axis=1)
    table = grid.first_rad + grid.beam_rad * np.arange(grid.n_beams)
    near = wrap(table[None, :] - tracks[:, BEARING, None])
    own = np.take_along_axis(mass, np.abs(near).argmin(axis=1)[:, None], axis=1)[:, 0]
    moved = tracks.copy()
    for t in np.flatnonzero(mass[np.arange(len(tracks)), best] > odds * own):
        beams = (best[t] + steps) % grid.n_beams
        weight = belief[t, beams] / belief[t, beams].sum()
        off = steps * grid.beam_rad
        mean = float(weight @ off)
        moved[t, BEARING] = float(wrap(table[best[t]] + mean))
        moved[t, P_BB] = float(weight @ (off - mean) ** 2) + grid.beam_rad**2 / 12.0
        moved[t, P_BT] = 0.0
    return moved


def cartesian(tracks: FloatArray, delay_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) of tracks (n, COLUMNS), `delay_s` (n,) before their time."""
    r, rate, turn = tracks[:, RANGE], tracks[:, RATE], tracks[:, TURN]
    c, n = np.cos(tracks[:, BEARING]), np.sin(tracks[:, BEARING])
    along, across = np.stack([c, n], axis=1), np.stack([-n, c], axis=1)
    velocity = rate[:, None] * along + (r * turn)[:, None] * across
    position = r[:, None] * along - velocity * delay_s[:, None]
    J = np.zeros((len(tracks), 4, 4))  # of x, y, vx, vy by range, its rate, bearing, its rate
    J[:, :2, 0], J[:, :2, 2] = along, r[:, None] * across
    J[:, 2:, 0], J[:, 2:, 1] = turn[:, None] * across, along
    J[:, 2:, 2] = rate[:, None] * across - (r * turn)[:, None] * along
    J[:, 2:, 3] = r[:, None] * across
    J[:, :2] -= delay_s[:, None, None] * J[:, 2:]
    P = np.zeros((len(tracks), 4, 4))
    for first, columns in ((0, (P_RR, P_RV, P_VV)), (2, (P_BB, P_BT, P_TT))):
        P[:, first, first], P[:, first + 1, first + 1] = tracks[:, columns[0]], tracks[:, columns[2]]
        P[:, first, first + 1] = P[:, first + 1, first] = tracks[:, columns[1]]
    covariance = J @ P @ np.swapaxes(J, 1, 2)
    return np.concatenate([position, velocity], axis=1), 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
