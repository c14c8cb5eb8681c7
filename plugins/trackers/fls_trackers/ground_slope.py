"""The slope of the floor below a vehicle, from the slant ranges of its altimeter beams."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow.messages import AltimeterBeams, Vector
from fls_trackers.ground_floor import beam_points, plane_through

__all__ = ["Slopes", "slope_of"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

LEAST_SPREAD = 0.05  # of the beams' feet across their line, per m of height: less tells no slope


def slope_of(beams: AltimeterBeams, attitude_rad: Vector) -> FloatArray:
    """Slope (2,) of the floor to north and east, m down per m, from one measurement; nan if it tells none.

    The plane through the feet of the beams that have found the bottom, by least squares; three or more that
    do not lie in a line. The attitude is the vehicle's at that instant.
    """
    found = np.isfinite(beams.range_m) & (beams.range_m > 0.0) & np.isfinite(beams.direction).all(axis=1)
    if np.count_nonzero(found) < 3 or not np.isfinite(attitude_rad).all():
        return np.full(2, np.nan)
    points = beam_points(beams.direction[found], beams.range_m[found], attitude_rad)
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    narrow = np.linalg.svd(flat, compute_uv=False)[1] / np.sqrt(len(flat))
    if not (points[:, 2] > 0.0).all() or narrow < LEAST_SPREAD * points[:, 2].mean():
        return np.full(2, np.nan)
    normal, _ = plane_through(points)
    slope: FloatArray = -normal[:2] / normal[2]
    return slope


@dataclass
class Slopes:
    """The slopes measured in the last `memory_s`; their median stands against single wrong ranges."""

    memory_s: float
    _stamps_ns: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    _slope: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))

    def add(self, stamp_ns: int, slope: FloatArray) -> None:
        """Take a slope (2,); one of nan is left out."""
        if np.isfinite(slope).all():
            self._stamps_ns = np.append(self._stamps_ns, stamp_ns)
            self._slope = np.concatenate([self._slope, slope[None]])

    def at(self, stamp_ns: int) -> FloatArray:
        """The median (2,) of the slopes that are not too old, older ones are forgotten; nan without any."""
        kept = self._stamps_ns >= stamp_ns - int(self.memory_s * 1e9)
        self._stamps_ns, self._slope = self._stamps_ns[kept], self._slope[kept]
        if not len(self._slope):
            return np.full(2, np.nan)
        median: FloatArray = np.median(self._slope, axis=0)
        return median

    def snapshot(self) -> dict[str, Any]:
        """Copies."""
        return {"stamps_ns": self._stamps_ns.copy(), "slope": self._slope.copy()}

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._stamps_ns = np.array(saved["stamps_ns"], np.int64)
        self._slope = np.array(saved["slope"], float).reshape(-1, 2)
