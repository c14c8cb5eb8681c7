"""Ten numbers that describe the region of an object in a chip: size, outline, amplitude, ellipse, moments."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled, frozen

__all__ = ["CELL_NAMES", "METRIC_NAMES", "Shape", "in_cells", "in_metres", "names_of"]

Shape = Literal["cells", "metres"]
FloatArray = npt.NDArray[np.float64]
SampleArray = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]

CELL_NAMES = (
    "area",
    "perimeter",
    "compactness",
    "mean",
    "variance",
    "major_axis",
    "minor_axis",
    "eccentricity",
    "phi1",
    "phi2",
)
# Other names than in cells, also where there is no unit: a classifier of one must refuse the other.
METRIC_NAMES = (
    "area_m2",
    "perimeter_m",
    "metric_compactness",
    "mean",
    "variance",
    "major_axis_m",
    "minor_axis_m",
    "metric_eccentricity",
    "metric_phi1",
    "metric_phi2",
)


def names_of(shape: Shape) -> tuple[str, ...]:
    """The names of the ten features, in their order."""
    return CELL_NAMES if shape == "cells" else METRIC_NAMES


def in_cells(mask: BoolArray, amplitude: npt.NDArray[np.generic]) -> FloatArray:
    """(n, 10) features of regions (n, rows, columns), with the cell as unit of length; nan for an empty one.

    area          A = number of cells
    perimeter     P = cells with one of the four neighbours outside the region or outside the chip
    compactness   4 pi A / P^2
    mean, variance of the amplitude, over A
    axes          4 sqrt(l), l the eigenvalues of the cells' covariance + I/12: the ellipse of equal moments
    eccentricity  sqrt(1 - l_min / l_max)
    phi1, phi2    eta_20 + eta_02, (eta_20 - eta_02)^2 + 4 eta_11^2, eta = mu / A^2 of the mask (Hu 1962)

    Source: Brinkmann 2010, (3.36)-(3.46) and table 4.3; the axes as in the listing, since its text speaks of
    an enclosing ellipse.
    """
    out = np.full((mask.shape[0], len(CELL_NAMES)), np.nan)
    _cells(frozen(mask), frozen(np.ascontiguousarray(amplitude, np.float32)), out)
    return out


@compiled
def _cells(mask: BoolArray, amplitude: SampleArray, out: FloatArray) -> None:
    n, rows, columns = mask.shape
    for k in range(n):
        area, outline = 0, 0
        i0, j0, a0 = 0, 0, 0.0  # the first cell: sums from there lose no digits
        s_i, s_j, s_ii, s_jj, s_ij = 0, 0, 0, 0, 0
        s_a, s_aa = 0.0, 0.0
        for i in range(rows):
            for j in range(columns):
                if not mask[k, i, j]:
                    continue
                if area == 0:
                    i0, j0, a0 = i, j, np.float64(amplitude[k, i, j])
                area += 1
                if (
                    i == 0
                    or j == 0
                    or i == rows - 1
                    or j == columns - 1
                    or not (mask[k, i - 1, j] and mask[k, i + 1, j])
                    or not (mask[k, i, j - 1] and mask[k, i, j + 1])
                ):
                    outline += 1
                p, q = i - i0, j - j0
                s_i += p
                s_j += q
                s_ii += p * p
                s_jj += q * q
                s_ij += p * q
                x = np.float64(amplitude[k, i, j]) - a0
                s_a += x
                s_aa += x * x
        if area == 0:
            continue
        total = float(area)
        mean = s_a / total
        out[k, 0] = total
        out[k, 1] = float(outline)
        out[k, 2] = 4.0 * np.pi * total / (float(outline) * float(outline))
        out[k, 3] = a0 + mean
        out[k, 4] = max(s_aa / total - mean * mean, 0.0)
        mu_ii = float(s_ii) - float(s_i) * float(s_i) / total
        mu_jj = float(s_jj) - float(s_j) * float(s_j) / total
        mu_ij = float(s_ij) - float(s_i) * float(s_j) / total
        _ellipse(mu_ii / total + 1.0 / 12.0, mu_jj / total + 1.0 / 12.0, mu_ij / total, out[k])
        _invariants(mu_ii, mu_jj, mu_ij, total, out[k])


@compiled
def _ellipse(c_ii: float, c_jj: float, c_ij: float, out: FloatArray) -> None:
    middle = 0.5 * (c_ii + c_jj)
    apart = np.sqrt(0.25 * (c_ii - c_jj) * (c_ii - c_jj) + c_ij * c_ij)
    largest = middle + apart
    smallest = max((c_ii * c_jj - c_ij * c_ij) / largest, 0.0)  # no difference of nearly equal numbers
    out[5] = 4.0 * np.sqrt(largest)
    out[6] = 4.0 * np.sqrt(smallest)
    out[7] = np.sqrt(min(max(2.0 * apart / largest, 0.0), 1.0))


@compiled
def _invariants(mu_ii: float, mu_jj: float, mu_ij: float, area: float, out: FloatArray) -> None:
    square = area * area
    difference = (mu_ii - mu_jj) / square
    mixed = mu_ij / square
    out[8] = (mu_ii + mu_jj) / square
    out[9] = difference * difference + 4.0 * mixed * mixed


def in_metres(
    mask: BoolArray,
    amplitude: npt.NDArray[np.generic],
    range_m: FloatArray,
    bearing_rad: FloatArray,
    cell_m: float,
    beam_spacing_rad: float,
) -> FloatArray:
    """(n, 10) the same features of the area that the cells cover, so that range does not change them.

    A cell at range r covers w = r dr dtheta. area = sum w (m^2); perimeter is the length of the cells' sides
    that face the outside (m): 2 (a + b) of a rectangle, 8 R of a disc; mean and variance are over cells, as
    in cells; moments are integrals over the cells in Cartesian metres (a cell adds w (dr^2, (r dtheta)^2) /
    12 along its own axes), so that a rectangle a x b has phi1 = (a^2 + b^2) / (12 a b), and a disc 1/(2 pi).

    range_m (n, rows), bearing_rad (n, columns); a lone row or column takes `cell_m` or `beam_spacing_rad`.
    """
    out = np.full((mask.shape[0], len(METRIC_NAMES)), np.nan)
    n, rows, columns = mask.shape
    if not (n and rows and columns):
        return out
    chips = frozen(np.ascontiguousarray(amplitude, np.float32))
    heights, widths = _sides(range_m, cell_m), _sides(bearing_rad, beam_spacing_rad)
    _metric(frozen(mask), chips, frozen(range_m), frozen(bearing_rad), heights, widths, out)
    return out


def _sides(centre: FloatArray, lone: float) -> FloatArray:
    """The lengths of cells from halfway to halfway between their centres (n, m)."""
    if centre.shape[1] == 1:
        return np.full(centre.shape, lone if lone > 0.0 else 0.0)
    return np.abs(np.gradient(centre, axis=1))


@compiled
def _metric(
    mask: BoolArray,
    amplitude: SampleArray,
    range_m: FloatArray,
    bearing_rad: FloatArray,
    heights: FloatArray,
    widths: FloatArray,
    out: FloatArray,
) -> None:
    n, rows, columns = mask.shape
    cosine, sine = np.empty(columns), np.empty(columns)
    for k in range(n):
        middle = bearing_rad[k, columns // 2]
        for j in range(columns):
            cosine[j] = np.cos(bearing_rad[k, j] - middle)
            sine[j] = np.sin(bearing_rad[k, j] - middle)
        cells, area, outline = 0, 0.0, 0.0
        r0, a0 = 0.0, 0.0
        s_u, s_v, s_uu, s_vv, s_uv = 0.0, 0.0, 0.0, 0.0, 0.0
        s_a, s_aa = 0.0, 0.0
        for i in range(rows):
            r, dr = range_m[k, i], heights[k, i]
            for j in range(columns):
                if not mask[k, i, j]:
                    continue
                if cells == 0:
                    r0, a0 = r, np.float64(amplitude[k, i, j])
                cells += 1
                across = r * widths[k, j]
                w = dr * across
                outline += _facing(mask[k], i, j, r, dr, widths[k, j])
                c, s = cosine[j], sine[j]
                u, v = r * c - r0, r * s
                own_r, own_b = dr * dr / 12.0, across * across / 12.0
                area += w
                s_u += w * u
                s_v += w * v
                s_uu += w * (u * u + own_r * c * c + own_b * s * s)
                s_vv += w * (v * v + own_r * s * s + own_b * c * c)
                s_uv += w * (u * v + (own_r - own_b) * c * s)
                x = np.float64(amplitude[k, i, j]) - a0
                s_a += x
                s_aa += x * x
        if not area > 0.0:
            continue
        mean = s_a / cells
        out[k, 0] = area
        out[k, 1] = outline
        out[k, 2] = 4.0 * np.pi * area / (outline * outline)
        out[k, 3] = a0 + mean
        out[k, 4] = max(s_aa / cells - mean * mean, 0.0)
        mu_uu = s_uu - s_u * s_u / area
        mu_vv = s_vv - s_v * s_v / area
        mu_uv = s_uv - s_u * s_v / area
        _ellipse(mu_uu / area, mu_vv / area, mu_uv / area, out[k])
        _invariants(mu_uu, mu_vv, mu_uv, area, out[k])


@compiled
def _facing(mask: BoolArray, i: int, j: int, r: float, dr: float, width: float) -> float:
    """The length of those sides of a cell that no cell of the region touches."""
    rows, columns = mask.shape
    length = 0.0
    if j == 0 or not mask[i, j - 1]:
        length += dr
    if j == columns - 1 or not mask[i, j + 1]:
        length += dr
    if i == 0 or not mask[i - 1, j]:
        length += (r - 0.5 * dr) * width
    if i == rows - 1 or not mask[i + 1, j]:
        length += (r + 0.5 * dr) * width
    return length
