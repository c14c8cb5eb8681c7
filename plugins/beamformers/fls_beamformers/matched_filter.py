"""The analytic matched filter: correlation with the transmitted pulse by FFT, block after block.

y[l] = sum_n x[n + l] conj(h[n]) / E, h the analytic pulse times a taper, E = sum_n w[n] conj(h[n]), so that
an echo a w[n - l0] gives y[l0] = a.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy import fft, signal

__all__ = ["Replica", "Taper", "compressed", "occupied_band"]

Taper = Literal["none", "hann", "hamming"]
FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex64] | npt.NDArray[np.complex128]
HILBERT_PADDING = 4  # lengths of the pulse: its Hilbert transform decays beside it


@dataclass(frozen=True, eq=False)
class Replica:
    """A pulse to correlate with: its analytic, tapered and scaled samples, and the band that it fills."""

    samples: npt.NDArray[np.complex128]  # (n_pulse,)
    carrier_hz: float
    bandwidth_hz: float

    @classmethod
    def of(cls, waveform: FloatArray, sample_rate_hz: float, taper: Taper = "none") -> Replica:
        """The replica of a real pulse; raises ValueError for one that is empty, silent or not finite."""
        if not (waveform.size and np.isfinite(waveform).all() and np.any(waveform)):
            raise ValueError(
                f"the waveform has {waveform.size} samples; it needs finite ones that are not all 0"
            )
        if not 0.0 < sample_rate_hz < np.inf:
            raise ValueError(f"sample_rate_hz is {sample_rate_hz}; it must be positive and finite")
        if taper not in get_args(Taper):
            raise ValueError(f"taper is {taper!r}; it must be one of {get_args(Taper)}")
        analytic = signal.hilbert(waveform, HILBERT_PADDING * waveform.size)[: waveform.size]
        if taper != "none":
            analytic = analytic * signal.get_window(taper, waveform.size, fftbins=False)
        carrier_hz, bandwidth_hz = occupied_band(analytic, sample_rate_hz)
        scale = np.vdot(analytic, waveform)  # sum of w conj(h)
        return cls(analytic / np.conj(scale), carrier_hz, bandwidth_hz)


def occupied_band(analytic: npt.NDArray[np.complex128], sample_rate_hz: float) -> tuple[float, float]:
    """Centre and equivalent width of a pulse's power spectrum P, Hz.

    Centre: sum f P / sum P over positive f. Width: (integral of P)^2 / integral of P^2, which is the width of
    a spectrum that is flat.
    """
    n = fft.next_fast_len(4 * analytic.size)
    power = np.abs(fft.fft(analytic, n)[: n // 2 + 1]) ** 2
    frequency = np.arange(power.size) * (sample_rate_hz / n)
    total = power.sum()
    width = total**2 / np.square(power).sum() * (sample_rate_hz / n)
    return float((frequency * power).sum() / total), float(width)


def compressed(
    samples: npt.NDArray[np.float32] | FloatArray, replica: Replica, max_fft: int = 1 << 18
) -> ComplexArray:
    """Matched-filter outputs (n_channels, n_samples), complex, in the precision of `samples`.

    One FFT where it is no longer than `max_fft`; beyond, pieces whose overlapping ends are added.
    """
    n_channels, n = samples.shape
    n_pulse = replica.samples.size
    dtype = np.complex64 if samples.dtype == np.float32 else np.complex128
    whole = fft.next_fast_len(n + n_pulse - 1)
    length = min(whole, fft.next_fast_len(max(max_fft, 2 * n_pulse)))
    step = n if length == whole else length - n_pulse + 1
    spectrum = np.conj(fft.fft(replica.samples, length)).astype(dtype)
    out = np.zeros((n_channels, n), dtype)
    for begin in range(0, n, step):
        piece = samples[:, begin : begin + step]
        lagged = fft.ifft(fft.fft(piece, length) * spectrum, overwrite_x=True)
        _add(out, lagged[:, : piece.shape[1]], begin)
        _add(out, lagged[:, length - n_pulse + 1 :], begin - n_pulse + 1)  # negative lags: echoes from before
    return out


def _add(out: ComplexArray, values: ComplexArray, begin: int) -> None:
    """Add `values` at column `begin` of `out`, but for what lies outside."""
    first, last = max(begin, 0), min(begin + values.shape[1], out.shape[1])
    if last > first:
        out[:, first:last] += values[:, first - begin : last - begin]
