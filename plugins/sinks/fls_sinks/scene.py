"""What a picture shows of one ping, in the sensor frame and in memory of its own."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import (
    BeamMask,
    Classes,
    Detections,
    Frame,
    Ping,
    Sealed,
    Tracks,
    TrackStatus,
    Truth,
    Wakes,
    array,
)
from fls_flow.geometry import Pose, sensor_pose

__all__ = ["History", "Scene"]

FloatArray = npt.NDArray[np.float64]
Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Scene(Sealed):
    """One ping and what was found in it: plain arrays, numbers and strings."""

    seq: int
    stamp_ns: int
    amplitude: Array = array((np.float32, np.uint8, np.uint16), "n_ranges", "n_beams")  # nan where not valid
    range_m: FloatArray = array(float, "n_ranges")
    bearing_rad: FloatArray = array(float, "n_beams")
    beamwidth_rad: float = float("nan")
    detection_m: FloatArray = array(float, "n_detections", 2)  # positions [x, y]
    detection_kind: Array = array(np.uint8, "n_detections")
    wake_apex_m: FloatArray = array(float, "n_wakes", 2)
    wake_shape: FloatArray = array(float, "n_wakes", 3)  # orientation (rad), length (m), half angle (rad)
    wake_end: Array = array(bool, "n_wakes")
    noisy_rad: FloatArray = array(float, "n_noisy")  # bearings of noisy beams
    track_id: Array = array(np.int64, "n_tracks")
    track_status: Array = array(np.uint8, "n_tracks")
    track_m: FloatArray = array(float, "n_tracks", 2)
    track_covariance: FloatArray = array(float, "n_tracks", 2, 2)
    track_label: tuple[str, ...] = ()  # one per track, "" where it has none; or nothing
    truth_m: FloatArray = array(float, "n_truth", 2)
    trail_id: Array = array(np.int64, "n_trail")  # one entry per track and ping, oldest first
    trail_m: FloatArray = array(float, "n_trail", 2)
    notes: tuple[str, ...] = ()
    pose: tuple[float, float, float] | None = None  # of the sensor: north, east (m), heading (rad)

    @classmethod
    def of(
        cls,
        ping: Ping,
        detections: Detections | None = None,
        wakes: Wakes | None = None,
        tracks: Tracks | None = None,
        beam_mask: BeamMask | None = None,
        truth: Truth | None = None,
        classes: Classes | None = None,
    ) -> Scene:
        """The scene of one ping; tracks and truth in the NED frame are turned by the ping's navigation."""
        pose, notes = _pose(ping), []
        parts: dict[str, Any] = {}
        if detections is not None:
            with np.errstate(invalid="ignore"):  # an infinite range has no position
                parts.update(detection_m=detections.position_m, detection_kind=detections.kind.copy())
        if wakes is not None:
            shape = np.column_stack([wakes.orientation_rad, wakes.length_m, wakes.half_angle_rad])
            parts.update(wake_apex_m=wakes.apex_m.copy(), wake_shape=shape, wake_end=wakes.is_end.copy())
        if beam_mask is not None:
            parts.update(noisy_rad=beam_mask.bearing_rad[beam_mask.noisy])
        if tracks is not None:
            turned = _turned(tracks.state[:, :2], tracks.frame, pose)
            notes += [] if turned is not None else [f"{len(tracks)} tracks in NED are not drawn"]
            parts.update({} if turned is None else _tracks(tracks, turned, pose, classes))
        if truth is not None:
            turned = _turned(truth.state[:, :2], truth.frame, pose)
            notes += [] if turned is not None else [f"{len(truth)} true targets in NED are not drawn"]
            parts.update({} if turned is None else {"truth_m": turned})
        if notes:
            notes.append("the ping has no navigation")
        return cls(
            ping.seq,
            ping.stamp_ns,
            _amplitude(ping),
            ping.range_m.copy(),
            ping.bearing_rad.copy(),
            ping.beamwidth_rad,
            **parts,
            notes=tuple(notes),
            pose=None if pose is None else (pose.north_m, pose.east_m, pose.heading_rad),
        )

    def within(self, reach_m: float) -> Scene:
        """The same scene with nan in place of all that lies, or spreads, beyond `reach_m`.

        Rendering takes minutes for shapes that are many orders larger than the picture.
        """
        shape = self.wake_shape
        spread = np.trace(np.abs(self.track_covariance), axis1=1, axis2=2)
        return replace(
            self,
            detection_m=_near(self.detection_m, reach_m),
            wake_apex_m=_near(self.wake_apex_m, reach_m),
            wake_shape=np.where(np.abs(shape[:, 1:2]) <= reach_m, shape, np.nan),
            track_m=_near(self.track_m, reach_m),
            track_covariance=np.where(spread[:, None, None] <= reach_m**2, self.track_covariance, np.nan),
            truth_m=_near(self.truth_m, reach_m),
            trail_m=_near(self.trail_m, reach_m),
        )

    def snapshot(self) -> dict[str, Any]:
        """Copies of the fields by name."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {
            key: value.copy() if isinstance(value, np.ndarray) else value for key, value in values.items()
        }

    @classmethod
    def restored(cls, snapshot: dict[str, Any]) -> Scene:
        """The scene of a snapshot."""
        pose = snapshot["pose"]
        plain: dict[str, Any] = {
            "notes": tuple(snapshot["notes"]),
            "pose": None if pose is None else tuple(pose),
            "track_label": tuple(snapshot["track_label"]),
        }
        arrays = {key: value.copy() for key, value in snapshot.items() if isinstance(value, np.ndarray)}
        return cls(**(snapshot | arrays | plain))


@dataclass
class History:
    """Where confirmed tracks were in the last `pings` pings, in the trackers' own frame."""

    pings: int
    frame: Frame = "sensor"
    _steps: deque[tuple[Array, FloatArray]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._steps = deque(maxlen=self.pings)

    def add(self, tracks: Tracks) -> None:
        """Remember the confirmed tracks of one ping."""
        which = tracks.status == TrackStatus.CONFIRMED
        self.frame = tracks.frame
        self._steps.append((tracks.id[which], tracks.state[which, :2]))

    def trail(self, pose: tuple[float, float, float] | None) -> tuple[Array, FloatArray]:
        """Ids and positions [x, y] in the frame of a sensor at `pose`, oldest first."""
        ids, positions = self._joined()
        turned = _turned(positions, self.frame, None if pose is None else Pose(*pose))
        return (ids, turned) if turned is not None else (ids[:0], positions[:0])

    def snapshot(self) -> dict[str, Any]:
        """All steps as flat arrays."""
        ids, positions = self._joined()
        counts = np.array([step[0].size for step in self._steps], np.int64)
        return {"frame": self.frame, "counts": counts, "ids": ids, "positions": positions}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Take over the steps of a snapshot."""
        cuts = np.cumsum(np.asarray(snapshot["counts"], np.int64))[:-1]
        self.frame = snapshot["frame"]
        ids, positions = np.array(snapshot["ids"]), np.array(snapshot["positions"])
        steps = zip(np.split(ids, cuts), np.split(positions, cuts), strict=True)
        self._steps = deque(steps if len(snapshot["counts"]) else (), maxlen=self.pings)

    def _joined(self) -> tuple[Array, FloatArray]:
        if not self._steps:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        ids, positions = zip(*self._steps, strict=True)
        return np.concatenate(ids), np.concatenate(positions)


def _near(position_m: FloatArray, reach_m: float) -> FloatArray:
    return np.where((np.abs(position_m) <= reach_m).all(axis=1, keepdims=True), position_m, np.nan)


def _amplitude(ping: Ping) -> Array:
    if ping.valid is None or ping.valid.all():
        return np.array(ping.amplitude)
    return np.where(ping.valid, ping.amplitude, np.float32(np.nan)).astype(np.float32)


def _pose(ping: Ping) -> Pose | None:
    if ping.nav is None:
        return None
    try:
        return sensor_pose(ping.nav, ping.mount)
    except ValueError:  # position or heading unknown
        return None


def _turned(position_m: FloatArray, frame: Frame, pose: Pose | None) -> FloatArray | None:
    if frame == "sensor" or not len(position_m):
        return position_m.copy()
    return None if pose is None else pose.to_sensor(position_m)


def _tracks(
    tracks: Tracks, position_m: FloatArray, pose: Pose | None, classes: Classes | None
) -> dict[str, Any]:
    covariance = tracks.covariance[:, :2, :2].copy()
    if tracks.frame == "ned" and pose is not None:
        axes = pose.to_ned(np.eye(2)) - pose.origin_m  # rows: the sensor's axes in NED
        covariance = axes @ covariance @ axes.T
    return {
        "track_id": tracks.id.copy(),
        "track_status": tracks.status.copy(),
        "track_m": position_m,
        "track_covariance": covariance,
        "track_label": () if classes is None else _labels(tracks, classes),
    }


def _labels(tracks: Tracks, classes: Classes) -> tuple[str, ...]:
    named = dict(zip(classes.track_id.tolist(), classes.label.tolist(), strict=True))
    return tuple(classes.names[named[one]] if one in named else "" for one in tracks.id.tolist())
