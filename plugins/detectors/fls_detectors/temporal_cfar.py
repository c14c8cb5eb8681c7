"""Detect what rises above each cell's own past: moving things over a background that stands still."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from fls_detectors.clutter_map import smoothed
from fls_detectors.temporal_background import Latecomers, Rates, learn, rayleigh_threshold
from fls_detectors.temporal_objects import around, linked, objects
from fls_flow import Detections, Ping, hookimpl

__all__ = ["TemporalCfar", "TemporalPing"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
FloatImage = npt.NDArray[np.float32]
BoolImage = npt.NDArray[np.bool_]
Strength = Literal["peak", "energy"]

LEAST_SHARE = np.float32(0.05)  # of its height that a cell keeps, however long it has been there
EARLY_MARGIN = 2.0  # thresholds above which a cell learns slowly in the warm-up: its moments are rough yet


class TemporalPing(NamedTuple):
    """What stands out of a ping, and the ping without its background."""

    detections: Detections
    foreground: Ping


def _no_image() -> FloatImage:
    return np.zeros((0, 0), np.float32)


def _no_table() -> FloatArray:
    return np.zeros(0)


@dataclass
class TemporalCfar:
    """One detection per cell whose amplitude X exceeds its running mean by more than tau deviations.

    z = (X - mu) / max(sd, floor) > tau, with mu and sd of the pings before; so drops (shadows) are none.
    Then mu += a_k (X - mu), var += b_k ((X - mu)^2 - var), with a_k = max(`rate`, 1 / (k + 1)) at ping k, and
    b_k alike from `variance_rate`. tau is `threshold`, or the height that Rayleigh amplitudes of known
    moments exceed with probability `pfa`: tau = (sqrt(-ln pfa) - 0.886) / 0.463; estimated moments make
    false alarms more frequent (at 1e-2: 1.06e-2 with a rate of 0.01, 2.1e-2 with 0.2). The first
    `warm_up_pings` detect nothing, nor do those of a cell whose data begin later; when the geometry of the
    pings changes, learning begins anew.
    With `event_rate`, the mean of a detected cell learns at most that fast and its variance not at all, so
    that what is slow is not absorbed so soon. From ping `early_pings` on that holds in the warm-up too, for
    cells above twice the threshold: what swims there then is not learnt as background.
    `floor` bounds sd from below; by default it is one step of integer amplitudes, else 0.

    Cells are joined to one detection per object with `link_m`: those nearer to each other than that, in
    chains; or with `reach_m`: the strongest cell and what is within that distance of it, then the strongest
    of the others, and so on, so that a wide echo, or two that touch, gives several. Objects of fewer than
    `min_cells` are dropped. The place is the mean weighted by the square of the cells' height above the
    background, with their spread as covariance; `strength` is that of the strongest cell (`peak`), or the
    root of the sum of squared heights (`energy`), which tells a swimmer from its bubbles better.

    With `recent_rate`, what has stayed in place counts less. With h the height above the background under a
    Gaussian of `recent_cells` (range, beam), and r its mean over the pings before,
    r += `recent_rate` (h - r), f = h - `recent_share` r: the weight is max(f, h / 20) in place of the height;
    and only cells with f >= `fresh_share` h count for `min_cells`. So what a swimmer leaves behind (bubbles,
    stirred silt) fades within some 1 / `recent_rate` pings, and so does a swimmer who keeps as still as that;
    unless `recent_share` is at most 1 - `fresh_share`: then both stay, but weigh little.

    `foreground` is the ping with max(0, X - mu) as amplitude, float32, under a Gaussian of `smooth_cells`
    (range, beam), which makes one region of an object that speckle has broken up; during warm-up it is zero.

    Source: Brinkmann 2010, (3.5), (4.1) and 4.1, with the prior mean, a signed statistic and a variance
    recursion; event rate, objects and recent past are ours.
    """

    pfa: float = 1e-4
    threshold: float | None = None
    rate: float = 0.05
    variance_rate: float | None = None  # None: as rate
    event_rate: float | None = None  # None: events learn as all others do
    warm_up_pings: int = 20
    early_pings: int | None = None  # None: in the warm-up all cells learn alike
    floor: float | None = None
    max_detections: int = 5_000  # the strongest cells are kept
    link_m: float = 0.0  # 0 here and in reach_m: every cell is a detection
    reach_m: float = 0.0
    min_cells: int = 1  # of an object
    strength: Strength = "peak"  # of an object
    recent_rate: float | None = None  # None: how long a cell has been above its background does not matter
    recent_share: float = 1.0
    recent_cells: tuple[float, float] = (3.0, 2.0)  # standard deviations
    fresh_share: float = 0.2
    smooth_cells: tuple[float, float] = (0.0, 0.0)  # of the foreground; standard deviations
    _count: int = field(default=0, init=False, repr=False)
    _mean: FloatImage = field(default_factory=_no_image, init=False, repr=False)
    _variance: FloatImage = field(default_factory=_no_image, init=False, repr=False)
    _late: Latecomers = field(default_factory=Latecomers, init=False, repr=False)
    _recent: FloatImage = field(default_factory=_no_image, init=False, repr=False)
    _range_m: FloatArray = field(default_factory=_no_table, init=False, repr=False)
    _bearing_rad: FloatArray = field(default_factory=_no_table, init=False, repr=False)

    def __post_init__(self) -> None:
        self._require("pfa", 0.0 < self.pfa < 1.0, "between 0 and 1")
        self._require("threshold", self.threshold is None or 0.0 < self.threshold < math.inf, "positive")
        if self.tau <= 0.0:
            raise ValueError(f"pfa is {self.pfa}; below 0.45 the threshold is above the mean")
        for name in ("rate", "variance_rate"):
            value = getattr(self, name)
            self._require(name, value is None or 0.0 < value < 1.0, "between 0 and 1")
        slow = self.event_rate
        self._require("event_rate", slow is None or 0.0 <= slow < 1.0, "from 0 to below 1")
        self._require("warm_up_pings", self.warm_up_pings >= 2, "at least 2, for a variance")
        early = self.early_pings
        self._require("early_pings", early is None or early >= 2, "at least 2, for a variance")
        self._require("floor", self.floor is None or 0.0 <= self.floor < math.inf, "finite and not negative")
        for name in ("link_m", "reach_m"):
            self._require(name, 0.0 <= getattr(self, name) < math.inf, "finite and not negative")
        if self.link_m and self.reach_m:
            raise ValueError(f"reach_m is {self.reach_m} and link_m is {self.link_m}; give one of them")
        self._require("strength", self.strength in get_args(Strength), f"one of {get_args(Strength)}")
        recent = self.recent_rate
        self._require("recent_rate", recent is None or 0.0 < recent < 1.0, "between 0 and 1")
        for name in ("recent_share", "fresh_share"):
            self._require(name, 0.0 <= getattr(self, name) <= 1.0, "from 0 to 1")
        for name in ("smooth_cells", "recent_cells"):
            widths = getattr(self, name)
            self._require(name, all(0.0 <= w < math.inf for w in widths), "finite and not negative")
        for name in ("max_detections", "min_cells"):
            self._require(name, getattr(self, name) >= 1, "at least 1")

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(f"{name} is {getattr(self, name)}; it must be {what}")

    @property
    def tau(self) -> float:
        """The threshold, in standard deviations above the mean."""
        return rayleigh_threshold(self.pfa) if self.threshold is None else self.threshold

    def __call__(self, ping: Ping) -> TemporalPing:
        """The detections of one ping, in order of range, then beam, and its foreground."""
        self._begin_anew_if_changed(ping)
        if not self._count:
            self._mean[:] = _finite(ping)
            self._late = Latecomers.of(ping.amplitude, ping.valid)
        warm = self._count >= self.warm_up_pings
        cells, height = self._learnt(ping, self._rates(ping, warm))
        self._count += 1
        if not warm:
            cells, height = cells[:0], np.zeros_like(height)
        return TemporalPing(
            self._detections(ping, cells, *self._weights(height)),
            _foreground(ping, smoothed(height, self.smooth_cells)),
        )

    def _learnt(self, ping: Ping, rates: Rates) -> tuple[IntArray, FloatImage]:
        """The cells that stand out and the heights of all, after learning from a ping."""
        late = self._late.cells
        before = self._mean.reshape(-1)[late], self._variance.reshape(-1)[late]
        cells, height = learn(ping.amplitude, ping.valid, self._mean, self._variance, rates)
        if late.size:
            after = self._mean, self._variance
            slow = self.rate, self.rate if self.variance_rate is None else self.variance_rate
            young = self._late.learn(ping.amplitude, ping.valid, before, after, slow, self.warm_up_pings)
            height.reshape(-1)[young] = 0.0
            cells = cells[~np.isin(cells, young)]
        return cells, height

    def _weights(self, height: FloatImage) -> tuple[FloatImage, BoolImage]:
        """What cells weigh in their object, and which count for its size; learns the recent past."""
        if self.recent_rate is None:
            return height, np.ones(height.shape, bool)
        smooth = smoothed(height, self.recent_cells)
        fresh = smooth - np.float32(self.recent_share) * self._recent
        self._recent += np.float32(self.recent_rate) * (smooth - self._recent)
        return np.maximum(fresh, LEAST_SHARE * smooth), fresh >= np.float32(self.fresh_share) * smooth

    def _begin_anew_if_changed(self, ping: Ping) -> None:
        same = (
            self._mean.shape == ping.amplitude.shape
            and np.array_equal(self._range_m, ping.range_m)
            and np.array_equal(self._bearing_rad, ping.bearing_rad)
        )
        if not same:
            self._count = 0
            self._mean = np.zeros(ping.amplitude.shape, np.float32)
            self._variance = np.zeros(ping.amplitude.shape, np.float32)
            self._recent = np.zeros(ping.amplitude.shape, np.float32)
            self._range_m, self._bearing_rad = ping.range_m.copy(), ping.bearing_rad.copy()

    def _rates(self, ping: Ping, warm: bool) -> Rates:
        ramp = 1.0 / (self._count + 1)
        mean = max(self.rate, ramp)
        variance = max(self.rate if self.variance_rate is None else self.variance_rate, ramp)
        event = (mean, variance) if self.event_rate is None else (min(self.event_rate, mean), 0.0)
        floor = self.floor
        if floor is None:
            floor = 1.0 if np.issubdtype(ping.amplitude.dtype, np.integer) else 0.0
        return Rates(mean, variance, *event, self._event_tau(warm), floor)

    def _event_tau(self, warm: bool) -> float:
        """The threshold above which cells of this ping learn as events; inf: none does."""
        if warm:
            return self.tau
        early = self.early_pings
        slow = self.event_rate is not None and early is not None and self._count >= early
        return EARLY_MARGIN * self.tau if slow else math.inf

    def _detections(self, ping: Ping, cells: IntArray, weight: FloatImage, counted: BoolImage) -> Detections:
        rows, beams = np.divmod(cells, max(ping.bearing_rad.size, 1))
        strength = ping.amplitude[rows, beams].astype(float)
        if cells.size > self.max_detections:
            keep = np.sort(np.argsort(-strength, kind="stable")[: self.max_detections])
            rows, beams, strength = rows[keep], beams[keep], strength[keep]
        range_m, bearing_rad = ping.range_m[rows], ping.bearing_rad[beams]
        if not (self.link_m or self.reach_m) or not rows.size:
            return Detections.of(ping, range_m=range_m, bearing_rad=bearing_rad, amplitude=strength)
        energy = np.square(weight[rows, beams], dtype=float)
        position = np.stack([range_m * np.cos(bearing_rad), range_m * np.sin(bearing_rad)], axis=1)
        joined = objects(
            range_m,
            bearing_rad,
            strength,
            energy,
            linked(position, self.link_m) if self.link_m else around(position, energy, self.reach_m),
            cell_sd=(ping.cell_m, abs(ping.beam_spacing_rad)),
            counted=counted[rows, beams],
            min_cells=self.min_cells,
            energy=self.strength == "energy",
        )
        return Detections.of(
            ping,
            range_m=joined.range_m,
            bearing_rad=joined.bearing_rad,
            amplitude=joined.amplitude,
            extent=joined.extent,
            covariance=joined.covariance,
        )

    def snapshot(self) -> dict[str, Any]:
        """The background, how many pings it has seen, and of which geometry."""
        return {
            "count": self._count,
            "mean": self._mean.copy(),
            "variance": self._variance.copy(),
            "recent": self._recent.copy(),
            "late_cells": self._late.cells.copy(),
            "late_pings": self._late.pings.copy(),
            "range_m": self._range_m.copy(),
            "bearing_rad": self._bearing_rad.copy(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._count = int(state["count"])
        self._mean = np.array(state["mean"], np.float32)
        self._variance = np.array(state["variance"], np.float32)
        self._recent = np.array(state["recent"], np.float32)
        self._late = Latecomers(
            np.array(state["late_cells"], np.int64), np.array(state["late_pings"], np.int64)
        )
        self._range_m = np.array(state["range_m"], float)
        self._bearing_rad = np.array(state["bearing_rad"], float)


def _finite(ping: Ping) -> FloatImage:
    """The amplitudes; 0 where there is no sensible number."""
    image = ping.amplitude.astype(np.float32)
    known = np.abs(image) < 1e18
    return np.where(known if ping.valid is None else known & ping.valid, image, np.float32(0.0))


def _foreground(ping: Ping, height: FloatImage) -> Ping:
    return replace(
        ping,
        amplitude=height,
        range_m=ping.range_m.copy(),
        bearing_rad=ping.bearing_rad.copy(),
        valid=None if ping.valid is None else ping.valid.copy(),
    )


@hookimpl
def fls_node() -> type[TemporalCfar]:
    """The kind `temporal-cfar`."""
    return TemporalCfar
