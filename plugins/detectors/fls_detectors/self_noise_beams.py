"""Find the beams that a ship's own noise fills, and where in them the ship may be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fls_detectors.beams import (
    adjacent_groups,
    beam_medians,
    guard_beams,
    loud_beams,
    median_normalised,
    strongest_peaks,
)
from fls_flow import BeamMask, DetectionKind, Detections, Ping, hookimpl

__all__ = ["SelfNoise", "SelfNoiseBeams"]

LEAST_REFERENCE = 5  # beams to each side that the mean is taken over, at least


class SelfNoise(NamedTuple):
    """The noisy beams, and the candidate echoes of the ships in them."""

    beam_mask: BeamMask
    detections: Detections


@dataclass
class SelfNoiseBeams:
    """Beams whose median over range exceeds xi times the mean median of the beams beside them.

    The mean is over guard < |i - j| <= window, the window reaching at least 5 beams beyond the guard. Of
    integer amplitudes, means below one step count as one. Of each group of adjacent noisy beams, the one with
    the largest median gives the ship's bearing, and the strongest maxima of x / (moving median of x) in it
    are candidates of its range: detections of kind SELF_NOISE in order of range, whose bearing extent is the
    group's width.

    Source: Karoui 2015, III-A, (1)-(3).
    """

    xi: float = 1.5
    window_beams: int = 8
    guard_beams: int | None = None  # None: 3 floor(beamwidth / spacing)
    median_cells: int = 50  # half width of the moving median
    n_peaks: int = 10
    min_separation_m: float = 1.0  # of two peaks

    def __post_init__(self) -> None:
        if not 1.0 < self.xi < np.inf:
            raise ValueError(f"xi must be above 1, not {self.xi}")
        for name, least in (("window_beams", 1), ("guard_beams", 0), ("median_cells", 1), ("n_peaks", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name} must be at least {least}, not {value}")
        if not 0.0 <= self.min_separation_m < np.inf:
            raise ValueError(f"min_separation_m must be finite and not negative, not {self.min_separation_m}")

    def __call__(self, ping: Ping) -> SelfNoise:
        """The noisy beams of one ping."""
        median = beam_medians(ping.amplitude, ping.valid)
        guard = self.guard_beams
        if guard is None:
            guard = guard_beams(ping.beamwidth_rad, ping.beam_spacing_rad)
        step = 1.0 if np.issubdtype(ping.amplitude.dtype, np.integer) else 0.0
        noisy = loud_beams(median, self.xi, max(self.window_beams, guard + LEAST_REFERENCE), guard, step)
        mask = BeamMask(ping.seq, ping.stamp_ns, noisy, ping.bearing_rad.copy())
        return SelfNoise(mask, self._candidates(ping, adjacent_groups(noisy), median))

    def _candidates(self, ping: Ping, groups: list[slice], median: np.ndarray) -> Detections:
        cells: list[np.ndarray] = []
        beams: list[int] = []
        for group in groups:
            beam = group.start + int(np.argmax(median[group]))
            beams.append(beam)
            cells.append(self._peaks(ping, beam))
        counts = [c.size for c in cells]
        rows = np.concatenate([np.zeros(0, np.intp), *cells])
        columns = np.repeat(np.array(beams, np.intp), counts)
        width = [abs(float(ping.bearing_rad[g.stop - 1] - ping.bearing_rad[g.start])) for g in groups]
        return Detections.of(
            ping,
            range_m=ping.range_m[rows],
            bearing_rad=ping.bearing_rad[columns],
            amplitude=ping.amplitude[rows, columns],
            extent=np.stack([np.zeros(rows.size), np.repeat(np.array(width), counts)], axis=1),
            kind=DetectionKind.SELF_NOISE,
        )

    def _peaks(self, ping: Ping, beam: int) -> np.ndarray:
        echo = ping.amplitude[:, beam]
        if ping.valid is not None:
            echo = np.where(ping.valid[:, beam], echo, np.nan)
        separation = max(1, int(self.min_separation_m / ping.cell_m + 0.5)) if ping.range_m.size > 1 else 1
        return strongest_peaks(median_normalised(echo, self.median_cells), self.n_peaks, separation)


@hookimpl
def fls_node() -> type[SelfNoiseBeams]:
    """The kind `self-noise-beams`."""
    return SelfNoiseBeams
