"""The sea floor of a simulated scene: two sediments and their relief, fixed to the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Floor", "Patch", "floor"]

FloatArray = npt.NDArray[np.float64]

WAVES = 24
SEDIMENT_M = (12.0, 50.0)  # wavelengths of the border between the sediments
RELIEF_M = (1.5, 6.0)  # and of the relief
RELIEF_SD = 0.25  # of the logarithm of the power
BORDER = 8.0  # how sharp the border is
COVER = 0.4  # level of the wave field, in standard deviations, above which the second sediment lies


@dataclass(frozen=True, eq=False)
class Waves:
    """A random field: a sum of plane waves of equal height, with variance 1 over the world."""

    wavenumber: FloatArray  # (n, 2), rad/m
    phase_rad: FloatArray  # (n,)

    @classmethod
    def drawn(cls, wavelength_m: tuple[float, float], rng: np.random.Generator) -> Waves:
        """A field of wavelengths in this range, and of all directions."""
        direction = 2.0 * np.pi * rng.random(WAVES)
        k = 2.0 * np.pi / rng.uniform(*wavelength_m, WAVES)
        wavenumber = k[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        return cls(wavenumber, 2.0 * np.pi * rng.random(WAVES))

    def at(self, position_m: FloatArray) -> FloatArray:
        """The field at positions (..., 2)."""
        angle = position_m @ self.wavenumber.T + self.phase_rad
        field: FloatArray = np.sqrt(2.0 / WAVES) * np.cos(angle).sum(axis=-1)
        return field


@dataclass(frozen=True, slots=True)
class Patch:
    """A strip of bright sediment across the way, between two distances north."""

    south_m: float
    north_m: float


@dataclass(frozen=True, eq=False)
class Floor:
    """The power that the floor scatters back, against its dark sediment."""

    sediment: Waves
    relief: Waves
    bright_db: float
    patch: Patch | None = None

    def power(self, position_m: FloatArray) -> FloatArray:
        """Mean power at [north, east] (..., 2): 1 on dark sediment, more on bright, both with relief."""
        if self.patch is None:
            bright = 0.5 + 0.5 * np.tanh(BORDER * (self.sediment.at(position_m) - COVER))
        else:
            north = position_m[..., 0]
            bright = ((north >= self.patch.south_m) & (north < self.patch.north_m)).astype(float)
        relief = np.exp(RELIEF_SD * self.relief.at(position_m) - 0.5 * RELIEF_SD**2)
        power: FloatArray = relief * (1.0 + bright * (10.0 ** (self.bright_db / 10.0) - 1.0))
        return power


def floor(bright_db: float, patch: Patch | None, rng: np.random.Generator) -> Floor:
    """A random floor whose second sediment is `bright_db` brighter."""
    return Floor(Waves.drawn(SEDIMENT_M, rng), Waves.drawn(RELIEF_M, rng), bright_db, patch)
