"""Where the ships are whose noise fills beams: bearing from the noise, range from a wake that ends there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import DetectionKind, Detections, geometry

__all__ = ["placed_ships"]


def placed_ships(
    measurements: Detections,
    candidates: Detections,
    *,
    cluster_radius_m: float,
    tolerance_beams: float,
    tolerance_m: float,
) -> Detections:
    """The measurements with the ships appended, each instead of the wake end in its bearing, if there is one.

    `candidates` of one bearing are one ship; their bearing extent is the width w of its noisy beams. No cell
    of these beams is tested, so a wake that ends there is seen to end beside them: an end at range r is in
    the ship's bearing if it is off by at most w + `tolerance_beams` beams + `cluster_radius_m` / r. Of
    several, the one nearest in bearing counts. Then the ship is placed at its candidate nearest in range to
    the end, or at the end's range if that candidate is farther off than `tolerance_m`. Without an end, all
    candidates are appended. One end serves one ship, in order of bearing.

    Source: Karoui 2015, III-A, last paragraph.
    """
    kept = np.ones(len(measurements), bool)
    ships: list[Detections] = []
    for bearing in np.unique(candidates.bearing_rad):
        ship = candidates.select(np.flatnonzero(candidates.bearing_rad == bearing))
        ends = np.flatnonzero(kept & (measurements.kind == DetectionKind.WAKE_END))
        off = np.abs(geometry.wrap(measurements.bearing_rad[ends] - bearing))
        width = ship.extent[0, 1] + tolerance_beams * abs(candidates.view.beam_spacing_rad)
        near = off <= width + cluster_radius_m / np.maximum(measurements.range_m[ends], cluster_radius_m)
        if near.any():
            end = ends[np.argmin(np.where(near, off, np.inf))]
            kept[end] = False
            ship = _at_range(ship, float(measurements.range_m[end]), tolerance_m)
        ships.append(ship)
    return _joined([measurements.select(np.flatnonzero(kept)), *ships])


def _at_range(ship: Detections, range_m: float, tolerance_m: float) -> Detections:
    off = np.abs(ship.range_m - range_m)
    nearest = ship.select(np.array([np.argmin(off)]))
    return nearest if off.min() <= tolerance_m else replace(nearest, range_m=np.array([range_m]))


def _joined(parts: list[Detections]) -> Detections:
    def column(name: str) -> npt.NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in parts])

    return replace(
        parts[0],
        range_m=column("range_m"),
        bearing_rad=column("bearing_rad"),
        amplitude=column("amplitude"),
        extent=column("extent"),
        covariance=column("covariance"),
        kind=column("kind"),
    )
