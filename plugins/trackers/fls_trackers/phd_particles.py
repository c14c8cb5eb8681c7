"""The probability hypothesis density as weighted particles: motion, update, resampling."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.phd_existence import MOST_CERTAIN
from fls_trackers.phd_sector import Measurements, Sector, sees, within_half_turn

__all__ = ["Update", "propagated", "resampled", "updated", "updated_by_label"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

GATE_SD = 6.0  # beyond it a likelihood counts as 0: exp(-18)


class Update(NamedTuple):
    """Weights after a ping, and what each measurement says of the targets."""

    weight: FloatArray  # (n,)
    missed: FloatArray  # (n,) the part of each weight that no measurement explains
    taken: FloatArray  # (m,) probability that the measurement comes from a target, C / (kappa + C)
    mean: FloatArray  # (m, 4) mean state of that target; nan with no particle near


def propagated(
    state: FloatArray,
    weight: FloatArray,
    dt_s: float,
    sigma_v_mps2: float,
    p_s: float,
    sector: Sector | None,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Particles after `dt_s`, and their weights times the probability of survival.

    x = F x + G v, v ~ N(0, sigma_v^2); survival is p_s where F x lies in the sector, else 0, and 1 for all
    when the sector is not known.

    Source: Clark & Bell 2005 (10), (14) and step 5.
    """
    acceleration = sigma_v_mps2 * rng.standard_normal((weight.size, 2))
    anywhere = Sector(0.0, math.inf, -math.pi, math.pi)
    known = sector is not None
    moved: tuple[FloatArray, FloatArray] = _propagated(
        state, weight, dt_s, acceleration, p_s if known else 1.0, sector if sector is not None else anywhere
    )
    return moved


@compiled
def _propagated(
    state: FloatArray, weight: FloatArray, dt: float, acceleration: FloatArray, p_s: float, sector: Sector
) -> tuple[FloatArray, FloatArray]:
    x, w = np.empty_like(state), np.empty_like(weight)
    for s in range(weight.size):
        px, py = state[s, 0] + dt * state[s, 2], state[s, 1] + dt * state[s, 3]
        w[s] = p_s * weight[s] if sees(px, py, sector)[2] else 0.0
        x[s, 0] = px + 0.5 * dt * dt * acceleration[s, 0]
        x[s, 1] = py + 0.5 * dt * dt * acceleration[s, 1]
        x[s, 2] = state[s, 2] + dt * acceleration[s, 0]
        x[s, 3] = state[s, 3] + dt * acceleration[s, 1]
    return x, w


def updated(
    state: FloatArray, weight: FloatArray, z: Measurements, kappa: float, p_d: float, sector: Sector
) -> Update:
    """The particles' weights after the measurements `z`.

    w' = [1 - pD + sum_i pD g_i / (kappa + C_i)] w, C_i = sum_r pD_r g_i(x_r) w_r, with the predicted weights
    w; g_i = N(range; sd) N(bearing; sd), pD = p_d inside the sector and 0 outside, kappa the density of
    clutter per (m rad).

    Source: Clark & Bell 2005 (13); (12) with the predicted density in the denominator.
    """
    nobody = np.zeros(0, np.int64)
    return Update(*_updated(state, weight, nobody, 0, *_as_arrays(z), kappa, p_d, sector))


def updated_by_label(
    state: FloatArray,
    weight: FloatArray,
    place: IntArray,
    labels: int,
    z: Measurements,
    kappa: float,
    p_d: float,
    sector: Sector,
) -> Update:
    """The particles' weights after the measurements `z`, when those of label `place` (n,) are one target.

    As `updated`, with C_i less the part of the particle's own label in the denominator; then each label's
    weights over 1 - r + their sum, r the label's sum before. Source: see `phd_existence`.
    """
    w, missed, taken, mean = _updated(state, weight, place, labels, *_as_arrays(z), kappa, p_d, sector)
    before, after = np.bincount(place, weight, labels), np.bincount(place, w, labels)
    norm = (np.maximum(1.0 - before, 1.0 - MOST_CERTAIN) + after)[place]
    return Update(w / norm, missed / norm, taken, mean)


