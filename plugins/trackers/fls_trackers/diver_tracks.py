"""What the trackers `pdaf` and `nnkf` have in common: everything but how a track takes its events."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Tracks, TrackStatus
from fls_flow.geometry import Pose
from fls_flow.kernels import frozen
from fls_flow.messages import Frame
from fls_trackers.adaptive_noise import NOISE_COLUMNS, predict_each
from fls_trackers.clutter import ClutterDensity, cell_density
from fls_trackers.conversion import convert
from fls_trackers.echo_strength import STRENGTH_COLUMNS, begun_strength, strengths
from fls_trackers.encounters import MEETING_COLUMNS, Scan, encounters
from fls_trackers.fusion import Fusion, fused
from fls_trackers.grouping import grouped
from fls_trackers.initiation import by_place, strongest
from fls_trackers.placement import Placement, check_finite
from fls_trackers.settings import Grain, Settings
from fls_trackers.single_target import follow, settle_by_score
from fls_trackers.track_bank import MAX_WINDOW, Ledger, TrackBank, new_tracks

__all__ = ["DiverTracks", "Sharing"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

Sharing = Literal["joint", "own"]

TENTATIVE, LOST = int(TrackStatus.TENTATIVE), int(TrackStatus.LOST)


class _Tables(NamedTuple):
    """What is known of the tracks besides where they are; a row each."""

    noise: FloatArray  # (n, NOISE_COLUMNS)
    strength: FloatArray  # (n, STRENGTH_COLUMNS)
    meeting: FloatArray  # (n, MEETING_COLUMNS)

    def select(self, which: npt.NDArray[Any]) -> _Tables:
        return _Tables(*(table[which] for table in self))

    def joined(self, other: _Tables) -> _Tables:
        return _Tables(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    @classmethod
    def begun(cls, ln_amplitude: FloatArray) -> _Tables:
        """Those of tracks that begin with one event each."""
        n = ln_amplitude.size
        return cls(np.zeros((n, NOISE_COLUMNS)), begun_strength(ln_amplitude), np.zeros((n, MEETING_COLUMNS)))


def _no_tables() -> _Tables:
    return _Tables.begun(np.zeros(0))


class _Events(NamedTuple):
    """What a ping has seen, one event per object."""

    range_m: FloatArray  # (m,)
    bearing_rad: FloatArray  # (m,)
    amplitude: FloatArray  # (m,)
    y: FloatArray  # (m, 2) in the frame of the tracks
    R0: FloatArray  # (m, 2, 2)


@dataclass
class DiverTracks:
    """Tracks in every ping until they are lost; the engine behind the nodes, which document the parameters.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it was.
    """

    settings: Settings
    frame: Frame
    one_event: bool
    sharing: Sharing
    velocity_walk_mps: float
    max_propagate: int
    max_common_events: int
    fusion: Fusion
    group_m: float
    resolution_m: float | None
    meeting_m: float | None
    extent_sd_m: float
    amplitude_sd: float | None
    estimate_noise: bool
    max_tracks: int

    _bank: TrackBank = field(default_factory=TrackBank, init=False, repr=False)
    _tables: _Tables = field(default_factory=_no_tables, init=False, repr=False)
    _clutter: ClutterDensity = field(init=False, repr=False)
    _place: Placement = field(init=False, repr=False)
    _next_id: int = field(default=1, init=False, repr=False)

    def __post_init__(self) -> None:
        if not 0 <= self.max_propagate < MAX_WINDOW:
            raise ValueError(f"max_propagate = {self.max_propagate}: must be 0 to {MAX_WINDOW - 1}")
        if self.max_common_events < 0:
            raise ValueError(f"max_common_events = {self.max_common_events}: must be 0 (no fusion) or more")
        for name, allowed in (("fusion", get_args(Fusion)), ("sharing", get_args(Sharing))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} = {getattr(self, name)!r}: must be {' or '.join(allowed)}")
        for name in ("velocity_walk_mps", "amplitude_sd", "meeting_m"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"{name} = {value}: must be positive")
        for name in ("group_m", "resolution_m", "extent_sd_m"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < math.inf:
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
        if pose is None:
            shown, tables = self._unseen(dt_s), self._tables
        else:
            shown, tables = self._seen(self._events(detections, grain, pose), dt_s, pose, grain)
        goes_on = shown.ledger["status"] != LOST
        self._bank, self._tables = shown.select(goes_on), tables.select(goes_on)
        self._place.stamp_ns = detections.stamp_ns
        return shown.message(detections.seq, detections.stamp_ns, self.frame)

    def _events(self, detections: Detections, grain: Grain, pose: Pose) -> _Events:
        r, b, level = (
            frozen(row) for row in (detections.range_m, detections.bearing_rad, detections.amplitude)
        )
        if self.group_m > 0.0:
            r, b, group = grouped(r, b, level, self.group_m)
            most = np.full(r.size, -np.inf)
            np.maximum.at(most, group, np.nan_to_num(level, nan=-np.inf))
            r, b, level = frozen(r), frozen(b), frozen(most)
        y, R0 = convert(r, b, grain.range_sd_m, grain.bearing_sd_rad, pose)
        return _Events(r, b, level, y, R0 + self.extent_sd_m**2 * np.eye(2))

    def _unseen(self, dt_s: float) -> TrackBank:
        """The predicted tracks of a ping that could not be placed."""
        bank = self._bank
        x, P = predict_each(bank.state, bank.covariance, dt_s, self.velocity_walk_mps, self._tables.noise)
        ledger = bank.ledger.copy()
        ledger["age"] += 1
        return TrackBank(x, P, ledger)

    def _seen(self, events: _Events, dt_s: float, pose: Pose, grain: Grain) -> tuple[TrackBank, _Tables]:
        """Tracks that go on, are lost, or begin, with what is known of them."""
        s, bank = self.settings, self._bank
        clutter = self._clutter.terms(events.range_m, events.bearing_rad, grain.area_m2)
        p_g, ln_amplitude = s.gate_probability, strengths(events.amplitude)
        resolution_m = self.group_m if self.resolution_m is None else self.resolution_m
        x, P, rows, noise, strength, event, none, known, claimed = follow(
            bank.state,
            bank.covariance,
            bank.ledger,
            self._tables.noise,
            self._tables.strength,
            events.y,
            ln_amplitude,
            cell_density(events.range_m, clutter[0], grain.cell_m, grain.spacing_rad, clutter[1]),
            (dt_s, self.velocity_walk_mps),
            (grain.range_sd_m, grain.bearing_sd_rad, pose.north_m, pose.east_m, pose.heading_rad),
            (self.extent_sd_m, self.amplitude_sd or 0.0, resolution_m),
            (s.gamma, s.p_d / (1.0 - s.p_d * p_g), 1.0 - s.p_d * p_g),
            (self.one_event, s.hit == "probable", self.estimate_noise, self.sharing == "joint"),
        )
        self._clutter.count(int(np.count_nonzero(~claimed)))
        rows, keep, part = settle_by_score(
            rows,
            x,
            P,
            event,
            none,
            (s.m1, s.n1, s.start_score),
            self.max_propagate,
            s.max_sd_m,
            self.max_common_events,
            self.sharing == "joint",
        )
        for t in np.flatnonzero(part >= 0):
            other = part[t]
            x[other], P[other] = fused(x[other], P[other], x[t], P[t], self.fusion)
        tables = _Tables(noise, strength, self._tables.meeting)
        x, P, tables = self._told_apart(rows, keep, x, P, tables, event, ln_amplitude, dt_s)
        shown = np.flatnonzero(keep | (rows["status"] == LOST))
        which = self._chosen(events, ~known, self.max_tracks - int(np.count_nonzero(keep)))
        return (
            TrackBank(x, P, rows).select(shown).joined(self._starts(events, which)),
            tables.select(shown).joined(_Tables.begun(ln_amplitude[which])),
        )

    def _told_apart(
        self,
        rows: Ledger,
        keep: BoolArray,
        x: FloatArray,
        P: FloatArray,
        tables: _Tables,
        event: IntArray,
        ln_amplitude: FloatArray,
        dt_s: float,
    ) -> tuple[FloatArray, FloatArray, _Tables]:
        """States, covariances and tables, exchanged between tracks that met and parted with the wrong one."""
        if self.meeting_m is None:
            return x, P, tables
        status = np.where(keep, rows["status"], LOST)
        scan = Scan(frozen(rows["id"]), status, x, P, tables.strength, event, ln_amplitude)
        walk, amplitude_sd = (dt_s, self.velocity_walk_mps), self.amplitude_sd or 0.0
        meeting, path = encounters(tables.meeting, scan, walk, self.meeting_m, amplitude_sd)
        return x[path], P[path], _Tables(tables.noise[path], tables.strength[path], meeting)

    def _chosen(self, events: _Events, free: BoolArray, room: int) -> IntArray:
        """Which of the `free` events start tracks: at most `room`, the strongest ones, by place."""
        which = np.flatnonzero(free)
        if which.size > room:
            free = np.zeros_like(free)
            free[strongest(which, events.amplitude, max(room, 0))] = True
        return by_place(free, events.range_m, events.bearing_rad)

    def _starts(self, events: _Events, which: IntArray) -> TrackBank:
        speed = self.settings.speed_sd_mps
        starts = new_tracks(events.y, events.R0, (speed, speed), TENTATIVE, which)
        starts.ledger["id"] = np.arange(self._next_id, self._next_id + len(starts))
        self._next_id += len(starts)
        return starts

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            **self._bank.snapshot(),
            **self._clutter.snapshot(),
            "noise": self._tables.noise.copy(),
            "strength": self._tables.strength.copy(),
            "meeting": self._tables.meeting.copy(),
            "next_id": self._next_id,
            "stamp_ns": self._place.stamp_ns,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._bank = TrackBank.restored(saved)
        self._clutter.restore(saved)
        self._tables = _Tables(
            np.array(saved["noise"], float).reshape(-1, NOISE_COLUMNS),
            np.array(saved["strength"], float).reshape(-1, STRENGTH_COLUMNS),
            np.array(saved["meeting"], float).reshape(-1, MEETING_COLUMNS),
        )
        self._next_id = int(saved["next_id"])
        stamp = saved["stamp_ns"]
        self._place.stamp_ns = None if stamp is None else int(stamp)
