"""How the blob tracker compares polar blobs with Cartesian tracks: debiased, or in polar terms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import Pose, to_cartesian
from fls_trackers.conversion import noise_at
from fls_trackers.kalman import update
from fls_trackers.ncv_polar import along_arc, axes, polar_noise, residuals, robust_noise
from fls_trackers.ncv_scan import Scan

__all__ = ["Debiased", "Polar"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Moments = tuple[FloatArray, FloatArray]  # states or positions, and their covariances


@dataclass(frozen=True, slots=True)
class Debiased:
    """Blobs become positions, by the debiased conversion."""

    range_sd_m: float
    bearing_sd_rad: float

    def axes(self, state: FloatArray, pose: Pose) -> FloatArray:
        """None, (0, 2): innovations are Cartesian."""
        return np.zeros((0, 2))

    def noise(self, state: FloatArray, pose: Pose) -> FloatArray:
        """R (n, 2, 2) of a blob at the predicted position of each track (n, 4)."""
        return noise_at(state, self.range_sd_m, self.bearing_sd_rad, pose)

    def innovations(self, state: FloatArray, scan: Scan, blob: IntArray) -> FloatArray:
        """nu (n, 2) of the blob that each track took."""
        return scan.y[blob] - state[:, :2]

    def updated(self, state: FloatArray, covariance: FloatArray, nu: FloatArray, pose: Pose) -> Moments:
        """The tracks after their innovations."""
        return _kalman(state, covariance, self.noise(state, pose), nu)

    def begun(self, scan: Scan, blob: IntArray) -> Moments:
        """Positions (n, 2) and covariances (n, 2, 2) of tracks that begin at blobs."""
        return scan.y[blob], scan.R[blob]


@dataclass(frozen=True, slots=True)
class Polar:
    """Innovations are those of range and bearing, corrections follow the arc, and far bearings count less."""

    range_sd_m: float
    bearing_sd_rad: float

    def axes(self, state: FloatArray, pose: Pose) -> FloatArray:
        """The line of sight (n, 2) of each track."""
        return axes(state[:, :2], pose)

    def noise(self, state: FloatArray, pose: Pose) -> FloatArray:
        """R (n, 2, 2) of a blob at the predicted position of each track (n, 4)."""
        return polar_noise(state[:, :2], self.range_sd_m, self.bearing_sd_rad, pose)

    def innovations(self, state: FloatArray, scan: Scan, blob: IntArray) -> FloatArray:
        """nu (n, 2) of the blob that each track took."""
        return residuals(state[:, :2], scan.polar[blob], scan.pose)

    def updated(self, state: FloatArray, covariance: FloatArray, nu: FloatArray, pose: Pose) -> Moments:
        """The tracks after their innovations."""
        R = robust_noise(nu, state[:, :2], covariance, self.noise(state, pose), pose)
        return along_arc(state, *_kalman(state, covariance, R, nu), pose)

    def begun(self, scan: Scan, blob: IntArray) -> Moments:
        """Positions (n, 2) and covariances (n, 2, 2) of tracks that begin at blobs."""
        position = scan.pose.to_ned(to_cartesian(*scan.polar[blob].T))
        return position, polar_noise(position, self.range_sd_m, self.bearing_sd_rad, scan.pose)


def _kalman(state: FloatArray, covariance: FloatArray, R: FloatArray, nu: FloatArray) -> Moments:
    n = len(state)
    x, P = update(
        state, covariance, R, state[:, :2] + nu, np.arange(n + 1), np.arange(n), np.ones(n), np.zeros(n)
    )
    return x, P
