"""The tracks of still objects as arrays, one row per track, and their places in NED."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import Mount, NavState
from fls_trackers.ground_filter import unscented
from fls_trackers.ground_floor import FloorPlane
from fls_trackers.ground_motion import SensorMotion, locate, sensor_motion

__all__ = ["GroundBank", "PoseSd", "afloat_probability", "places"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

PRIOR_AFLOAT = 0.1  # of a new track to be in the water column
NEAR_ON_FLOOR = 0.1  # chance that an object on the floor seems nearer than the floor, by an error
MOST_SD_M = 1e3  # a track less certain than the sea is wide says nothing more
FADE = 1e-300  # the odds do not underflow


def _ints() -> IntArray:
    return np.zeros(0, np.int64)


@dataclass
class GroundBank:
    """n tracks in the order of their ids; the arrays of a bank in use are never written."""

    x: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # range (m), bearing (rad)
    P: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 2)))
    ned_m: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # last known; nan: never
    ned_cov: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 2)))
    id: IntArray = field(default_factory=_ints)
    hits: IntArray = field(default_factory=_ints)
    age: IntArray = field(default_factory=_ints)
    misses: IntArray = field(default_factory=_ints)  # in a row
    near: IntArray = field(default_factory=_ints)  # updates nearer than the floor can be
    confirmed: IntArray = field(default_factory=_ints)  # 0 or 1

    def __len__(self) -> int:
        return self.id.size

    @property
    def afloat(self) -> BoolArray:
        """Which are rather in the water column than on the floor, (n,)."""
        return afloat_probability(self.near) > 0.5

    @property
    def sane(self) -> BoolArray:
        """Whose state still says something, (n,)."""
        size = np.abs(self.x).sum(axis=1) + np.abs(self.P).sum(axis=(1, 2))
        known: BoolArray = np.isfinite(size) & (self.x[:, 0] > 0.0) & (self.P[:, 0, 0] < MOST_SD_M**2)
        return known

    def select(self, which: npt.NDArray[Any]) -> GroundBank:
        """The tracks that a mask or an index array selects, as copies."""
        return replace(self, **{name: values[which] for name, values in self._arrays()})

    def joined(self, other: GroundBank) -> GroundBank:
        """These tracks, then the younger ones of `other`."""
        return GroundBank(*(np.concatenate([a, getattr(other, name)]) for name, a in self._arrays()))

    def snapshot(self) -> dict[str, Any]:
        """Copies of all arrays."""
        return {name: values.copy() for name, values in self._arrays()}

    @classmethod
    def restored(cls, saved: dict[str, Any]) -> GroundBank:
        """The bank that gave the snapshot `saved`."""
        empty = cls()
        return cls(
            *(
                np.array(saved[name], values.dtype).reshape(-1, *values.shape[1:])
                for name, values in empty._arrays()
            )
        )

    @classmethod
    def new(cls, x: FloatArray, P0: FloatArray, first_id: int) -> GroundBank:
        """Tracks that begin at x (n, 2) with the same covariance P0 (2, 2), after one update."""
        n = len(x)
        one = np.ones(n, np.int64)
        return cls(
            x,
            np.broadcast_to(P0, (n, 2, 2)).copy(),
            np.full((n, 2), np.nan),
            np.zeros((n, 2, 2)),
            np.arange(first_id, first_id + n),
            one,
            0 * one,
            0 * one,
            0 * one,
            0 * one,
        )

    def _arrays(self) -> list[tuple[str, npt.NDArray[Any]]]:
        return [(f.name, getattr(self, f.name)) for f in fields(self)]


def afloat_probability(near: IntArray) -> FloatArray:
    """Posterior (n,) of an object in the water column, after `near` updates nearer than the floor.

    p = p0 / (p0 + (1 - p0) e^near): each such update has the chance e on the floor and 1 in the water; an
    update farther away says nothing, as the sonar does not tell elevations.
    """
    floor = (1.0 - PRIOR_AFLOAT) * np.maximum(NEAR_ON_FLOOR ** near.astype(float), FADE)
    return PRIOR_AFLOAT / (PRIOR_AFLOAT + floor)


@dataclass(frozen=True, slots=True)
class PoseSd:
    """How well the vehicle's pose is known: standard deviations, m and rad."""

    position_m: float
    heading_rad: float
    tilt_rad: float  # of roll and of pitch
    altitude_m: float


def places(
    bank: GroundBank,
    motion: SensorMotion,
    nav: NavState,
    mount: Mount,
    floor: FloorPlane | None,
    pose_sd: PoseSd,
) -> tuple[FloatArray, FloatArray]:
    """Places [north, east] (n, 2) and covariances (n, 2, 2): of the filter, and of the vehicle's pose.

    P = unscented transform of the track + sigma_p^2 I + sum_i sigma_i^2 J_i J_i^T, J_i the derivative of the
    place by roll, pitch, yaw and altitude. Errors of the pose are common to all tracks of a ping.
    """
    afloat = bank.afloat

    def placed(x: FloatArray, moved: SensorMotion = motion) -> FloatArray:
        return (locate(x, moved, afloat).m @ moved.R.T + moved.origin_m)[..., :2]

    mean, P = unscented(bank.x, bank.P, placed)
    P = P + pose_sd.position_m**2 * np.eye(2)
    for sd, more, less, floors in _perturbed(nav, floor, pose_sd):
        ends = [sensor_motion(n, mount, f) for n, f in zip((more, less), floors, strict=True)]
        if ends[0] is not None and ends[1] is not None and sd > 0.0:
            J = 0.5 * (placed(bank.x, ends[0]) - placed(bank.x, ends[1]))  # for one sd
            P = P + J[:, :, None] * J[:, None, :]
    return mean, 0.5 * (P + P.transpose(0, 2, 1))


Floors = tuple[FloorPlane | None, FloorPlane | None]


def _perturbed(
    nav: NavState, floor: FloorPlane | None, pose_sd: PoseSd
) -> list[tuple[float, NavState, NavState, Floors]]:
    """The navigation one standard deviation up and down, in roll, pitch, yaw and altitude."""
    ends: list[tuple[float, NavState, NavState, Floors]] = []
    for axis, sd in enumerate((pose_sd.tilt_rad, pose_sd.tilt_rad, pose_sd.heading_rad)):
        step = np.where(np.arange(3) == axis, sd, 0.0)
        up, down = np.array(nav.attitude_rad) + step, np.array(nav.attitude_rad) - step
        more, less = ((float(a[0]), float(a[1]), float(a[2])) for a in (up, down))
        ends.append((sd, replace(nav, attitude_rad=more), replace(nav, attitude_rad=less), (floor, floor)))
    sd = pose_sd.altitude_m
    higher = replace(nav, altitude_m=nav.altitude_m + sd)
    lower = replace(nav, altitude_m=nav.altitude_m - sd)
    floors = (_lowered(floor, sd), _lowered(floor, -sd))
    return [*ends, (sd, higher, lower, floors)]


def _lowered(floor: FloorPlane | None, by_m: float) -> FloorPlane | None:
    return None if floor is None else replace(floor, height_m=floor.height_m + by_m)
