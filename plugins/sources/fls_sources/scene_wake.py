"""The turbulent wakes of a simulated scene: bubbles that stay where a boat left them, widen and fade."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_sources.scene_clutter import beam_power
from fls_sources.scene_motion import TimedPath

__all__ = ["Bubbles", "WakeLaw", "bubbles", "wake_patch"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
N_BUBBLES = 6000  # patches of bubbles alive in one wake: bounds memory and time


@dataclass(frozen=True, slots=True)
class WakeLaw:
    """How a wake begins, widens and fades."""

    snr_db: float = 23.0  # power of the fresh wake against the clutter
    half_width_m: float = 0.5  # at the boat
    widening_mps: float = 0.004  # growth of the half width with age
    decay_s: float = 90.0  # power falls as exp(-age / decay)
    life_s: float = 120.0
    start_s: float = 0.0  # nothing was laid before


@dataclass(frozen=True, eq=False)
class Bubbles:
    """The random numbers of one wake, a ring that outlives each patch: side (-1 to 1) and power (mean 1)."""

    law: WakeLaw
    side: FloatArray
    strength: FloatArray

    def alive(self, path: TimedPath, time_s: float) -> tuple[FloatArray, FloatArray]:
        """NED positions (n, 2) of the patches at `time_s`, and the area that each scatters like, m^2.

        A patch is laid every life / N seconds at the boat, at `side` of the half width; it drifts outwards as
        the wake widens. Area = speed 2 half_width dt snr strength exp(-age / decay).
        """
        step = self.law.life_s / self.side.size
        last = int(np.floor(time_s / step))
        first = max(last - self.side.size + 1, int(np.ceil(self.law.start_s / step)))
        index = np.arange(first, last + 1)
        slot, laid_s = index % self.side.size, index * step
        age = time_s - laid_s
        position, velocity = path.at(laid_s)
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        across = np.stack([-velocity[:, 1], velocity[:, 0]], axis=-1) / np.maximum(speed, 1e-9)[:, None]
        offset = self.side[slot] * (self.law.half_width_m + self.law.widening_mps * age)
        area = speed * (2.0 * self.law.half_width_m * step * 10.0 ** (self.law.snr_db / 10.0))
        return position + across * offset[:, None], area * self.strength[slot] * np.exp(
            -age / self.law.decay_s
        )


def bubbles(law: WakeLaw, rng: np.random.Generator) -> Bubbles:
    """The bubbles of a wake: normal across it (sd 0.5, cut off at 1), exponential in power."""
    side = np.clip(0.5 * rng.standard_normal(N_BUBBLES), -1.0, 1.0)
    return Bubbles(law, side, rng.standard_exponential(N_BUBBLES))


def wake_patch(
    range_m: FloatArray,
    bearing_rad: FloatArray,
    area_m2: FloatArray,
    *,
    range_min_m: float,
    cell_m: float,
    n_ranges: int,
    beams_rad: FloatArray,
    spacing_rad: float,
    beamwidth_rad: float,
) -> tuple[slice, FloatArray]:
    """The rows that wakes touch, and their mean power (rows, n_beams) against the clutter.

    Power of a patch in a cell = area / (cell range 1.064 beamwidth) times the main lobe of the beam pattern
    (1.064: integral of the lobe in beamwidths), cut off 1.5 beamwidths out: side lobes of wakes are left out.
    Beams are `spacing_rad` apart.
    """
    reach = int(np.ceil(1.5 * beamwidth_rad / spacing_rad))
    row = np.floor((range_m - range_min_m) / cell_m).astype(np.int64)
    column = np.rint((bearing_rad - beams_rad[0]) / spacing_rad).astype(np.int64)
    seen = (row >= 0) & (row < n_ranges) & (column >= -reach) & (column < beams_rad.size + reach)
    if not seen.any():
        return slice(0, 0), np.zeros((0, beams_rad.size))
    row, column, bearing = row[seen], column[seen], bearing_rad[seen]
    away = np.maximum(range_m[seen], cell_m)  # the first cell holds no smaller area
    density = area_m2[seen] / (cell_m * away * 1.064 * beamwidth_rad)
    columns, inside = _columns(column, reach, beams_rad.size)
    lobe = beam_power(bearing[:, None] - (beams_rad[0] + columns * spacing_rad), beamwidth_rad, -np.inf)
    first, last = int(row.min()), int(row.max()) + 1
    flat = ((row - first)[:, None] * beams_rad.size + columns)[inside]
    power = np.bincount(flat, (density[:, None] * lobe)[inside], (last - first) * beams_rad.size)
    return slice(first, last), power.reshape(-1, beams_rad.size).astype(float)


def _columns(column: IntArray, reach: int, n_beams: int) -> tuple[IntArray, npt.NDArray[np.bool_]]:
    """The columns within `reach` of each of `column` (n, m), and which of them to use."""
    if 2 * reach + 1 >= n_beams:
        columns = np.broadcast_to(np.arange(n_beams), (column.size, n_beams))
        return columns, np.abs(columns - column[:, None]) <= reach
    columns = column[:, None] + np.arange(-reach, reach + 1)
    return columns, (columns >= 0) & (columns < n_beams)
