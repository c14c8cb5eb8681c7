"""Navigation samples as rows of numbers: interpolation to an instant, dead reckoning.

A row is [north, east, down, roll, pitch, yaw, their rates (3), velocity (3), altitude]; stamps are kept apart
as integers. What is not known is nan, column by column.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow import NavState
from fls_flow.geometry import rotation, wrap

__all__ = [
    "ALTITUDE",
    "ATTITUDE",
    "COLUMNS",
    "POSITION",
    "RATE",
    "VELOCITY",
    "interpolated",
    "reckoned",
    "row",
    "state",
    "velocity_ned",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

POSITION, ATTITUDE, RATE, VELOCITY, ALTITUDE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12
COLUMNS = 13


def row(nav: NavState) -> FloatArray:
    """The 13 numbers of a sample; what is not finite counts as not known."""
    values = np.array(
        [*nav.position_m, *nav.attitude_rad, *nav.attitude_rate_radps, *nav.velocity_mps, nav.altitude_m]
    )
    return np.where(np.isfinite(values), values, np.nan)


def state(seq: int, stamp_ns: int, values: FloatArray) -> NavState:
    """The sample with these 13 numbers."""
    v = [float(one) for one in values]
    return NavState(
        seq, stamp_ns, (v[0], v[1], v[2]), (v[3], v[4], v[5]), (v[6], v[7], v[8]), (v[9], v[10], v[11]), v[12]
    )


def interpolated(stamps_ns: IntArray, rows: FloatArray, stamp_ns: int, max_age_s: float) -> FloatArray:
    """The 13 numbers at an instant from rows (k, 13) with increasing stamps; nan where too old.

    Each column for itself: between the last known value before and the first at or after, angles by the
    shorter way; with one of them, that value, carried on by the rates, or by the velocity turned to NED.
    Values more than `max_age_s` from the instant do not count. Rates that nobody gives are the slope of the
    angles.
    """
    out, offset = np.full(COLUMNS, np.nan), np.zeros(COLUMNS)
    seconds = (stamps_ns - stamp_ns) * 1e-9
    near = np.abs(seconds) <= max_age_s
    rows, seconds = rows[near], seconds[near]
    for column in range(COLUMNS):
        known = np.isfinite(rows[:, column])
        out[column], offset[column] = _column(
            seconds[known], rows[known, column], ATTITUDE.start <= column < ATTITUDE.stop
        )
    slopes = _slopes(seconds, rows)
    out[RATE] = np.where(np.isfinite(out[RATE]), out[RATE], slopes)
    turned = np.nan_to_num(out[RATE]) * offset[ATTITUDE]
    out[ATTITUDE] = wrap(out[ATTITUDE] + turned)
    if offset[POSITION].any():
        out[POSITION] += np.nan_to_num(velocity_ned(out)) * offset[POSITION]
    return out


def _column(seconds: FloatArray, values: FloatArray, angle: bool) -> tuple[float, float]:
    """The value at time 0, and how long it must be carried on."""
    if not values.size:
        return float("nan"), 0.0
    after = int(np.searchsorted(seconds, 0.0))
    if after == values.size:
        return float(values[-1]), float(-seconds[-1])
    if after == 0 or seconds[after] == 0.0:
        return float(values[after]), float(-seconds[after])
    t0, t1 = seconds[after - 1], seconds[after]
    step = values[after] - values[after - 1]
    if angle:
        step = float(wrap(step))
    return float(values[after - 1] - t0 / (t1 - t0) * step), 0.0


def _slopes(seconds: FloatArray, rows: FloatArray) -> FloatArray:
    """Rates (3,) of the angles between the two known samples around time 0, or the two nearest."""
    out = np.full(3, np.nan)
    for n in range(3):
        angle = rows[:, ATTITUDE.start + n]
        known = np.flatnonzero(np.isfinite(angle))
        if known.size < 2:
            continue
        at = int(np.clip(np.searchsorted(seconds[known], 0.0), 1, known.size - 1))
        i, j = known[at - 1], known[at]
        out[n] = float(wrap(angle[j] - angle[i])) / (seconds[j] - seconds[i])
    return out


def velocity_ned(values: FloatArray) -> FloatArray:
    """Velocity (3,) in NED; roll, pitch and heave that are not known count as zero, nan without the rest."""
    roll, pitch, yaw = values[ATTITUDE]
    ahead, starboard, down = values[VELOCITY]
    attitude = (float(np.nan_to_num(roll)), float(np.nan_to_num(pitch)), float(yaw))
    if not np.isfinite([ahead, starboard, yaw]).all():
        return np.full(3, np.nan)
    moved: FloatArray = rotation(attitude) @ np.array([ahead, starboard, np.nan_to_num(down)])
    return moved


def reckoned(last_m: FloatArray, dt_s: float, mean_mps: FloatArray, now: FloatArray) -> FloatArray:
    """The place (3,) after `dt_s` at the mean velocity (3,), NED; it stays where that is not known.

    A depth that the sample `now` has measured is kept.
    """
    place = last_m + np.nan_to_num(mean_mps) * dt_s
    measured = now[POSITION.stop - 1]
    if np.isfinite(measured):
        place[2] = measured
    return place