def _as_arrays(z: Measurements) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    return z.range_m, z.bearing_rad, z.range_sd_m, z.bearing_sd_rad


@compiled
def _updated(
    state: FloatArray,
    weight: FloatArray,
    place: IntArray,
    labels: int,
    zr: FloatArray,
    zb: FloatArray,
    sr: FloatArray,
    sb: FloatArray,
    kappa: float,
    p_d: float,
    sector: Sector,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    n, m = weight.size, zr.size
    r, b, detected, missed = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for s in range(n):
        r[s], b[s], seen = sees(state[s, 0], state[s, 1], sector)
        p = p_d if seen else 0.0
        detected[s] = p * weight[s]
        missed[s] = (1.0 - p) * weight[s]
    w, taken, mean = missed.copy(), np.zeros(m), np.full((m, 4), np.nan)
    near, part, own = np.empty(n, np.int64), np.empty(n), np.zeros(labels)
    for i in range(m):
        k, total = _parts(r, b, detected, zr[i], zb[i], sr[i], sb[i], near, part)
        if total > 0.0:
            taken[i] = total / (kappa + total)
            mean[i] = 0.0
            own[:] = 0.0
            if labels:
                for e in range(k):
                    own[place[near[e]]] += part[e]
            for e in range(k):
                others = total - own[place[near[e]]] if labels else total
                w[near[e]] += part[e] / (kappa + max(others, 0.0))
                for a in range(4):
                    mean[i, a] += part[e] / total * state[near[e], a]
    return w, missed, taken, mean


@compiled
def _parts(
    r: FloatArray,
    b: FloatArray,
    detected: FloatArray,
    zr: float,
    zb: float,
    sr: float,
    sb: float,
    near: IntArray,
    part: FloatArray,
) -> tuple[int, float]:
    """Writes the particles in the gate of a measurement, and pD g w of each; their number and the sum."""
    k, total = 0, 0.0
    reach, scale = GATE_SD * sr, 1.0 / (2.0 * math.pi * sr * sb)
    for s in range(r.size):
        dr = r[s] - zr
        if abs(dr) > reach:
            continue
        db = within_half_turn(b[s] - zb, 0.0)
        if abs(db) > GATE_SD * sb:
            continue
        u, v = dr / sr, db / sb
        near[k] = s
        part[k] = detected[s] * scale * math.exp(-0.5 * (u * u + v * v))
        total += part[k]
        k += 1
    return k, total


def resampled(
    weight: FloatArray, n: int, power: float, rng: np.random.Generator
) -> tuple[IntArray, FloatArray]:
    """`n` particles drawn systematically in proportion to w^power, and weights for them that keep the mass.

    Particle s is drawn floor or ceil of n q_s times, q = w^power / sum w^power, and weighs w / q over the
    sum of those times the mass: with a power of 1 every one mass / n. A power below 1 leaves more particles
    to targets that are not certain yet. Nothing is left of a mass of 0.

    Source: Clark & Bell 2005, step 4; with the mass kept, not rounded (ALGORITHMS, E-C4); the power is ours,
    in the manner of the auxiliary particle filter (Pitt & Shephard 1999).
    """
    mass = float(weight.sum())
    if not mass > 0.0:
        return np.zeros(0, np.int64), np.zeros(0)
    flattened = weight if power == 1.0 else weight**power
    drawn = _systematic(flattened, n, float(rng.random()))
    if power == 1.0:
        return drawn, np.full(n, mass / n)
    share = weight[drawn] / flattened[drawn]
    return drawn, share * (mass / share.sum())


@compiled
def _systematic(weight: FloatArray, n: int, u: float) -> IntArray:
    drawn = np.empty(n, np.int64)
    step = weight.sum() / n
    s, reached = 0, weight[0]
    for k in range(n):
        while reached <= (k + u) * step and s < weight.size - 1:
            s += 1
            reached += weight[s]
        drawn[k] = s
    # rounding may carry the last draws on to particles of weight 0
    for k in range(n - 1, -1, -1):
        while weight[drawn[k]] == 0.0 and drawn[k] > 0:
            drawn[k] -= 1
    return drawn
