"""Detect cells that stand out of an ordered statistic of their surroundings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.cfar_ping import (
    beam_scale,
    cell_flags_of,
    check_settings,
    detections_of,
    empty,
    quantum,
    window_of,
)
from fls_detectors.ordered_statistic import ordered_hits, ordered_ratio
from fls_flow import BeamMask, Detections, Ping, Tracks, Wakes, hookimpl

__all__ = ["OsCfar"]


@dataclass
class OsCfar:
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

    pfa: float = 1e-6
    rank: float = 0.75  # k / J
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
        if not 0.0 < self.rank <= 1.0:
            raise ValueError(f"rank must lie above 0 and up to 1, not {self.rank}")

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
        hits = ordered_hits(
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
        return ordered_ratio(ping.amplitude, window_of(self, ping.cell_m), **options)

    def _options(
        self, ping: Ping, noisy: BeamMask | None, wakes: Wakes | None, tracks: Tracks | None
    ) -> dict[str, Any]:
        return {
            "pfa": self.pfa,
            "rank": self.rank,
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
def fls_node() -> type[OsCfar]:
    """The kind `os-cfar`."""
    return OsCfar
