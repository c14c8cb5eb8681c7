"""The probability hypothesis density as a Gaussian mixture: motion and extended Kalman update."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.kalman import predict
from fls_trackers.phd_sector import FULL_TURN_RAD, Births, Measurements, Sector, within_half_turn

__all__ = ["Explained", "Mixture", "explained", "predicted"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

GATE = 25.0  # squared distance beyond which a measurement says nothing of a component


class Mixture(NamedTuple):
    """Weighted Gaussians."""

    weight: FloatArray  # (n,)
    state: FloatArray  # (n, 4)
    covariance: FloatArray  # (n, 4, 4)

    @classmethod
    def empty(cls) -> Mixture:
        """No component at all."""
        return cls(np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4, 4)))

    def select(self, which: IntArray) -> Mixture:
        """The chosen components, as copies."""
        return Mixture(self.weight[which], self.state[which], self.covariance[which])

    def joined(self, other: Mixture) -> Mixture:
        """These components, then the others."""
        return Mixture(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


class Explained(NamedTuple):
    """What a predicted mixture says of the measurements of a ping."""

    missed: FloatArray  # (n,) 1 - pD of each component
    pairs: Mixture  # updated components; weight pD w q, not normalised, births among them
    parent: IntArray  # (pairs,) which component it was; -1: a birth
    measurement: IntArray  # (pairs,) which measurement updates them
    total: FloatArray  # (m,) C: sum of the weights of its pairs


def predicted(
    mixture: Mixture, dt_s: float, sigma_v_mps2: float, p_s: float, sector: Sector | None
) -> Mixture:
    """The mixture after `dt_s`: components of nearly constant velocity that survive with p_s in the sector.

    Survival is p_s times the part of the component that is still inside, taken over range and bearing apart;
    1 when the sector is not known. Source: Vo & Ma 2006 (24)-(27).
    """
    if not mixture.weight.size:
        return mixture
    state, covariance = predict(mixture.state, mixture.covariance, dt_s, sigma_v_mps2)
    weight = mixture.weight.copy()
    if sector is not None:
        weight *= p_s * _inside(state, covariance, sector)
    return Mixture(weight, state, covariance)


@compiled
def _inside(state: FloatArray, covariance: FloatArray, sector: Sector) -> FloatArray:
    """The part of each component that lies in the sector, range and bearing taken as independent normals."""
    part = np.empty(state.shape[0])
    for t in range(part.size):
        r, b, c, s = _line_of_sight(state[t], sector)
        P = covariance[t]
        along = c * c * P[0, 0] + 2.0 * c * s * P[0, 1] + s * s * P[1, 1]
        across = s * s * P[0, 0] - 2.0 * c * s * P[0, 1] + c * c * P[1, 1]
        sd_r, sd_b = math.sqrt(along), math.sqrt(across) / max(r, 1e-9)
        part[t] = _between(r, sd_r, sector.range_min_m, sector.range_max_m)
        part[t] *= _beside(b, sd_b, sector)
    return part


@compiled
def _between(mean: float, sd: float, low: float, high: float) -> float:
    """P(low < x < high) of a normal x."""
    scale = 1.0 / (sd * math.sqrt(2.0))
    return 0.5 * (math.erf((high - mean) * scale) - math.erf((low - mean) * scale))


@compiled
def _beside(mean: float, sd: float, sector: Sector) -> float:
    """P(the bearing is the sector's) of a normal bearing; 1 all round."""
    low, high = sector.bearing_min_rad, sector.bearing_max_rad
    return 1.0 if high - low > FULL_TURN_RAD else _between(mean, sd, low, high)


@compiled
def _line_of_sight(x: FloatArray, sector: Sector) -> tuple[float, float, float, float]:
    """Range, bearing, and the direction [c, s] from the sonar in the frame of the targets."""
    dx, dy = x[0] - sector.north_m, x[1] - sector.east_m
    r = max(math.hypot(dx, dy), 1e-9)
    middle = 0.5 * (sector.bearing_min_rad + sector.bearing_max_rad)
    return r, within_half_turn(math.atan2(dy, dx) - sector.heading_rad, middle), dx / r, dy / r


def explained(mixture: Mixture, births: Births, z: Measurements, p_d: float, sector: Sector) -> Explained:
    """Every component updated by every measurement in its gate, and a birth at each measurement.

    An extended Kalman update in range and bearing: q = N(z; h(x), S), S = H P H^T + R. A target born at z has
    the position of z with its noise and the births' velocity; as births are even over their region, its C is
    p_d times their density times the part of N(z, R) that lies in the region: no component waits for them.
    The same holds of targets that were there from the start and have not been seen.
    pD is p_d times the part of a component inside the sector.

    Source: Vo & Ma 2006 (30)-(38) and section IV-B; births without prior components as Houssineau &
    Laneuville 2010, with the density kept.
    """
    inside = _inside(mixture.state, mixture.covariance, sector) if mixture.weight.size else np.zeros(0)
    detected = p_d * inside
    noise = (z.range_m, z.bearing_rad, z.range_sd_m**2, z.bearing_sd_rad**2)
    weight, state, covariance, parent, measurement = _pairs(*mixture, detected, *noise, sector)
    new = _births(
        z.range_m,
        z.bearing_rad,
        z.range_sd_m,
        z.bearing_sd_rad,
        births,
        births.density(sector),
        births.unseen / sector.area_m2,
        p_d,
        sector,
    )
    pairs = Mixture(weight, state, covariance).joined(Mixture(*new))
    of = np.concatenate([measurement, np.arange(len(z))])
    parent = np.concatenate([parent, np.full(len(z), -1)])
    total = np.bincount(of, pairs.weight, minlength=len(z)).astype(float)
    return Explained(1.0 - detected, pairs, parent, of, total)


@compiled
def _pairs(
    weight: FloatArray,
    state: FloatArray,
    covariance: FloatArray,
    detected: FloatArray,
    zr: FloatArray,
    zb: FloatArray,
    vr: FloatArray,
    vb: FloatArray,
    sector: Sector,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, IntArray]:
    n, m = weight.size, zr.size
    room = _count(state, covariance, detected, zr, zb, vr, vb, sector)
    w, x, P = np.empty(room), np.empty((room, 4)), np.empty((room, 4, 4))
    parent, of = np.empty(room, np.int64), np.empty(room, np.int64)
    k = 0
    for t in range(n):
        if detected[t] <= 0.0:
            continue
        r, b, c, s = _line_of_sight(state[t], sector)
        s11, s12, s22 = _polar_spread(covariance[t], r, c, s)
        for i in range(m):
            d2, det = _distance(zr[i] - r, within_half_turn(zb[i] - b, 0.0), s11 + vr[i], s12, s22 + vb[i])
            if d2 <= GATE:
                innovation = (zr[i] - r, within_half_turn(zb[i] - b, 0.0), s11 + vr[i], s12, s22 + vb[i])
                _update(state[t], covariance[t], r, c, s, innovation, x[k], P[k])
                w[k] = detected[t] * weight[t] * math.exp(-0.5 * d2) / (2.0 * math.pi * math.sqrt(det))
                parent[k], of[k] = t, i
                k += 1
    return w, x, P, parent, of


@compiled
def _count(
    state: FloatArray,
    covariance: FloatArray,
    detected: FloatArray,
    zr: FloatArray,
    zb: FloatArray,
    vr: FloatArray,
    vb: FloatArray,
    sector: Sector,
) -> int:
    k = 0
    for t in range(state.shape[0]):
        if detected[t] <= 0.0:
            continue
        r, b, c, s = _line_of_sight(state[t], sector)
        s11, s12, s22 = _polar_spread(covariance[t], r, c, s)
        for i in range(zr.size):
            d2, _ = _distance(zr[i] - r, within_half_turn(zb[i] - b, 0.0), s11 + vr[i], s12, s22 + vb[i])
            k += d2 <= GATE
    return k


@compiled
def _polar_spread(P: FloatArray, r: float, c: float, s: float) -> tuple[float, float, float]:
    """H P H^T with H = [[c, s], [-s / r, c / r]] over the position."""
    along = c * c * P[0, 0] + 2.0 * c * s * P[0, 1] + s * s * P[1, 1]
    mixed = (c * s * (P[1, 1] - P[0, 0]) + (c * c - s * s) * P[0, 1]) / r
    across = (s * s * P[0, 0] - 2.0 * c * s * P[0, 1] + c * c * P[1, 1]) / (r * r)
    return along, mixed, across


@compiled
def _distance(u: float, v: float, s11: float, s12: float, s22: float) -> tuple[float, float]:
    det = s11 * s22 - s12 * s12
    return (u * (s22 * u - s12 * v) + v * (s11 * v - s12 * u)) / det, det


@compiled
def _update(
    x: FloatArray,
    P: FloatArray,
    r: float,
    c: float,
    s: float,
    innovation: tuple[float, float, float, float, float],
    new_x: FloatArray,
    new_P: FloatArray,
) -> None:
    """x + K nu and P - K S K^T, K = P H^T S^-1; `innovation` is nu and S."""
    u, v, s11, s12, s22 = innovation
    det = s11 * s22 - s12 * s12
    PH, K = np.empty((4, 2)), np.empty((4, 2))
    for a in range(4):
        PH[a, 0] = P[a, 0] * c + P[a, 1] * s
        PH[a, 1] = (P[a, 1] * c - P[a, 0] * s) / r
        K[a, 0] = (PH[a, 0] * s22 - PH[a, 1] * s12) / det
        K[a, 1] = (PH[a, 1] * s11 - PH[a, 0] * s12) / det
        new_x[a] = x[a] + K[a, 0] * u + K[a, 1] * v
    for a in range(4):
        for o in range(a + 1):
            new_P[a, o] = new_P[o, a] = P[a, o] - K[a, 0] * PH[o, 0] - K[a, 1] * PH[o, 1]


@compiled
def _births(
    zr: FloatArray,
    zb: FloatArray,
    sr: FloatArray,
    sb: FloatArray,
    births: Births,
    density: float,
    unseen: float,
    p_d: float,
    sector: Sector,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    m = zr.size
    weight, state, covariance = np.empty(m), np.empty((m, 4)), np.zeros((m, 4, 4))
    for i in range(m):
        near = density * _between(zr[i], sr[i], births.near_m, births.far_m)
        near += unseen * _between(zr[i], sr[i], sector.range_min_m, sector.range_max_m)
        weight[i] = p_d * zr[i] * near * _beside(zb[i], sb[i], sector)
        c, s = math.cos(zb[i] + sector.heading_rad), math.sin(zb[i] + sector.heading_rad)
        state[i, 0], state[i, 1] = sector.north_m + zr[i] * c, sector.east_m + zr[i] * s
        state[i, 2], state[i, 3] = births.velocity_mps
        along, across = sr[i] ** 2, (zr[i] * sb[i]) ** 2
        covariance[i, 0, 0] = c * c * along + s * s * across
        covariance[i, 1, 1] = s * s * along + c * c * across
        covariance[i, 0, 1] = covariance[i, 1, 0] = c * s * (along - across)
        covariance[i, 2, 2] = covariance[i, 3, 3] = births.speed_sd_mps**2
    return weight, state, covariance
