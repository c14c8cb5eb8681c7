"""What divers breathe out: puffs of bubbles that stay behind, spread, drift and rise out of the beam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

__all__ = ["Circuit", "Puffs", "breathing"]

FloatArray = npt.NDArray[np.float64]
Circuit = Literal["open", "semi-closed", "closed"]

# clumps of bubbles per breath, echo power of one (gas of a scatterer's size is 1), breaths between two puffs
EXHALED: dict[Circuit, tuple[int, float, int]] = {
    "open": (14, 0.8, 1),
    "semi-closed": (3, 0.5, 3),
    "closed": (0, 0.0, 1),
}
RISE_MPS = 0.25
DIFFUSION_M2PS = 0.006  # of a clump by turbulence
BIRTH_SD_M = 0.2
LONGEST_S = 40.0


@dataclass(frozen=True, eq=False)
class Puffs:
    """The n clumps of bubbles that one diver lets go, in order of time."""

    release_s: FloatArray  # (n,)
    scatter: FloatArray  # (n, 2) where in its cloud each drifts, of variance 1
    power: FloatArray  # (n,)
    depth_m: float  # of the diver: bubbles are gone when they have risen so far

    def alive(self, time_s: float) -> slice:
        """Those that are in the water."""
        life = min(self.depth_m / RISE_MPS, LONGEST_S)
        first, last = np.searchsorted(self.release_s, [time_s - life, time_s], side="right")
        return slice(int(first), int(last))

    def at(
        self, time_s: float, origin_m: FloatArray, current_mps: FloatArray, vertical_rad: float, alive: slice
    ) -> tuple[FloatArray, FloatArray]:
        """Positions (k, 2) and powers (k,) of those `alive`, released at `origin_m` (k, 2).

        sd^2 = birth^2 + 2 D age about origin + current age; power 2^-(rise / h)^2, h the half-height of the
        vertical beam (`vertical_rad` at half power) at that range.
        """
        age = time_s - self.release_s[alive]
        sd = np.sqrt(BIRTH_SD_M**2 + 2.0 * DIFFUSION_M2PS * age)
        place = origin_m + age[:, None] * current_mps + sd[:, None] * self.scatter[alive]
        height = np.hypot(place[:, 0], place[:, 1]) * np.tan(0.5 * vertical_rad)
        return place, self.power[alive] * np.exp2(-np.square(RISE_MPS * age / height))


def breathing(circuit: Circuit, start_s: float, end_s: float, rng: np.random.Generator) -> Puffs:
    """The puffs of a diver from `start_s` to `end_s`: a breath every 3.5 to 6 s, exhaled in 1.5 to 2.5 s."""
    period, exhale, depth = rng.uniform(3.5, 6.0), rng.uniform(1.5, 2.5), float(rng.uniform(3.0, 8.0))
    clumps, power, every = EXHALED[circuit]
    first = rng.random()
    when, where, bright = rng.spawn(3)  # each drawn in the order of time: a longer stay begins alike
    breaths = start_s + period * (first + np.arange(0, np.ceil((end_s - start_s) / period), every))
    release = (breaths[:, None] + np.sort(when.random((breaths.size, clumps)), axis=1) * exhale).ravel()
    scatter, glint = where.standard_normal((release.size, 2)), bright.standard_exponential(release.size)
    kept = release <= end_s
    return Puffs(release[kept], scatter[kept], power * glint[kept], depth)
