"""Separate the object in each chip from its background."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np

from fls_features.chip_messages import Chips, Regions
from fls_features.company import Company
from fls_features.growing import Rule, central, grown, reach, seeds, smoothed, thresholds, within
from fls_flow import hookimpl

__all__ = ["RegionGrowing"]


@dataclass
class RegionGrowing:
    """The region of each chip: cells above a threshold, 8-connected with the brightest of the smoothed chip.

    The chip is smoothed by an adaptive Wiener filter over `filter_rows` x `filter_columns` cells. The seed is
    its maximum in the central 10 to 90 % of the chip, or, with `seed_within_m`, at most so far from the
    track: several objects may share a chip, and a shifted chip has its object at the border. The threshold
    is `level` times the seed; or, by `threshold`, the centre of that bin of a histogram of 100 bins, or that
    percentile. Cells up to `gap_m` apart are connected too: speckle breaks a body, or a school of fish, into
    pieces. A region that is empty or fills more than `max_fill` of its chip is not kept: it has leaked.
    Nor, with `alone_m`, is one that comes so near to another confirmed track, while one of the two has mostly
    been alone: it holds two swimmers, or one and its bubbles, and describes neither. Tracks that never are
    without each other follow one object (a school) and describe it.

    Source: Brinkmann 2010, 3.3.1 and 4.3.2; gaps, company and the guard against leaks are ours.
    """

    filter_rows: int = 20
    filter_columns: int = 2
    threshold: Rule = "seed"
    level: float = 0.78
    seed_within_m: float | None = None
    max_fill: float = 0.5
    gap_m: float = 0.0  # 0: neighbours alone
    alone_m: float | None = None  # None: other tracks do not matter
    _company: Company = field(default_factory=Company, init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("filter_rows", "filter_columns"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        if self.threshold not in get_args(Rule):
            raise ValueError(f"threshold is '{self.threshold}'; it is one of {', '.join(get_args(Rule))}")
        if not 0.0 < self.level < 1.0:
            raise ValueError(f"level is {self.level}; it lies between 0 and 1")
        if self.seed_within_m is not None and not 0.0 < self.seed_within_m < math.inf:
            raise ValueError(f"seed_within_m is {self.seed_within_m}; it must be positive")
        if not 0.0 < self.max_fill <= 1.0:
            raise ValueError(f"max_fill is {self.max_fill}; it lies between 0 and 1")
        if not 0.0 <= self.gap_m < math.inf:
            raise ValueError(f"gap_m is {self.gap_m}; it must be finite and not negative")
        if self.alone_m is not None and not 0.0 < self.alone_m < math.inf:
            raise ValueError(f"alone_m is {self.alone_m}; it must be positive")

    def __call__(self, chips: Chips) -> Regions:
        """The regions of one ping's chips."""
        if not chips.amplitude.size:
            return Regions(chips.seq, chips.stamp_ns)
        filtered = smoothed(chips.amplitude, (self.filter_rows, self.filter_columns))
        if self.seed_within_m is None:
            candidate = np.broadcast_to(central(filtered.shape[1:]), filtered.shape)
        else:
            candidate = within(self.seed_within_m, chips.range_m, chips.bearing_rad, chips.centre)
        seed = seeds(filtered, candidate)
        threshold = thresholds(filtered, seed, self.threshold, self.level)
        spans = None
        if self.gap_m:
            at_m = chips.range_m[np.arange(len(chips)), seed[:, 0]]
            spans = reach(self.gap_m, at_m, chips.cell_m, chips.beam_spacing_rad)
        mask = grown(filtered, seed, threshold, spans)
        cells = np.count_nonzero(mask, axis=(1, 2))
        kept = (cells > 0) & (cells <= self.max_fill * mask[0].size)
        if self.alone_m is not None:
            kept &= self._company.describes(chips, mask, self.alone_m)
        return Regions(chips.seq, chips.stamp_ns, chips.track_id.copy(), mask, seed, kept)

    def snapshot(self) -> dict[str, Any]:
        """Which tracks have been alone, and how often."""
        return self._company.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._company.restore(snapshot)


@hookimpl
def fls_node() -> type[RegionGrowing]:
    """Return the node of kind `region-growing`."""
    return RegionGrowing
