"""Detect blobs in the angle-distance matrix of an array, at a constant false-alarm rate."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fls_detectors.array_blobs import Blobs, blobs_of
from fls_detectors.cfar import NO_FLAGS, Window, rayleigh_hits
from fls_detectors.exclusion import all_finite, cell_flags, no_marks
from fls_detectors.reference import nearest_cells
from fls_flow import Detections, Ping, hookimpl

__all__ = ["ArrayCfar"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
log = logging.getLogger(__name__)


@dataclass
class ArrayCfar:
    """One detection per 4-connected blob of cells above a Rayleigh threshold, at the blob's centroid.

    A cell is a hit when x > sqrt((pfa^(-1/J) - 1) sum_j x_j^2), strictly. The J reference cells lie in the
    beam under test, since neighbouring beams and lobes see the same echoes: `references` of them, half before
    and half behind a guard of `guard_m`, every `stride_m` (a pulse of bandwidth B gives independent cells
    every c / (2 B)). J counts those that exist, are valid and finite; where fewer than `min_ref` are left,
    the reference goes on outwards, twice as far, and a cell that still has fewer is not decided. The root
    mean square of integer amplitudes counts at least 1, one step.

    Kept are blobs of at least `min_cells` cells that span at most `max_range_m` and `max_bearing_deg`; of
    more than `max_detections` the ones with the highest peaks, and the log says so once. The covariance is
    diag(range_sd_m^2, bearing_sd_deg^2). The amplitude is that of the highest cell, or with
    `amplitude: ratio` that over the root mean square of its reference, which trackers can compare between
    ranges. When the sound met a blob follows from its range: stamp + range / c.

    Source: Abu 2024 (6)-(11), reference along range only; its limits on size are not printed.
    """

    pfa: float = 1e-5
    references: int = 32
    stride_m: float = 0.076
    guard_m: float = 0.16
    min_ref: int = 8
    min_cells: int = 3
    max_range_m: float = 5.0
    max_bearing_deg: float = 30.0
    centroid: Literal["cells", "power"] = "cells"
    amplitude: Literal["peak", "ratio"] = "peak"
    range_sd_m: float = 0.3
    bearing_sd_deg: float = 5.0
    max_detections: int = 5000
    _warned: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.pfa < 1.0:
            raise ValueError(f"pfa must lie between 0 and 1, not {self.pfa}")
        if self.references < 2 or self.references & (self.references - 1):
            raise ValueError(f"references must be a power of two from 2 on, not {self.references}")
        if not 1 <= self.min_ref <= self.references:
            raise ValueError(f"min_ref must be 1 to references, not {self.min_ref}")
        if not 0.0 <= self.guard_m < np.inf:
            raise ValueError(f"guard_m must be finite and not negative, not {self.guard_m}")
        self._check_limits()

    def _check_limits(self) -> None:
        for name in ("stride_m", "max_range_m", "max_bearing_deg", "range_sd_m", "bearing_sd_deg"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive and finite, not {getattr(self, name)}")
        for name in ("min_cells", "max_detections"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name, words in (("centroid", ("cells", "power")), ("amplitude", ("peak", "ratio"))):
            if getattr(self, name) not in words:
                raise ValueError(f"{name} must be {' or '.join(words)}, not {getattr(self, name)!r}")

    def __call__(self, ping: Ping) -> Detections:
        """The blobs of one ping."""
        if ping.range_m.size < 2 or not ping.bearing_rad.size:
            return Detections.of(ping, range_m=[], bearing_rad=[], amplitude=[])
        found = blobs_of(ping, self.hits(ping), by_power=self.centroid == "power")
        kept = (
            (found.cells >= self.min_cells)
            & (found.extent[:, 0] <= self.max_range_m)
            & (found.extent[:, 1] <= np.radians(self.max_bearing_deg))
        )
        return self._detections(ping, found.select(kept))

    def hits(self, ping: Ping) -> BoolArray:
        """Which cells (n_ranges, n_beams) exceed their threshold."""
        window = self._window(ping.cell_m)
        floor = 1.0 if np.issubdtype(ping.amplitude.dtype, np.integer) else 0.0
        flags = NO_FLAGS
        if ping.valid is not None or not all_finite(ping.amplitude):
            quiet = np.zeros(ping.bearing_rad.size, bool)
            flags = cell_flags(ping.amplitude, no_marks(*ping.amplitude.shape), quiet, ping.valid)
        return rayleigh_hits(
            ping.amplitude, window, pfa=self.pfa, min_ref=self.min_ref, floor=floor, flags=flags
        )

    def _window(self, cell_m: float) -> Window:
        stride = max(1, nearest_cells(self.stride_m / cell_m))
        levels = self.references.bit_length() - 2
        return Window(nearest_cells(self.guard_m / cell_m), stride, levels, 0, self.references)

    def snapshot(self) -> dict[str, Any]:
        """Whether the user has been warned."""
        return {"warned": self._warned}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._warned = bool(state["warned"])

    def _detections(self, ping: Ping, found: Blobs) -> Detections:
        n = found.peak.size
        if n > self.max_detections:
            if not self._warned:
                log.warning(
                    "ping %d has %d blobs, the %d highest are kept (max_detections); said once",
                    ping.seq, n, self.max_detections,
                )  # fmt: skip
                self._warned = True
            found = found.select(np.sort(np.argsort(-found.peak, kind="stable")[: self.max_detections]))
        amplitude = found.peak
        if self.amplitude == "ratio":
            amplitude = amplitude / _reference_rms(ping, found, self._window(ping.cell_m))
        noise = np.diag([self.range_sd_m**2, np.radians(self.bearing_sd_deg) ** 2])
        return Detections.of(
            ping,
            range_m=found.range_m,
            bearing_rad=found.bearing_rad,
            amplitude=amplitude,
            extent=found.extent,
            covariance=np.broadcast_to(noise, (found.peak.size, 2, 2)),
        )


def _reference_rms(ping: Ping, found: Blobs, window: Window) -> FloatArray:
    """Root mean square (n,) of the reference cells of each blob's highest cell; 1 where it has none."""
    steps = window.guard + 1 + window.stride * np.arange(1 << window.levels)
    rows = found.row[:, None] + np.concatenate([-steps[::-1], steps])
    usable = (rows >= 0) & (rows < ping.range_m.size)
    rows = np.where(usable, rows, 0)
    cells = ping.amplitude[rows, found.beam[:, None]].astype(float)
    usable &= np.isfinite(cells)
    if ping.valid is not None:
        usable &= ping.valid[rows, found.beam[:, None]]
    count = np.count_nonzero(usable, axis=1)
    power = np.where(usable, cells, 0.0) ** 2
    mean = power.sum(axis=1) / np.maximum(count, 1)
    return np.sqrt(np.where(mean > 0.0, mean, 1.0))


@hookimpl
def fls_node() -> type[ArrayCfar]:
    """The kind `array-cfar`."""
    return ArrayCfar
