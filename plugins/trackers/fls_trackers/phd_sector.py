"""The sector that a PHD filter works in: limits and pose, measurements and their noise, births."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, View
from fls_flow.geometry import Pose, sensor_pose, wrap
from fls_flow.kernels import compiled
from fls_trackers.phd_settings import PhdSettings

__all__ = [
    "Births",
    "Measurements",
    "Sector",
    "births_of",
    "measurements_of",
    "pose_of",
    "sector_of",
    "sees",
    "within_half_turn",
]

FloatArray = npt.NDArray[np.float64]
FULL_TURN_RAD = 2.0 * math.pi - 1e-6  # a sector at least so wide is all round
LEAST_UNSEEN = 1e-3  # part of the prior below which it is forgotten
UNKNOWN_CELL_M = 0.25
UNKNOWN_SPACING_RAD = math.radians(0.5)


class Sector(NamedTuple):
    """What the sonar sees, and from where; numbers alone, so that kernels take it.

    Its bearings count on from border to border, so that a sector astern, or one all round, has no seam.
    """

    range_min_m: float
    range_max_m: float
    bearing_min_rad: float
    bearing_max_rad: float
    north_m: float = 0.0
    east_m: float = 0.0
    heading_rad: float = 0.0

    @property
    def area_m2(self) -> float:
        """Its area, m^2."""
        return 0.5 * self.width_rad * (self.range_max_m**2 - self.range_min_m**2)

    @property
    def width_rad(self) -> float:
        """From border to border, rad."""
        return self.bearing_max_rad - self.bearing_min_rad

    @property
    def polar_area(self) -> float:
        """Its size in measurement space, m rad."""
        return (self.range_max_m - self.range_min_m) * self.width_rad

    def holds(self, position_m: FloatArray) -> npt.NDArray[np.bool_]:
        """Which positions (n, 2) in the frame of the targets lie inside."""
        xy = self.pose.to_sensor(position_m)
        return self.spans(np.hypot(xy[:, 0], xy[:, 1]), self.bearings(np.arctan2(xy[:, 1], xy[:, 0])))

    def spans(self, range_m: FloatArray, bearing_rad: FloatArray) -> npt.NDArray[np.bool_]:
        """Which polar positions (n,) lie inside; bearings as `bearings` gives them."""
        inside: npt.NDArray[np.bool_] = (range_m >= self.range_min_m) & (range_m <= self.range_max_m)
        if self.width_rad > FULL_TURN_RAD:
            return inside
        return inside & (bearing_rad >= self.bearing_min_rad) & (bearing_rad <= self.bearing_max_rad)

    def bearings(self, angle_rad: FloatArray) -> FloatArray:
        """The angles (n,), sensor frame, at most half a turn from the sector's middle."""
        middle = 0.5 * (self.bearing_min_rad + self.bearing_max_rad)
        off = angle_rad - middle
        return np.where(np.abs(off) <= np.pi, angle_rad, middle + wrap(off))

    @property
    def pose(self) -> Pose:
        """Where the sonar is, in the frame of the targets."""
        return Pose(self.north_m, self.east_m, self.heading_rad)

    def seen_from(self, pose: Pose) -> Sector:
        """The same sector of a sonar that is elsewhere."""
        return self._replace(north_m=pose.north_m, east_m=pose.east_m, heading_rad=pose.heading_rad)


@dataclass(frozen=True, slots=True)
class Measurements:
    """The m measurements of a ping and their standard deviations."""

    range_m: FloatArray
    bearing_rad: FloatArray
    range_sd_m: FloatArray
    bearing_sd_rad: FloatArray

    def __len__(self) -> int:
        return self.range_m.size


class Births(NamedTuple):
    """Where targets are born, `mass` of them per ping: uniform in area between two ranges of the sector.

    And `unseen` that were there from the start, anywhere in the sector, and have never been detected.
    """

    mass: float
    near_m: float
    far_m: float
    velocity_mps: tuple[float, float]  # mean, in the frame of the targets
    speed_sd_mps: float
    unseen: float = 0.0

    def everywhere(self, mass: float, sector: Sector) -> Births:
        """So many births over the whole sector, as before the first ping."""
        return self._replace(mass=mass, near_m=sector.range_min_m, far_m=sector.range_max_m)

    def started(self, views: int, settings: PhdSettings, sector: Sector) -> Births:
        """These births after so many pings: before the first, the prior; then also what is left of it unseen.

        prior (1 - p_d)^views: filters that begin targets at measurements miss those that are not detected.
        """
        if not views:
            return self.everywhere(settings.prior_targets, sector)
        left = (1.0 - settings.p_d) ** views
        return self._replace(unseen=settings.prior_targets * left if left > LEAST_UNSEEN else 0.0)

    @property
    def total(self) -> float:
        """Births and unseen targets together."""
        return self.mass + self.unseen

    def density(self, sector: Sector) -> float:
        """Births per m^2 and ping, where there are any."""
        return self.mass / (0.5 * sector.width_rad * (self.far_m**2 - self.near_m**2))


def pose_of(view: View, settings: PhdSettings) -> Pose | None:
    """The sensor's pose in the frame of the targets; None when that is `ned` and the pose is not known."""
    if settings.frame == "sensor":
        return Pose()
    if view.nav is None:
        return None
    try:
        return sensor_pose(view.nav, view.mount)
    except ValueError:  # position or heading unknown
        return None


