"""The probability hypothesis density as weighted particles: motion, update, births, resampling."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import to_cartesian
from fls_flow.kernels import compiled
from fls_trackers.phd_sector import Births, Measurements, Sector

__all__ = ["Update", "born", "propagated", "resampled", "updated"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

GATE_SD = 6.0  # beyond it a likelihood counts as 0: exp(-18)
PROPOSAL_SD = 3.0  # where a measurement proposes births


class Update(NamedTuple):
    """Weights after a ping, and what each measurement says of the targets."""

    weight: FloatArray  # (n,)
    missed: FloatArray  # (n,) the part of each weight that no measurement explains
    taken: FloatArray  # (m,) probability that the measurement comes from a target, C / (kappa + C)
    mean: FloatArray  # (m, 4) mean state of that target; nan with no particle near


def born(
    n: int, sector: Sector, births: Births, z: Measurements | None, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Particles (k, 4) of new targets and their weights.

    Without `z`, n of them are spread over the births' region with weight mass / n. With `z` the same density
    b is sampled where it counts: near the measurements, from q = sum_i N(z_i, R_i) / m cut at 3 standard
    deviations, with weights b / (n q); k counts those that fall into the region.

    Source: Clark & Bell 2005, steps 1 and 5, uniform in area; importance sampling as
    Ristic et al. 2012, with an unchanged density.
    """
    if z is None:
        return _spread(n, sector, births, rng), np.full(n, births.mass / n)
    z = _near(z, births)
    if not len(z) or not n:
        return np.zeros((0, 4)), np.zeros(0)
    which = np.arange(n) % len(z)
    cut = -math.expm1(-0.5 * PROPOSAL_SD**2)
    radius, angle = np.sqrt(-2.0 * np.log1p(-cut * rng.random(n))), 2.0 * np.pi * rng.random(n)
    r = z.range_m[which] + z.range_sd_m[which] * radius * np.cos(angle)
    b = z.bearing_rad[which] + z.bearing_sd_rad[which] * radius * np.sin(angle)
    velocity = _velocities(n, births, rng)
    inside = (r >= births.near_m) & (r <= births.far_m)
    inside &= (b >= sector.bearing_min_rad) & (b <= sector.bearing_max_rad)
    r, b, velocity = r[inside], b[inside], velocity[inside]
    share = np.bincount(which, minlength=len(z)) / n
    q = _proposal(r, b, z.range_m, z.bearing_rad, z.range_sd_m, z.bearing_sd_rad, share / cut)
    weight = births.density(sector) * r / (n * q)
    return np.concatenate([sector.pose.to_ned(to_cartesian(r, b)), velocity], axis=1), weight


def _near(z: Measurements, births: Births) -> Measurements:
    """The measurements whose proposals reach into the region of births."""
    reach = PROPOSAL_SD * z.range_sd_m
    near = (z.range_m + reach > births.near_m) & (z.range_m - reach < births.far_m)
    return Measurements(z.range_m[near], z.bearing_rad[near], z.range_sd_m[near], z.bearing_sd_rad[near])


def _spread(n: int, sector: Sector, births: Births, rng: np.random.Generator) -> FloatArray:
    r = np.sqrt(rng.uniform(births.near_m**2, births.far_m**2, n))
    b = rng.uniform(sector.bearing_min_rad, sector.bearing_max_rad, n)
    position = sector.pose.to_ned(to_cartesian(r, b))
    return np.concatenate([position, _velocities(n, births, rng)], axis=1)


def _velocities(n: int, births: Births, rng: np.random.Generator) -> FloatArray:
    return np.array(births.velocity_mps) + births.speed_sd_mps * rng.standard_normal((n, 2))


