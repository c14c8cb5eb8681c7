"""Detect what exceeds the mean energy at its range, without merging."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.array_blobs import blobs_of
from fls_flow import Detections, Ping, hookimpl
from fls_flow.kernels import compiled, frozen

__all__ = ["MeanEnergy", "ring_energy"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
ALL_VALID: BoolArray = np.zeros((0, 0), bool)


@dataclass
class MeanEnergy:
    """One detection per 4-connected blob of cells with x^2 > -ln(pfa) E, at the blob's centroid.

    E is the mean energy of all beams over `window_m` of range around the cell; in Rayleigh clutter that is
    the same all round, cells exceed it at the rate `pfa`. Of integer amplitudes E counts at least 1, one
    step. Lobes of one target stay detections of their own.
    Of more than `max_detections` the ones with the highest peaks are kept.

    Source: after Lo & Ferguson 2004, as the benchmark of Abu 2024, section VI; the window and the threshold
    as a false-alarm rate are ours.
    """

    pfa: float = 1e-5
    window_m: float = 20.0
    min_cells: int = 1
    range_sd_m: float = 0.3
    bearing_sd_deg: float = 5.0
    max_detections: int = 5000

    def __post_init__(self) -> None:
        if not 0.0 < self.pfa < 1.0:
            raise ValueError(f"pfa must lie between 0 and 1, not {self.pfa}")
        for name in ("window_m", "range_sd_m", "bearing_sd_deg"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive and finite, not {getattr(self, name)}")
        for name in ("min_cells", "max_detections"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")

    def __call__(self, ping: Ping) -> Detections:
        """The detections of one ping."""
        if ping.range_m.size < 2 or not ping.bearing_rad.size:
            return Detections.of(ping, range_m=[], bearing_rad=[], amplitude=[])
        amplitude, valid = frozen(ping.amplitude), frozen(ALL_VALID if ping.valid is None else ping.valid)
        half = int(0.5 * self.window_m / ping.cell_m + 0.5)
        step = 1.0 if np.issubdtype(amplitude.dtype, np.integer) else 0.0
        energy = np.maximum(ring_energy(*_row_energies(amplitude, valid), half), step)
        limit = -np.log(self.pfa) * energy
        found = blobs_of(ping, _above(amplitude, valid, limit.astype(np.float32)))
        found = found.select(found.cells >= self.min_cells)
        if found.peak.size > self.max_detections:
            found = found.select(np.sort(np.argsort(-found.peak, kind="stable")[: self.max_detections]))
        noise = np.diag([self.range_sd_m**2, np.radians(self.bearing_sd_deg) ** 2])
        return Detections.of(
            ping,
            range_m=found.range_m,
            bearing_rad=found.bearing_rad,
            amplitude=found.peak,
            extent=found.extent,
            covariance=np.broadcast_to(noise, (found.peak.size, 2, 2)),
        )


def ring_energy(total: FloatArray, count: IntArray, half: int) -> FloatArray:
    """Mean power of the known cells of the rows m - half .. m + half, (n_ranges,); where none is known, 0.

    `total` and `count` (n_ranges,) are the power and the number of the known cells of each row.
    """
    number = _window_sums(count.astype(float), half)
    mean: FloatArray = _window_sums(total, half) / np.maximum(number, 1.0)
    return mean


def _window_sums(values: FloatArray, half: int) -> FloatArray:
    """Sums (n,) of values m - half .. m + half, as many as there are.

    Each is the end of one block and the start of the next, both added up in it: differences of one running
    sum would carry the rounding of a huge value into all windows behind it.
    """
    n, length = values.size, 2 * half + 1
    blocks = np.zeros((-(-(n + 2 * half) // length), length))
    blocks.reshape(-1)[half : half + n] = values
    starts = np.cumsum(blocks, axis=1).reshape(-1)
    ends = np.cumsum(blocks[:, ::-1], axis=1)[:, ::-1].reshape(-1)
    first = np.arange(n)
    return ends[first] + np.where(first % length, starts[first + length - 1], 0.0)


@compiled
def _row_energies(amplitude: npt.NDArray[Any], valid: BoolArray) -> tuple[FloatArray, IntArray]:
    """Power and number of the cells of each row that are finite and valid."""
    n_ranges, n_beams = amplitude.shape
    total, count = np.zeros(n_ranges), np.zeros(n_ranges, np.int64)
    lanes = np.zeros(8)  # added to in turn, so that no sum waits for the one before
    for r in range(n_ranges):
        lanes[:] = 0.0
        known = 0
        for b in range(n_beams):
            x = np.float32(amplitude[r, b])
            good = np.isfinite(x) and (valid.size == 0 or valid[r, b])
            lanes[b & 7] += x * x if good else np.float32(0.0)
            known += good
        total[r], count[r] = lanes.sum(), known
    return total, count


@compiled
def _above(amplitude: npt.NDArray[Any], valid: BoolArray, limit: npt.NDArray[np.float32]) -> BoolArray:
    """Which known cells have more power than the limit of their row."""
    n_ranges, n_beams = amplitude.shape
    hits = np.zeros((n_ranges, n_beams), np.bool_)
    for r in range(n_ranges):
        for b in range(n_beams):
            x = np.float32(amplitude[r, b])
            hits[r, b] = np.isfinite(x) and x * x > limit[r] and (valid.size == 0 or valid[r, b])
    return hits


@hookimpl
def fls_node() -> type[MeanEnergy]:
    """The kind `mean-energy`."""
    return MeanEnergy
