"""Short overlapping pieces of the channels, in narrow bands, and range cells from such pieces of beams.

A frame is a stretch of fine samples under a Hann window, the next one begins half a frame later: the windows
add up to 1, so that beams whose weights do not change come out as from the whole block. Silence on both sides
of a frame leaves room for delays.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
import numpy.typing as npt
from scipy import fft

from fls_beamformers.grid import CellGrid

__all__ = ["FramePlan", "band_frames", "cells_of_frames"]

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex64] | npt.NDArray[np.complex128]
FRAME_OF_APERTURE = 32.0  # a frame lasts so many times what sound takes from the origin to a hydrophone
MIN_CELLS = 16
BAND = 0.75  # half of the band that is worked, of the pulse's bandwidth: holds a chirp but for 1 % or so


@dataclass(frozen=True, slots=True)
class FramePlan:
    """Frames of `cells` range cells, `guard` cells of silence on each side; the bins of the pulse's band."""

    cells: int  # even
    guard: int
    count: int
    bins: npt.NDArray[np.int64]  # of a frame with its silence, around the carrier: from negative to positive
    bin_hz: float

    @classmethod
    def of(cls, grid: CellGrid, bandwidth_hz: float, guard_s: float) -> FramePlan:
        """The frames of a grid, for delays of at most `guard_s`."""
        cell_rate_hz = grid.fine_rate_hz / grid.stride
        half = max(MIN_CELLS // 2, ceil(0.5 * FRAME_OF_APERTURE * guard_s * cell_rate_hz))
        guard = ceil(guard_s * cell_rate_hz) + 1
        while fft.next_fast_len(2 * (half + guard)) != 2 * (half + guard):
            half += 1
        bin_hz = cell_rate_hz / (2 * (half + guard))
        highest = int(min(BAND * bandwidth_hz, 0.49 * grid.fine_rate_hz) / bin_hz)
        count = ceil(grid.count / half) + 1
        return cls(2 * half, guard, count, np.arange(-highest, highest + 1), bin_hz)

    @property
    def padded(self) -> int:
        """Cells of a frame with its silence."""
        return self.cells + 2 * self.guard

    @property
    def centre(self) -> npt.NDArray[np.int64]:
        """The cell in the middle of each frame; the first frame's is the first cell."""
        return np.arange(self.count) * (self.cells // 2)


def band_frames(fine: ComplexArray, grid: CellGrid, plan: FramePlan) -> ComplexArray:
    """Spectra (n_bins, n_frames, n_channels) of the frames of fine samples (n_channels, n_fine)."""
    length, hop = plan.cells * grid.stride, plan.cells // 2 * grid.stride
    begin = grid.first * grid.stride - hop
    need = length + (plan.count - 1) * hop
    before, after = max(0, -begin), max(0, begin + need - fine.shape[1])
    wanted = np.pad(fine[:, max(0, begin) : begin + need], ((0, 0), (before, after)))
    window = (0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)).astype(fine.real.dtype)
    frames = np.zeros((fine.shape[0], plan.count, plan.padded * grid.stride), fine.dtype)
    lead = plan.guard * grid.stride
    for number in range(plan.count):
        piece = wanted[:, number * hop : number * hop + length]
        np.multiply(piece, window, out=frames[:, number, lead : lead + length])
    spectra = fft.fft(frames, overwrite_x=True)[:, :, plan.bins]
    return np.ascontiguousarray(spectra.transpose(2, 1, 0))


def cells_of_frames(spectra: ComplexArray, grid: CellGrid, plan: FramePlan) -> npt.NDArray[np.float32]:
    """|b| (n_cells, n_beams) of beams' spectra (n_bins, n_frames, n_beams).

    Bins beyond the rate of the cells fold onto those below, which samples the beam at the cells.
    """
    n_beams = spectra.shape[2]
    folded = np.zeros((plan.padded, plan.count, n_beams), spectra.dtype)
    for row, at in zip(spectra, plan.bins % plan.padded, strict=True):
        folded[at] += row
    # An inverse transform of the fine frames, taken at every stride-th sample only.
    pieces = fft.ifft(folded, axis=0, overwrite_x=True)
    pieces *= pieces.real.dtype.type(1.0 / grid.stride)
    half = plan.cells // 2
    total = np.zeros((half * (plan.count + 1) + 2 * plan.guard, n_beams), spectra.dtype)
    for number in range(plan.count):
        total[number * half : number * half + plan.padded] += pieces[:, number]
    first = half + plan.guard
    return np.abs(total[first : first + grid.count]).astype(np.float32)
