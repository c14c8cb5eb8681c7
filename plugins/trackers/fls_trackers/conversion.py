"""Polar measurements as Cartesian ones in the frame of the tracks, compiled.

The formulas are those of `fls_flow.geometry.debiased`; here they run in one pass over the measurements and
turn with the sensor's pose.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import Pose
from fls_flow.kernels import compiled

__all__ = ["convert", "measured", "noise_at", "noise_of"]

FloatArray = npt.NDArray[np.float64]
Terms = tuple[float, float, float, float, float, float, float]


def convert(
    range_m: FloatArray, bearing_rad: FloatArray, range_sd_m: float, bearing_sd_rad: float, pose: Pose
) -> tuple[FloatArray, FloatArray]:
    """Debiased positions (m, 2) and their covariances R_0 (m, 2, 2), at the measured polar position.

    Source: Lerro & Bar-Shalom 1993; Karoui 2015 (7)-(11), (11) with the sign of Lerro & Bar-Shalom.
    """
    sensor = (range_sd_m, bearing_sd_rad, pose.north_m, pose.east_m, pose.heading_rad)
    y, R, _ = measured(np.ascontiguousarray(range_m), np.ascontiguousarray(bearing_rad), sensor)
    return y, R


def noise_at(state: FloatArray, range_sd_m: float, bearing_sd_rad: float, pose: Pose) -> FloatArray:
    """R (n, 2, 2): the covariance that a measurement of each track will have, at its predicted position.

    Evaluated at the prediction, not at the measurement, one R serves all measurements in a track's gate and
    the gain does not depend on their noise.
    """
    R: FloatArray = noise_of(state, range_sd_m, bearing_sd_rad, pose.north_m, pose.east_m, pose.heading_rad)
    return R


@compiled
def measured(
    range_m: FloatArray, bearing_rad: FloatArray, sensor: tuple[float, float, float, float, float]
) -> tuple[FloatArray, FloatArray, bool]:
    """`convert` in machine code, and whether all is finite; `sensor`: sd in range and bearing, pose."""
    sd, sb, north, east, heading = sensor
    m = range_m.size
    y = np.empty((m, 2))
    R = np.empty((m, 2, 2))
    s = sb * sb
    debias = 1.0 - math.exp(-s) + math.exp(-s / 2.0)
    cos_h, sin_h = math.cos(heading), math.sin(heading)
    terms = _bearing_terms(s)
    finite = True
    for j in range(m):
        d, c, n = range_m[j], math.cos(bearing_rad[j]), math.sin(bearing_rad[j])
        finite &= math.isfinite(d) and math.isfinite(c)
        px, py = d * c * debias, d * n * debias
        y[j, 0] = cos_h * px - sin_h * py + north
        y[j, 1] = sin_h * px + cos_h * py + east
        _fill_noise(R, j, d * d, c, n, sd * sd, terms, cos_h, sin_h)
    return y, R, finite


@compiled
def noise_of(
    state: FloatArray, sd: float, sb: float, north: float, east: float, heading: float
) -> FloatArray:
    """`noise_at` in machine code."""
    R = np.empty((state.shape[0], 2, 2))
    s = sb * sb
    cos_h, sin_h = math.cos(heading), math.sin(heading)
    terms = _bearing_terms(s)
    for t in range(state.shape[0]):
        dn, de = state[t, 0] - north, state[t, 1] - east
        x, y = cos_h * dn + sin_h * de, cos_h * de - sin_h * dn
        d2 = x * x + y * y
        d = math.sqrt(d2)
        c, n = (x / d, y / d) if d > 0.0 else (1.0, 0.0)
        _fill_noise(R, t, d2, c, n, sd * sd, terms, cos_h, sin_h)
    return R


@compiled
def _bearing_terms(s: float) -> Terms:
    along, across = math.cosh(2 * s) - math.cosh(s), math.sinh(2 * s) - math.sinh(s)
    along_v, across_v = 2 * math.cosh(2 * s) - math.cosh(s), 2 * math.sinh(2 * s) - math.sinh(s)
    return along, across, along_v, across_v, math.exp(-2.0 * s), math.exp(-4.0 * s), math.expm1(s)


@compiled
def _fill_noise(
    R: FloatArray,
    t: int,
    d2: float,
    c: float,
    n: float,
    v: float,
    terms: Terms,
    cos_h: float,
    sin_h: float,
) -> None:
    """R[t] of a range^2 d2 and a bearing with the cosine c and the sine n, turned by the heading."""
    along, across, along_v, across_v, common, common_12, grown = terms
    r11 = common * (d2 * (c * c * along + n * n * across) + v * (c * c * along_v + n * n * across_v))
    r22 = common * (d2 * (n * n * along + c * c * across) + v * (n * n * along_v + c * c * across_v))
    r12 = n * c * common_12 * (v - (d2 + v) * grown)
    R[t, 0, 0] = cos_h * cos_h * r11 - 2.0 * cos_h * sin_h * r12 + sin_h * sin_h * r22
    R[t, 1, 1] = sin_h * sin_h * r11 + 2.0 * cos_h * sin_h * r12 + cos_h * cos_h * r22
    R[t, 0, 1] = R[t, 1, 0] = cos_h * sin_h * (r11 - r22) + (cos_h * cos_h - sin_h * sin_h) * r12
