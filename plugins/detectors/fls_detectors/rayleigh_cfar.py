"""Detect cells that stand out of Rayleigh clutter, at a constant false-alarm rate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.cfar import rayleigh_hits
from fls_detectors.cfar_ping import (
    beam_scale,
    cell_flags_of,
    check_settings,
    detections_of,
    empty,
    quantum,
    window_of,
)
from fls_detectors.cfar_ratio import rayleigh_ratio
from fls_flow import BeamMask, Detections, Ping, Tracks, Wakes, hookimpl

__all__ = ["RayleighCfar"]


@dataclass
class RayleighCfar:
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

    pfa: float = 1e-6
    guard_m: float = 1.0
    guard_beams: int = 1
    reference_m: float = 2.0
    max_ref: int = 48
    min_ref: int = 8
    widen_m: float = 20.0
    gate: float = 4.0  # squared Mahalanobis distance that bounds the ellipse around a track
    gate_radius_m: float = 2.0  # its half-axes are at least
    gate_limit_m: float = 10.0  # and at most this long: an uncertain track must not blind the detector
    floor: float | None = None
    threshold_scale: float | tuple[float, ...] = 1.0
    max_detections: int = 20_000  # the strongest are kept
    _warned: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        check_settings(self)

    def __call__(
        self,
        ping: Ping,
        noisy: BeamMask | None = None,
        wakes: Wakes | None = None,
        tracks: Tracks | None = None,
    ) -> Detections:
        """The detections of one ping."""
        if empty(ping):
            return Detections.of(ping, range_m=[], bearing_rad=[], amplitude=[])
        hits = rayleigh_hits(
            ping.amplitude,
            window_of(self, ping.cell_m),
            **self._options(ping, noisy, wakes, tracks),
            scale=beam_scale(self, ping.bearing_rad.size),
        )
        found, self._warned = detections_of(ping, hits, self.max_detections, warned=self._warned)
        return found

    def threshold_ratio(
        self,
        ping: Ping,
        noisy: BeamMask | None = None,
        wakes: Wakes | None = None,
        tracks: Tracks | None = None,
    ) -> npt.NDArray[np.float64]:
        """Amplitude over threshold (n_ranges, n_beams) with scale 1, nan where nothing is decided."""
        if empty(ping):
            return np.full(ping.amplitude.shape, np.nan)
        options = self._options(ping, noisy, wakes, tracks)
        return rayleigh_ratio(ping.amplitude, window_of(self, ping.cell_m), **options)

    def _options(
        self, ping: Ping, noisy: BeamMask | None, wakes: Wakes | None, tracks: Tracks | None
    ) -> dict[str, Any]:
        return {
            "pfa": self.pfa,
            "min_ref": self.min_ref,
            "floor": quantum(self, ping),
            "flags": cell_flags_of(self, ping, noisy, wakes, tracks),
        }

    def snapshot(self) -> dict[str, Any]:
        """Whether the user has been warned."""
        return {"warned": self._warned}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._warned = bool(state["warned"])


@hookimpl
def fls_node() -> type[RayleighCfar]:
    """The kind `rayleigh-cfar`."""
    return RayleighCfar
