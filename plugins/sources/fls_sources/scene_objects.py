"""The things in a simulated scene: what they are, where their scatterers lie, the echo field they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_sources.scene_clutter import beam_power
from fls_sources.scene_motion import TimedPath
from fls_sources.scene_wake import WakeLaw

__all__ = ["Scatterers", "SceneObject", "echo_field", "scatterers"]

FloatArray = npt.NDArray[np.float64]
Complex64Array = npt.NDArray[np.complex64]
IntArray = npt.NDArray[np.int64]

SCATTERERS_PER_M = 40.0  # about two per range cell of 0.05 m
MOST_SCATTERERS = 400


@dataclass(frozen=True, eq=False)
class SceneObject:
    """One thing at the sea surface: an ellipse of scatterers along a path."""

    target_id: int
    class_name: str
    path: TimedPath
    length_m: float = 0.0  # along its motion; 0: a point
    width_m: float = 0.0
    snr_db: float = 25.0  # mean echo power per cell against the clutter, for a thing narrower than the beam
    coherence: float = 0.5  # part of a scatterer's power that does not fluctuate: 0 Rayleigh, 1 steady
    wake: WakeLaw | None = None
    noise_db: float | None = None  # power of its self-noise in its beam at half of the full range


@dataclass(frozen=True, eq=False)
class Scatterers:
    """The n scatterers of all things together."""

    owner: IntArray  # (n,): index of the thing
    offset_m: FloatArray  # (n, 2): ahead and to starboard of its centre
    power: FloatArray  # (n,): mean, against the clutter
    coherence: FloatArray  # (n,)
    size_m: FloatArray  # (n,): of the owner

    def place(self, position_m: FloatArray, velocity_mps: FloatArray) -> FloatArray:
        """NED positions (n, 2) for owners at `position_m` (k, 2) that head where they go."""
        heading = np.arctan2(velocity_mps[:, 1], velocity_mps[:, 0])[self.owner]
        c, s = np.cos(heading), np.sin(heading)
        ahead, starboard = self.offset_m.T
        turned = np.stack([c * ahead - s * starboard, s * ahead + c * starboard], axis=-1)
        placed: FloatArray = position_m[self.owner] + turned
        return placed


def scatterers(things: Sequence[SceneObject], cell_m: float, rng: np.random.Generator) -> Scatterers:
    """Scatterers spread evenly over each thing's ellipse, with exponential powers (glints).

    The powers of one thing add up to its SNR times the range cells in its size, sqrt(length width).
    """
    owner, offset, power, coherence, size = [], [], [], [], []
    for k, thing in enumerate(things):
        extent = float(np.sqrt(thing.length_m * thing.width_m))
        n = int(np.clip(np.ceil(extent * SCATTERERS_PER_M), 1, MOST_SCATTERERS))
        radius, angle = 0.5 * np.sqrt(rng.random(n)), 2.0 * np.pi * rng.random(n)
        axes = np.array([thing.length_m, thing.width_m])
        glint = rng.standard_exponential(n)
        owner.append(np.full(n, k))
        offset.append((radius * np.stack([np.cos(angle), np.sin(angle)])).T * axes)
        power.append(glint / glint.sum() * 10.0 ** (thing.snr_db / 10.0) * max(1.0, extent / cell_m))
        coherence.append(np.full(n, thing.coherence))
        size.append(np.full(n, extent))
    if not owner:
        return Scatterers(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0))
    return Scatterers(
        np.concatenate(owner),
        np.concatenate(offset),
        np.concatenate(power),
        np.concatenate(coherence),
        np.concatenate(size),
    )


def echo_field(
    row: IntArray,
    bearing_rad: FloatArray,
    power: FloatArray,
    coherence: FloatArray,
    beams_rad: FloatArray,
    beamwidth_rad: float,
    side_lobe_db: float,
    rng: np.random.Generator,
) -> tuple[IntArray, Complex64Array]:
    """The rows (r,) that echoes touch, increasing, and their complex field (r, n_beams); clutter rms is 1.

    Each scatterer has the field sqrt(power) (sqrt(coherence) + sqrt(1 - coherence) z) exp(i phase) in all
    beams alike, weighted by the beam pattern's amplitude; z ~ CN(0, 1) and the phase are new in every ping.
    """
    n = row.size
    if n == 0:
        return row, np.zeros((0, beams_rad.size), np.complex64)
    phase = np.exp(2j * np.pi * rng.random(n))
    z = (rng.standard_normal(n) + 1j * rng.standard_normal(n)) * np.sqrt(0.5)
    field = np.sqrt(power) * (np.sqrt(coherence) + np.sqrt(1.0 - coherence) * z) * phase
    order = np.argsort(row, kind="stable")
    touched, start = np.unique(row[order], return_index=True)
    lobe = np.sqrt(beam_power(bearing_rad[order, None] - beams_rad, beamwidth_rad, side_lobe_db))
    spread = field[order, None].astype(np.complex64) * lobe.astype(np.float32)
    return touched, np.add.reduceat(spread, start, axis=0)