@compiled
def _proposal(
    r: FloatArray,
    b: FloatArray,
    zr: FloatArray,
    zb: FloatArray,
    sr: FloatArray,
    sb: FloatArray,
    share: FloatArray,
) -> FloatArray:
    """The density of the proposal per (m rad), at the places (n,)."""
    q = np.zeros(r.size)
    for i in range(zr.size):
        scale = share[i] / (2.0 * math.pi * sr[i] * sb[i])
        for s in range(r.size):
            u, v = (r[s] - zr[i]) / sr[i], (b[s] - zb[i]) / sb[i]
            d2 = u * u + v * v
            if d2 <= PROPOSAL_SD * PROPOSAL_SD * (1.0 + 1e-9):
                q[s] += scale * math.exp(-0.5 * d2)
    return q


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
    anywhere = Sector(0.0, math.inf, -math.inf, math.inf)
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
        r, b = _polar(px, py, sector)
        w[s] = p_s * weight[s] if _sees(sector, r, b) else 0.0
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
    return Update(
        *_updated(state, weight, z.range_m, z.bearing_rad, z.range_sd_m, z.bearing_sd_rad, kappa, p_d, sector)
    )


@compiled
def _updated(
    state: FloatArray,
    weight: FloatArray,
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
        r[s], b[s] = _polar(state[s, 0], state[s, 1], sector)
        p = p_d if _sees(sector, r[s], b[s]) else 0.0
        detected[s] = p * weight[s]
        missed[s] = (1.0 - p) * weight[s]
    w, taken, mean = missed.copy(), np.zeros(m), np.full((m, 4), np.nan)
    near, part = np.empty(n, np.int64), np.empty(n)
    for i in range(m):
        k, total = 0, 0.0
        reach, scale = GATE_SD * sr[i], 1.0 / (2.0 * math.pi * sr[i] * sb[i])
        for s in range(n):
            dr = r[s] - zr[i]
            if abs(dr) > reach:
                continue
            db = _wrapped(b[s] - zb[i])
            if abs(db) > GATE_SD * sb[i]:
                continue
            u, v = dr / sr[i], db / sb[i]
            near[k] = s
            part[k] = detected[s] * scale * math.exp(-0.5 * (u * u + v * v))
            total += part[k]
            k += 1
        if total > 0.0:
            taken[i] = total / (kappa + total)
            mean[i] = 0.0
            for e in range(k):
                w[near[e]] += part[e] / (kappa + total)
                for a in range(4):
                    mean[i, a] += part[e] / total * state[near[e], a]
    return w, missed, taken, mean


def resampled(
    state: FloatArray, weight: FloatArray, n: int, power: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """`n` particles drawn systematically in proportion to w^power, with weights that keep the mass.

    Particle s is drawn floor or ceil of n q_s times, q = w^power / sum w^power, and weighs w / q over the
    sum of those times the mass: with a power of 1 every one mass / n. A power below 1 leaves more particles
    to targets that are not certain yet. Nothing is left of a mass of 0.

    Source: Clark & Bell 2005, step 4; with the mass kept, not rounded (ALGORITHMS, E-C4); the power is ours,
    in the manner of the auxiliary particle filter (Pitt & Shephard 1999).
    """
    mass = float(weight.sum())
    if not mass > 0.0:
        return np.zeros((0, 4)), np.zeros(0)
    flattened = weight if power == 1.0 else weight**power
    drawn = _systematic(flattened, n, float(rng.random()))
    if power == 1.0:
        return state[drawn], np.full(n, mass / n)
    share = weight[drawn] / flattened[drawn]
    return state[drawn], share * (mass / share.sum())


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


@compiled
def _polar(x: float, y: float, sector: Sector) -> tuple[float, float]:
    dx, dy = x - sector.north_m, y - sector.east_m
    return math.hypot(dx, dy), _wrapped(math.atan2(dy, dx) - sector.heading_rad)


@compiled
def _wrapped(angle: float) -> float:
    while angle > math.pi:
        angle -= 2.0 * math.pi
    while angle <= -math.pi:
        angle += 2.0 * math.pi
    return angle


@compiled
def _sees(sector: Sector, r: float, b: float) -> bool:
    return (
        sector.range_min_m <= r <= sector.range_max_m
        and sector.bearing_min_rad <= b <= sector.bearing_max_rad
    )
