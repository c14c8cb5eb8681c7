"""Images of a harbour: what stands still, what drifts slowly, and the echoes of what swims."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import to_polar
from fls_flow.kernels import compiled, frozen
from fls_sources.scene_clutter import AmplitudeArray, Background, NumberFormat, quantized, speckle
from fls_sources.scene_image import Sonar

__all__ = ["Still", "blurred", "echo_power", "ping_image", "still_scene"]

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
Complex64Array = npt.NDArray[np.complex64]

PULSE_CELLS = 1.2  # -3 dB width of the pulse, in range cells
WALL_SPACING_M = 0.3
REACH_BEAMWIDTHS = 15.0  # beyond, side lobes are 20 dB below their first
SWAY = 0.05  # part by which the echo of a structure swells from ping to ping


@dataclass(frozen=True, eq=False)
class Still:
    """What stays as it is from ping to ping."""

    water: Background
    texture: Float32Array  # (n_ranges, n_beams): amplitude of the reverberation, about 1
    structure: Float32Array  # (n_ranges, n_beams): echo power of piles and a wall, in one look
    drift_db: float  # by which all levels swell and fall
    drift_period_s: FloatArray  # (3,)
    drift_phase: FloatArray  # (3,)

    def level(self, time_s: float) -> float:
        """The slow gain of all amplitudes at a time."""
        wave = np.sin(2.0 * np.pi * time_s / self.drift_period_s + self.drift_phase).sum() / 3.0
        return float(10.0 ** (self.drift_db * wave / 20.0))


def still_scene(
    sonar: Sonar,
    water: Background,
    *,
    texture_db: float,
    structures: int,
    structure_db: float,
    drift_db: float,
    rng: np.random.Generator,
) -> Still:
    """Texture with a correlation of some cells, piles at random places, a wall along a side, slow drift."""
    shape = (sonar.n_ranges, sonar.beams_rad.size)
    patch = blurred(rng.standard_normal(shape), 6, 2)
    texture = 10.0 ** (texture_db * patch / max(float(patch.std()), 1e-12) / 20.0)
    place = _piles(sonar, structures, rng)
    glint = rng.standard_exponential(len(place)) * 10.0 ** (structure_db / 10.0)
    return Still(
        water,
        texture.astype(np.float32),
        echo_power(sonar, place, glint, 1, rng),
        drift_db,
        rng.uniform(40.0, 240.0, 3),
        rng.uniform(0.0, 2.0 * np.pi, 3),
    )


def _piles(sonar: Sonar, structures: int, rng: np.random.Generator) -> FloatArray:
    """(n, 2) scatterers of single piles, and of one straight wall along a side of the sector."""
    reach = rng.uniform(sonar.range_min_m, sonar.range_max_m, structures)
    b = rng.uniform(-sonar.half_width_rad, sonar.half_width_rad, structures)
    piles = np.stack([reach * np.cos(b), reach * np.sin(b)], axis=1)
    if not structures:
        return piles
    side = 1.0 if rng.random() < 0.5 else -1.0
    edge = side * 0.95 * sonar.half_width_rad
    along = np.arange(0.55, 1.0, WALL_SPACING_M / sonar.range_max_m) * sonar.range_max_m
    wall = np.stack([along * np.cos(edge), along * np.sin(edge)], axis=1)
    return np.concatenate([piles, wall + 0.1 * rng.standard_normal(wall.shape)])


def blurred(image: FloatArray, rows: int, columns: int) -> FloatArray:
    """Running means over 2 `rows` + 1 and 2 `columns` + 1 cells; edges are repeated."""
    for axis, half in ((0, rows), (1, columns)):
        pad = [(half + 1, half) if k == axis else (0, 0) for k in (0, 1)]
        total = np.cumsum(np.pad(image, pad, mode="edge"), axis=axis)
        width = 2 * half + 1
        n = image.shape[axis]
        high, low = np.arange(width, width + n), np.arange(n)
        image = (np.take(total, high, axis) - np.take(total, low, axis)) / width
    return image


def echo_power(
    sonar: Sonar, position_m: FloatArray, power: FloatArray, looks: int, rng: np.random.Generator
) -> Float32Array:
    """The echo power (n_ranges, n_beams), summed over looks, of scatterers at (n, 2) with mean `power` (n,).

    In each look, the scatterers' fields add with phases of their own: sum_l |sum_k sqrt(p_k) exp(i phi_kl)
    h_k|^2, with h_k the response of a Gaussian pulse in range and of the beam pattern in bearing.
    """
    out = np.zeros((sonar.n_ranges, sonar.beams_rad.size), np.float32)
    if not power.size:
        return out
    distance, bearing = to_polar(position_m)
    row = (distance - sonar.range_min_m) / sonar.cell_m - 0.5
    phase = 2.0 * np.pi * rng.random((looks, power.size), dtype=np.float32)
    field = (np.sqrt(power, dtype=np.float32) * np.exp(1j * phase)).astype(np.complex64)
    first, last = _touched(row, out.shape[0])
    planes = np.zeros((looks, last - first, out.shape[1]), np.complex64)
    lobes = 10.0 ** (sonar.side_lobe_db / 20.0)
    beams, spacing = frozen(sonar.beams_rad), sonar.beam_spacing_rad
    _scatter(
        frozen(row - first),
        frozen(bearing),
        frozen(field),
        beams,
        spacing,
        sonar.beamwidth_rad,
        lobes,
        planes,
    )
    out[first:last] = (planes.real**2 + planes.imag**2).sum(axis=0)
    return out


def _touched(row: FloatArray, n_ranges: int) -> tuple[int, int]:
    """The first row that echoes reach, and the one after the last."""
    first, last = np.floor(row.min()) - 3, np.ceil(row.max()) + 4
    low = int(np.clip(first, 0, n_ranges))
    return low, int(np.clip(last, low, n_ranges))


@compiled
def _scatter(
    row: FloatArray,
    bearing: FloatArray,
    field: Complex64Array,
    beams: FloatArray,
    spacing: float,
    beamwidth: float,
    lobes: float,
    planes: Complex64Array,
) -> None:
    looks, n_ranges, n_beams = planes.shape
    pattern = np.empty(n_beams, np.float32)
    reach = int(np.ceil(REACH_BEAMWIDTHS * beamwidth / spacing))
    for k in range(row.size):
        middle = int(np.floor(row[k] + 0.5))
        if middle < -2 or middle > n_ranges + 1:
            continue
        at = int(np.floor((bearing[k] - beams[0]) / spacing + 0.5))
        left, right = max(at - reach, 0), min(at + reach + 1, n_beams)
        for j in range(left, right):
            u = abs(bearing[k] - beams[j]) / beamwidth
            response = lobes * 1.5 / max(u, 1.5)
            if u < 2.5:  # further off, the main lobe is below all side lobes
                response = max(response, np.exp2(-2.0 * u * u))
            pattern[j] = response
        for i in range(max(middle - 2, 0), min(middle + 3, n_ranges)):
            off = (i - row[k]) / PULSE_CELLS
            pulse = np.float32(np.exp2(-2.0 * off * off))
            for m in range(looks):
                echo = field[m, k] * pulse
                for j in range(left, right):
                    planes[m, i, j] += echo * pattern[j]


def ping_image(
    still: Still,
    echoes: Float32Array,
    time_s: float,
    looks: int,
    number_format: NumberFormat,
    rng: np.random.Generator,
) -> AmplitudeArray:
    """Amplitudes of reverberation, structures and `echoes` under the gains of ranges, beams and drift.

    The mean over L looks of |n_l + f_l|^2, n_l circular normal, depends on the fields f_l only by G =
    sum |f_l|^2: it is (|n + sqrt(G)|^2 + E_2 + ... + E_L) / L, the E_l exponential. Reverberation of another
    law than Rayleigh's has one look.
    """
    water = still.water
    first = speckle(water, None, rng)
    phase = rng.random(first.shape, dtype=np.float32)
    if water.law == "rayleigh":
        others = np.zeros_like(first)
        for _ in range(looks - 1):
            others += rng.standard_exponential(first.shape, dtype=np.float32)
        scale = 1.0 / looks
    else:
        others, scale = np.zeros_like(first), 1.0
        echoes = echoes / np.float32(looks)
    sway = float((1.0 + SWAY * rng.standard_normal()) ** 2 / scale)
    amplitude = np.empty_like(first)
    _combine(first, others, still.texture, phase, echoes, still.structure, sway, scale, amplitude)
    amplitude *= water.range_gain * np.float32(still.level(time_s))
    amplitude *= water.beam_gain
    return quantized(amplitude, water.law, number_format)


@compiled
def _combine(
    first: Float32Array,
    others: Float32Array,
    texture: Float32Array,
    phase: Float32Array,
    echoes: Float32Array,
    structure: Float32Array,
    sway: float,
    scale: float,
    out: Float32Array,
) -> None:
    turn = np.float32(2.0 * np.pi)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            square = texture[i, j] * texture[i, j]
            steady = echoes[i, j] + np.float32(sway) * structure[i, j]
            one = first[i, j] * square
            beat = np.float32(2.0) * np.sqrt(one * steady) * np.cos(turn * phase[i, j])
            # rounding may take the sum of two opposite phasors a hair below zero
            power = max(one + steady + beat, np.float32(0.0)) + others[i, j] * square
            out[i, j] = np.sqrt(power * np.float32(scale))
