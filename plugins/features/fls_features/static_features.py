"""Describe the object in each chip by ten numbers, and by how it moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np
import numpy.typing as npt

from fls_features.chip_messages import Chips, Regions
from fls_features.directions import alignment
from fls_features.shape import Shape, in_cells, in_metres, names_of
from fls_flow import Features, Tracks, hookimpl

__all__ = ["MOTION", "StaticFeatures"]

MOTION = ("speed_mps", "axis_on_course", "axis_on_sight", "course_on_sight")


@dataclass
class StaticFeatures:
    """Area, perimeter, compactness, mean and variance of the amplitude, axes, eccentricity, two invariants.

    One row per region that was kept. `shape: cells` measures as the source does: the farther an object, the
    wider the beams and the smaller its numbers. `shape: metres` measures what the cells cover, in names of
    its own, so that range changes only what it does to the image. With `tracks` wired four more features say
    how the object moves: `speed_mps`, that of the track's state (over ground in NED tracks, else relative to
    the sonar), and |cos| of the angles between the region's major axis, the course of the track, and the line
    of sight: a body swims along its axis, a school need not, and what faces the sonar echoes most.

    Raises ValueError when chips and regions are not of the same tracks, or a chip's track is not among
    `tracks`.

    Source: Brinkmann 2010, 3.3.2.1; motion is ours.
    """

    shape: Shape = "cells"

    def __post_init__(self) -> None:
        if self.shape not in get_args(Shape):
            raise ValueError(f"shape is '{self.shape}'; it is one of {', '.join(get_args(Shape))}")

    def __call__(self, chips: Chips, regions: Regions, tracks: Tracks | None = None) -> Features:
        """The features of one ping's objects; names are there even when rows are not."""
        names = names_of(self.shape)
        if not np.array_equal(chips.track_id, regions.track_id):
            raise ValueError(
                f"regions are of tracks {regions.track_id.tolist()}, chips of {chips.track_id.tolist()}; "
                "wire both from the same chips"
            )
        kept = regions.kept
        track_id, values = chips.track_id[kept], np.zeros((0, len(names)))
        if len(chips):
            values = self._measured(chips, regions)
        if tracks is not None:
            names, values = (*names, *MOTION), np.column_stack([values, _motion(chips, regions, tracks)])
        known = np.isfinite(values).all(axis=1)
        return Features(chips.seq, chips.stamp_ns, track_id[known], names, values[known])

    def _measured(self, chips: Chips, regions: Regions) -> npt.NDArray[np.float64]:
        """(n, 10) features of the regions that were kept."""
        kept = regions.kept
        mask, amplitude = regions.mask[kept], chips.amplitude[kept]
        if self.shape == "cells":
            return in_cells(mask, amplitude)
        tables = chips.range_m[kept], chips.bearing_rad[kept]
        return in_metres(mask, amplitude, *tables, chips.cell_m, chips.beam_spacing_rad)


def _motion(chips: Chips, regions: Regions, tracks: Tracks) -> npt.NDArray[np.float64]:
    """(n, 4) speed, and the angles between axis, course and line of sight, of the regions that were kept."""
    kept = regions.kept
    speed = _speed_mps(tracks, chips.track_id[kept])
    tables = chips.range_m[kept], chips.bearing_rad[kept]
    return np.column_stack([speed, alignment(regions.mask[kept], *tables, chips.course_rad[kept])])


def _speed_mps(tracks: Tracks, track_id: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    absent = np.setdiff1d(track_id, tracks.id)
    if absent.size:
        raise ValueError(f"chips are of tracks {absent.tolist()}, which are not there; wire these tracks")
    order = np.argsort(tracks.id, kind="stable")
    at = order[np.searchsorted(tracks.id, track_id, sorter=order)]
    return np.asarray(np.hypot(tracks.state[at, 2], tracks.state[at, 3]))


@hookimpl
def fls_node() -> type[StaticFeatures]:
    """Return the node of kind `static-features`."""
    return StaticFeatures
