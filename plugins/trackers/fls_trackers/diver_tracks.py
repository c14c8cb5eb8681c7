"""What the trackers `pdaf` and `nnkf` have in common: everything but how a track takes its events."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Tracks, TrackStatus
from fls_flow.geometry import Pose
from fls_flow.kernels import frozen
from fls_flow.messages import Frame
from fls_trackers.adaptive_noise import NOISE_COLUMNS, predict_each
from fls_trackers.clutter import ClutterDensity, cell_density
from fls_trackers.conversion import convert
from fls_trackers.fusion import Fusion, fused
from fls_trackers.grouping import grouped
from fls_trackers.initiation import by_place, strongest
from fls_trackers.placement import Placement, check_finite
from fls_trackers.settings import Grain, Settings
from fls_trackers.single_target import follow, settle_by_score
from fls_trackers.track_bank import MAX_WINDOW, TrackBank, new_tracks

__all__ = ["DiverTracks"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

TENTATIVE, LOST = int(TrackStatus.TENTATIVE), int(TrackStatus.LOST)


def _no_noise() -> FloatArray:
    return np.zeros((0, NOISE_COLUMNS))


@dataclass
class DiverTracks:
    """Tracks in every ping until they are lost; the engine behind the nodes, which document the parameters.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it was.
    """

    settings: Settings
    frame: Frame
    one_event: bool
    velocity_walk_mps: float
    max_propagate: int
    max_common_events: int
    fusion: Fusion
    group_m: float
    extent_sd_m: float
    estimate_noise: bool
    max_tracks: int

    _bank: TrackBank = field(default_factory=TrackBank, init=False, repr=False)
    _noise: FloatArray = field(default_factory=_no_noise, init=False, repr=False)
    _clutter: ClutterDensity = field(init=False, repr=False)
    _place: Placement = field(init=False, repr=False)
    _next_id: int = field(default=1, init=False, repr=False)

    def __post_init__(self) -> None:
        if not 0 <= self.max_propagate < MAX_WINDOW:
            raise ValueError(f"max_propagate = {self.max_propagate}: must be 0 to {MAX_WINDOW - 1}")
        if self.max_common_events < 0:
            raise ValueError(f"max_common_events = {self.max_common_events}: must be 0 (no fusion) or more")
        if self.fusion not in ("algebraic", "covariance-intersection"):
            raise ValueError(f"fusion = {self.fusion!r}: must be algebraic or covariance-intersection")
        if not (math.isfinite(self.velocity_walk_mps) and self.velocity_walk_mps > 0.0):
            raise ValueError(f"velocity_walk_mps = {self.velocity_walk_mps}: must be positive")
        for name, value in (("group_m", self.group_m), ("extent_sd_m", self.extent_sd_m)):
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value}: must be 0 (off) or more")
        if self.max_tracks < 1:
            raise ValueError(f"max_tracks = {self.max_tracks}: must be at least 1")
        s = self.settings
        self._place = Placement(s, self.frame)
        self._clutter = ClutterDensity(s.clutter, s.p_fa, window=20)

    @classmethod
    def of(cls, parameters: Mapping[str, Any], *, one_event: bool) -> Self:
        """The engine of a node with these parameters."""
        own = {one.name for one in fields(cls) if one.init} - {"settings", "one_event"}
        common = {one.name for one in fields(Settings)} & set(parameters)
        settings = replace(Settings(centroid_sd_m=0.0), **{name: parameters[name] for name in common})
        return cls(settings=settings, one_event=one_event, **{name: parameters[name] for name in own})

    def __call__(self, detections: Detections) -> Tracks:
        """The tracks at the stamp of `detections`, after its update."""
        dt_s = self._place.elapsed_s(detections)
        check_finite(detections)
        grain, pose = self._place.grain_of(detections.view), self._place.pose(detections)
        r, b, level = self._events(detections)
        y, R0 = convert(r, b, grain.range_sd_m, grain.bearing_sd_rad, pose or Pose())
        R0 += self.extent_sd_m**2 * np.eye(2)
        if pose is None:
            y, r, b = y[:0], r[:0], b[:0]
        shown, noise, gated, claimed = self._followed(y, r, b, dt_s, pose, grain)
        if pose is not None:
            self._clutter.count(int(np.count_nonzero(~claimed)))
            room = max(0, self.max_tracks - int(np.count_nonzero(shown.ledger["status"] != LOST)))
            starts = self._starts(y, R0, ~gated, r, b, level, room)
            shown = shown.joined(starts)
            noise = np.concatenate([noise, np.zeros((len(starts), NOISE_COLUMNS))])
        goes_on = shown.ledger["status"] != LOST
        self._bank, self._noise = shown.select(goes_on), noise[goes_on]
        self._place.stamp_ns = detections.stamp_ns
        return shown.message(detections.seq, detections.stamp_ns, self.frame)

    def _events(self, detections: Detections) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Range, bearing and amplitude (k,) of the events, one per object."""
        r, b, level = (
            frozen(row) for row in (detections.range_m, detections.bearing_rad, detections.amplitude)
        )
        if self.group_m == 0.0:
            return r, b, level
        range_m, bearing_rad, group = grouped(r, b, level, self.group_m)
        most = np.full(range_m.size, -np.inf)
        np.maximum.at(most, group, np.nan_to_num(level, nan=-np.inf))
        return frozen(range_m), frozen(bearing_rad), frozen(most)

    def _followed(
        self, y: FloatArray, r: FloatArray, b: FloatArray, dt_s: float, pose: Pose | None, grain: Grain
    ) -> tuple[TrackBank, FloatArray, BoolArray, BoolArray]:
        """Tracks that go on or are lost, their noise; which events lie in gates, which in confirmed ones'."""
        s, bank = self.settings, self._bank
        if pose is None:
            x, P = predict_each(bank.state, bank.covariance, dt_s, self.velocity_walk_mps, self._noise)
            ledger = bank.ledger.copy()
            ledger["age"] += 1
            return TrackBank(x, P, ledger), self._noise, np.zeros(0, bool), np.zeros(0, bool)
        density = cell_density(r, *_reordered(self._clutter.terms(r, b, grain.area_m2), grain))
        p_g = s.gate_probability
        x, P, rows, noise, event, gated, claimed = follow(
            bank.state,
            bank.covariance,
            bank.ledger,
            self._noise,
            y,
            density,
            (dt_s, self.velocity_walk_mps),
            (grain.range_sd_m, grain.bearing_sd_rad, pose.north_m, pose.east_m, pose.heading_rad),
            self.extent_sd_m,
            (s.gamma, s.p_d / (1.0 - s.p_d * p_g), 1.0 - s.p_d * p_g),
            self.one_event,
            s.hit == "probable",
            self.estimate_noise,
        )
        confirm = (s.m1, s.n1, s.start_score)
        rows, keep, part = settle_by_score(
            rows, x, P, event, confirm, self.max_propagate, s.max_sd_m, self.max_common_events
        )
        for t in np.flatnonzero(part >= 0):
            other = part[t]
            x[other], P[other] = fused(x[other], P[other], x[t], P[t], self.fusion)
        shown = keep | (rows["status"] == LOST)
        return TrackBank(x, P, rows).select(shown), noise[shown], gated, claimed

    def _starts(
        self,
        y: FloatArray,
        R0: FloatArray,
        free: BoolArray,
        r: FloatArray,
        b: FloatArray,
        level: FloatArray,
        room: int,
    ) -> TrackBank:
        """Tentative tracks at the events that lie in no track's gate, at most `room`."""
        which = np.flatnonzero(free)
        if which.size > room:
            free = np.zeros_like(free)
            free[strongest(which, level, room)] = True
        speed = self.settings.speed_sd_mps
        starts = new_tracks(y, R0, (speed, speed), TENTATIVE, by_place(free, r, b))
        starts.ledger["id"] = np.arange(self._next_id, self._next_id + len(starts))
        self._next_id += len(starts)
        return starts

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            **self._bank.snapshot(),
            **self._clutter.snapshot(),
            "noise": self._noise.copy(),
            "next_id": self._next_id,
            "stamp_ns": self._place.stamp_ns,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._bank = TrackBank.restored(saved)
        self._clutter.restore(saved)
        self._noise = np.array(saved["noise"], float).reshape(-1, NOISE_COLUMNS)
        self._next_id = int(saved["next_id"])
        stamp = saved["stamp_ns"]
        self._place.stamp_ns = None if stamp is None else int(stamp)


def _reordered(terms: tuple[float, float], grain: Grain) -> tuple[float, float, float, float]:
    return terms[0], grain.cell_m, grain.spacing_rad, terms[1]
