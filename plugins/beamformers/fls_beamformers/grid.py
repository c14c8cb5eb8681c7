"""Where beams look and when their echoes arrive: bearings, range cells, focus zones and delays."""

from __future__ import annotations

from dataclasses import dataclass, fields
from fractions import Fraction
from math import ceil, floor, gcd, isfinite

import numpy as np
import numpy.typing as npt
from scipy import fft

from fls_flow import InputError

__all__ = ["TAPS", "Beams", "CellGrid", "arrival_delays_s", "beam_directions", "focus_zones"]

FloatArray = npt.NDArray[np.float64]
FULL_TURN_DEG = 360.0
MAX_DENOMINATOR = 64  # of the resampling ratio: keeps transforms fast, moves the cell by less than 1 %
FINE_RATE = 8.0  # fine samples per 1 / bandwidth: cubic interpolation is then 65 dB below the echo
TAPS = 4
FOCUS_ERROR = 1 / 32  # of a wavelength, at the ends of a focus zone


@dataclass(frozen=True, slots=True)
class Beams:
    """Evenly spaced bearings from `first_deg` over `sector_deg`; a full turn leaves out its last."""

    first_deg: float
    sector_deg: float
    spacing_deg: float

    def __post_init__(self) -> None:
        for one in fields(self):
            if not isfinite(getattr(self, one.name)):
                raise ValueError(f"{one.name} is {getattr(self, one.name)}; it must be finite")
        if not 0.0 < self.sector_deg <= FULL_TURN_DEG:
            raise ValueError(f"sector_deg is {self.sector_deg}; it must be positive and at most 360")
        if not 0.0 < self.spacing_deg <= self.sector_deg:
            raise ValueError(
                f"beam_spacing_deg is {self.spacing_deg}; it must be positive, within the sector"
            )
        last = self.first_deg + (self.count - 1) * self.spacing_deg
        if self.first_deg < -180.0 - 1e-9 or last > 180.0 + 1e-9:
            raise ValueError(
                f"first_beam_deg is {self.first_deg}: beams reach from there to {last}; "
                "they must lie from -180 to 180"
            )

    @property
    def count(self) -> int:
        """How many bearings there are."""
        steps = self.sector_deg / self.spacing_deg
        return round(steps) if self.sector_deg == FULL_TURN_DEG else floor(steps + 1e-9) + 1

    @property
    def bearing_rad(self) -> FloatArray:
        """The bearings, increasing."""
        degrees = self.first_deg + self.spacing_deg * np.arange(self.count)
        return np.asarray(np.clip(np.deg2rad(degrees), -np.pi, np.pi))


@dataclass(frozen=True, slots=True)
class CellGrid:
    """How compressed samples become range cells: fine samples, of which every `stride` is a cell."""

    fft_length: int  # of the compressed samples, zeros behind them
    fine_length: int
    fine_rate_hz: float
    stride: int  # fine samples per cell
    first: int  # cell numbers count from the start of transmission
    count: int

    @classmethod
    def of(
        cls,
        n_samples: int,
        sample_rate_hz: float,
        bandwidth_hz: float,
        cell_rate_hz: float,
        window_s: tuple[float, float],
        guard_s: float,
    ) -> CellGrid:
        """Cells at about `cell_rate_hz` that lie in a window of two-way times and in the block.

        The rate is the nearest for which fine and given samples stand in a ratio of small integers. `guard_s`
        bounds the delays of the hydrophones. Raises InputError when no cell is left.
        """
        stride = max(1, ceil(FINE_RATE * bandwidth_hz / cell_rate_hz))
        ratio = Fraction(stride * cell_rate_hz / sample_rate_hz).limit_denominator(MAX_DENOMINATOR)
        ratio = max(ratio, Fraction(1, MAX_DENOMINATOR))
        multiple = ratio.denominator * stride // gcd(ratio.numerator, stride)
        silence = 2 * ceil(guard_s * sample_rate_hz) + 4 * TAPS * ceil(1 / ratio)
        fft_length = multiple * fft.next_fast_len(ceil((n_samples + silence) / multiple))
        fine_length = fft_length * ratio.numerator // ratio.denominator
        fine_rate_hz = sample_rate_hz * float(ratio)
        cell_s = stride / fine_rate_hz
        first = max(0, ceil(window_s[0] / cell_s - 1e-9))
        last = floor(min(window_s[1], (n_samples - 1) / sample_rate_hz) / cell_s + 1e-9)
        if last < first:
            raise InputError(
                f"the block ends after {n_samples / sample_rate_hz:g} s, the range window begins at "
                f"{window_s[0]:g} s; lower range_min_m or record longer"
            )
        return cls(fft_length, fine_length, fine_rate_hz, stride, first, last - first + 1)

    @property
    def time_s(self) -> FloatArray:
        """Two-way times of the cells."""
        return np.asarray((self.first + np.arange(self.count)) * (self.stride / self.fine_rate_hz), float)


def beam_directions(bearing_rad: FloatArray) -> FloatArray:
    """Unit vectors (n_beams, 3) from the array towards each bearing, in the sensor's plane."""
    return np.stack([np.cos(bearing_rad), np.sin(bearing_rad), np.zeros_like(bearing_rad)], axis=-1)


def arrival_delays_s(
    position_m: FloatArray, bearing_rad: FloatArray, sound_speed_mps: float, focus_m: float | None = None
) -> FloatArray:
    """How much later than at the origin each hydrophone hears each bearing, s, (n_channels, n_beams).

    tau = -p.u / c for plane waves (Abu et al. 2024 (2), u pointing to the target: a nearer hydrophone hears
    earlier); (|r u - p| - r) / c from a point at `focus_m`.
    """
    u = beam_directions(bearing_rad)
    if focus_m is None:
        return -(position_m @ u.T) / sound_speed_mps
    path = np.linalg.norm(focus_m * u[None] - position_m[:, None], axis=-1)
    return np.asarray((path - focus_m) / sound_speed_mps)


def focus_zones(
    range_m: FloatArray, aperture_m: float, wavelength_m: float
) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Zones of range in which one focus does: their first cells (n_zones + 1,) and focus ranges (n_zones,).

    The path to a hydrophone at distance a differs from a plane wave's by up to a^2 / 2r, so zones are even in
    1/r, and the path is in error by at most 1/32 wavelength at their ends.
    """
    near = max(float(range_m[0]), aperture_m, float(np.finfo(float).tiny))
    far = max(float(range_m[-1]), near)
    span = 0.5 * aperture_m**2 * (1.0 / near - 1.0 / far)
    n_zones = min(1 + int(span / (2.0 * FOCUS_ERROR * wavelength_m)), range_m.size)
    inverse = np.linspace(1.0 / near, 1.0 / far, n_zones + 1)
    edges = np.searchsorted(range_m, 1.0 / inverse[1:-1])
    starts = np.concatenate([[0], edges, [range_m.size]]).astype(np.int64)
    return starts, 2.0 / (inverse[:-1] + inverse[1:])
