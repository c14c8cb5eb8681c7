"""What a beamformer works out once per geometry: bearings, cells, focus zones, delays; and its pings."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from math import isfinite
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from fls_beamformers.grid import Beams, CellGrid, arrival_delays_s, focus_zones
from fls_beamformers.messages import CompressedBlock
from fls_beamformers.pattern import main_lobe_width_rad
from fls_beamformers.steering import FineSamples, Steering, baseband
from fls_flow import InputError, Ping

__all__ = ["Layout", "Precision", "Settings"]

Precision = Literal["single", "double"]
FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex64] | npt.NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Settings:
    """Where a beamformer looks; names and meaning are those of its parameters."""

    range_min_m: float
    range_max_m: float
    oversampling: float
    range_step_m: float | None
    first_beam_deg: float
    sector_deg: float
    beam_spacing_deg: float
    focus: bool
    sound_speed_mps: float | None
    precision: Precision

    def __post_init__(self) -> None:
        if not (isfinite(self.range_min_m) and self.range_min_m >= 0.0):
            raise ValueError(f"range_min_m is {self.range_min_m}; it must be finite and 0 or more")
        if not (isfinite(self.range_max_m) and self.range_max_m > self.range_min_m):
            raise ValueError(f"range_max_m is {self.range_max_m}; it must be finite and beyond range_min_m")
        if not (isfinite(self.oversampling) and self.oversampling >= 1.0):
            raise ValueError(f"oversampling is {self.oversampling}; it must be finite and 1 or more")
        for name in ("range_step_m", "sound_speed_mps"):
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}; it must be positive and finite")
        if self.precision not in get_args(Precision):
            raise ValueError(f"precision is {self.precision!r}; it must be one of {get_args(Precision)}")
        self.beams()

    @classmethod
    def of(cls, beamformer: object) -> Settings:
        """Those of a node that has them all as parameters."""
        return cls(**{one.name: getattr(beamformer, one.name) for one in fields(cls)})

    def beams(self) -> Beams:
        """The bearings."""
        return Beams(self.first_beam_deg, self.sector_deg, self.beam_spacing_deg)

    def cell_rate_hz(self, bandwidth_hz: float, sound_speed_mps: float) -> float:
        """Range cells per second of two-way time."""
        if self.range_step_m is not None:
            return sound_speed_mps / (2.0 * self.range_step_m)
        return self.oversampling * bandwidth_hz


@dataclass(eq=False)
class Layout:
    """Tables for blocks of one geometry."""

    key: tuple[object, ...]
    bandwidth_hz: float
    bearing_rad: FloatArray
    range_m: FloatArray
    beamwidth_rad: float
    sound_speed_mps: float
    grid: CellGrid
    guard_s: float  # no delay is longer
    zone_start: npt.NDArray[np.int64]
    delay_s: FloatArray  # (n_zones, n_channels, n_beams)
    _steering: tuple[object, Steering] | None = field(default=None, init=False)

    @classmethod
    def known(cls, last: Layout | None, settings: Settings, block: CompressedBlock) -> Layout:
        """`last` if it fits the block, else the block's own; InputError for a block without geometry."""
        numbers = (block.sample_rate_hz, block.carrier_hz, block.bandwidth_hz, block.sound_speed_mps)
        key = (numbers, block.samples.shape, block.position_m.tobytes(), settings)
        if last is not None and last.key == key:
            return last
        _require(block)
        return cls._made(key, settings, block)

    @classmethod
    def _made(cls, key: tuple[object, ...], settings: Settings, block: CompressedBlock) -> Layout:
        speed = settings.sound_speed_mps or block.sound_speed_mps
        bearing_rad = settings.beams().bearing_rad
        aperture_m = float(np.linalg.norm(block.position_m, axis=1).max())
        guard_s = aperture_m / speed
        window_s = (2.0 * settings.range_min_m / speed, 2.0 * settings.range_max_m / speed)
        cell_rate_hz = settings.cell_rate_hz(block.bandwidth_hz, speed)
        n_samples = block.samples.shape[1]
        grid = CellGrid.of(
            n_samples, block.sample_rate_hz, block.bandwidth_hz, cell_rate_hz, window_s, guard_s
        )
        range_m = grid.time_s * (speed / 2.0)
        zone_start, focus_m = np.array([0, grid.count]), [None]
        if settings.focus:
            zone_start, found = focus_zones(range_m, aperture_m, speed / block.carrier_hz)
            focus_m = found.tolist()
        delays = [arrival_delays_s(block.position_m, bearing_rad, speed, focus) for focus in focus_m]
        width = main_lobe_width_rad(block.position_m, block.carrier_hz, speed)
        return cls(
            key,
            block.bandwidth_hz,
            bearing_rad,
            range_m,
            width,
            speed,
            grid,
            guard_s,
            zone_start,
            np.array(delays),
        )

    @property
    def cell_m(self) -> float:
        """Depth of a range cell."""
        return 0.5 * self.sound_speed_mps * self.grid.stride / self.grid.fine_rate_hz

    def baseband(self, block: CompressedBlock, precision: Precision) -> tuple[ComplexArray, float]:
        """The block's samples at the grid's fine rate, and the carrier that was taken away."""
        given = block.samples
        samples = given.astype(np.complex64) if precision == "single" else given.astype(np.complex128)
        return baseband(samples, block.sample_rate_hz, block.carrier_hz, self.grid)

    def steering(self, fine: FineSamples) -> Steering:
        """The steering of samples of this layout, in their precision."""
        key = fine.real.dtype, fine.carrier_hz
        if self._steering is None or self._steering[0] != key:
            self._steering = key, Steering.of(self.delay_s, self.zone_start, fine, self.grid)
        return self._steering[1]

    def ping(self, block: CompressedBlock, amplitude: npt.NDArray[np.float32]) -> Ping:
        """The polar image of a block."""
        return Ping(
            block.seq,
            block.stamp_ns,
            amplitude,
            self.range_m.copy(),
            self.bearing_rad.copy(),
            beamwidth_rad=self.beamwidth_rad,
            sound_speed_mps=self.sound_speed_mps,
            frequency_hz=block.carrier_hz,
            mount=block.mount,
            nav=block.nav,
        )


def _require(block: CompressedBlock) -> None:
    for name in ("sample_rate_hz", "carrier_hz", "bandwidth_hz", "sound_speed_mps"):
        value = getattr(block, name)
        if not (isfinite(value) and value > 0.0):
            raise InputError(f"block seq {block.seq}: {name} is {value}; give a positive number")
    if not np.isfinite(block.position_m).all():
        raise InputError(
            f"block seq {block.seq}: position_m has entries that are not finite; give them in metres"
        )
