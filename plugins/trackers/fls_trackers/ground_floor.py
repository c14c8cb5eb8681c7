"""The sea floor below and before a vehicle as a plane, from altitudes in several directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow import Sealed, array
from fls_flow.geometry import rotation
from fls_flow.messages import Vector

__all__ = ["FloorPlane", "beam_points", "four_beams", "plane_through", "plane_to"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FloorPlane(Sealed):
    """The floor as normal . p = height, p in NED from the vehicle; empty: not known."""

    seq: int
    stamp_ns: int
    normal: FloatArray = array(float, 3)  # unit, NED, into the floor
    height_m: float = float("nan")  # along the normal

    @property
    def known(self) -> bool:
        """Whether there is a plane."""
        return bool(np.isfinite(self.height_m) and np.isfinite(self.normal).all() and self.normal.any())

    @property
    def slope_rad(self) -> float:
        """Steepest slope, rad; nan if not known."""
        return float(np.arccos(np.clip(self.normal[2], -1.0, 1.0))) if self.known else float("nan")


def beam_points(direction: npt.ArrayLike, range_m: npt.ArrayLike, attitude_rad: Vector) -> FloatArray:
    """Where beams hit the floor, (n, 3) NED from the vehicle; unit directions (n, 3) in the body frame."""
    ranges = np.asarray(range_m, float)
    points: FloatArray = (np.asarray(direction, float) * ranges[:, None]) @ rotation(attitude_rad).T
    return points


def four_beams(tilt_rad: float) -> FloatArray:
    """Body directions (4, 3) of a DVL: fore starboard, aft starboard, aft port, fore port; tilted from z."""
    azimuth = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    s, c = np.sin(tilt_rad), np.cos(tilt_rad)
    return np.stack([s * np.cos(azimuth), s * np.sin(azimuth), np.full(4, c)], axis=1)


def plane_through(points_m: npt.ArrayLike) -> tuple[FloatArray, float]:
    """Unit normal (3,) and height of the plane through points (n, 3), by least squares; NED from the vehicle.

    down = a north + b east + c: normal = (-a, -b, 1) / sqrt(a^2 + b^2 + 1), height = c / sqrt(...). Where the
    points do not tell the slope across their line (two altitudes), the smallest slope that fits is taken.
    Points that are not finite are left out. Raises ValueError without any.
    """
    points = np.asarray(points_m, float).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise ValueError("no finite point: a floor needs one altitude or more")
    middle = points.mean(axis=0)
    slope, *_ = np.linalg.lstsq(points[:, :2] - middle[:2], points[:, 2] - middle[2], rcond=1e-9)
    return plane_to(-slope[0], -slope[1], float(middle[2] - slope @ middle[:2]))


def plane_to(north: float, east: float, altitude_m: float) -> tuple[FloatArray, float]:
    """Unit normal and height of the plane with normal (north, east, 1) at `altitude_m` below the vehicle."""
    length = float(np.sqrt(north * north + east * east + 1.0))
    return np.array([north, east, 1.0]) / length, altitude_m / length
