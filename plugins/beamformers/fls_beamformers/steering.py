"""Delay and sum at baseband: all beams of all range cells from fine samples, in machine code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import fft

from fls_beamformers.grid import TAPS, CellGrid
from fls_flow.kernels import compiled

__all__ = ["FineSamples", "Steering", "baseband", "delay_and_sum", "fine_samples"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Real = npt.NDArray[np.float32] | FloatArray
ComplexArray = npt.NDArray[np.complex64] | npt.NDArray[np.complex128]
CHUNK = 256  # cells that are worked at once: a beam's share stays in the first cache


@dataclass(frozen=True, eq=False)
class FineSamples:
    """Baseband samples, every `stride`-th together: [channel, phase, cell], with `margin` cells before 0."""

    real: Real
    imag: Real
    margin: int
    carrier_hz: float  # that was taken away


@dataclass(frozen=True, eq=False)
class Steering:
    """What each beam takes from each channel, per focus zone."""

    zone_start: IntArray  # (n_zones + 1,) cells
    tap: IntArray  # (n_zones, n_beams, n_channels): fine sample of the first tap, for cell 0
    weight: Real  # (n_zones, n_beams, n_channels, TAPS)
    turn: Real  # (n_zones, n_beams, n_channels, 2): cos and sin of the carrier's phase, over n_channels

    @classmethod
    def of(cls, delay_s: FloatArray, zone_start: IntArray, fine: FineSamples, grid: CellGrid) -> Steering:
        """The steering for delays (n_zones, n_channels, n_beams)."""
        delay = np.ascontiguousarray(np.swapaxes(delay_s, 1, 2))
        at = delay * grid.fine_rate_hz
        tap = np.floor(at).astype(np.int64)
        phase = 2.0 * np.pi * fine.carrier_hz * delay
        turn = np.stack([np.cos(phase), np.sin(phase)], axis=-1) / delay.shape[2]
        weight = _cubic(at - tap)
        return cls(zone_start, tap - 1, _as(fine.real, weight), _as(fine.real, turn))


def _as(like: Real, values: FloatArray) -> Real:
    return values.astype(np.float32) if like.dtype == np.float32 else values


def _cubic(x: FloatArray) -> FloatArray:
    """Lagrange weights (..., 4) of the samples at -1, 0, 1, 2 for the value at x in [0, 1)."""
    return np.stack(
        [
            -x * (x - 1.0) * (x - 2.0) / 6.0,
            (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0,
            -(x + 1.0) * x * (x - 2.0) / 2.0,
            (x + 1.0) * x * (x - 1.0) / 6.0,
        ],
        axis=-1,
    )


def baseband(
    samples: ComplexArray, sample_rate_hz: float, carrier_hz: float, grid: CellGrid
) -> tuple[ComplexArray, float]:
    """The samples shifted to baseband and resampled at the grid's fine rate, exactly for their band.

    And the carrier that was taken away, Hz: the frequency of a bin.
    """
    n, m = grid.fft_length, grid.fine_length
    centre = round(carrier_hz / sample_rate_hz * n)
    half = min(n, m) // 2
    spectrum = fft.fft(samples, n)
    shifted = np.zeros((samples.shape[0], m), samples.dtype)
    shifted[:, :half] = np.take(spectrum, np.arange(centre, centre + half) % n, axis=1)
    shifted[:, m - half :] = np.take(spectrum, np.arange(centre - half, centre) % n, axis=1)
    fine = fft.ifft(shifted, overwrite_x=True) * samples.real.dtype.type(m / n)
    return fine, centre * sample_rate_hz / n


def fine_samples(fine: ComplexArray, carrier_hz: float, grid: CellGrid, guard_s: float) -> FineSamples:
    """Baseband samples in the order of the kernel."""
    phases = fine.reshape(fine.shape[0], -1, grid.stride).transpose(0, 2, 1)
    margin = 2 + int(np.ceil((guard_s * grid.fine_rate_hz + TAPS) / grid.stride))
    wanted = np.arange(grid.first - margin, grid.first + grid.count + margin) % phases.shape[2]
    kept = np.take(phases, wanted, axis=2)
    return FineSamples(np.ascontiguousarray(kept.real), np.ascontiguousarray(kept.imag), margin, carrier_hz)


def delay_and_sum(fine: FineSamples, steering: Steering, n_cells: int) -> npt.NDArray[np.float32]:
    """|b| (n_cells, n_beams): b(u, t) = (1 / M) sum_m y_m(t + tau_m(u)), Abu et al. 2024 (4)-(5)."""
    out = np.empty((n_cells, steering.tap.shape[1]), np.float32)
    tile = np.empty((out.shape[1], CHUNK), np.float32)
    scratch = np.empty((4, CHUNK), fine.real.dtype)
    _steer(
        fine.real,
        fine.imag,
        fine.margin,
        steering.zone_start,
        steering.tap,
        steering.weight,
        steering.turn,
        scratch,
        tile,
        out,
    )
    return out


@compiled
def _steer(
    real: Real,
    imag: Real,
    margin: int,
    zone_start: IntArray,
    tap: IntArray,
    weight: Real,
    turn: Real,
    scratch: Real,
    tile: npt.NDArray[np.float32],
    out: npt.NDArray[np.float32],
) -> None:
    """Fill `out` chunk by chunk: every beam of one chunk, then the tile turned over."""
    for zone in range(zone_start.size - 1):
        for begin in range(zone_start[zone], zone_start[zone + 1], CHUNK):
            n = min(CHUNK, zone_start[zone + 1] - begin)
            for beam in range(tap.shape[1]):
                _sum_channels(
                    real,
                    imag,
                    margin + begin,
                    tap[zone, beam],
                    weight[zone, beam],
                    turn[zone, beam],
                    n,
                    scratch,
                )
                _magnitude(scratch[0, :n], scratch[1, :n], tile[beam, :n])
            for cell in range(n):
                for beam in range(tap.shape[1]):
                    out[begin + cell, beam] = tile[beam, cell]


@compiled
def _sum_channels(
    real: Real, imag: Real, start: int, tap: IntArray, weight: Real, turn: Real, n: int, scratch: Real
) -> None:
    """Rows 0 and 1 of `scratch`: real and imaginary part of the beam's sum."""
    scratch[:2, :n] = 0
    for channel in range(tap.size):
        _interpolate_channel(real, imag, channel, start, tap[channel], weight[channel], n, scratch)
        _turn_and_add(scratch, turn[channel, 0], turn[channel, 1], n)


