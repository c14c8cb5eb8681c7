"""Describe the object in each chip by ten numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from fls_features.chip_messages import Chips, Regions
from fls_features.shape import Shape, in_cells, in_metres, names_of
from fls_flow import Features, hookimpl

__all__ = ["StaticFeatures"]


@dataclass
class StaticFeatures:
    """Area, perimeter, compactness, mean and variance of the amplitude, axes, eccentricity, two invariants.

    One row per region that was kept. `shape: cells` measures as the source does: the farther an object, the
    wider the beams and the smaller its numbers. `shape: metres` measures what the cells cover, in names of
    its own, so that range changes only what it does to the image.

    Raises ValueError when chips and regions are not of the same tracks.

    Source: Brinkmann 2010, 3.3.2.1.
    """

    shape: Shape = "cells"

    def __post_init__(self) -> None:
        if self.shape not in get_args(Shape):
            raise ValueError(f"shape is '{self.shape}'; it is one of {', '.join(get_args(Shape))}")

    def __call__(self, chips: Chips, regions: Regions) -> Features:
        """The features of one ping's objects; names are there even when rows are not."""
        names = names_of(self.shape)
        if not np.array_equal(chips.track_id, regions.track_id):
            raise ValueError(
                f"regions are of tracks {regions.track_id.tolist()}, chips of {chips.track_id.tolist()}; "
                "wire both from the same chips"
            )
        if not len(chips):
            return Features(chips.seq, chips.stamp_ns, names=names, values=np.zeros((0, len(names))))
        kept = regions.kept
        mask, amplitude = regions.mask[kept], chips.amplitude[kept]
        if self.shape == "cells":
            values = in_cells(mask, amplitude)
        else:
            tables = chips.range_m[kept], chips.bearing_rad[kept]
            values = in_metres(mask, amplitude, *tables, chips.cell_m, chips.beam_spacing_rad)
        known = np.isfinite(values).all(axis=1)
        track_id = regions.track_id[kept][known]
        return Features(chips.seq, chips.stamp_ns, track_id, names, values[known])


@hookimpl
def fls_node() -> type[StaticFeatures]:
    """Return the node of kind `static-features`."""
    return StaticFeatures
