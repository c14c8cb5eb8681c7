"""Detect cells that stand out of Rayleigh clutter, at a constant false-alarm rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.cfar import rayleigh_hits
from fls_detectors.cfar_ping import CfarNode
from fls_detectors.cfar_ratio import rayleigh_ratio
from fls_detectors.reference import Window
from fls_flow import hookimpl

__all__ = ["RayleighCfar"]


@dataclass
class RayleighCfar(CfarNode):
    """One detection per cell with x > c sqrt((pfa^(-1/J) - 1) sum_j x_j^2), in order of range, then beam.

    c is `threshold_scale`, one number or one per beam: `fls-flow calibrate` finds it. The J reference cells
    lie in the beam under test and `guard_beams` to each side, before and behind a guard of `guard_m`, spread
    over `reference_m` a side, with the stride that keeps J <= `max_ref`. J counts those that exist, are
    valid, finite and not excluded. Excluded are the noisy beams (not tested either), the wedges of `wakes`
    and the gates of `tracks` predicted to the ping (both tested all the same); world tracks need `ping.nav`,
    else they exclude nothing. Where fewer than `min_ref` are left, the reference goes on outwards, with the
    same stride, as far as `widen_m`; a cell that still has fewer is not decided.
    Amplitudes below `floor` are not told from zero: the root mean square of the reference counts at
    least that much. By default it is one step of integer amplitudes, else 0; a reference of zeros alone, with
    floor 0, decides nothing.

    False alarms come at the rate `pfa` in Rayleigh clutter. A heavier tail gives far more of them, and they
    hide objects by being taken for wakes: then lower `pfa` until few are left. On the simulated surface 1e-12
    does in K clutter of shape 2 what 1e-6 does in Rayleigh clutter, and 1e-20 nearly so in measured clutter.

    Raises ValueError when `noisy` or `threshold_scale` has another number of beams than the ping.

    Source: Karoui 2015, III-B and (4); reference window and widening are ours.
    """

    def _hits(self, amplitude: npt.NDArray[Any], window: Window, **options: Any) -> npt.NDArray[np.bool_]:
        return rayleigh_hits(amplitude, window, **options)

    def _ratio(self, amplitude: npt.NDArray[Any], window: Window, **options: Any) -> npt.NDArray[np.float64]:
        return rayleigh_ratio(amplitude, window, **options)


@hookimpl
def fls_node() -> type[RayleighCfar]:
    """The kind `rayleigh-cfar`."""
    return RayleighCfar