@compiled
def _interpolate_channel(
    real: Real, imag: Real, channel: int, start: int, tap: int, w: Real, n: int, scratch: Real
) -> None:
    """Rows 2 and 3 of `scratch`: real and imaginary part of a channel, delayed."""
    stride = real.shape[1]
    rows = (
        _row(tap, stride, start),
        _row(tap + 1, stride, start),
        _row(tap + 2, stride, start),
        _row(tap + 3, stride, start),
    )
    for part, plane in enumerate((real, imag)):
        _interpolate(
            plane[channel, rows[0][0], rows[0][1] : rows[0][1] + n],
            plane[channel, rows[1][0], rows[1][1] : rows[1][1] + n],
            plane[channel, rows[2][0], rows[2][1] : rows[2][1] + n],
            plane[channel, rows[3][0], rows[3][1] : rows[3][1] + n],
            w,
            scratch[2 + part, :n],
        )


@compiled
def _row(fine_sample: int, stride: int, start: int) -> tuple[int, int]:
    """Phase and first column of the samples that are `fine_sample` behind each cell."""
    return fine_sample % stride, start + fine_sample // stride


@compiled
def _interpolate(a: Real, b: Real, c: Real, d: Real, w: Real, into: Real) -> None:
    """Fill `into` with the weighted sums of four rows."""
    w0, w1, w2, w3 = w[0], w[1], w[2], w[3]
    for i in range(into.size):
        into[i] = (w0 * a[i] + w1 * b[i]) + (w2 * c[i] + w3 * d[i])


@compiled
def _turn_and_add(scratch: Real, c: float, s: float, n: int) -> None:
    """Rows 2 and 3, turned by the carrier's phase, come on top of rows 0 and 1."""
    for i in range(n):
        scratch[0, i] += c * scratch[2, i] - s * scratch[3, i]
        scratch[1, i] += c * scratch[3, i] + s * scratch[2, i]


@compiled
def _magnitude(real: Real, imag: Real, into: Real) -> None:
    """Fill `into` with the absolute values."""
    for i in range(into.size):
        into[i] = np.sqrt(real[i] * real[i] + imag[i] * imag[i])
