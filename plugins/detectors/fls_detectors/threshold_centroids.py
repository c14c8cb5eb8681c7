"""Detect bright regions: threshold, connected cells, centroids."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Ping, hookimpl

__all__ = ["Regions", "ThresholdCentroids", "bright_regions"]

FloatArray = npt.NDArray[np.float64]

LARGEST = float(np.finfo(np.float32).max)  # above which there is no amplitude


class Regions(NamedTuple):
    """Connected regions, in order of range, then beam, of their first cells."""

    centroid: FloatArray  # (n, 2) row and column, weighted by power
    spread: FloatArray  # (n, 2) standard deviation about it, in rows and columns
    size: FloatArray  # (n, 2) rows and columns that it spans
    cells: FloatArray  # (n,)
    peak: FloatArray  # (n,) largest amplitude
    border: FloatArray  # (n,) part of its power in the first and last column


@dataclass
class ThresholdCentroids:
    """One detection per connected region of cells above a threshold, at the region's centroid.

    The threshold is `threshold` in units of the amplitude, or `threshold_db` above the ping's median where
    that is None; of integer amplitudes the median counts at least 1, one step. Cells with gaps of up to
    `gap_m` and `gap_beams` between them make one region, of `min_cells` to `max_cells` cells: an object's
    echo is patchy, and trackers take each region for an object.
    Centroids are weighted by power; the covariance is that of a centroid known to a part of the region's
    size: its spread, plus a cell's own 1/12, over sqrt(2) per axis, and at least `min_sd_m` and
    `min_sd_beams`. Regions with more than `max_border_share` of their power in the first and last beam are
    left out: what is seen by them alone lies mostly outside of the sector, and where is not known.

    Source: Clark & Bell 2005, section III; the threshold is ours.
    """

    threshold_db: float = 20.0
    threshold: float | None = None
    gap_m: float = 0.5
    gap_beams: int = 1
    min_cells: int = 2
    max_cells: int = 5000
    min_sd_m: float = 0.15
    min_sd_beams: float = 0.5
    max_border_share: float = 1.0
    max_detections: int = 1000  # the strongest are kept

    def __post_init__(self) -> None:
        for name in ("threshold_db", "threshold"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} is {value}; it must be finite")
        if not (0.0 <= self.gap_m < math.inf and self.gap_beams >= 0):
            raise ValueError(f"gap_m {self.gap_m} and gap_beams {self.gap_beams}: neither is negative")
        if self.threshold is not None and self.threshold < 0.0:
            raise ValueError(f"threshold is {self.threshold}; it must be 0 or more")
        if not 1 <= self.min_cells <= self.max_cells:
            raise ValueError(
                f"min_cells {self.min_cells} to max_cells {self.max_cells} is no range from 1 on"
            )
        for name in ("min_sd_m", "min_sd_beams"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")
        if not 0.0 < self.max_border_share <= 1.0:
            raise ValueError(f"max_border_share is {self.max_border_share}; it must be above 0 and at most 1")
        if self.max_detections < 1:
            raise ValueError(f"max_detections is {self.max_detections}; it must be at least 1")

    def __call__(self, ping: Ping) -> Detections:
        """The detections of one ping."""
        if ping.range_m.size < 2 or not ping.bearing_rad.size:
            return Detections.of(ping, range_m=[], bearing_rad=[], amplitude=[])
        amplitude = np.nan_to_num(ping.amplitude.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
        known = np.isfinite(ping.amplitude)
        if ping.valid is not None:
            known &= ping.valid
        amplitude[~known] = 0.0
        step = 1.0 if np.issubdtype(ping.amplitude.dtype, np.integer) else 0.0
        limit = self._limit(amplitude, known, step)
        gap = (math.floor(self.gap_m / ping.cell_m + 1e-9), self.gap_beams)
        found = bright_regions(amplitude, (amplitude > limit) & known, gap)
        kept = (found.cells >= self.min_cells) & (found.cells <= self.max_cells)
        if self.max_border_share < 1.0:
            kept &= found.border <= self.max_border_share
        return self._detections(ping, Regions(*(part[kept] for part in found)))

    def _limit(self, amplitude: npt.NDArray[np.float32], known: npt.NDArray[np.bool_], step: float) -> float:
        if self.threshold is not None:
            return self.threshold
        middle = float(np.median(amplitude[known].astype(float))) if known.any() else 0.0
        return min(max(middle, step) * float(10.0 ** (self.threshold_db / 20.0)), LARGEST)

    def _detections(self, ping: Ping, found: Regions) -> Detections:
        if found.cells.size > self.max_detections:
            keep = np.sort(np.argsort(-found.peak, kind="stable")[: self.max_detections])
            found = Regions(*(part[keep] for part in found))
        rows, columns = found.centroid.T
        pitch = np.array([ping.cell_m, abs(ping.beam_spacing_rad)])
        least = np.array([self.min_sd_m, self.min_sd_beams * pitch[1]])
        sd = np.maximum(np.sqrt(0.5 * (found.spread**2 + 1.0 / 12.0)) * pitch, least)
        covariance = np.zeros((rows.size, 2, 2))
        covariance[:, 0, 0], covariance[:, 1, 1] = sd.T**2
        return Detections.of(
            ping,
            range_m=np.interp(rows, np.arange(ping.range_m.size), ping.range_m),
            bearing_rad=np.interp(columns, np.arange(ping.bearing_rad.size), ping.bearing_rad),
            amplitude=found.peak,
            extent=(found.size - 1.0) * pitch,
            covariance=covariance,
        )


def bright_regions(
    amplitude: npt.NDArray[np.float32], bright: npt.NDArray[np.bool_], gap: tuple[int, int] = (0, 0)
) -> Regions:
    """The regions of `bright` cells (rows, columns) with at most `gap` (rows, columns) dark ones between.

    Without a gap they touch by sides or corners.
    """
    label = _labels(bright.astype(np.uint8), gap)
    row, column = np.nonzero(bright)
    name, first, of = np.unique(label[row, column], return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    of, n = rank[of], name.size
    power = amplitude[row, column].astype(float) ** 2
    place = np.stack([row, column], axis=1).astype(float)
    total = np.bincount(of, power, n)
    centroid = _per_region(of, power, place, n) / total[:, None]
    spread = np.sqrt(_per_region(of, power, (place - centroid[of]) ** 2, n) / total[:, None])
    low, high, peak = np.full((n, 2), np.inf), np.full((n, 2), -np.inf), np.full(n, -np.inf)
    np.minimum.at(low, of, place)
    np.maximum.at(high, of, place)
    np.maximum.at(peak, of, amplitude[row, column])
    edge = (column == 0) | (column == bright.shape[1] - 1)
    border = np.bincount(of[edge], power[edge], n) / total
    cells = np.bincount(of, minlength=n).astype(float)
    return Regions(centroid, spread, high - low + 1.0, cells, peak, border)


def _labels(bright: npt.NDArray[np.uint8], gap: tuple[int, int]) -> npt.NDArray[np.int32]:
    """Numbers of the regions; each cell grows by half a gap to one side and the other half to the other."""
    import cv2  # only where there is something to detect

    rows, columns = gap
    grown = bright
    if rows or columns:
        # a box of gap + 1 cells, so that grown cells touch exactly where the gap is bridged
        grown = np.asarray(cv2.dilate(bright, np.ones((rows + 1, columns + 1), np.uint8)), np.uint8)
    _, label = cv2.connectedComponents(grown, connectivity=8, ltype=cv2.CV_32S)
    return np.asarray(label, np.int32)


def _per_region(of: npt.NDArray[np.intp], power: FloatArray, value: FloatArray, n: int) -> FloatArray:
    columns = [np.bincount(of, power * value[:, axis], n) for axis in range(2)]
    return np.stack(columns, axis=1)


@hookimpl
def fls_node() -> type[ThresholdCentroids]:
    """The kind `threshold-centroids`."""
    return ThresholdCentroids
