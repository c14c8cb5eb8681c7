"""The blobs of a ping as the blob tracker needs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow import Detections
from fls_flow.geometry import Pose, sensor_pose, wrap
from fls_flow.messages import Frame
from fls_trackers.conversion import convert
from fls_trackers.ncv_memory import Recall

__all__ = ["BlobDensity", "Scan", "amplitude_gain", "pose_of", "scan_of"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

CELL = 1.5  # cells or beams that the blob of what stands still may move
MEMORY = 20  # pings over which blobs are counted
ORIGIN = Pose()


@dataclass(frozen=True, slots=True)
class Scan:
    """The blobs of a ping, in order of range."""

    polar: FloatArray  # (m, 2) range (m) and bearing (rad)
    y: FloatArray  # (m, 2) debiased, in the frame of the tracks
    R: FloatArray  # (m, 2, 2)
    time_ns: IntArray  # (m,) when the sound met each
    level: FloatArray  # (m,) log amplitude
    gain: FloatArray  # (m,) what the amplitude adds to a score
    recalled: Recall  # what each place showed in the last ping
    cell: tuple[float, float]  # range (m) and bearing (rad) within which a blob is where another was
    pose: Pose
    sound_speed_mps: float


def pose_of(d: Detections, frame: Frame) -> Pose | None:
    """Where the sonar is in the frame of the tracks; None when that is not known."""
    if frame == "sensor":
        return ORIGIN
    nav = d.view.nav
    if nav is None or not np.isfinite([*nav.position_m[:2], nav.attitude_rad[2]]).all():
        return None
    return sensor_pose(nav, d.view.mount)


def scan_of(
    d: Detections,
    recalled: Recall,
    pose: Pose,
    range_sd_m: float,
    bearing_sd_rad: float,
    snr_db: float | None,
) -> Scan:
    """The blobs of `d`; `recalled` comes in its order."""
    order = np.lexsort((d.bearing_rad, d.range_m))
    range_m, bearing_rad = d.range_m[order], wrap(d.bearing_rad[order])
    y, R = convert(range_m, bearing_rad, range_sd_m, bearing_sd_rad, pose)
    c = d.view.sound_speed_mps
    time_ns = d.stamp_ns + np.rint(range_m / c * 1e9).astype(np.int64)
    level = np.log(np.maximum(np.nan_to_num(d.amplitude[order]), 1e-30))
    gain = np.zeros(level.size) if snr_db is None else amplitude_gain(level, 10.0 ** (snr_db / 10.0))
    polar = np.stack([range_m, bearing_rad], axis=1)
    cell = CELL * d.view.cell_m, CELL * abs(d.view.beam_spacing_rad)
    return Scan(polar, y, R, time_ns, level, gain, recalled.take(order), cell, pose, c)


def amplitude_gain(level: FloatArray, snr: float) -> FloatArray:
    """Log likelihood ratios (m,) that log amplitudes above the threshold add, for a fluctuating target."""
    power = np.exp(2.0 * level)
    above = power - power.min(initial=np.inf)
    gain: FloatArray = above * snr / (1.0 + snr) - np.log1p(snr)
    return gain


@dataclass(frozen=True, slots=True)
class BlobDensity:
    """Mean number of blobs per ping, metre and radian, at least one in 20 pings."""

    mean: float = 0.0  # m^-1 rad^-1
    pings: int = 0  # that it is the mean of

    def after(self, d: Detections) -> BlobDensity:
        """With the blobs of one ping more."""
        depth = d.view.range_max_m - d.view.range_min_m
        seen = d.view.bearing_rad
        width = float(np.ptp(seen)) + abs(d.view.beam_spacing_rad) if depth > 0.0 and seen.size else 0.0
        if not (depth > 0.0 and width > 0.0):
            depth, width = max(float(d.range_m.max(initial=0.0)), 1.0), 2.0 * np.pi
        pings = min(self.pings + 1, MEMORY)
        mean = self.mean + (len(d) / (depth * width) - self.mean) / pings
        return BlobDensity(max(mean, 1.0 / (MEMORY * depth * width)), pings)
