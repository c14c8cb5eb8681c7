"""What the trackers `pdaf` and `nnkf` have in common: everything but how a track takes its events."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Tracks, TrackStatus
from fls_flow.geometry import Pose
from fls_flow.kernels import frozen
from fls_flow.messages import Frame
from fls_trackers.adaptive_noise import NOISE_COLUMNS, predict_each
from fls_trackers.clutter import ClutterDensity
from fls_trackers.diver_scan import FIXED, Row, Scanned, diver_scan
from fls_trackers.echo_strength import STRENGTH_COLUMNS, strengths
from fls_trackers.encounters import MEETING_COLUMNS
from fls_trackers.fusion import Fusion
from fls_trackers.grouping import grouped
from fls_trackers.placement import Placement, check_finite
from fls_trackers.scan import row
from fls_trackers.settings import Grain, Settings
from fls_trackers.track_bank import MAX_WINDOW, TrackBank

__all__ = ["DiverTracks", "Sharing"]

FloatArray = npt.NDArray[np.float64]

Sharing = Literal["joint", "own"]

LOST = int(TrackStatus.LOST)


class _Tables(NamedTuple):
    """What is known of the tracks besides where they are; a row each."""

    noise: FloatArray  # (n, NOISE_COLUMNS)
    strength: FloatArray  # (n, STRENGTH_COLUMNS)
    meeting: FloatArray  # (n, MEETING_COLUMNS), or none if tracks are not told apart after they met

    def select(self, which: npt.NDArray[Any]) -> _Tables:
        return _Tables(*(table[which] for table in self))


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
    _tables: _Tables = field(init=False, repr=False)
    _fixed: Row = field(init=False, repr=False)
    _heard: bool = field(init=False, repr=False)
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
        self._fixed = self._fixed_settings()
        self._heard = bool(self._fixed["heard"][0])
        columns = (NOISE_COLUMNS, STRENGTH_COLUMNS, self._meeting_columns)
        self._tables = _Tables(*(np.zeros((0, n)) for n in columns))

    @property
    def _meeting_columns(self) -> int:
        return MEETING_COLUMNS if self.meeting_m else 0

    def _fixed_settings(self) -> Row:
        s, joint, probable = self.settings, self.sharing == "joint", self.settings.hit == "probable"
        resolution_m = self.group_m if self.resolution_m is None else self.resolution_m
        miss = 1.0 - s.p_d * s.gate_probability
        # Tracks that take one event each have none together with others: nobody asks how strong they are.
        together = joint and resolution_m > 0.0 and not (self.one_event and probable)
        derived = {
            "resolution_m": resolution_m,
            "amplitude_sd": self.amplitude_sd or 0.0,
            "meeting_m": self.meeting_m or 0.0,
            "factor": s.p_d / miss,
            "miss": miss,
            "only_probable": probable,
            "joint": joint,
            "heard": together or self.amplitude_sd is not None,
            "by_intersection": self.fusion == "covariance-intersection",
        }
        given = {**asdict(s), **vars(self), **derived}
        return np.array([tuple(given[name] for name in FIXED.names or ())], FIXED)

    @classmethod
    def of(cls, parameters: Mapping[str, Any], *, one_event: bool) -> Self:
        """The engine of a node with these parameters."""
        own = {one.name for one in fields(cls) if one.init} - {"settings", "one_event"}
        common = {one.name for one in fields(Settings)} & set(parameters)
        settings = replace(Settings(centroid_sd_m=0.0), **{name: parameters[name] for name in common})
        return cls(settings=settings, one_event=one_event, **{name: parameters[name] for name in own})

    def __call__(self, detections: Detections) -> Tracks:
        """The tracks at the stamp of `detections`, after its update."""
        place = self._place
        dt_s = place.elapsed_s(detections)
        grain, pose = place.grain_of(detections.view), place.pose(detections)
        if pose is None or not grain.area_m2:
            check_finite(detections)
        if pose is None:
            shown = self._bank = self._unseen(dt_s)
        else:
            found = self._scanned(detections, dt_s, pose, grain)
            self._bank = shown = TrackBank(found.state, found.covariance, found.ledger)
            self._tables = _Tables(found.noise, found.strength, found.meeting)
            if found.lost:
                goes_on = shown.ledger["status"] != LOST
                self._bank, self._tables = shown.select(goes_on), self._tables.select(goes_on)
        place.stamp_ns = detections.stamp_ns
        return shown.message(detections.seq, detections.stamp_ns, self.frame)

    def _scanned(self, detections: Detections, dt_s: float, pose: Pose, grain: Grain) -> Scanned:
        """What the ping makes of the tracks."""
        bank = self._bank
        r, b, level = row(detections.range_m), row(detections.bearing_rad), row(detections.amplitude)
        p_fa, least_density = self._clutter_terms(r, b, level, grain.area_m2)
        found = Scanned(
            *diver_scan(
                bank.state,
                bank.covariance,
                bank.ledger,
                *self._tables,
                r,
                b,
                level,
                frozen(strengths(level)) if self._heard else level,
                self._next_id,
                dt_s,
                grain.range_sd_m,
                grain.bearing_sd_rad,
                pose.north_m,
                pose.east_m,
                pose.heading_rad,
                p_fa,
                least_density,
                grain.cell_m,
                grain.spacing_rad,
                self._fixed,
            )
        )
        if not found.finite:
            check_finite(detections)
        self._clutter.count(found.unclaimed)
        self._next_id += found.begun
        return found

    def _clutter_terms(
        self, r: FloatArray, b: FloatArray, level: FloatArray, area_m2: float
    ) -> tuple[float, float]:
        if not area_m2 and self.group_m:  # the sector is that in which there were events
            r, b, _ = grouped(r, b, level, self.group_m)
        return self._clutter.terms(r, b, area_m2)

    def _unseen(self, dt_s: float) -> TrackBank:
        """The predicted tracks of a ping that could not be placed."""
        bank = self._bank
        x, P = predict_each(bank.state, bank.covariance, dt_s, self.velocity_walk_mps, self._tables.noise)
        ledger = bank.ledger.copy()
        ledger["age"] += 1
        return TrackBank(x, P, ledger)

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            **self._bank.snapshot(),
            **self._clutter.snapshot(),
            "noise": self._tables.noise.copy(),
            "strength": self._tables.strength.copy(),
            "meeting": self._tables.meeting.copy()
            if self.meeting_m
            else np.zeros((len(self._bank), MEETING_COLUMNS)),
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
            np.array(saved["meeting"], float).reshape(-1, MEETING_COLUMNS)[:, : self._meeting_columns].copy(),
        )
        self._next_id = int(saved["next_id"])
        stamp = saved["stamp_ns"]
        self._place.stamp_ns = None if stamp is None else int(stamp)
