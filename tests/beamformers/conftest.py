"""Echoes of a chirp at four hydrophones, worked out sample by sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from fls_flow import HydrophoneBlock

FLOATER = np.array([[-0.385, 0.0, 0.0], [0.0, 0.395, 0.0], [0.405, 0.0, 0.0], [0.0, -0.405, 0.0]])
Echo = tuple[float, float, float]  # range m, bearing deg, amplitude


@dataclass
class Sea:
    """Makes blocks by the textbook: x_m(t) = sum a w(t - 2 r / c - tau_m)."""

    sample_rate_hz: float = 96e3
    start_hz: float = 31e3
    stop_hz: float = 41e3
    duration_s: float = 0.01
    c: float = 1520.0
    length_m: float = 100.0

    def pulse(self, time_s: np.ndarray) -> np.ndarray:
        slope = (self.stop_hz - self.start_hz) / self.duration_s
        inside = (time_s >= 0.0) & (time_s < self.duration_s)
        return inside * np.cos(2.0 * np.pi * (self.start_hz * time_s + 0.5 * slope * time_s**2))

    @property
    def waveform(self) -> np.ndarray:
        return self.pulse(np.arange(round(self.duration_s * self.sample_rate_hz)) / self.sample_rate_hz)

    @property
    def n_samples(self) -> int:
        return int(np.ceil(2.0 * self.length_m * self.sample_rate_hz / self.c))

    def samples(
        self, echoes: list[Echo], position: np.ndarray = FLOATER, *, near: bool = False
    ) -> np.ndarray:
        time_s = np.arange(self.n_samples) / self.sample_rate_hz
        x = np.zeros((len(position), time_s.size))
        for r, bearing_deg, amplitude in echoes:
            u = np.array([np.cos(np.deg2rad(bearing_deg)), np.sin(np.deg2rad(bearing_deg)), 0.0])
            for m, p in enumerate(position):
                path = r + (np.linalg.norm(r * u - p) if near else r - p @ u)
                x[m] += amplitude * self.pulse(time_s - path / self.c)
        return x

    def block(
        self, echoes: list[Echo], position: np.ndarray = FLOATER, *, near: bool = False, seq: int = 0
    ) -> HydrophoneBlock:
        x = self.samples(echoes, position, near=near).astype(np.float32)
        return HydrophoneBlock(seq, 10**9 * seq, x, self.sample_rate_hz, position, self.waveform, self.c)


@pytest.fixture
def sea() -> Sea:
    return Sea()


@pytest.fixture
def make_sea() -> Callable[..., Sea]:
    return Sea
