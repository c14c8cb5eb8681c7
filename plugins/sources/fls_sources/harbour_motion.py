"""How divers and animals move in a sector: wandering, turning back at its borders, keeping apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = ["STEP_S", "Gait", "Visits", "walks"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

STEP_S = 0.1  # of the integration
AHEAD_S = 4.0  # how far ahead a swimmer sees the border of the sector
BORDER_M = 2.0  # and how far it keeps from it


@dataclass(frozen=True, slots=True)
class Gait:
    """How one swimmer moves: its mean speed, and how speed and heading wander about it."""

    speed_mps: float
    speed_log_sd: float  # standard deviation of the logarithm of the speed
    speed_tau_s: float
    turn_sd_radps: float  # of the turn rate
    turn_tau_s: float
    turn_max_radps: float


@dataclass(frozen=True, eq=False)
class Visits:
    """The n swimmers that come to a scene."""

    gaits: tuple[Gait, ...]
    start: FloatArray  # (n, 3): x, y (m) and heading (rad) when it comes
    home_m: FloatArray  # (n, 2) what it turns back to


def walks(
    visits: Visits,
    who: IntArray,
    noise: FloatArray,
    sector: tuple[float, float, float],
    apart_m: float,
) -> FloatArray:
    """(n_steps, n_places, 5) x, y, vx, vy and heading at every step; nan where nobody is.

    `who` (n_steps, n_places) is the index of the visit, or -1. Speed and turn rate are Ornstein-Uhlenbeck
    processes driven by `noise` (n_steps, n_places, 2), of variance 1: v = mean exp(sd z - sd^2 / 2), at
    most twice the mean. A swimmer that sees the border of the sector (range from and to, m, half-angle, rad)
    ahead turns to its home, one with another nearer than `apart_m` turns away, at most at its own rate.
    """
    gait = np.array(
        [
            (g.speed_mps, g.speed_log_sd, g.speed_tau_s, g.turn_sd_radps, g.turn_tau_s, g.turn_max_radps)
            for g in visits.gaits
        ]
    ).reshape(-1, 6)
    out = np.full((*who.shape, 5), np.nan)
    bounds = np.array([*sector, apart_m])
    start, home_m = frozen(visits.start), frozen(visits.home_m)
    _walk(frozen(gait), frozen(who), start, home_m, frozen(noise), frozen(bounds), out)
    return out


@compiled
def _walk(
    gait: FloatArray,
    who: IntArray,
    start: FloatArray,
    home_m: FloatArray,
    noise: FloatArray,
    bounds: FloatArray,
    out: FloatArray,
) -> None:
    n_steps, n = who.shape
    near, far, half, apart = bounds[0], bounds[1], bounds[2], bounds[3]
    state = np.full((n, 3), np.nan)  # x, y, heading
    z, turn = np.zeros(n), np.zeros(n)
    for k in range(n_steps):
        for i in range(n):
            w = who[k, i]
            if w < 0:
                state[i] = np.nan
                continue
            speed_mean, log_sd, tau, turn_sd, turn_tau, turn_max = gait[w]
            if k == 0 or who[k - 1, i] != w:
                state[i] = start[w]
                z[i], turn[i] = noise[k, i, 0], turn_sd * noise[k, i, 1]
            speed = speed_mean * min(np.exp(log_sd * z[i] - 0.5 * log_sd * log_sd), 2.0)
            x, y, heading = state[i]
            c, s = np.cos(heading), np.sin(heading)
            out[k, i, 0], out[k, i, 1], out[k, i, 4] = x, y, heading
            out[k, i, 2], out[k, i, 3] = speed * c, speed * s
            command = turn[i]
            reach = BORDER_M + AHEAD_S * max(speed, speed_mean)
            if not _inside(x + reach * c, y + reach * s, near, far, half):
                home = np.arctan2(home_m[w, 1] - y, home_m[w, 0] - x)
                command += 1.5 * _wrapped(home - heading)
            else:
                command += _repelled(i, state, apart, heading)
            command = min(max(command, -turn_max), turn_max)
            state[i, 0] = x + STEP_S * speed * c
            state[i, 1] = y + STEP_S * speed * s
            state[i, 2] = _wrapped(heading + STEP_S * command)
            a, b = np.exp(-STEP_S / tau), np.exp(-STEP_S / turn_tau)
            z[i] = a * z[i] + np.sqrt(1.0 - a * a) * noise[k, i, 0]
            turn[i] = b * turn[i] + np.sqrt(1.0 - b * b) * turn_sd * noise[k, i, 1]


@compiled
def _inside(x: float, y: float, near: float, far: float, half: float) -> bool:
    r = np.hypot(x, y)
    return bool(near <= r <= far and abs(np.arctan2(y, x)) <= half)


@compiled
def _repelled(i: int, state: FloatArray, apart: float, heading: float) -> float:
    """The turn rate away from the nearest other swimmer."""
    nearest, away = apart, 0.0
    for j in range(state.shape[0]):
        dx, dy = state[i, 0] - state[j, 0], state[i, 1] - state[j, 1]
        d = np.hypot(dx, dy)
        if j != i and d < nearest:  # false for those that are not there
            nearest, away = d, np.arctan2(dy, dx)
    if nearest < apart:
        return float(2.0 * (1.0 - nearest / apart) * _wrapped(away - heading))
    return 0.0


@compiled
def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)
