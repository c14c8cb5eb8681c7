"""The water of a simulated image: gain with range, speckle of each law, beam pattern, number format."""

from __future__ import annotations

from dataclasses import dataclass
from math import gamma
from typing import Literal

import numpy as np
import numpy.typing as npt

__all__ = [
    "Background",
    "Law",
    "NumberFormat",
    "background",
    "beam_power",
    "mean_gain",
    "measured_scale",
    "noise_gain",
    "quantized",
    "speckle",
]

Law = Literal["rayleigh", "k", "measured"]
NumberFormat = Literal["float32", "uint8", "uint16"]
FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
AmplitudeArray = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]

TEXTURE_CELLS = 8  # range cells that share one value of the K law's texture
WEIBULL_SHAPE = 0.7  # of measured amplitudes: as whole numbers, with the beams' gains, mean/std is 0.61
BEAM_PATTERN_SD = 0.15  # of the logarithm of the fixed gain per beam, measured law
MEASURED_NEAR, MEASURED_FAR = 4.4, 1.5  # mean 8-bit amplitude at the first and the last range
# rms of the clutter where the gain is 1; below uint8's top there is room for an echo of 26 dB at any range
LEVEL: dict[NumberFormat, float] = {"float32": 100.0, "uint16": 400.0, "uint8": 8.0}


@dataclass(frozen=True, eq=False)
class Background:
    """What stays of the clutter from ping to ping: amplitude gains over range and over beams."""

    law: Law
    k_shape: float
    range_gain: Float32Array  # (n_ranges, 1): rms amplitude of the clutter
    beam_gain: Float32Array  # (n_beams,)


def background(
    law: Law,
    k_shape: float,
    number_format: NumberFormat,
    shape: tuple[int, int],
    rng: np.random.Generator,
) -> Background:
    """The fixed part of a clutter law for images of `shape` (n_ranges, n_beams).

    The measured law has the level of the recording that it follows, whatever the number format.
    """
    fraction = (np.arange(shape[0]) + 0.5) / shape[0]
    beams = np.ones(shape[1])
    if law == "measured":
        beams = np.exp(BEAM_PATTERN_SD * rng.standard_normal(shape[1]))
        beams /= beams.mean()
        mean = MEASURED_NEAR * (MEASURED_FAR / MEASURED_NEAR) ** fraction
        gain = measured_scale(mean) * np.sqrt(gamma(1.0 + 2.0 / WEIBULL_SHAPE))
    else:
        gain = LEVEL[number_format] * mean_gain(fraction)
    return Background(law, k_shape, gain[:, None].astype(np.float32), beams.astype(np.float32))


def mean_gain(fraction: FloatArray) -> FloatArray:
    """Amplitude gain left by a TVG that follows the reverberation, over the fraction of the full range.

    g^2 = 1 + exp(-f / 0.1) + 1.5 f^3: too little correction near by, amplified noise far out.
    """
    return np.sqrt(1.0 + np.exp(-fraction / 0.1) + 1.5 * fraction**3)


def noise_gain(fraction: FloatArray) -> FloatArray:
    """Power gain (2 f)^1.5 that the TVG gives to noise, over the fraction f of the full range."""
    return (2.0 * fraction) ** 1.5


def measured_scale(mean: FloatArray) -> FloatArray:
    """Scales of the Weibull law whose amplitudes, cut to whole numbers, have these means (0.05 to 15).

    E floor(x) = sum_{i >= 1} P(x >= i) = sum exp(-(i / scale)^shape).
    """
    scale = np.geomspace(0.05, 20.0, 400)
    floor_mean = np.exp(-((np.arange(1, 4000)[:, None] / scale) ** WEIBULL_SHAPE)).sum(axis=0)
    return np.interp(mean, floor_mean, scale)


def speckle(fixed: Background, extra: Float32Array | None, rng: np.random.Generator) -> Float32Array:
    """Intensity (n_ranges, n_beams) of one ping against the mean clutter, independent from cell to cell.

    Rayleigh: (1 + extra) E; K: (tau + extra) E with tau ~ Gamma(k_shape) / k_shape; measured: (1 + extra) W,
    W the square of a Weibull amplitude, mean 1; E ~ Exp(1). `extra` is the power of wakes and noise, or None.
    """
    shape = (fixed.range_gain.shape[0], fixed.beam_gain.size)
    intensity = rng.standard_exponential(shape, dtype=np.float32)
    if fixed.law == "k":
        texture = _texture(shape, fixed.k_shape, rng)
        intensity *= texture if extra is None else texture + extra
        return intensity
    if fixed.law == "measured":
        intensity **= np.float32(2.0 / WEIBULL_SHAPE)
        intensity *= np.float32(1.0 / gamma(1.0 + 2.0 / WEIBULL_SHAPE))
    if extra is not None:
        intensity *= 1.0 + extra
    return intensity


def _texture(shape: tuple[int, int], k_shape: float, rng: np.random.Generator) -> Float32Array:
    blocks = -(-shape[0] // TEXTURE_CELLS)
    tau = rng.standard_gamma(k_shape, (blocks, shape[1]), dtype=np.float32) / np.float32(k_shape)
    return np.repeat(tau, TEXTURE_CELLS, axis=0)[: shape[0]]


def beam_power(offset_rad: npt.ArrayLike, beamwidth_rad: float, side_lobe_db: float) -> FloatArray:
    """Power response of a beam, `offset_rad` off its axis; 1 on it.

    max(2^(-4 u^2), s (1.5 / max(u, 1.5))^2), u = |offset| / beamwidth: a Gaussian main lobe of the stated
    -3 dB width above the envelope of side lobes that begin at `side_lobe_db` and fall by 6 dB per doubling.
    """
    u = np.abs(np.asarray(offset_rad, float)) / beamwidth_rad
    lobes = 10.0 ** (side_lobe_db / 10.0) * (1.5 / np.maximum(u, 1.5)) ** 2
    power: FloatArray = np.maximum(np.exp2(-4.0 * u * u), lobes)
    return power


def quantized(amplitude: Float32Array, law: Law, number_format: NumberFormat) -> AmplitudeArray:
    """The amplitudes in the sonar's number format; measured ones are cut to whole numbers, others rounded."""
    if law == "measured":
        amplitude = np.floor(amplitude)
    if number_format == "float32":
        return amplitude
    if number_format == "uint8":
        return np.minimum(np.rint(amplitude), np.float32(255)).astype(np.uint8)
    return np.minimum(np.rint(amplitude), np.float32(65535)).astype(np.uint16)
