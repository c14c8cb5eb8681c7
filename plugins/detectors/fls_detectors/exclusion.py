"""Which cells of a ping may be reference and which are to be tested.

Ellipses around predicted tracks and wedges of wakes are convex, so each beam crosses one in a single interval
of range. Only the ends of these intervals are marked; one pass along the ranges then sums the marks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.cfar import REFERENCE, TEST, Flags
from fls_flow.kernels import compiled, frozen

__all__ = ["all_finite", "cell_flags", "gate_shapes", "mark_ellipses", "mark_wedges", "no_marks"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Marks = npt.NDArray[np.int16]
EMPTY = np.zeros((0, 0), bool)


def no_marks(n_ranges: int, n_beams: int) -> Marks:
    """Room for interval ends: +1 at the first row inside a shape, -1 at the first row behind it."""
    return np.zeros((n_ranges + 1, n_beams), np.int16)


def gate_shapes(covariance_m2: FloatArray, gate: float, least_m: float, most_m: float) -> FloatArray:
    """M (n, 2, 2) of the ellipses e^T M e <= 1: e^T S^-1 e <= gate, half-axes from `least_m` to `most_m`."""
    values, vectors = np.linalg.eigh(covariance_m2)
    half_axes = np.clip(gate * values, least_m**2, most_m**2)
    shape: FloatArray = np.einsum("nij,nj,nkj->nik", vectors, 1.0 / half_axes, vectors)
    return shape


@compiled
def mark_ellipses(
    marks: Marks,
    range_m: FloatArray,
    bearing_rad: FloatArray,
    half_width_rad: float,
    centre_m: FloatArray,
    shape: FloatArray,
) -> None:
    """Mark the cells with (p - centre)^T M (p - centre) <= 1.

    A beam is looked at along its own ray and along the one within its half width that comes nearest to the
    centre: a shape narrower than the beams is not lost between them.
    """
    for i in range(centre_m.shape[0]):
        x, y = centre_m[i]
        a, b, c = shape[i, 0, 0], shape[i, 0, 1], shape[i, 1, 1]
        at_centre = a * x * x + 2.0 * b * x * y + c * y * y - 1.0
        longest = 1.0 / np.sqrt(0.5 * (a + c) - np.hypot(0.5 * (a - c), b))
        middle, widest = np.arctan2(y, x), _half_angle_of(longest, x, y)
        for beam in range(bearing_rad.size):
            off = _off_beam(bearing_rad[beam], half_width_rad, middle)
            if abs(off) > widest:
                continue
            for angle in _rays(bearing_rad[beam], middle - off):
                u, v = np.cos(angle), np.sin(angle)
                square = a * u * u + 2.0 * b * u * v + c * v * v
                along = a * u * x + b * (u * y + v * x) + c * v * y
                root = along * along - square * at_centre
                if root >= 0.0:
                    reach = np.sqrt(root)
                    _mark(marks, range_m, beam, (along - reach) / square, (along + reach) / square)


@compiled
def mark_wedges(
    marks: Marks,
    range_m: FloatArray,
    bearing_rad: FloatArray,
    half_width_rad: float,
    apex_m: FloatArray,
    orientation_rad: FloatArray,
    length_m: FloatArray,
    half_angle_rad: FloatArray,
) -> None:
    """Mark the cells with |p - apex| <= length and |arg(p - apex) - orientation| <= half angle.

    Beams as in `mark_ellipses`, nearest to the middle of the wedge. Of half angles from 90 degrees on, which
    are not convex, the whole disc is marked.
    """
    for i in range(orientation_rad.size):
        x, y = apex_m[i]
        phi, length, half = orientation_rad[i], length_m[i], half_angle_rad[i]
        x_mid, y_mid = x + 0.5 * length * np.cos(phi), y + 0.5 * length * np.sin(phi)
        reach = length * np.sqrt(1.25 - np.cos(min(half, np.pi)))  # from the middle to the ends of the arc
        middle, widest = np.arctan2(y_mid, x_mid), _half_angle_of(max(reach, 0.5 * length), x_mid, y_mid)
        left, right = phi - half, phi + half
        normals = ((np.sin(right), -np.cos(right)), (-np.sin(left), np.cos(left)))  # of the edges, inwards
        for beam in range(bearing_rad.size):
            off = _off_beam(bearing_rad[beam], half_width_rad, middle)
            if abs(off) > widest:
                continue
            for angle in _rays(bearing_rad[beam], middle - off):
                low, high = _within_disc(angle, x, y, length)
                if half < 0.5 * np.pi:
                    for nx, ny in normals:
                        low, high = _beyond_edge(angle, x, y, nx, ny, low, high)
                _mark(marks, range_m, beam, low, high)


@compiled
def _within_disc(angle: float, x: float, y: float, radius: float) -> tuple[float, float]:
    """From where to where a ray lies in a disc around (x, y); the end before the begin: nowhere."""
    along = np.cos(angle) * x + np.sin(angle) * y
    root = along * along - (x * x + y * y - radius * radius)
    if root < 0.0:
        return np.inf, -np.inf
    return along - np.sqrt(root), along + np.sqrt(root)


@compiled
def _beyond_edge(
    angle: float, x: float, y: float, nx: float, ny: float, low: float, high: float
) -> tuple[float, float]:
    """What is left of a ray on the side of the edge through (x, y) to which the normal points."""
    slope, offset = nx * np.cos(angle) + ny * np.sin(angle), nx * x + ny * y
    if slope > 0.0:
        return max(low, offset / slope), high
    if slope < 0.0:
        return low, min(high, offset / slope)
    return low, -np.inf if offset > 0.0 else high


@compiled
def _rays(own: float, nearest: float) -> tuple[float, float]:
    """Along which angles a beam is looked at."""
    return own, nearest


@compiled
def _off_beam(bearing: float, half_width: float, middle: float) -> float:
    """The angle from the ray of the beam that comes nearest to `middle` on to `middle`; 0 inside the beam."""
    off = (middle - bearing + np.pi) % (2.0 * np.pi) - np.pi
    return off - min(max(off, -half_width), half_width)


@compiled
def _half_angle_of(radius: float, x: float, y: float) -> float:
    """Half the angle at which a disc around (x, y) is seen, a little widened; pi from inside it."""
    distance = np.hypot(x, y)
    return np.pi if radius >= distance else np.arcsin(radius / distance) + 1e-9


@compiled
def _mark(marks: Marks, range_m: FloatArray, beam: int, low: float, high: float) -> None:
    if high >= low and high >= 0.0:
        first, last = np.searchsorted(range_m, low), np.searchsorted(range_m, high, side="right")
        if last > first:
            marks[first, beam] += 1
            marks[last, beam] -= 1


def all_finite(amplitude: npt.NDArray[Any]) -> bool:
    """Whether no amplitude is nan or infinite; fast, because integers always are finite."""
    return not np.issubdtype(amplitude.dtype, np.floating) or bool(np.isfinite(amplitude).all())


def cell_flags(amplitude: npt.NDArray[Any], marks: Marks, noisy: BoolArray, valid: BoolArray | None) -> Flags:
    """Flags (n_ranges, n_beams) of `cfar.REFERENCE` and `cfar.TEST`.

    None: not valid, not finite, or in a noisy beam. Only `TEST`: inside a marked shape. Both: all others.
    """
    return _flags(frozen(amplitude), marks, frozen(noisy), frozen(EMPTY if valid is None else valid))


@compiled
def _flags(amplitude: npt.NDArray[Any], marks: Marks, noisy: BoolArray, valid: BoolArray) -> Flags:
    n_ranges, n_beams = amplitude.shape
    flags = np.empty((n_ranges, n_beams), np.uint8)
    depth = np.zeros(n_beams, np.int16)
    for row in range(n_ranges):
        for beam in range(n_beams):
            depth[beam] += marks[row, beam]
            good = np.isfinite(amplitude[row, beam]) and not noisy[beam]
            flags[row, beam] = (TEST if depth[beam] else TEST | REFERENCE) if good else 0
        if valid.size:
            for beam in range(n_beams):
                flags[row, beam] *= valid[row, beam]
    return flags
