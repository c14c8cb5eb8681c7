"""Form adaptive beams all around: minimum variance (Capon) in place of delay and sum."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite

import numpy as np
import numpy.typing as npt

from fls_beamformers.frames import FramePlan, band_frames, cells_of_frames
from fls_beamformers.layout import Layout, Precision, Settings
from fls_beamformers.messages import CompressedBlock
from fls_beamformers.mvdr import minimum_variance, phases, smoothed_covariance
from fls_flow import Ping, hookimpl

__all__ = ["Capon"]

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex64] | npt.NDArray[np.complex128]
BINS_EACH = 2  # that share a covariance: over more, sound from elsewhere loses its phase between hydrophones
BEAMS_AT_ONCE = 60  # bounds the memory for spectra of beams


@dataclass
class Capon:
    """Polar images of beams that pass echoes from their own direction whole, and the least power besides.

    Channels are cut into overlapping frames (6.5 m of range for an aperture of 0.8 m) and narrow bands, in
    which sound from any direction is coherent over the array. In each, b = a^H R^-1 y / (a^H R^-1 a), R the
    sum of y y^H over two bins and about `window_m` of range, with `loading` times its trace added to its
    diagonal. Much loading gives delay and sum; little nulls harder what fills the window from elsewhere, and
    with it an echo between two beams where nothing else is in the window. An echo that is short against the
    window weighs little in clutter, so that its ambiguous lobes stay. `focus` holds per frame. The other
    parameters are those of `delay-and-sum`.

    Source: Capon 1969; loading by the trace, Synnevag et al. 2007. Raises ValueError for bad parameters,
    InputError for blocks shorter than the range window, or of unknown geometry.
    """

    window_m: float = 50.0
    loading: float = 0.1
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
        for name in ("window_m", "loading"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}; it must be positive and finite")
        Settings.of(self)

    def __call__(self, block: CompressedBlock) -> Ping:
        """The block's polar image."""
        if not block.samples.size:
            return Ping(block.seq, block.stamp_ns, mount=block.mount, nav=block.nav)
        layout = self._layout = Layout.known(self._layout, Settings.of(self), block)
        plan = FramePlan.of(layout.grid, layout.bandwidth_hz, layout.guard_s)
        samples, carrier_hz = layout.baseband(block, self.precision)
        frames = band_frames(samples, layout.grid, plan)
        hop_m = plan.cells // 2 * layout.cell_m
        half_frames = max(1, int(0.5 * self.window_m / hop_m + 0.5))
        covariance = smoothed_covariance(frames, BINS_EACH, half_frames, self.loading)
        frequency_hz = np.asarray(carrier_hz + plan.bins * plan.bin_hz, float)
        zone = np.searchsorted(layout.zone_start, np.minimum(plan.centre, layout.grid.count - 1), "right") - 1
        amplitude = np.empty((layout.grid.count, layout.bearing_rad.size), np.float32)
        for begin in range(0, amplitude.shape[1], BEAMS_AT_ONCE):
            delays = layout.delay_s[:, :, begin : begin + BEAMS_AT_ONCE]
            beams = _beams(frames, covariance, frequency_hz, delays, zone)
            amplitude[:, begin : begin + BEAMS_AT_ONCE] = cells_of_frames(beams, layout.grid, plan)
        return layout.ping(block, amplitude)


def _beams(
    frames: ComplexArray,
    covariance: npt.NDArray[np.complex128],
    frequency_hz: FloatArray,
    delay_s: FloatArray,
    zone: npt.NDArray[np.int64],
) -> ComplexArray:
    """Spectra (n_bins, n_frames, n_beams), each frame steered as its focus zone says."""
    out = np.empty((*frames.shape[:2], delay_s.shape[2]), frames.dtype)
    for one in np.unique(zone):
        inside = zone == one
        turn = phases(frequency_hz, delay_s[one])
        out[:, inside] = minimum_variance(frames[:, inside], covariance[:, inside], BINS_EACH, turn)
    return out


@hookimpl
def fls_node() -> type[Capon]:
    """Return the node of kind `capon`."""
    return Capon
