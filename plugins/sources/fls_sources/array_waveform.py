"""The transmitted pulse of an active array: a linear chirp, at any time."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np
import numpy.typing as npt

__all__ = ["Chirp"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Chirp:
    """w(t) = g(t) cos 2 pi (f0 t + (f1 - f0) t^2 / 2T) for 0 <= t < T, else 0.

    g rises and falls as a cosine over `taper` / 2 of T at each end (Tukey); 0 is a rectangle.
    """

    start_hz: float = 31e3
    stop_hz: float = 41e3
    duration_s: float = 0.01
    taper: float = 0.0

    def __post_init__(self) -> None:
        for name in ("start_hz", "stop_hz", "duration_s"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}; it must be positive and finite")
        if not 0.0 <= self.taper <= 1.0:
            raise ValueError(f"taper is {self.taper}; it must be from 0 to 1")

    @property
    def centre_hz(self) -> float:
        """Middle of the band."""
        return 0.5 * (self.start_hz + self.stop_hz)

    @property
    def highest_hz(self) -> float:
        """The end of the band that lies higher."""
        return max(self.start_hz, self.stop_hz)

    def at(self, time_s: FloatArray) -> FloatArray:
        """The pulse's value at times since its onset."""
        slope = (self.stop_hz - self.start_hz) / self.duration_s
        phase = 2.0 * np.pi * time_s * (self.start_hz + 0.5 * slope * time_s)
        inside = (time_s >= 0.0) & (time_s < self.duration_s)
        value = np.where(inside, np.cos(phase), 0.0)
        if self.taper > 0.0:
            edge = np.minimum(time_s, self.duration_s - time_s) / (0.5 * self.taper * self.duration_s)
            value *= 0.5 - 0.5 * np.cos(np.pi * np.clip(edge, 0.0, 1.0))
        return value

    def samples(self, sample_rate_hz: float) -> FloatArray:
        """The pulse from its onset, at a sample rate."""
        n = int(np.ceil(self.duration_s * sample_rate_hz - 1e-9))
        return self.at(np.arange(n) / sample_rate_hz)
