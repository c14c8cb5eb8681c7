"""Form beams all around: delay and sum of compressed channels, a polar image comes out."""

from __future__ import annotations

from dataclasses import dataclass, field

from fls_beamformers.layout import Layout, Precision, Settings
from fls_beamformers.messages import CompressedBlock
from fls_beamformers.steering import delay_and_sum, fine_samples
from fls_flow import Ping, hookimpl

__all__ = ["DelayAndSum"]


@dataclass
class DelayAndSum:
    """Polar images of |b|, b(u, t) = (1 / M) sum_m y_m(t + tau_m(u)): amplitudes of echoes, ranges by beams.

    Delays are exact for the band of the pulse: the carrier's phase, and cubic interpolation of the baseband
    at eight samples per 1/B, 65 dB below the echo. `focus` follows the curvature of echoes from near, in
    zones of range; without it waves are plane. Ranges are c t / 2 of times since the start of transmission:
    the projector counts as at the sensor's origin. Cells are c / (2 `oversampling` B) deep, B the pulse's
    equivalent bandwidth, or `range_step_m` (to 1 %): an echo between two cells loses 3.9 dB at an
    oversampling of 1, 0.9 dB at 2, 0.4 dB at 3. `sound_speed_mps` None: what the block says.

    Source: Abu et al. 2024 (2), (4), (5). Raises ValueError for bad parameters, InputError for blocks shorter
    than the range window, or of which the geometry is not known.
    """

    range_min_m: float = 10.0
    range_max_m: float = 500.0
    oversampling: float = 2.0
    range_step_m: float | None = None
    first_beam_deg: float = -179.0
    sector_deg: float = 360.0
    beam_spacing_deg: float = 1.0
    focus: bool = True
    sound_speed_mps: float | None = None
    precision: Precision = "single"
    _layout: Layout | None = field(default=None, init=False, repr=False)  # of the last block's geometry

    def __post_init__(self) -> None:
        Settings.of(self)

    def __call__(self, block: CompressedBlock) -> Ping:
        """The block's polar image."""
        if not block.samples.size:
            return Ping(block.seq, block.stamp_ns, mount=block.mount, nav=block.nav)
        layout = self._layout = Layout.known(self._layout, Settings.of(self), block)
        samples, carrier_hz = layout.baseband(block, self.precision)
        fine = fine_samples(samples, carrier_hz, layout.grid, layout.guard_s)
        amplitude = delay_and_sum(fine, layout.steering(fine), layout.grid.count)
        return layout.ping(block, amplitude)


@hookimpl
def fls_node() -> type[DelayAndSum]:
    """Return the node of kind `delay-and-sum`."""
    return DelayAndSum
