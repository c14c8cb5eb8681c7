"""A simulated AUV on a smooth, manoeuvring path, with its motion in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow import NavState
from fls_flow.geometry import rotation
from fls_flow.messages import Vector

__all__ = ["Instant", "Swing", "Vehicle"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Swing:
    """offset + amplitude sin(2 pi t / period + phase)."""

    amplitude: float = 0.0
    period_s: float = 10.0
    phase_rad: float = 0.0
    offset: float = 0.0

    def at(self, time_s: float) -> tuple[float, float, float]:
        """The value and its first and second derivative by time."""
        w = 2.0 * np.pi / self.period_s
        s, c = np.sin(w * time_s + self.phase_rad), np.cos(w * time_s + self.phase_rad)
        a = self.amplitude
        return float(self.offset + a * s), float(a * w * c), float(-a * w * w * s)


@dataclass(frozen=True, slots=True)
class Instant:
    """Place, attitude and motion at one time."""

    position_m: FloatArray  # (3,) NED
    velocity_mps: FloatArray  # (3,) NED
    attitude_rad: Vector
    attitude_rate_radps: Vector

    @property
    def R(self) -> FloatArray:  # noqa: N802  # the books' letter
        """Body to NED, (3, 3)."""
        return rotation(self.attitude_rad)

    def nav(self, seq: int, stamp_ns: int, altitude_m: float) -> NavState:
        """The same as a navigation sample without errors."""
        body = self.R.T @ self.velocity_mps
        return NavState(
            seq,
            stamp_ns,
            _vector(self.position_m),
            self.attitude_rad,
            self.attitude_rate_radps,
            _vector(body),
            altitude_m,
        )


@dataclass(frozen=True, slots=True)
class Vehicle:
    """An AUV that makes way to the north and sways, heading along its path but for the crab angle.

    north(t) = speed t + surge(t), east(t) = sway(t), down(t) = heave(t);
    yaw = atan2(east', north') + crab(t).
    """

    speed_mps: float
    surge: Swing = Swing()
    sway: Swing = Swing()
    heave: Swing = Swing()
    crab: Swing = Swing()
    pitch: Swing = Swing()
    roll: Swing = Swing()

    def at(self, time_s: float) -> Instant:
        """The vehicle `time_s` after the start."""
        (n, dn, ddn), (e, de, dde) = self.surge.at(time_s), self.sway.at(time_s)
        (d, dd, _), (crab, dcrab, _) = self.heave.at(time_s), self.crab.at(time_s)
        (pitch, dpitch, _), (roll, droll, _) = self.pitch.at(time_s), self.roll.at(time_s)
        n, dn = n + self.speed_mps * time_s, dn + self.speed_mps
        course = float(np.arctan2(de, dn))
        dcourse = (dn * dde - de * ddn) / (dn * dn + de * de)
        return Instant(
            np.array([n, e, d]),
            np.array([dn, de, dd]),
            (roll, pitch, course + crab),
            (droll, dpitch, dcourse + dcrab),
        )


def _vector(values: FloatArray) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
