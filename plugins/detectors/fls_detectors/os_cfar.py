"""Detect cells that stand out of an ordered statistic of their surroundings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.cfar_ping import CfarNode
from fls_detectors.ordered_statistic import ordered_hits, ordered_ratio
from fls_detectors.reference import Window
from fls_flow import hookimpl

__all__ = ["OsCfar"]


@dataclass
class OsCfar(CfarNode):
    """One detection per cell with x > c sqrt(a) max(x_(k), floor), in order of range, then beam.

    x_(k) is the k-th smallest of the J reference cells, k = `rank` J rounded to nearest, and a the factor for
    which false alarms in Rayleigh clutter come at the rate `pfa` exactly, whatever J. Up to J - k cells of
    other echoes among the reference leave the threshold nearly as it is: the choice beside walls, wakes and
    swimmers in groups, at some loss in plain clutter. c is `threshold_scale`, one number or one per beam.

    The reference cells, what is excluded from them, `floor` and all other parameters are those of
    `rayleigh-cfar`.

    Raises ValueError when `noisy` or `threshold_scale` has another number of beams than the ping.

    Source: Rohling 1983; reference window and widening are ours.
    """

    rank: float = 0.75  # k / J

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.rank <= 1.0:
            raise ValueError(f"rank must lie above 0 and up to 1, not {self.rank}")

    def _hits(self, amplitude: npt.NDArray[Any], window: Window, **options: Any) -> npt.NDArray[np.bool_]:
        return ordered_hits(amplitude, window, rank=self.rank, **options)

    def _ratio(self, amplitude: npt.NDArray[Any], window: Window, **options: Any) -> npt.NDArray[np.float64]:
        return ordered_ratio(amplitude, window, rank=self.rank, **options)


@hookimpl
def fls_node() -> type[OsCfar]:
    """The kind `os-cfar`."""
    return OsCfar
