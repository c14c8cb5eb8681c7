"""Compress the echoes of a known pulse: the analytic matched filter of every channel."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from fls_beamformers.matched_filter import Replica, Taper, compressed
from fls_beamformers.messages import CompressedBlock
from fls_flow import HydrophoneBlock, InputError, hookimpl

__all__ = ["PulseCompression"]

Precision = Literal["single", "double"]
MIN_FFT = 1024


@dataclass
class PulseCompression:
    """Analytic matched-filter outputs, as many as there are samples; a whole echo peaks with its amplitude.

    `taper` weights the pulse in time: `hann` takes a chirp's range side lobes from -13 dB to below -30, for
    a main lobe 1.6 times as wide and 1.8 dB less gain against noise. Blocks whose transform would be longer
    than `max_fft` are worked in pieces. Samples that are not finite count as silence.

    Source: Abu et al. 2024, section IV-A; Turin 1960. Raises ValueError for bad parameters, InputError for a
    block without a usable waveform or sample rate.
    """

    taper: Taper = "none"
    precision: Precision = "single"
    max_fft: int = 1 << 18
    _replica: tuple[bytes, Replica] | None = field(default=None, init=False, repr=False)  # of the last pulse

    def __post_init__(self) -> None:
        for name, known in (("taper", Taper), ("precision", Precision)):
            if getattr(self, name) not in get_args(known):
                raise ValueError(f"{name} is {getattr(self, name)!r}; it must be one of {get_args(known)}")
        if self.max_fft < MIN_FFT:
            raise ValueError(f"max_fft is {self.max_fft}; it must be {MIN_FFT} or more")

    def __call__(self, block: HydrophoneBlock) -> CompressedBlock:
        """The block's channels, compressed."""
        if not block.samples.size:
            return CompressedBlock(block.seq, block.stamp_ns, mount=block.mount, nav=block.nav)
        replica = self._known(block)
        single = self.precision == "single"
        samples = block.samples.astype(np.float32) if single else block.samples.astype(np.float64)
        samples[~np.isfinite(samples)] = 0.0
        return CompressedBlock(
            block.seq,
            block.stamp_ns,
            compressed(samples, replica, self.max_fft),
            block.sample_rate_hz,
            replica.carrier_hz,
            replica.bandwidth_hz,
            block.position_m.copy(),
            block.sound_speed_mps,
            block.mount,
            block.nav,
        )

    def _known(self, block: HydrophoneBlock) -> Replica:
        key = np.float64(block.sample_rate_hz).tobytes() + block.waveform.tobytes()
        if self._replica is None or self._replica[0] != key:
            try:
                replica = Replica.of(block.waveform, block.sample_rate_hz, self.taper)
            except ValueError as error:
                raise InputError(f"block seq {block.seq}: {error}; give the pulse that was sent") from error
            self._replica = key, replica
        return self._replica[1]


@hookimpl
def fls_node() -> type[PulseCompression]:
    """Return the node of kind `pulse-compression`."""
    return PulseCompression
