"""Merge the blobs that one target gives in neighbouring beams and lobes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from fls_detectors.blob_groups import circular_mean, components, stars
from fls_flow import Detections, hookimpl
from fls_flow.geometry import wrap

__all__ = ["BlobMerge"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass
class BlobMerge:
    """One detection per group of detections within `merge_range_m` and `merge_bearing_deg` of each other.

    `group`: `components` are chains, whatever their length and the order of the blobs; `strongest` groups
    reach no farther than that from their strongest blob, which leaves dense scenes apart. `place`: `mean` is
    the mean range and the circular mean of bearings; `strongest` is that of the strongest blob, which has no
    bias from lobes that lie unevenly about the true bearing. Amplitude, covariance and kind are those of the
    strongest blob; the extent spans all of them, with their own extents.

    Groups stand in order of range, then bearing.

    Source: Abu 2024 (12), (13); `strongest` is ours.
    """

    merge_range_m: float = 10.0
    merge_bearing_deg: float = 30.0
    group: Literal["components", "strongest"] = "components"
    place: Literal["mean", "strongest"] = "mean"

    def __post_init__(self) -> None:
        if not 0.0 <= self.merge_range_m < np.inf:
            raise ValueError(f"merge_range_m must be finite and not negative, not {self.merge_range_m}")
        if not 0.0 <= self.merge_bearing_deg <= 180.0:
            raise ValueError(f"merge_bearing_deg must be 0 to 180, not {self.merge_bearing_deg}")
        if self.group not in ("components", "strongest"):
            raise ValueError(f"group must be components or strongest, not {self.group!r}")
        if self.place not in ("mean", "strongest"):
            raise ValueError(f"place must be mean or strongest, not {self.place!r}")

    def __call__(self, detections: Detections) -> Detections:
        """The merged detections of one ping."""
        d = detections
        within_rad = float(np.radians(self.merge_bearing_deg))
        if self.group == "components":
            of, n = components(d.range_m, d.bearing_rad, self.merge_range_m, within_rad)
        else:
            of, n = stars(d.range_m, d.bearing_rad, d.amplitude, self.merge_range_m, within_rad)
        first = _strongest(d, of, n)
        if self.place == "mean":
            range_m = np.bincount(of, d.range_m, n) / np.bincount(of, minlength=n)
            bearing_rad = circular_mean(d.bearing_rad, of, n)
        else:
            range_m, bearing_rad = d.range_m[first], wrap(d.bearing_rad[first])
        merged = replace(
            d.select(first),
            range_m=range_m,
            bearing_rad=bearing_rad,
            extent=_spans(d, of, bearing_rad),
            view=replace(d.view, bearing_rad=d.view.bearing_rad.copy()),
        )
        return merged.select(np.lexsort((bearing_rad, range_m)))


def _strongest(d: Detections, of: IntArray, n: int) -> IntArray:
    """The strongest member of each group; of equal ones the nearer in range, then bearing."""
    order = np.lexsort((d.bearing_rad, d.range_m, -d.amplitude))
    first = np.empty(n, np.int64)
    first[of[order[::-1]]] = order[::-1]
    return first


def _spans(d: Detections, of: IntArray, bearing_rad: FloatArray) -> FloatArray:
    """Sizes (n, 2) of the groups, from the outer edge of one member to that of another."""
    off = wrap(d.bearing_rad - bearing_rad[of])
    places = np.stack([d.range_m, off], axis=1)
    low, high = np.full((bearing_rad.size, 2), np.inf), np.full((bearing_rad.size, 2), -np.inf)
    np.minimum.at(low, of, places - 0.5 * d.extent)
    np.maximum.at(high, of, places + 0.5 * d.extent)
    spans: FloatArray = high - low
    return spans


@hookimpl
def fls_node() -> type[BlobMerge]:
    """The kind `blob-merge`."""
    return BlobMerge
