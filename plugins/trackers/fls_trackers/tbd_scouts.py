"""Scouts: what might be a target, from pairs of peaks on, followed through the ratios of other pings.

A scout is a Gaussian over range and range rate, another over bearing, the log likelihood ratio of that path
against clutter, and the noise of its motion. All are rows of one array, whose columns are named below.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.tbd_evidence import LEAST, evidence, scratch
from fls_trackers.tbd_grid import Grid, Motion
from fls_trackers.tbd_ratio import Codes, Plane

__all__ = ["COLUMNS", "best_of_cells", "by_range", "followed", "predicted", "with_agile"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

RANGE, RATE, P_RR, P_RV, P_VV = range(5)
BEARING, TURN, P_BB, P_BT, P_TT = range(5, 10)
SCORE, AGE, SIGMA = 10, 11, 12  # SIGMA: acceleration that its motion is allowed, m/s^2
COLUMNS = 13
ORDER_M = 0.25  # of range, in which the order of scouts does not matter


@compiled
def predicted(scouts: FloatArray, motion: Motion) -> FloatArray:
    """The scouts (n, COLUMNS) after a step of nearly constant velocity, seen from where the sonar is then.

    Means move in Cartesian coordinates; covariances along and across the line of sight as if each were
    straight, with the noise of white acceleration.
    """
    new = scouts.copy()
    dt = motion.dt_s
    for s in new:
        r, turn, q = s[RANGE], s[TURN], s[SIGMA] ** 2
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
def followed(scouts: FloatArray, half: Codes, decoded: Plane, grid: Grid, since: Motion) -> FloatArray:
    """The scouts after a ping `since.dt_s` before their time, 0 for that of now: scored, and moved by it.

    With weights w_ij of the cells under the Gaussians over range and bearing there, the score grows by
    ln sum w_ij ratio_ij. What the moments of w_ij ratio_ij say of the place then, the Kalman gain of
    [1, -dt] says of the place now and of its rate. Scouts that leave the ping have a score of -inf.

    Source: Bayes' rule on a grid, collapsed to Gaussians after each ping.
    """
    new = scouts.copy()
    dt = since.dt_s
    least_r, least_b = (LEAST * 0.5 * grid.cell_m) ** 2, (LEAST * 0.5 * grid.beam_rad) ** 2
    weights = scratch()
    for s in new:
        q = s[SIGMA] ** 2
        distance, bearing = _place(s, since)
        p_r = _variance(s[RANGE : P_VV + 1], dt, q)
        p_b = _variance(s[BEARING : P_TT + 1], dt, q / max(distance, 1.0) ** 2)
        wide_r, wide_b = max(p_r, least_r), max(p_b, least_b)
        gain, j_r, z_r, j_b, z_b = evidence(
            distance, math.sqrt(wide_r), bearing, math.sqrt(wide_b), half, decoded, grid, weights
        )
        s[SCORE] += gain
        if gain == -np.inf:
            continue
        _moved(s[RANGE : P_VV + 1], dt, p_r, j_r, z_r)
        _moved(s[BEARING : P_TT + 1], dt, p_b, j_b, z_b)
        s[AGE] += 1.0
    return new


@compiled
def _place(s: FloatArray, since: Motion) -> tuple[float, float]:
    """Range and bearing of a scout some time ago, seen from where the sonar was then."""
    distance, bearing = s[RANGE], s[BEARING]
    if since.dt_s > 0.0:
        along, across = distance - since.dt_s * s[RATE], -since.dt_s * distance * s[TURN]
        distance = math.hypot(along, across)
        bearing += math.atan2(across, along) + since.own_turn_rad
    if since.own_x_m != 0.0 or since.own_y_m != 0.0:
        c, n = math.cos(bearing), math.sin(bearing)
        along = distance + since.own_x_m * c + since.own_y_m * n
        across = since.own_y_m * c - since.own_x_m * n
        distance, bearing = math.hypot(along, across), bearing + math.atan2(across, along)
    return distance, bearing


@compiled
def _variance(s: FloatArray, dt: float, q: float) -> float:
    """Of a place `dt` ago, from mean and rate now and their covariance s[2:5]."""
    variance: float = max(s[2] - 2.0 * dt * s[3] + dt * dt * s[4], 1e-12) + q * dt**4 / 4.0
    return variance


@compiled
def _moved(s: FloatArray, dt: float, before: float, information: float, offset: float) -> None:
    """Give place and rate what is said of a place `dt` ago, of variance `before` until then: a Kalman update.

    `information` is that of the measurement, `offset` that times what it differs by.
    """
    after = before / (1.0 + before * information)
    gain, rate_gain = (s[2] - dt * s[3]) / before, (s[3] - dt * s[4]) / before
    s[0] += gain * after * offset
    s[1] += rate_gain * after * offset
    s[2] -= gain * gain * (before - after)
    s[3] -= gain * rate_gain * (before - after)
    s[4] -= rate_gain * rate_gain * (before - after)


def with_agile(scouts: FloatArray, agile_mps2: float, least: float, odds: float) -> FloatArray:
    """The scouts (n, COLUMNS), then copies of those from `least` on that may manoeuvre from now on.

    What speaks against that beforehand, ln of `odds`, is taken from their score.
    """
    turning = scouts[(scouts[:, SCORE] >= least) & (scouts[:, SIGMA] < agile_mps2)]
    turning[:, SIGMA], turning[:, SCORE] = agile_mps2, turning[:, SCORE] - math.log(odds)
    return np.concatenate([scouts, turning])


def by_range(scouts: FloatArray) -> FloatArray:
    """The scouts roughly in order of range: neighbours read the same rows of a ping, at hand by then."""
    step = np.clip(scouts[:, RANGE] / ORDER_M, 0.0, 32_767.0).astype(np.int16)  # of two bytes: by radix
    return scouts[np.argsort(step, kind="stable")]


@compiled
def best_of_cells(scouts: FloatArray, grid: Grid, rate_mps: float, least: float, most: int) -> FloatArray:
    """The best scout of each cell of range, bearing, rate and noise, those above `least`, at most `most`.

    Cells are a resolution cell long, half a beamwidth wide and `rate_mps` deep. Order stays that of the rows.
    """
    n = scouts.shape[0]
    mask = 1
    while mask < 2 * n + 2:
        mask *= 2
    table = np.full(mask, -1)
    keys = np.empty(n, np.int64)
    keep = np.zeros(n, np.bool_)
    usual = scouts[:, SIGMA].min() if n else 0.0
    width = 0.5 * grid.beamwidth_rad
    around = max(int(2.0 * math.pi / width), 1)
    for i in range(n):
        s = scouts[i]
        if not s[SCORE] >= least:
            continue
        r = math.floor(s[RANGE] / grid.resolution_m)
        b = math.floor(s[BEARING] / width) % around
        v = math.floor(s[RATE] / rate_mps + 0.5) + 512
        keys[i] = ((r * 1024 + v) * 4096 + b) * 2 + (s[SIGMA] > usual)
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
