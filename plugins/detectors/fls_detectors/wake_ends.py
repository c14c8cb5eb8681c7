"""Gather detections into clusters, and wakes into their ends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_detectors.clusters import Clusters, gathered, leader_clusters
from fls_detectors.ships import placed_ships
from fls_detectors.wakes import STEP, WakeWedges, wake_wedges
from fls_flow import DetectionKind, Detections, Wakes, geometry, hookimpl

__all__ = ["Measurements", "WakeEnds"]

FloatArray = npt.NDArray[np.float64]


class Measurements(NamedTuple):
    """What a tracker gets, and the wedges of wake that the next ping's detector leaves out of its clutter."""

    detections: Detections
    wakes: Wakes


@dataclass
class WakeEnds:
    """Cluster centres outside wakes, both ends of each wake, and the ships whose noise fills beams.

    Detections join the nearest stronger one within `cluster_radius_m` that leads (across the line of sight
    `cluster_radius_beams`, if that is more). From the centre of each cluster, wedges of 20 degrees every 10
    degrees are searched for wakes (`wakes.wake_wedges`). Clusters in a wedge of a wake, and the apexes of
    these wedges, are removed, except the ends (kind WAKE_END). What is left gives one measurement for all
    clusters whose centres are within the same radius: its place is the mean of its members, its amplitude
    their largest, its extent theirs, its covariance that of one cell. Order: range, then bearing.
    Detections that are not finite are dropped.

    Ships come last (kind SELF_NOISE). Candidates of one bearing are one ship. If a wake end stands
    in that bearing, within the width of the noisy beams and `bearing_tolerance_beams` and `cluster_radius_m`,
    the ship stands at the end's range (at that of its candidate nearest to it in range, if within
    `range_tolerance_m`), in its own bearing, and takes the place of the end; of several ends it is the one
    nearest in bearing. Otherwise all of the ship's candidates are measurements (`ships.placed_ships`).

    Source: Karoui 2015, III-A and III-C; the rule for ships in numbers is ours.
    """

    cluster_radius_m: float = 2.0
    cluster_radius_beams: float = 1.5  # the radius across is never below: far off, one echo fills beams
    strip_length_m: float = 15.0
    min_count: int = 50  # n_w: detections in a strip; two thirds of it in the first half of the strip
    ratio: float = 5.0  # of a strip's count to the mean over orientations; at most 18 is possible
    bearing_tolerance_beams: float = 1.5
    range_tolerance_m: float = 3.0

    def __post_init__(self) -> None:
        for name in ("cluster_radius_m", "strip_length_m"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive and finite, not {getattr(self, name)}")
        if self.min_count < 1:
            raise ValueError(f"min_count must be at least 1, not {self.min_count}")
        if not 0.0 < self.ratio < 18.0:
            raise ValueError(f"ratio must lie between 0 and 18, not {self.ratio}")
        for name in ("cluster_radius_beams", "bearing_tolerance_beams", "range_tolerance_m"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and not negative, not {getattr(self, name)}")

    def __call__(self, echoes: Detections, self_noise: Detections | None = None) -> Measurements:
        """The measurements of one ping."""
        points = _strongest_first(echoes)
        position = points.position_m
        spacing = abs(points.view.beam_spacing_rad)
        angle = self.cluster_radius_beams * spacing if spacing > 0.0 else 0.0
        clusters = leader_clusters(position, self.cluster_radius_m, angle)
        wedges = wake_wedges(
            clusters.centre_m,
            position,
            length_m=self.strip_length_m,
            short_m=0.5 * self.strip_length_m,
            min_count=self.min_count,
            ratio=self.ratio,
        )
        merged = _merged(points, clusters, wedges, self.cluster_radius_m, angle)
        if self_noise is not None and len(self_noise):
            merged = placed_ships(
                merged,
                self_noise,
                cluster_radius_m=self.cluster_radius_m,
                tolerance_beams=self.bearing_tolerance_beams,
                tolerance_m=self.range_tolerance_m,
            )
        return Measurements(merged, self._wakes(echoes, clusters, wedges))

    def _wakes(self, echoes: Detections, clusters: Clusters, wedges: WakeWedges) -> Wakes:
        n = wedges.centre.size
        return Wakes(
            echoes.seq,
            echoes.stamp_ns,
            clusters.centre_m[wedges.centre],
            geometry.wrap(wedges.orientation * STEP),
            np.full(n, self.strip_length_m),
            np.full(n, STEP),
            wedges.wake,
            wedges.is_end,
        )


def _strongest_first(echoes: Detections) -> Detections:
    """The finite ones in an order that does not depend on theirs."""
    order = np.lexsort((echoes.bearing_rad, echoes.range_m, -echoes.amplitude))
    finite = np.isfinite(echoes.range_m) & np.isfinite(echoes.bearing_rad) & np.isfinite(echoes.amplitude)
    return echoes.select(order[finite[order]])


def _merged(
    points: Detections, clusters: Clusters, wedges: WakeWedges, radius_m: float, angle_rad: float
) -> Detections:
    """One detection per cluster of those that are not covered by a wake."""
    is_end = np.zeros(clusters.leader.size, bool)
    is_end[wedges.centre[wedges.is_end]] = True
    outside, shown = clusters.select(~wedges.covered)
    points = points.select(shown)
    objects, object_of = gathered(outside, points.position_m, radius_m, angle_rad)
    distance, bearing = geometry.to_polar(objects.centre_m)
    kind = points.kind[objects.leader]
    kind[object_of[is_end[~wedges.covered]]] = DetectionKind.WAKE_END
    off = geometry.wrap(points.bearing_rad - bearing[objects.member_of])
    extent = np.stack([_spread(points.range_m, objects), _spread(off, objects)], axis=1)
    merged = replace(
        points,
        range_m=distance,
        bearing_rad=bearing,
        amplitude=points.amplitude[objects.leader],
        extent=extent,
        covariance=points.covariance[objects.leader],
        kind=kind,
        view=replace(points.view, bearing_rad=points.view.bearing_rad.copy()),
    )
    return merged.select(np.lexsort((bearing, distance)))


def _spread(value: FloatArray, clusters: Clusters) -> FloatArray:
    n = clusters.leader.size
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, clusters.member_of, value)
    np.maximum.at(high, clusters.member_of, value)
    spread: FloatArray = high - low
    return spread


@hookimpl
def fls_node() -> type[WakeEnds]:
    """The kind `wake-ends`."""
    return WakeEnds
