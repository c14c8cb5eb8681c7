"""Detect areas whose amplitudes do not follow a Rayleigh law: echoes and shadows on the sea floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from fls_detectors.snippets import RATIO_SD, RAYLEIGH_RATIO, Areas, Snippets, areas, painted, snippets
from fls_flow import Detections, Ping, hookimpl

__all__ = ["EchoesAndShadows", "RayleighRatio"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Side = Literal["both", "upper"]

INTEGER_STEPS = 2.0  # mean from which rounding leaves the ratio of speckle within its tolerance


class EchoesAndShadows(NamedTuple):
    """One detection per area."""

    detections: Detections  # brighter than the floor around
    shadows: Detections  # darker


@dataclass
class RayleighRatio:
    """The centres of areas that are no speckle, brighter ones and darker ones apart, in order of range.

    The image is cut into snippets; one is flagged where |std / mean - sqrt(4 / pi - 1)| > tolerance, by
    default `sigmas` standard deviations 0.3713 / sqrt(cells) of that ratio; `side: upper` flags only ratios
    above. It is an echo where its mean is above that of the floor at its range, the upper quartile of the
    snippets that are speckle, and a shadow where it is below. Flagged snippets of one kind that touch
    (8-connected) make an area; its place is the centroid of its amplitudes (for shadows, of what is missing
    to the floor's), its amplitude their mean. Areas of fewer than `min_cells` are left out. Cells that are
    not valid or not finite do not count; a snippet with fewer than half of its cells is not judged, nor one
    whose mean is below `floor`, by default two steps of integer amplitudes: the law of what is mostly zeros
    and ones is that of the rounding.

    Source: Quidu, Bertholom & Dupas 2010, section 2; size, tolerance, overlap, floor and the two kinds are
    ours.
    """

    snippet_ranges: int = 15
    snippet_beams: int = 10
    overlap: float = 0.5
    sigmas: float = 5.0
    tolerance: float | None = None
    side: Side = "both"
    floor: float | None = None  # in units of the amplitude
    min_cells: int = 1
    max_detections: int = 1000  # of each kind; the largest are kept

    def __post_init__(self) -> None:
        for name in ("snippet_ranges", "snippet_beams", "min_cells", "max_detections"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.snippet_ranges * self.snippet_beams < 4:
            raise ValueError(
                f"a snippet has {self.snippet_ranges} x {self.snippet_beams} cells; 4 is the least"
            )
        if not 0.0 <= self.overlap < 1.0:
            raise ValueError(f"overlap must lie from 0 to below 1, not {self.overlap}")
        for name in ("sigmas", "tolerance"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, not {value}")
        if self.floor is not None and not 0.0 <= self.floor < math.inf:
            raise ValueError(f"floor must be finite and not negative, not {self.floor}")
        if self.side not in get_args(Side):
            raise ValueError(f"side must be one of {get_args(Side)}, not {self.side!r}")

    def __call__(self, ping: Ping) -> EchoesAndShadows:
        """The echoes and shadows of one ping."""
        if not ping.amplitude.size:
            none = _detections(ping, None, ping.amplitude.astype(np.float32))
            return EchoesAndShadows(none, none)
        amplitude, valid = _clean(ping)
        grid = snippets(amplitude, valid, (self.snippet_ranges, self.snippet_beams), self.overlap)
        steps = INTEGER_STEPS if np.issubdtype(ping.amplitude.dtype, np.integer) else 0.0
        flagged = self._flagged(grid, steps if self.floor is None else self.floor)
        background = _background(grid, flagged)
        bright = flagged & (grid.mean >= background[:, None])
        echo = painted(grid, bright, amplitude.shape)
        shadow = painted(grid, flagged & ~bright, amplitude.shape) & ~echo
        if valid is not None:
            echo, shadow = echo & valid, shadow & valid
        level = np.interp(np.arange(amplitude.shape[0]), grid.row + 0.5 * grid.shape[0], background)
        shade = areas(shadow, _missing(level, amplitude) if shadow.any() else amplitude)
        return EchoesAndShadows(
            _detections(ping, self._largest(areas(echo, amplitude)), amplitude),
            _detections(ping, self._largest(shade), amplitude, shade=level),
        )

    def _flagged(self, grid: Snippets, floor: float) -> BoolArray:
        tolerance = self.sigmas * RATIO_SD / np.sqrt(np.maximum(grid.cells, 1.0))
        if self.tolerance is not None:
            tolerance = np.full(grid.cells.shape, self.tolerance)
        off = grid.ratio - RAYLEIGH_RATIO
        if self.side == "both":
            off = np.abs(off)
        enough = grid.cells >= 0.5 * grid.shape[0] * grid.shape[1]
        flagged: BoolArray = enough & (off > tolerance) & (grid.mean >= floor)  # nan: no
        return flagged

    def _largest(self, found: Areas) -> Areas:
        keep = found.cells >= self.min_cells
        if np.count_nonzero(keep) > self.max_detections:
            order = np.argsort(-found.cells, kind="stable")
            keep = np.zeros(keep.size, bool)
            keep[order[: self.max_detections]] = True
        return Areas(
            found.cells[keep],
            found.weight[keep],
            found.row[keep],
            found.beam[keep],
            found.height[keep],
            found.width[keep],
        )


def _clean(ping: Ping) -> tuple[npt.NDArray[np.float32], BoolArray | None]:
    """The amplitudes as float32, 0 where they are not valid or not finite, and the mask of the others."""
    amplitude, valid = ping.amplitude.astype(np.float32, copy=False), ping.valid
    if np.issubdtype(ping.amplitude.dtype, np.floating):
        finite = np.isfinite(amplitude)
        if not finite.all():
            valid = finite if valid is None else finite & valid
    if valid is not None:
        amplitude = np.where(valid, amplitude, np.float32(0.0))
    return amplitude, valid


def _missing(level: FloatArray, amplitude: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """What amplitudes (n_ranges, n_beams) lack to the floor's mean (n_ranges,) at their range."""
    missing: npt.NDArray[np.float32] = level.astype(np.float32)[:, None] - amplitude
    np.maximum(missing, np.float32(0.0), out=missing)
    return missing


def _background(grid: Snippets, flagged: BoolArray) -> FloatArray:
    """Mean amplitude of the floor at each row of the grid, (n_rows,).

    The upper quartile of the snippets that are not flagged, else of all: shadows, dark but speckle inside,
    may fill more than half of a row. 0 where no snippet has a cell.
    """
    known = np.isfinite(grid.mean)
    usable = known & ~flagged
    usable |= known & ~usable.any(axis=1, keepdims=True)
    ordered = np.sort(np.where(usable, grid.mean, -np.inf), axis=1)
    from_top = (0.25 * (usable.sum(axis=1) - 1)).astype(np.int64)
    level = ordered[np.arange(len(ordered)), ordered.shape[1] - 1 - np.maximum(from_top, 0)]
    return np.where(np.isfinite(level), level, 0.0)


def _detections(
    ping: Ping, found: Areas | None, amplitude: npt.NDArray[np.float32], shade: FloatArray | None = None
) -> Detections:
    """Areas as detections; their amplitude is the mean, for shadows the background less what is missing."""
    if found is None or not found.cells.size:
        return Detections.of(ping, range_m=[], bearing_rad=[], amplitude=[])
    rows, beams = np.arange(ping.range_m.size), np.arange(ping.bearing_rad.size)
    mean = found.weight / found.cells
    if shade is not None:
        mean = np.maximum(np.interp(found.row, rows, shade) - mean, 0.0)
    extent = np.stack([found.height * ping.cell_m, found.width * abs(ping.beam_spacing_rad)], axis=-1)
    return Detections.of(
        ping,
        range_m=np.interp(found.row, rows, ping.range_m),
        bearing_rad=np.interp(found.beam, beams, ping.bearing_rad),
        amplitude=mean,
        extent=np.nan_to_num(extent),
    )


@hookimpl
def fls_node() -> type[RayleighRatio]:
    """The kind `rayleigh-ratio`."""
    return RayleighRatio
