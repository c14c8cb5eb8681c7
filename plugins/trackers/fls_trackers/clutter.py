"""How dense false measurements are, per square metre, at each measurement."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["Clutter", "ClutterDensity", "cell_density"]

FloatArray = npt.NDArray[np.float64]
Clutter = Literal["adaptive", "cell", "paper"]

FLOOR_PER_M2 = 1e-12  # keeps likelihood ratios finite


@compiled
def cell_density(
    range_m: FloatArray, p_fa: float, cell_m: float, spacing_rad: float, least: float = 0.0
) -> FloatArray:
    """False alarms per m^2 of a detector with `p_fa` per cell, at ranges (m,): p_fa / (dr r db), or `least`.

    Source: Karoui 2015 (22), whose lambda = p_fa counts per cell, not per m^2.
    """
    density = np.empty(range_m.size)
    for j in range(range_m.size):
        density[j] = max(p_fa / (cell_m * spacing_rad * max(range_m[j], cell_m)), least)
    return density


@dataclass
class ClutterDensity:
    """Density of false measurements, learnt from the measurements that no track claims.

    `adaptive`: max(p_fa / (dr r db), unclaimed measurements of the last `window` pings / (pings * area));
    `cell`: its first term alone; `paper`: p_fa, taken as if it were per m^2.
    """

    kind: Clutter
    p_fa: float
    window: int
    _counts: list[int] = field(default_factory=list, init=False, repr=False)
    _extent: tuple[float, float, float] = field(default=(0.0, np.inf, -np.inf), init=False, repr=False)

    def at(
        self,
        range_m: FloatArray,
        bearing_rad: FloatArray,
        cell_m: float,
        spacing_rad: float,
        area_m2: float,
    ) -> FloatArray:
        """Densities (m,), per m^2; an `area_m2` of 0: take the sector in which anything was seen so far."""
        p_fa, least = self.terms(range_m, bearing_rad, area_m2)
        return cell_density(range_m, p_fa, cell_m, spacing_rad, least)

    def terms(self, range_m: FloatArray, bearing_rad: FloatArray, area_m2: float) -> tuple[float, float]:
        """The p_fa and the least density with which `cell_density` gives those of `at`."""
        if self.kind == "paper":
            return 0.0, self.p_fa
        least = FLOOR_PER_M2
        if self.kind == "adaptive":
            area = area_m2 if area_m2 > 0.0 else self._area_seen(range_m, bearing_rad)
            if self._counts and area > 0.0:
                least = max(least, sum(self._counts) / (len(self._counts) * area))
        return self.p_fa, least

    def count(self, unclaimed: int) -> None:
        """Note the number of measurements of a ping that lay in no track's gate."""
        self._counts.append(unclaimed)
        del self._counts[: -self.window]

    def _area_seen(self, range_m: FloatArray, bearing_rad: FloatArray) -> float:
        if range_m.size:
            far, low, high = self._extent
            self._extent = (
                max(far, float(range_m.max())),
                min(low, float(bearing_rad.min())),
                max(high, float(bearing_rad.max())),
            )
        far, low, high = self._extent
        return 0.5 * (high - low) * far**2 if high > low else 0.0

    def snapshot(self) -> dict[str, Any]:
        """What was learnt, as plain arrays."""
        return {"counts": np.array(self._counts, np.int64), "extent": np.array(self._extent)}

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._counts = [int(n) for n in saved["counts"]]
        far, low, high = (float(v) for v in saved["extent"])
        self._extent = (far, low, high)
