"""By how much each cell exceeds the threshold of the Rayleigh CFAR."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.cfar import rayleigh_factors
from fls_detectors.reference import NO_FLAGS, TEST, Flags, Window, gathered_cells
from fls_flow.kernels import compiled, frozen

__all__ = ["rayleigh_ratio"]

FloatArray = npt.NDArray[np.float64]


def rayleigh_ratio(
    amplitude: npt.NDArray[Any],
    window: Window,
    *,
    pfa: float,
    min_ref: int = 8,
    floor: float = 0.0,
    flags: Flags = NO_FLAGS,
) -> FloatArray:
    """x / T (n_ranges, n_beams) with scale 1, nan where `rayleigh_hits` decides nothing."""
    window = window.within(amplitude.shape[0])
    factors = rayleigh_factors(pfa, min_ref, window.most)
    ratio = np.full(amplitude.shape, np.nan)
    if amplitude.size:
        _ratios(frozen(amplitude), frozen(flags), window, max(min_ref, 1), factors, floor * floor, ratio)
    return ratio


@compiled
def _ratios(
    amplitude: npt.NDArray[Any],
    flags: Flags,
    window: Window,
    min_ref: int,
    factors: FloatArray,
    floor_power: float,
    ratio: FloatArray,
) -> None:
    cells = np.empty(factors.size + 1)
    for row in range(ratio.shape[0]):
        for beam in range(ratio.shape[1]):
            if flags.size and not flags[row, beam] & TEST:
                continue
            count = gathered_cells(amplitude, flags, row, beam, window, min_ref, cells)
            total = max(np.sum(np.square(cells[:count])), count * floor_power)
            if count >= min_ref and total > 0.0:
                ratio[row, beam] = np.float64(amplitude[row, beam]) / np.sqrt(factors[count] * total)
