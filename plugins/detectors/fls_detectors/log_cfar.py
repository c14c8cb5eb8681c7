"""Detect cells that stand out of their surroundings on a logarithmic scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.cfar_ping import CfarNode
from fls_detectors.log_factors import FEWEST, HIGHEST_PFA, LOWEST_PFA
from fls_detectors.log_statistic import Clutter, log_hits, log_ratio
from fls_detectors.reference import Window
from fls_flow import hookimpl

__all__ = ["LogCfar"]


@dataclass
class LogCfar(CfarNode):
    """One detection per cell with x > c max(exp(m + t s), floor sqrt(-ln pfa)), in order of range, then beam.

    m and s are mean and standard deviation of ln max(x_j, floor) over the J reference cells, and t(J) the
    factor for which false alarms come at the rate `pfa` whatever scale and shape the clutter has: Weibull, of
    which Rayleigh is one, or log-normal (`clutter`). That costs threshold: at 1e-6 and J = 48 it lies some
    3 dB above that of `rayleigh-cfar` in Rayleigh clutter. With floor 0, cells that are 0 or less are no
    reference. c is `threshold_scale`, one number or one per beam: `fls-flow calibrate` finds it for samples
    of which none of this is true, such as log-compressed ones.

    The reference cells, what is excluded from them, `floor` and all other parameters are those of
    `rayleigh-cfar`.

    Raises ValueError when `noisy` or `threshold_scale` has another number of beams than the ping.

    Source: Goldstein 1973; reference window and widening are ours.
    """

    clutter: Clutter = "weibull"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clutter not in ("weibull", "lognormal"):
            raise ValueError(f"clutter must be weibull or lognormal, not {self.clutter!r}")
        if not LOWEST_PFA <= self.pfa <= HIGHEST_PFA:
            raise ValueError(f"pfa must lie between {LOWEST_PFA:g} and {HIGHEST_PFA:g} here, not {self.pfa}")
        if self.min_ref < FEWEST:
            raise ValueError(f"min_ref must be at least {FEWEST} here, not {self.min_ref}")

    def _hits(self, amplitude: npt.NDArray[Any], window: Window, **options: Any) -> npt.NDArray[np.bool_]:
        return log_hits(amplitude, window, clutter=self.clutter, **options)

    def _ratio(self, amplitude: npt.NDArray[Any], window: Window, **options: Any) -> npt.NDArray[np.float64]:
        return log_ratio(amplitude, window, clutter=self.clutter, **options)


@hookimpl
def fls_node() -> type[LogCfar]:
    """The kind `log-cfar`."""
    return LogCfar
