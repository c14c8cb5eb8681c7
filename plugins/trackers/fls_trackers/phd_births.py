"""Particles of targets that are born: over the region of births, or near the measurements."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import to_cartesian
from fls_flow.kernels import compiled
from fls_trackers.phd_sector import Births, Measurements, Sector, within_half_turn

__all__ = ["born"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

PROPOSAL_SD = 3.0  # where a measurement proposes births


def born(
    n: int, sector: Sector, births: Births, z: Measurements | None, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Particles (k, 4) of new targets, their weights, and the measurement near which each was drawn, or 0.

    Without `z`, n of them are spread over the births' region with weight mass / n. With `z` the same density
    b is sampled where it counts: near the measurements, from q = sum_i N(z_i, R_i) / m cut at 3 standard
    deviations, with weights b / (n q); k counts those that fall into the region.

    Source: Clark & Bell 2005, steps 1 and 5, uniform in area; importance sampling as
    Ristic et al. 2012, with an unchanged density.
    """
    if z is None:
        return _spread(n, sector, births, rng), np.full(n, births.mass / n), np.zeros(n, np.int64)
    z = _near(z, births)
    if not len(z) or not n:
        return np.zeros((0, 4)), np.zeros(0), np.zeros(0, np.int64)
    which = np.arange(n) % len(z)
    cut = -math.expm1(-0.5 * PROPOSAL_SD**2)
    radius, angle = np.sqrt(-2.0 * np.log1p(-cut * rng.random(n))), 2.0 * np.pi * rng.random(n)
    r = z.range_m[which] + z.range_sd_m[which] * radius * np.cos(angle)
    b = sector.bearings(z.bearing_rad[which] + z.bearing_sd_rad[which] * radius * np.sin(angle))
    velocity = _velocities(n, births, rng)
    new = (r >= births.near_m) & (r <= births.far_m)
    inside = sector.spans(r, b) & (new | (births.unseen > 0.0))
    r, b, velocity = r[inside], b[inside], velocity[inside]
    share = np.bincount(which, minlength=len(z)) / n
    q = _proposal(r, b, z.range_m, z.bearing_rad, z.range_sd_m, z.bearing_sd_rad, share / cut)
    density = births.density(sector) * new[inside] + births.unseen / sector.area_m2
    weight = density * r / (n * q)
    state = np.concatenate([sector.pose.to_ned(to_cartesian(r, b)), velocity], axis=1)
    return state, weight, which[inside]


def _near(z: Measurements, births: Births) -> Measurements:
    """The measurements whose proposals reach into the region of births."""
    reach = PROPOSAL_SD * z.range_sd_m
    near = (z.range_m + reach > births.near_m) & (z.range_m - reach < births.far_m)
    near |= births.unseen > 0.0
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
            u, v = (r[s] - zr[i]) / sr[i], within_half_turn(b[s] - zb[i], 0.0) / sb[i]
            d2 = u * u + v * v
            if d2 <= PROPOSAL_SD * PROPOSAL_SD * (1.0 + 1e-9):
                q[s] += scale * math.exp(-0.5 * d2)
    return q
