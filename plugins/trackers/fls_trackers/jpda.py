"""Joint probabilistic data association on converted measurements (CMKF-D/JPDA), with track management."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fls_flow import DetectionKind, Detections, Tracks, TrackStatus, View, hookimpl
from fls_flow.geometry import Pose, sensor_pose
from fls_flow.messages import Frame
from fls_trackers.clutter import ClutterDensity
from fls_trackers.conversion import convert
from fls_trackers.initiation import BoxInitiator, box_tracks, by_place, several_in_a_beam, strongest
from fls_trackers.kalman import predict
from fls_trackers.life import Rules, settle
from fls_trackers.scan import Scanned, scan
from fls_trackers.settings import RECOMMENDED, Grain, Settings, grain_of, settings_of
from fls_trackers.track_bank import TrackBank, new_tracks

__all__ = ["Jpda", "fls_node"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

log = logging.getLogger(__name__)

# As numbers: looking an enumeration's member up costs more than the comparison with it.
TENTATIVE, LOST = int(TrackStatus.TENTATIVE), int(TrackStatus.LOST)
ORIGIN = Pose()
SELF_NOISE = int(DetectionKind.SELF_NOISE)


@dataclass
class Jpda:
    """Tracks of the objects that detections come from, each in every ping until it is lost.

    Detections become Cartesian by debiased conversion; each track follows nearly constant velocity and is
    updated by all measurements in its gate, weighted by their joint probabilities. These are exact while a
    cluster of tracks shares at most `max_shared` measurements at a time, and come from loopy belief
    propagation beyond (errors of beta of some 0.02; the log says it once), which bounds the time of a scan.

    Parameters left None take the value of `preset`: `paper` is Karoui et al. 2015 as printed, except for its
    errors; `recommended` is what keeps tracks on clustered detections in clutter.

    `initiation`: `box` starts a confirmed track where n1 of m1 pings had an unclaimed detection within
    x_max, y_max; `gate` starts a tentative one at each unclaimed detection, confirmed with n1 updates in
    m1 pings and a log likelihood ratio of `start_score` against clutter (e^-start_score bounds the chance of
    a false detection to become a track). n1 of m1 is 16 of 20 with `box`, 6 of 8 with `gate`. With `box` more
    than a few false detections per ping make false starts.
    `hit`: what counts as an update, a detection in the gate (`gated`), or one also more likely than none
    (`probable`). Tracks end with fewer than n2 updates in m2 pings, or with a position less certain than
    max_sd_m, whether or not the sonar still looks their way.
    `merge_pings`: how long two tracks must share one echo and move as one until the younger ends; 0: never.
    `start_from_candidates`: whether each of several self-noise candidates in one beam may start a track; a
    single one always may, and all of them update tracks. Beyond `max_tracks` only the strongest detections
    start tracks, which bounds memory and time.

    With `frame: ned` tracks are in north and east, so that own motion does not bend them; in a ping without
    position or heading they are only predicted, and this counts neither as hit nor as miss.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it was.

    Source: Karoui et al. 2015, section IV.
    """

    preset: Literal["recommended", "paper"] = "recommended"
    frame: Frame = "sensor"
    sigma_v_mps2: float | None = None
    sigma_d_m: float | None = None
    sigma_delta_deg: float | None = None
    gamma: float | None = None
    p_d: float | None = None
    p_g: float | None = None
    p_fa: float | None = None
    clutter: Literal["adaptive", "cell", "paper"] | None = None
    initiation: Literal["box", "gate"] | None = None
    hit: Literal["gated", "probable"] | None = None
    m1: int | None = None
    n1: int | None = None
    start_score: float | None = None
    m2: int | None = None
    n2: int | None = None
    x_max_m: float | None = None
    y_max_m: float | None = None
    speed_sd_mps: float | None = None
    max_sd_m: float | None = None
    merge_pings: int | None = None
    start_from_candidates: bool | None = None
    max_shared: int = 12
    max_tracks: int = 500

    _settings: Settings = field(default=RECOMMENDED, init=False, repr=False)
    _bank: TrackBank = field(default_factory=TrackBank, init=False, repr=False)
    _rules: Rules = field(init=False, repr=False)
    _clutter: ClutterDensity = field(init=False, repr=False)
    _boxes: BoxInitiator = field(init=False, repr=False)
    _next_id: int = field(default=1, init=False, repr=False)
    _stamp_ns: int | None = field(default=None, init=False, repr=False)
    _grain: tuple[Any, Grain] | None = field(default=None, init=False, repr=False)
    _said: set[str] = field(default_factory=set, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.frame not in ("sensor", "ned"):
            raise ValueError(f"frame = {self.frame!r}: must be sensor or ned")
        if not 1 <= self.max_shared <= 16:
            raise ValueError(f"max_shared = {self.max_shared}: must be 1 to 16")
        if self.max_tracks < 1:
            raise ValueError(f"max_tracks = {self.max_tracks}: must be at least 1")
        own = {f.name: getattr(self, f.name, None) for f in fields(Settings)}
        given = {name: value for name, value in own.items() if value is not None}
        self._settings = settings_of(self.preset, given)
        self._clutter = ClutterDensity(self._settings.clutter, self._settings.p_fa, window=20)
        s = self._settings
        self._rules = Rules(s.m1, s.n1, s.start_score, s.m2, s.n2, s.max_sd_m)
        self._boxes = BoxInitiator(self._settings.m1, self._settings.n1)

    def __call__(self, detections: Detections) -> Tracks:
        """The tracks at the stamp of `detections`, after its update."""
        dt_s = self._elapsed_s(detections)
        grain, pose = self._grain_of(detections.view), self._pose(detections)
        y, R0 = convert(
            detections.range_m, detections.bearing_rad, grain.range_sd_m, grain.bearing_sd_rad, pose or ORIGIN
        )
        if not math.isfinite(y.sum()):
            raise ValueError(_not_finite(detections))
        bank = self._bank
        self._stamp_ns = detections.stamp_ns
        if pose is None:
            bank, keep = self._unseen(bank, dt_s)
            starts = TrackBank()
        else:
            found = self._scanned(detections, y, dt_s, pose, grain)
            bank, keep = found.bank, found.keep
            starts = self._starts(
                detections, y, R0, found, max(0, self.max_tracks - int(np.count_nonzero(keep)))
            )
        return self._answer(bank, keep, starts, detections)

    def _elapsed_s(self, detections: Detections) -> float:
        if self._stamp_ns is None:
            return 0.0
        elapsed = detections.stamp_ns - self._stamp_ns
        if elapsed <= 0:
            raise ValueError(
                f"ping seq {detections.seq} has stamp {detections.stamp_ns} ns, not after the last ping's "
                f"{self._stamp_ns} ns; pings must come in the order of their stamps"
            )
        return elapsed * 1e-9

    def _grain_of(self, view: View) -> Grain:
        """The grain of `view`, worked out again only when the view's geometry changes."""
        key = (
            view.range_min_m,
            view.range_max_m,
            view.cell_m,
            view.beamwidth_rad,
            view.bearing_rad.tobytes(),
        )
        if self._grain is None or self._grain[0] != key:
            self._grain = (key, grain_of(view, self._settings))
        return self._grain[1]

    def _pose(self, detections: Detections) -> Pose | None:
        """The sensor's pose in the frame of the tracks; None when that is `ned` and it is not known."""
        if self.frame == "sensor":
            return ORIGIN
        view = detections.view
        if view.nav is not None:
            north, east, _ = view.nav.position_m
            if np.isfinite([north, east, view.nav.attitude_rad[2]]).all():
                return sensor_pose(view.nav, view.mount)
        self._warn_once(
            f"ping seq {detections.seq}: no position or heading; tracks in ned are then only predicted"
        )
        return None

    def _scanned(
        self, detections: Detections, y: FloatArray, dt_s: float, pose: Pose, grain: Grain
    ) -> Scanned:
        density = self._clutter.at(
            detections.range_m, detections.bearing_rad, grain.cell_m, grain.spacing_rad, grain.area_m2
        )
        found = scan(self._bank, y, density, dt_s, grain, pose, self._settings, self._rules, self.max_shared)
        if found.approximate:
            self._warn_once(
                f"ping seq {detections.seq}: tracks share more than {self.max_shared} detections; "
                "probabilities of such clusters come from belief propagation"
            )
        return found

    def _unseen(self, bank: TrackBank, dt_s: float) -> tuple[TrackBank, BoolArray]:
        """The predicted tracks after a ping that could not be placed, and which of them go on."""
        state, covariance = predict(bank.state, bank.covariance, dt_s, self._settings.sigma_v_mps2)
        ledger = bank.ledger.copy()
        ledger["age"] += 1
        none = np.zeros(len(bank), bool)
        ledger, keep = settle(ledger, none, covariance, self._rules)
        return TrackBank(state, covariance, ledger), keep

    def _starts(
        self, detections: Detections, y: FloatArray, R0: FloatArray, found: Scanned, room: int
    ) -> TrackBank:
        """The tracks that begin in this ping, at most `room`."""
        s = self._settings
        free = ~found.claimed
        ambiguous = self._ambiguous(detections)
        if ambiguous is not None:
            free &= ~ambiguous
        self._clutter.count(int(np.count_nonzero(free)))
        if s.initiation == "box":
            which = np.flatnonzero(free)
            box_m = s.box_m(detections.view.range_max_m)
            found_starts = self._boxes(y[which], detections.stamp_ns, *box_m)
            starts = box_tracks(found_starts, y[which], R0[which], box_m, s.gamma, s.speed_sd_mps)
            return self._numbered(starts.select(np.arange(min(len(starts), room))))
        free = found.taken <= 0.5
        if ambiguous is not None:
            free &= ~ambiguous
        which = by_place(free, detections.range_m, detections.bearing_rad)
        if which.size > room:
            which = np.sort(which)
            free = np.zeros_like(free)
            free[strongest(which, detections.amplitude, room)] = True
            which = by_place(free, detections.range_m, detections.bearing_rad)
            self._warn_once(
                f"ping seq {detections.seq}: only the strongest detections start tracks, so that "
                f"there are at most {self.max_tracks} (max_tracks)"
            )
        speeds = (s.speed_sd_mps, s.speed_sd_mps)
        return self._numbered(new_tracks(y, R0, speeds, TENTATIVE, which))

    def _ambiguous(self, detections: Detections) -> BoolArray | None:
        """Which detections are among several candidates in one beam and so start nothing; None: none are."""
        if self._settings.start_from_candidates or not detections.kind.any():
            return None
        spacing = self._grain_of(detections.view).spacing_rad
        return several_in_a_beam(detections.bearing_rad, detections.kind == SELF_NOISE, spacing)

    def _numbered(self, starts: TrackBank) -> TrackBank:
        n = len(starts)
        starts.ledger["id"] = np.arange(self._next_id, self._next_id + n)
        self._next_id += n
        return starts

    def _answer(self, bank: TrackBank, keep: BoolArray, starts: TrackBank, detections: Detections) -> Tracks:
        """The tracks that go on, are lost, or begin; the lost ones are then forgotten."""
        lost = bank.ledger["status"] == LOST
        if lost.any():
            shown = bank.renewed(keep | lost, starts)
            self._bank = bank.renewed(keep, starts)
        else:
            self._bank = shown = bank.renewed(keep, starts)
        return shown.message(detections.seq, detections.stamp_ns, self.frame)

    def _warn_once(self, text: str) -> None:
        reason = text.partition(":")[2]
        if reason not in self._said:
            self._said.add(reason)
            log.warning("%s", text)

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            **self._bank.snapshot(),
            **self._clutter.snapshot(),
            **self._boxes.snapshot(),
            "next_id": self._next_id,
            "stamp_ns": self._stamp_ns,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._bank = TrackBank.restored(saved)
        self._clutter.restore(saved)
        self._boxes.restore(saved)
        self._next_id = int(saved["next_id"])
        stamp = saved["stamp_ns"]
        self._stamp_ns = None if stamp is None else int(stamp)


def _not_finite(detections: Detections) -> str:
    bad = ~(np.isfinite(detections.range_m) & np.isfinite(detections.bearing_rad))
    first = int(np.argmax(bad))
    return (
        f"ping seq {detections.seq}: {np.count_nonzero(bad)} of {len(detections)} detections are not finite; "
        f"the first (index {first}) is at {detections.range_m[first]} m, {detections.bearing_rad[first]} rad"
    )


@hookimpl
def fls_node() -> type[Jpda]:
    """Give the node class of kind `jpda`."""
    return Jpda
