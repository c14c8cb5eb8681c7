"""What the tracker of still objects answers: states in either frame, and what is in the water column."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Classes, Detections, Frame, Tracks
from fls_trackers.ground_bank import GroundBank, afloat_probability
from fls_trackers.ground_filter import flat, unscented
from fls_trackers.ground_motion import SensorMotion, locate, rates

__all__ = ["TracksAndClasses", "answered"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

NAMES = ("ground", "water-column")
STILL_SD_MPS = 1e-3  # the speed of a still object, so that covariances can be inverted


class TracksAndClasses(NamedTuple):
    """The tracks, and whether they lie on the floor or in the water column."""

    tracks: Tracks
    classes: Classes


def answered(
    bank: GroundBank,
    shown: BoolArray,
    status: IntArray,
    motion: SensorMotion | None,
    frame: Frame,
    detections: Detections,
) -> TracksAndClasses:
    """Those of the tracks (n,) that are `shown`, in `ned` without those whose place was never known."""
    if frame == "ned":
        shown = shown & np.isfinite(bank.ned_m).all(axis=1)
    seen = bank.select(shown)
    state, P = _in_ned(seen) if frame == "ned" else _in_sensor(seen, motion)
    kept = status[shown].astype(np.uint8)
    seq, stamp_ns = detections.seq, detections.stamp_ns
    tracks = Tracks(seq, stamp_ns, seen.id, kept, state, P, seen.hits, seen.age, frame)
    return TracksAndClasses(tracks, _classes(seen, detections))


def _still(n: int) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) without places and velocities."""
    P = np.zeros((n, 4, 4))
    P[:, 2, 2] = P[:, 3, 3] = STILL_SD_MPS**2
    return np.zeros((n, 4)), P


def _in_ned(bank: GroundBank) -> tuple[FloatArray, FloatArray]:
    state, P = _still(len(bank))
    state[:, :2], P[:, :2, :2] = bank.ned_m, bank.ned_cov
    return state, P


def _in_sensor(bank: GroundBank, motion: SensorMotion | None) -> tuple[FloatArray, FloatArray]:
    """With the apparent velocities, where the vehicle's motion is known."""
    state, P = _still(len(bank))
    state[:, :2], P[:, :2, :2] = unscented(bank.x, bank.P, flat)
    if motion is not None:
        speed = rates(bank.x, locate(bank.x, motion, bank.afloat).m, motion)
        (d, delta), (d_dot, delta_dot) = bank.x.T, speed.T
        state[:, 2] = d_dot * np.cos(delta) - d * delta_dot * np.sin(delta)
        state[:, 3] = d_dot * np.sin(delta) + d * delta_dot * np.cos(delta)
    return state, P


def _classes(bank: GroundBank, detections: Detections) -> Classes:
    afloat = afloat_probability(bank.near)
    posterior = np.stack([1.0 - afloat, afloat], axis=-1)
    label = (afloat > 0.5).astype(np.int64)
    return Classes(detections.seq, detections.stamp_ns, bank.id.copy(), NAMES, label, posterior)
