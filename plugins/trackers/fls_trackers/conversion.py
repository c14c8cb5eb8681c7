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

__all__ = ["convert", "noise_at", "noise_of"]

FloatArray = npt.NDArray[np.float64]
Terms = tuple[float, float, float, float]


def convert(
    range_m: FloatArray, bearing_rad: FloatArray, range_sd_m: float, bearing_sd_rad: float, pose: Pose
) -> tuple[FloatArray, FloatArray]:
    """Debiased positions (m, 2) and their covariances R_0 (m, 2, 2), at the measured polar position.

    Source: Lerro & Bar-Shalom 1993; Karoui 2015 (7)-(11), (11) with the sign of Lerro & Bar-Shalom.
    """
    y, R = _convert(
        np.ascontiguousarray(range_m),
        np.ascontiguousarray(bearing_rad),
        range_sd_m,
        bearing_sd_rad,
        pose.north_m,
        pose.east_m,
        pose.heading_rad,
    )
    return y, R


def noise_at(state: FloatArray, range_sd_m: float, bearing_sd_rad: float, pose: Pose) -> FloatArray:
    """R (n, 2, 2): the covariance that a measurement of each track will have, at its predicted position.

    Evaluated at the prediction, not at the measurement, one R serves all measurements in a track's gate and
    the gain does not depend on their noise.
    """
    R: FloatArray = noise_of(state, range_sd_m, bearing_sd_rad, pose.north_m, pose.east_m, pose.heading_rad)
    return R


@compiled
def _convert(
    range_m: FloatArray,
    bearing_rad: FloatArray,
    sd: float,
    sb: float,
    north: float,
    east: float,
    heading: float,
) -> tuple[FloatArray, FloatArray]:
    n = range_m.size
    y = np.empty((n, 2))
    R = np.empty((n, 2, 2))
    s = sb * sb
    debias = 1.0 - math.exp(-s) + math.exp(-s / 2.0)
    cos_h, sin_h = math.cos(heading), math.sin(heading)
    terms = _bearing_terms(s)
    for j in range(n):
        d, b = range_m[j], bearing_rad[j]
        px, py = d * math.cos(b) * debias, d * math.sin(b) * debias
        y[j, 0] = cos_h * px - sin_h * py + north
        y[j, 1] = sin_h * px + cos_h * py + east
        _fill_noise(R[j], d * d, b, sd * sd, s, terms, cos_h, sin_h)
    return y, R


@compiled
def noise_of(
    state: FloatArray, sd: float, sb: float, north: float, east: float, heading: float
) -> FloatArray:
    """`noise_at` in machine code."""
    n = state.shape[0]
    R = np.empty((n, 2, 2))
    s = sb * sb
    cos_h, sin_h = math.cos(heading), math.sin(heading)
    terms = _bearing_terms(s)
    for t in range(n):
        dn, de = state[t, 0] - north, state[t, 1] - east
        x, y = cos_h * dn + sin_h * de, cos_h * de - sin_h * dn
        _fill_noise(R[t], x * x + y * y, math.atan2(y, x), sd * sd, s, terms, cos_h, sin_h)
    return R


@compiled
def _bearing_terms(s: float) -> Terms:
    along, across = math.cosh(2 * s) - math.cosh(s), math.sinh(2 * s) - math.sinh(s)
    along_v, across_v = 2 * math.cosh(2 * s) - math.cosh(s), 2 * math.sinh(2 * s) - math.sinh(s)
    return along, across, along_v, across_v


@compiled
def _fill_noise(
    R: FloatArray,
    d2: float,
    bearing: float,
    v: float,
    s: float,
    terms: Terms,
    cos_h: float,
    sin_h: float,
) -> None:
    along, across, along_v, across_v = terms
    c, n = math.cos(bearing), math.sin(bearing)
    common = math.exp(-2.0 * s)
    r11 = common * (d2 * (c * c * along + n * n * across) + v * (c * c * along_v + n * n * across_v))
    r22 = common * (d2 * (n * n * along + c * c * across) + v * (n * n * along_v + c * c * across_v))
    r12 = n * c * math.exp(-4.0 * s) * (v - (d2 + v) * math.expm1(s))
    R[0, 0] = cos_h * cos_h * r11 - 2.0 * cos_h * sin_h * r12 + sin_h * sin_h * r22
    R[1, 1] = sin_h * sin_h * r11 + 2.0 * cos_h * sin_h * r12 + cos_h * cos_h * r22
    R[0, 1] = R[1, 0] = cos_h * sin_h * (r11 - r22) + (cos_h * cos_h - sin_h * sin_h) * r12
