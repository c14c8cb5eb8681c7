"""Track still objects on the sea floor, predicted by the vehicle's own motion."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Frame, TrackStatus, View, hookimpl
from fls_trackers.ground_answer import TracksAndClasses, answered
from fls_trackers.ground_bank import GroundBank, PoseSd, afloat_probability, places
from fls_trackers.ground_filter import (
    cell_of,
    correct,
    flat,
    means_by_group,
    measurement_noise,
    nearest_tracks,
    process_noise,
    start_groups,
    unscented,
)
from fls_trackers.ground_floor import FloorPlane
from fls_trackers.ground_motion import SensorMotion, locate, moved_euler, moved_exact, sensor_motion
from fls_trackers.ground_noise import NoiseEstimate

__all__ = ["NavUkf"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Step = Literal["exact", "euler"]
Noise = Literal["adaptive", "paper", "huber", "fixed"]
log = logging.getLogger(__name__)


@dataclass
class NavUkf:
    """Tracks of still objects, each in every ping until it has had no detection `misses` times in a row.

    State (range, bearing). The prediction moves it as navigation says that an object on the floor moves: by
    the rigid motion between two pings (`exact`), or as in the paper by its rates at the earlier ping
    (`euler`). Each detection goes to the nearest track within `limit_m`, several to one track as their mean;
    far ones start tracks, one for those within `start_limit_m` of each other. Confirmed after `confirm_hits`
    updates. The process noise is `q_*` per step and what errors of the velocity and of the turn rates make
    of it.

    `noise`: the measurements' variances, in pixels of a range cell and a beam spacing. `adaptive` learns them
    from what the measurements of all tracks leave unexplained, beginning at `floor_*_px` and staying within
    `noise_factor` of it, over the last `noise_memory` measurements; single far ones count less. `paper`:
    max(innovation, floor)^2; `huber`: floor max(innovation, floor); `fixed`: floor^2.

    In a ping whose navigation lacks velocity, turn rates or altitude, the state stays and its uncertainty
    grows by `drift_mps` and `drift_dps`. Tracks in `ned` carry the covariance of filter and vehicle pose
    (`*_sd_*`); without the vehicle's position or heading none start, and the others keep their last place.

    The floor is level at the altitude of `detections.view.nav`, or the plane of `floor`. An echo nearer than
    the floor by `near_margin_m` is none of it: each such update makes it more probable that the track is in
    the water column, and `classes` tells. It then begins anew from there, in the sonar's own plane.

    Bearings are cone angles of a horizontal array, which tell no side: detections from 90 degrees on are left
    out. A sonar that looks aside or astern has that in its `mount`.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it was.

    Source: Quidu, Bertholom & Dupas 2010, sections 3 to 5; frames, floors and classes are ours.
    """

    frame: Frame = "ned"
    step: Step = "exact"
    noise: Noise = "adaptive"
    limit_m: float = 15.0
    start_limit_m: float = 4.0
    misses: int = 3
    confirm_hits: int = 3
    floor_range_px: float = 20.0
    floor_bearing_px: float = 1.0
    noise_factor: float = 10.0
    noise_memory: int = 100
    start_range_px: float = 100.0
    start_bearing_px: float = 3.0
    q_range_m2: float = 0.48e-6  # per step
    q_bearing_rad2: float = 0.024e-6  # per step
    velocity_sd_mps: float = 0.02
    rate_sd_dps: float = 0.05
    drift_mps: float = 2.0
    drift_dps: float = 5.0
    near_margin_m: float = 1.0
    position_sd_m: float = 0.5
    heading_sd_deg: float = 0.5
    tilt_sd_deg: float = 0.2
    altitude_sd_m: float = 0.1
    max_tracks: int = 500

    _bank: GroundBank = field(default_factory=GroundBank, init=False, repr=False)
    _before: SensorMotion | None = field(default=None, init=False, repr=False)
    _noise: NoiseEstimate = field(init=False, repr=False)
    _stamp_ns: int | None = field(default=None, init=False, repr=False)
    _next_id: int = field(default=1, init=False, repr=False)
    _said: set[str] = field(default_factory=set, init=False, repr=False)

    def __post_init__(self) -> None:
        for name, allowed in (("frame", Frame), ("step", Step), ("noise", Noise)):
            if getattr(self, name) not in get_args(allowed):
                raise ValueError(f"{name} is {getattr(self, name)!r}; it must be one of {get_args(allowed)}")
        positive = ("limit_m", "start_limit_m", "floor_range_px", "floor_bearing_px")
        for name in (*positive, "start_range_px", "start_bearing_px"):
            self._require(name, 0.0 < getattr(self, name) < math.inf, "positive and finite")
        unsigned = ("q_range_m2", "q_bearing_rad2", "velocity_sd_mps", "rate_sd_dps", "drift_mps")
        spreads = ("drift_dps", "position_sd_m", "heading_sd_deg", "tilt_sd_deg", "altitude_sd_m")
        for name in (*unsigned, *spreads, "near_margin_m"):
            self._require(name, 0.0 <= getattr(self, name) < math.inf, "finite and not negative")
        for name in ("misses", "confirm_hits", "max_tracks", "noise_memory"):
            self._require(name, getattr(self, name) >= 1, "at least 1")
        self._require("noise_factor", 1.0 <= self.noise_factor < math.inf, "1 or more and finite")
        self._noise = NoiseEstimate.guess(self._floor_px)

    def __call__(self, detections: Detections, floor: FloorPlane | None = None) -> TracksAndClasses:
        """The tracks at the stamp of `detections`, after its update."""
        dt_s = self._elapsed_s(detections)
        y = self._ahead(detections)
        view = detections.view
        motion = self._motion(view, floor)
        bank = self._predicted(motion, dt_s)
        member = nearest_tracks(flat(bank.x), flat(y), self.limit_m)
        bank = self._updated(bank, y, member, cell_of(view), motion)
        placed = motion is not None and bool(np.isfinite(motion.origin_m[:2]).all()) and _heading(view)
        starts = GroundBank()
        if placed or self.frame == "sensor":
            starts = self._starts(y[member < 0], motion, cell_of(view), self.max_tracks - len(bank))
        self._stamp_ns, self._before = detections.stamp_ns, motion
        bank = bank.joined(starts)
        if motion is not None and placed and view.nav is not None and len(bank):
            ned, ned_cov = places(bank, motion, view.nav, view.mount, floor, self._pose_sd)
            bank = replace(bank, ned_m=ned, ned_cov=ned_cov)
        return self._answer(bank, motion, detections)

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        before = self._before
        return {
            **self._bank.snapshot(),
            "stamp_ns": self._stamp_ns,
            "next_id": self._next_id,
            "noise": self._noise.snapshot(),
            "moves": before is not None,
            "motion": np.zeros(22) if before is None else before.packed(),
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._bank = GroundBank.restored(saved)
        self._stamp_ns = None if saved["stamp_ns"] is None else int(saved["stamp_ns"])
        self._next_id = int(saved["next_id"])
        self._noise = NoiseEstimate.restored(saved["noise"])
        self._before = SensorMotion.unpacked(np.array(saved["motion"], float)) if saved["moves"] else None

    @property
    def _floor_px(self) -> FloatArray:
        return np.array([self.floor_range_px, self.floor_bearing_px])

    @property
    def _pose_sd(self) -> PoseSd:
        return PoseSd(
            self.position_sd_m,
            math.radians(self.heading_sd_deg),
            math.radians(self.tilt_sd_deg),
            self.altitude_sd_m,
        )

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(f"{name} is {getattr(self, name)!r}; it must be {what}")

    def _elapsed_s(self, detections: Detections) -> float:
        elapsed = 0 if self._stamp_ns is None else detections.stamp_ns - self._stamp_ns
        if self._stamp_ns is not None and elapsed <= 0:
            raise ValueError(
                f"ping seq {detections.seq} has stamp {detections.stamp_ns} ns, not after the last ping's "
                f"{self._stamp_ns} ns; pings must come in the order of their stamps"
            )
        return elapsed * 1e-9

    def _ahead(self, detections: Detections) -> FloatArray:
        """The measurements (m, 2) that a horizontal array can have made."""
        y = np.stack([detections.range_m, detections.bearing_rad], axis=-1)
        if not np.isfinite(y).all():
            bad = int(np.argmax(~np.isfinite(y).all(axis=1)))
            raise ValueError(f"ping seq {detections.seq}: detection {bad} is at {y[bad].tolist()} m, rad")
        ahead = np.abs(y[:, 1]) < 0.5 * np.pi
        if not ahead.all() and "astern" not in self._said:
            self._said.add("astern")
            log.warning("bearings of 90 degrees and more are left out: mount the sonar by its yaw; said once")
        return y[ahead]

    def _motion(self, view: View, floor: FloorPlane | None) -> SensorMotion | None:
        motion = None if view.nav is None else sensor_motion(view.nav, view.mount, floor)
        if motion is None and view.bearing_rad.size and "navigation" not in self._said:
            self._said.add("navigation")
            log.warning(
                "a ping has no velocity, turn rates or altitude: tracks are not moved, their uncertainty "
                "grows; said once"
            )
        return motion

    def _predicted(self, motion: SensorMotion | None, dt_s: float) -> GroundBank:
        """The tracks at the new ping, each with one miss more until it is updated."""
        bank, before = self._bank, self._before
        if not len(bank):
            return bank
        afloat = bank.afloat
        q = (self.q_range_m2, self.q_bearing_rad2)
        Q = process_noise(bank.x, dt_s, q, self.velocity_sd_mps, self.rate_sd_dps)
        if before is None or (motion is None and self.step == "exact"):
            x, P = bank.x, bank.P
            Q = process_noise(bank.x, dt_s, q, self.drift_mps, self.drift_dps)
        elif motion is not None and self.step == "exact":
            x, P = unscented(bank.x, bank.P, lambda z: moved_exact(z, before, motion, dt_s, afloat))
        else:
            x, P = unscented(bank.x, bank.P, lambda z: moved_euler(z, before, dt_s, afloat))
        return replace(bank, x=x, P=P + Q, age=bank.age + 1, misses=bank.misses + 1)

    def _updated(
        self, bank: GroundBank, y: FloatArray, member: IntArray, cell: FloatArray, motion: SensorMotion | None
    ) -> GroundBank:
        """The tracks with the mean of the measurements that each has got."""
        claimed = member >= 0
        number = np.bincount(member[claimed], minlength=len(bank))
        hit = np.flatnonzero(number)
        if not hit.size:
            return bank
        mean = means_by_group(y[claimed], member[claimed], len(bank))[hit]
        x, P = bank.x.copy(), bank.P.copy()
        x[hit], P[hit] = self._corrected(x[hit], P[hit], mean / cell, cell)
        hits, misses, near = bank.hits.copy(), bank.misses.copy(), bank.near.copy()
        hits[hit] += 1
        misses[hit] = 0
        near[hit] += self._nearer(mean, motion)
        surfaced = (afloat_probability(near[hit]) > 0.5) & ~bank.afloat[hit]
        x[hit[surfaced]], P[hit[surfaced]] = mean[surfaced], self._start_covariance(cell)
        for track in bank.id[hit[surfaced]].tolist():
            log.info("track %d is nearer than the floor: an obstacle in the water column", track)
        return replace(bank, x=x, P=P, hits=hits, misses=misses, near=near)

    def _corrected(
        self, x: FloatArray, P: FloatArray, y_px: FloatArray, cell: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """States and covariances with the noise of `noise`, which learns from it."""
        floor = self._floor_px
        if self.noise != "adaptive":
            return correct(x, P, y_px, cell, measurement_noise(y_px - x / cell, floor, self.noise))
        limits = ((floor / self.noise_factor) ** 2, (floor * self.noise_factor) ** 2)
        x, P, self._noise = self._noise.corrected(x, P, y_px, cell, limits, float(self.noise_memory))
        return x, P

    def _start_covariance(self, cell: FloatArray) -> FloatArray:
        return np.diag([(self.start_range_px * cell[0]) ** 2, (self.start_bearing_px * cell[1]) ** 2])

    def _nearer(self, y: FloatArray, motion: SensorMotion | None) -> IntArray:
        """1 where a measurement (n, 2) is nearer than the floor, (n,)."""
        if motion is None:
            return np.zeros(len(y), np.int64)
        return (locate(y, motion).shortfall_m > self.near_margin_m).astype(np.int64)

    def _starts(self, y: FloatArray, motion: SensorMotion | None, cell: FloatArray, room: int) -> GroundBank:
        """New tracks at the means of measurements that lie together, the nearest ones first."""
        y = y[np.lexsort((y[:, 1], y[:, 0]))]
        group = start_groups(flat(y), self.start_limit_m)
        count = int(group.max()) + 1 if group.size else 0
        x = means_by_group(y, group, count)[: max(room, 0)]
        starts = GroundBank.new(x, self._start_covariance(cell), self._next_id)
        self._next_id += len(starts)
        return replace(starts, near=self._nearer(x, motion))

    def _answer(
        self, bank: GroundBank, motion: SensorMotion | None, detections: Detections
    ) -> TracksAndClasses:
        """The tracks that go on and those lost now; the latter are then forgotten."""
        confirmed = np.logical_or(bank.confirmed > 0, bank.hits >= self.confirm_hits)
        bank = replace(bank, confirmed=confirmed.astype(np.int64))
        keep = (bank.misses < self.misses) & bank.sane
        status = np.where(confirmed, TrackStatus.CONFIRMED, TrackStatus.TENTATIVE)
        status[confirmed & ~keep] = TrackStatus.LOST
        self._bank = bank.select(keep)
        return answered(bank, keep | (confirmed & bank.sane), status, motion, self.frame, detections)


def _heading(view: View) -> bool:
    return view.nav is not None and bool(np.isfinite(view.nav.attitude_rad[2]))


@hookimpl
def fls_node() -> type[NavUkf]:
    """The kind `nav-ukf`."""
    return NavUkf