def sector_of(view: View) -> Sector | None:
    """The sector from the outer edges of its cells, sensor frame; None of a view that shows nothing.

    Beams all round make it a full turn, whatever the spacing.
    """
    if not view.bearing_rad.size or not view.range_max_m > view.range_min_m:
        return None
    spacing = view.beam_spacing_rad
    half_beam = 0.5 * spacing if spacing > 0.0 else 0.5 * UNKNOWN_SPACING_RAD
    half_cell = 0.5 * view.cell_m if view.cell_m > 0.0 else 0.0
    table = np.unwrap(view.bearing_rad)  # it may jump from pi to -pi
    low, high = float(table.min()) - half_beam, float(table.max()) + half_beam
    if high - low > FULL_TURN_RAD:
        low, high = 0.5 * (low + high) - np.pi, 0.5 * (low + high) + np.pi
    return Sector(max(0.0, view.range_min_m - half_cell), view.range_max_m + half_cell, low, high)


def measurements_of(detections: Detections, settings: PhdSettings, sector: Sector | None) -> Measurements:
    """The detections inside the sector of their view, as measurements.

    One from outside of the sector could come from no target that the filter knows, nor from its clutter.
    Raises ValueError for a detection that is not finite.
    """
    finite = np.isfinite(detections.range_m) & np.isfinite(detections.bearing_rad)
    if not finite.all():
        first = int(np.argmin(finite))
        raise ValueError(
            f"ping seq {detections.seq}: {np.count_nonzero(~finite)} of {len(detections)} detections are not "
            f"finite; the first (index {first}) is at {detections.range_m[first]} m, "
            f"{detections.bearing_rad[first]} rad"
        )
    if sector is not None:
        inside = sector.spans(detections.range_m, sector.bearings(detections.bearing_rad))
        if not inside.all():
            detections = detections.select(inside)
    range_sd, bearing_sd = _noise(detections, settings)
    bearing = detections.bearing_rad.copy() if sector is None else sector.bearings(detections.bearing_rad)
    return Measurements(detections.range_m.copy(), bearing, range_sd, bearing_sd)


def _noise(detections: Detections, settings: PhdSettings) -> tuple[FloatArray, FloatArray]:
    view, m = detections.view, len(detections)
    cell = max(view.cell_m, UNKNOWN_CELL_M) if view.cell_m > 0.0 else UNKNOWN_CELL_M
    range_sd, _ = _own(detections.covariance[:, 0, 0], cell)
    bearing_sd, known = _own(detections.covariance[:, 1, 1], UNKNOWN_SPACING_RAD)
    if not known and view.beam_spacing_rad > 0.0:
        bearing_sd, _ = _own(detections.covariance[:, 1, 1], view.beam_spacing_rad)
    if settings.sigma_range_m is not None:
        range_sd = np.full(m, settings.sigma_range_m)
    if settings.sigma_bearing_deg is not None:
        bearing_sd = np.full(m, math.radians(settings.sigma_bearing_deg))
    return range_sd, bearing_sd


def _own(variance: FloatArray, otherwise: float) -> tuple[FloatArray, bool]:
    """Standard deviations, and whether all are the variances' own."""
    known = np.isfinite(variance) & (variance > 0.0)
    return np.where(known, np.sqrt(np.where(known, variance, 1.0)), otherwise), bool(known.all())


def births_of(view: View, sector: Sector, range_sd_m: float, dt_s: float, settings: PhdSettings) -> Births:
    """The births of one ping; unless set, the far end is as deep as max((|v| + 2 speed sd) dt, 3 sigma).

    Source: Clark & Bell 2005, step 5 and section III; the depth as in ALGORITHMS, section 4.
    """
    closing = settings.closing_mps
    if closing is None:
        ahead = view.nav.velocity_mps[0] if view.nav is not None else math.nan
        closing = ahead if math.isfinite(ahead) else 0.0
    velocity = (0.0, 0.0) if settings.frame == "ned" else (-closing, 0.0)
    near = sector.range_min_m
    if settings.births == "far-end":
        reach = (abs(closing) + 2.0 * settings.speed_sd_mps) * dt_s
        depth = settings.birth_depth_m or max(reach, 3.0 * range_sd_m)
        near = max(near, sector.range_max_m - depth)
    return Births(settings.p_b, near, sector.range_max_m, velocity, settings.speed_sd_mps)


@compiled
def within_half_turn(angle: float, middle: float) -> float:
    """The same angle, at most half a turn from `middle`."""
    while angle - middle > math.pi:
        angle -= 2.0 * math.pi
    while angle - middle <= -math.pi:
        angle += 2.0 * math.pi
    return angle


@compiled
def sees(x: float, y: float, sector: Sector) -> tuple[float, float, bool]:
    """Range and bearing of a place in the frame of the targets, and whether it lies in the sector."""
    dx, dy = x - sector.north_m, y - sector.east_m
    low, high = sector.bearing_min_rad, sector.bearing_max_rad
    r = math.hypot(dx, dy)
    b = within_half_turn(math.atan2(dy, dx) - sector.heading_rad, 0.5 * (low + high))
    beside = low <= b <= high or high - low > FULL_TURN_RAD
    return r, b, beside and sector.range_min_m <= r <= sector.range_max_m
