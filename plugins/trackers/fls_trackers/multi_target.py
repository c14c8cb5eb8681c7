"""What the trackers `jpda`, `pda` and `gnn` have in common: all but how measurements are shared out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from fls_flow import DetectionKind, Detections, Tracks, TrackStatus
from fls_flow.geometry import Pose
from fls_flow.messages import Frame
from fls_trackers.clutter import ClutterDensity
from fls_trackers.conversion import convert
from fls_trackers.initiation import BoxInitiator, box_tracks, several_in_a_beam
from fls_trackers.kalman import predict
from fls_trackers.life import Rules, settle
from fls_trackers.placement import Placement, check_finite
from fls_trackers.scan import Method, Row, Scanned, Starts, fixed_of, scan
from fls_trackers.settings import Grain, Parameters, Settings, settings_of
from fls_trackers.track_bank import TrackBank

__all__ = ["MultiTarget", "MultiTargetNode"]

BoolArray = npt.NDArray[np.bool_]

# As a number: looking an enumeration's member up costs more than the comparison with it.
LOST = int(TrackStatus.LOST)
SELF_NOISE = int(DetectionKind.SELF_NOISE)


@dataclass
class MultiTarget:
    """Tracks in every ping until they are lost; the engine behind the nodes, which document the parameters.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it was.
    """

    settings: Settings
    frame: Frame
    method: Method
    max_tracks: int

    _bank: TrackBank = field(default_factory=TrackBank, init=False, repr=False)
    _fixed: Row = field(init=False, repr=False)
    _clutter: ClutterDensity = field(init=False, repr=False)
    _boxes: BoxInitiator = field(init=False, repr=False)
    _next_id: int = field(default=1, init=False, repr=False)
    _place: Placement = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not 1 <= self.method.max_shared <= 16:
            raise ValueError(f"max_shared = {self.method.max_shared}: must be 1 to 16")
        if self.max_tracks < 1:
            raise ValueError(f"max_tracks = {self.max_tracks}: must be at least 1")
        s = self.settings
        self._place = Placement(s, self.frame)
        self._clutter = ClutterDensity(s.clutter, s.p_fa, window=20)
        self._fixed = fixed_of(s, self.method)
        self._boxes = BoxInitiator(s.m1, s.n1)

    @classmethod
    def of(cls, parameters: Mapping[str, Any], sharing: int) -> Self:
        """The engine of a node with these parameters; those that are None are the preset's."""
        known = {one.name for one in fields(Settings)}
        given = {k: v for k, v in parameters.items() if k in known and v is not None}
        return cls(
            settings_of(parameters["preset"], given),
            parameters["frame"],
            Method(sharing, parameters.get("max_shared", 1)),
            parameters["max_tracks"],
        )

    def __call__(self, detections: Detections) -> Tracks:
        """The tracks at the stamp of `detections`, after its update."""
        place = self._place
        dt_s = place.elapsed_s(detections)
        grain, pose = place.grain_of(detections.view), place.pose(detections)
        if pose is None or not grain.area_m2:
            check_finite(detections)
        if pose is None:
            shown = self._unseen(dt_s)
            some_lost = bool((shown.ledger["status"] == LOST).any())
        else:
            barred = self._ambiguous(detections, grain)
            found = self._scanned(detections, barred, dt_s, pose, grain)
            shown, some_lost = found.bank, found.lost > 0
            self._clutter.count(found.free)
            if self.settings.initiation == "box":
                shown = shown.joined(self._boxed(detections, pose, grain, found))
            else:
                self._next_id += found.begun
        place.stamp_ns = detections.stamp_ns
        self._bank = shown.select(shown.ledger["status"] != LOST) if some_lost else shown
        return shown.message(detections.seq, detections.stamp_ns, self.frame)

    def _ambiguous(self, detections: Detections, grain: Grain) -> BoolArray | None:
        """Which detections are among several candidates in one beam and so start nothing; None: none are."""
        # As bytes: looking one up costs a tenth of a comparison of arrays.
        if self.settings.start_from_candidates or SELF_NOISE not in detections.kind.tobytes():
            return None
        candidate = detections.kind == SELF_NOISE
        return several_in_a_beam(detections.bearing_rad, candidate, grain.spacing_rad)

    def _scanned(
        self, detections: Detections, barred: BoolArray | None, dt_s: float, pose: Pose, grain: Grain
    ) -> Scanned:
        s = self.settings
        clutter = self._clutter.terms(detections.range_m, detections.bearing_rad, grain.area_m2)
        room = 0 if s.initiation == "box" else self.max_tracks
        starts = Starts(room, self._next_id)
        found = scan(
            self._bank,
            detections,
            barred,
            dt_s,
            grain,
            pose,
            self._fixed,
            clutter,
            starts,
        )
        if not found.finite:
            check_finite(detections)
        if found.approximate:
            self._place.warn_once(
                f"ping seq {detections.seq}: tracks share more than {self.method.max_shared} detections "
                "(max_shared) allow to sum; weak pairs of such clusters count by belief propagation"
            )
        if found.cut:
            self._place.warn_once(
                f"ping seq {detections.seq}: only the strongest detections start tracks, so that "
                f"there are at most {self.max_tracks} (max_tracks)"
            )
        return found

    def _boxed(self, detections: Detections, pose: Pose, grain: Grain, found: Scanned) -> TrackBank:
        """The tracks that the boxes begin in this ping."""
        s = self.settings
        y, R0 = convert(
            detections.range_m, detections.bearing_rad, grain.range_sd_m, grain.bearing_sd_rad, pose
        )
        which = np.flatnonzero(found.unclaimed)
        box_m = s.box_m(detections.view.range_max_m)
        found_starts = self._boxes(y[which], detections.stamp_ns, *box_m)
        starts = box_tracks(found_starts, y[which], R0[which], box_m, s.gamma, s.speed_sd_mps)
        room = max(0, self.max_tracks - (len(found.bank) - found.lost))
        starts = starts.select(np.arange(min(len(starts), room)))
        starts.ledger["id"] = np.arange(self._next_id, self._next_id + len(starts))
        self._next_id += len(starts)
        return starts

    def _unseen(self, dt_s: float) -> TrackBank:
        """The predicted tracks after a ping that could not be placed, those that end by it as lost."""
        s, bank = self.settings, self._bank
        state, covariance = predict(bank.state, bank.covariance, dt_s, s.sigma_v_mps2)
        ledger = bank.ledger.copy()
        ledger["age"] += 1
        rules = Rules(s.m1, s.n1, s.start_score, s.m2, s.n2, s.max_sd_m)
        ledger, keep = settle(ledger, np.zeros(len(bank), bool), covariance, rules)
        return TrackBank(state, covariance, ledger).select(keep | (ledger["status"] == LOST))

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            **self._bank.snapshot(),
            **self._clutter.snapshot(),
            **self._boxes.snapshot(),
            "next_id": self._next_id,
            "stamp_ns": self._place.stamp_ns,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._bank = TrackBank.restored(saved)
        self._clutter.restore(saved)
        self._boxes.restore(saved)
        self._next_id = int(saved["next_id"])
        stamp = saved["stamp_ns"]
        self._place.stamp_ns = None if stamp is None else int(stamp)


@dataclass
class MultiTargetNode(Parameters):
    """A node that tracks many objects; a kind says how measurements are shared out, and `jpda` the rest."""

    sharing: ClassVar[int]  # of `association`
    _tracker: MultiTarget = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._tracker = MultiTarget.of(vars(self), self.sharing)

    def __call__(self, detections: Detections) -> Tracks:
        """The tracks at the stamp of `detections`, after its update."""
        return self._tracker(detections)

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return self._tracker.snapshot()

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._tracker.restore(saved)
