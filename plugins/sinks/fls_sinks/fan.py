"""From a polar image to the pixels of its fan: x forward is up, y starboard is right."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Fan", "decibels", "edges", "fan", "peak_reduced", "raster"]

FloatArray = npt.NDArray[np.float64]
NARROW_BEAM_RAD = math.radians(1.0)  # drawn width of a lone beam of unknown width
OUTLINE_POINTS = 361


@dataclass(frozen=True, slots=True)
class Fan:
    """A polar image with the edges of its cells, beams in increasing order."""

    level: FloatArray  # (n_ranges, n_beams); nan: no data
    range_edge_m: FloatArray  # (n_ranges + 1,)
    bearing_edge_rad: FloatArray  # (n_beams + 1,)

    @property
    def outline_m(self) -> FloatArray:
        """(n, 2) closed polygon [x, y] around the fan."""
        bearing = np.linspace(self.bearing_edge_rad[0], self.bearing_edge_rad[-1], OUTLINE_POINTS)
        arc = np.column_stack([np.cos(bearing), np.sin(bearing)])
        return np.concatenate([self.range_edge_m[0] * arc, self.range_edge_m[-1] * arc[::-1]])

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Left and right (y), bottom and top (x) of the fan."""
        (bottom, left), (top, right) = self.outline_m.min(axis=0), self.outline_m.max(axis=0)
        thin = 1e-6 * max(right - left, top - bottom, 1e-3)  # a fan of no width still has pixels
        return float(left - thin), float(right + thin), float(bottom), float(top + thin)


def fan(
    level: npt.NDArray[Any], range_m: FloatArray, bearing_rad: FloatArray, beamwidth_rad: float = math.nan
) -> Fan:
    """The fan of a polar image (n_ranges, n_beams) whose cells are centred at the tables."""
    order = np.argsort(bearing_rad, kind="stable")
    width = beamwidth_rad if beamwidth_rad > 0 else NARROW_BEAM_RAD
    range_edge = np.maximum(edges(range_m, lone_width=0.02 * float(range_m[-1]) or 1.0), 0.0)
    return Fan(np.asarray(level[:, order], float), range_edge, edges(bearing_rad[order], lone_width=width))


def edges(centre: FloatArray, lone_width: float) -> FloatArray:
    """The n + 1 edges between n cells: halfway between centres, the outer ones by symmetry."""
    if centre.size == 1:
        return np.array([centre[0] - 0.5 * lone_width, centre[0] + 0.5 * lone_width])
    middle = 0.5 * (centre[:-1] + centre[1:])
    return np.concatenate([[2 * centre[0] - middle[0]], middle, [2 * centre[-1] - middle[-1]]])


def decibels(amplitude: npt.NDArray[Any], reference: float) -> FloatArray:
    """20 log10(amplitude / reference); -inf where it is not positive, nan where it is nan."""
    value = np.asarray(amplitude, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        level: FloatArray = 20.0 * np.log10(np.where(value < 0.0, 0.0, value) / reference)
    return level


def peak_reduced(image: Fan, max_ranges: int, max_beams: int) -> Fan:
    """The same fan with neighbouring cells joined, each with the strongest of its cells."""
    rows = np.arange(0, image.level.shape[0], math.ceil(image.level.shape[0] / max_ranges))
    columns = np.arange(0, image.level.shape[1], math.ceil(image.level.shape[1] / max_beams))
    level = np.fmax.reduceat(np.fmax.reduceat(image.level, rows, axis=0), columns, axis=1)
    return Fan(
        level,
        np.append(image.range_edge_m[rows], image.range_edge_m[-1]),
        np.append(image.bearing_edge_rad[columns], image.bearing_edge_rad[-1]),
    )


def raster(image: Fan, pixels: int) -> FloatArray:
    """The fan on square pixels over its `extent_m`, rows from the bottom; nan outside it.

    The longer side has `pixels`. Each pixel shows the cell at its centre, or a stronger one whose centre lies
    in it: no echo is lost near the apex, where beams are narrower than pixels.
    """
    left, right, bottom, top = image.extent_m
    pitch = max(right - left, top - bottom) / pixels
    n_y, n_x = max(1, round((right - left) / pitch)), max(1, round((top - bottom) / pitch))
    y = left + (np.arange(n_y) + 0.5) * (right - left) / n_y
    x = bottom + (np.arange(n_x) + 0.5) * (top - bottom) / n_x
    picture = _cells_at(image, x[:, None], y[None, :])

    distance = 0.5 * (image.range_edge_m[:-1] + image.range_edge_m[1:])[:, None]
    bearing = 0.5 * (image.bearing_edge_rad[:-1] + image.bearing_edge_rad[1:])
    row = (distance * np.cos(bearing) - bottom) / (top - bottom) * n_x
    column = (distance * np.sin(bearing) - left) / (right - left) * n_y
    at = (
        np.clip(row.astype(np.int64), 0, n_x - 1),
        np.clip(column.astype(np.int64), 0, n_y - 1),
    )
    np.fmax.at(picture, at, image.level)
    return picture


def _cells_at(image: Fan, x: FloatArray, y: FloatArray) -> FloatArray:
    middle = 0.5 * (image.bearing_edge_rad[0] + image.bearing_edge_rad[-1])
    turned = np.arctan2(y, x) - middle
    bearing = middle + turned - 2 * np.pi * np.floor((turned + np.pi) / (2 * np.pi))
    row = np.searchsorted(image.range_edge_m, np.hypot(x, y), side="right") - 1
    column = np.searchsorted(image.bearing_edge_rad, bearing, side="right") - 1
    n_ranges, n_beams = image.level.shape
    inside = (row >= 0) & (row < n_ranges) & (column >= 0) & (column < n_beams)
    cells = image.level[np.clip(row, 0, n_ranges - 1), np.clip(column, 0, n_beams - 1)]
    return np.where(inside, cells, np.nan)
