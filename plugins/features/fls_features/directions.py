"""How the axis of a region, the course of its track and the line of sight lie to each other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = ["alignment"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


def alignment(
    mask: BoolArray, range_m: FloatArray, bearing_rad: FloatArray, course_rad: FloatArray
) -> FloatArray:
    """(n, 3) |cos| between axis and course, axis and line of sight, course and line of sight.

    The axis is the major one of the region's cells (n, rows, columns) in Cartesian metres, weighed by their
    areas: tan 2a = 2 mu_11 / (mu_20 - mu_02); of a round region, ahead. The line of sight goes through its
    centroid. Range (n, rows), bearing (n, columns) of the cells, course (n,); nan for an empty region.
    """
    out = np.full((mask.shape[0], 3), np.nan)
    _alignment(frozen(mask), frozen(range_m), frozen(bearing_rad), frozen(course_rad), out)
    return out


@compiled
def _alignment(
    mask: BoolArray, range_m: FloatArray, bearing_rad: FloatArray, course_rad: FloatArray, out: FloatArray
) -> None:
    n, rows, columns = mask.shape
    cosine, sine = np.empty(columns), np.empty(columns)
    for k in range(n):
        for j in range(columns):
            cosine[j], sine[j] = np.cos(bearing_rad[k, j]), np.sin(bearing_rad[k, j])
        area, x0, y0 = 0.0, 0.0, 0.0
        s_x, s_y, s_xx, s_yy, s_xy = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(rows):
            r = range_m[k, i]
            for j in range(columns):
                if not mask[k, i, j]:
                    continue
                if area == 0.0:
                    x0, y0 = r * cosine[j], r * sine[j]  # sums from the first cell lose no digits
                x, y = r * cosine[j] - x0, r * sine[j] - y0
                area += r
                s_x += r * x
                s_y += r * y
                s_xx += r * x * x
                s_yy += r * y * y
                s_xy += r * x * y
        if not area > 0.0:
            continue
        x, y = s_x / area, s_y / area
        axis = 0.5 * np.arctan2(2.0 * (s_xy / area - x * y), (s_xx / area - x * x) - (s_yy / area - y * y))
        sight = np.arctan2(y0 + y, x0 + x)
        out[k, 0] = abs(np.cos(axis - course_rad[k]))
        out[k, 1] = abs(np.cos(axis - sight))
        out[k, 2] = abs(np.cos(course_rad[k] - sight))
