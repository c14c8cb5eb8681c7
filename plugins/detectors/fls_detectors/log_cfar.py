"""Detect cells that stand out of their surroundings on a logarithmic scale."""

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
from fls_detectors.log_factors import FEWEST, HIGHEST_PFA, LOWEST_PFA
from fls_detectors.log_statistic import Clutter, log_hits, log_ratio
from fls_flow import BeamMask, Detections, Ping, Tracks, Wakes, hookimpl

__all__ = ["LogCfar"]


@dataclass
class LogCfar:
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

    pfa: float = 1e-6
    clutter: Clutter = "weibull"
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
        if self.clutter not in ("weibull", "lognormal"):
            raise ValueError(f"clutter must be weibull or lognormal, not {self.clutter!r}")
        if not LOWEST_PFA <= self.pfa <= HIGHEST_PFA:
            raise ValueError(f"pfa must lie between {LOWEST_PFA:g} and {HIGHEST_PFA:g} here, not {self.pfa}")
        if self.min_ref < FEWEST:
            raise ValueError(f"min_ref must be at least {FEWEST} here, not {self.min_ref}")

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
        hits = log_hits(
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
        return log_ratio(ping.amplitude, window_of(self, ping.cell_m), **options)

    def _options(
        self, ping: Ping, noisy: BeamMask | None, wakes: Wakes | None, tracks: Tracks | None
    ) -> dict[str, Any]:
        return {
            "pfa": self.pfa,
            "clutter": self.clutter,
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
def fls_node() -> type[LogCfar]:
    """The kind `log-cfar`."""
    return LogCfar
