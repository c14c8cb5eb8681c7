"""Minimum-variance beams in narrow bands: each passes its own direction and as little else as it can."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["minimum_variance", "phases", "smoothed_covariance"]

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex64] | npt.NDArray[np.complex128]


def phases(frequency_hz: FloatArray, delay_s: FloatArray) -> npt.NDArray[np.complex128]:
    """exp(j 2 pi f tau), which takes delays away: (n_bins, n_channels, n_beams)."""
    return np.asarray(np.exp(2j * np.pi * frequency_hz[:, None, None] * delay_s))


def smoothed_covariance(
    frames: ComplexArray, bins_each: int, half_frames: int, loading: float
) -> npt.NDArray[np.complex128]:
    """Loaded covariances R (n_bands, n_frames, M, M) of spectra (n_bins, n_frames, M).

    R is the sum of y y^H over `bins_each` neighbouring bins and over `half_frames` frames before and after,
    with `loading` times its trace added to its diagonal; the unit matrix where all is silent.
    """
    n_bins, n_frames, n_channels = frames.shape
    starts = np.arange(0, n_bins, bins_each)
    y = frames.astype(np.complex128)
    products = np.add.reduceat(y[..., :, None] * np.conj(y[..., None, :]), starts, axis=0)
    padded = np.pad(np.cumsum(products, axis=1), ((0, 0), (1, 0), (0, 0), (0, 0)))
    at = np.arange(n_frames)
    last, first = np.minimum(at + half_frames + 1, n_frames), np.maximum(at - half_frames, 0)
    R = padded[:, last] - padded[:, first]
    trace = np.einsum("...ii->...", R).real
    # Differences of running sums leave rounding where nothing is heard: no more than that counts as silence.
    silent = trace <= 1e-12 * trace.max(initial=0.0)
    R[silent] = 0.0
    added = np.where(silent, 1.0, loading * trace)
    return np.asarray(R + added[..., None, None] * np.eye(n_channels))


def minimum_variance(
    frames: ComplexArray, covariance: npt.NDArray[np.complex128], bins_each: int, steering: ComplexArray
) -> ComplexArray:
    """Beams (n_bins, n_frames, n_beams): a^H R^-1 y / (a^H R^-1 a), of spectra y (n_bins, n_frames, M).

    `steering` is conj(a) = exp(j 2 pi f tau), (n_bins, M, n_beams). Source: Capon 1969.
    """
    n_channels = frames.shape[2]
    inverse = np.linalg.inv(covariance)
    out = np.empty((*frames.shape[:2], steering.shape[2]), frames.dtype)
    upper = np.triu_indices(n_channels, 1)
    for number in range(len(frames)):
        inverted = inverse[number // bins_each]
        turn = steering[number]
        weighed = np.matmul(inverted, frames[number, :, :, None])[..., 0]
        # a^H R^-1 a of a Hermitian matrix is real: its trace, and twice the real part of what lies above
        cross = turn[upper[0]] * np.conj(turn[upper[1]])
        above = inverted[:, upper[0], upper[1]]
        power = np.einsum("tii->t", inverted).real[:, None] + 2.0 * (
            above.real @ cross.real - above.imag @ cross.imag
        )
        out[number] = (weighed @ turn) / power
    return out
