"""What flows from pulse compression to the beamformers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from fls_flow import Mount, NavState, Sealed, array

__all__ = ["CompressedBlock"]

ComplexArray = npt.NDArray[np.complex64] | npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CompressedBlock(Sealed):
    """Matched-filter outputs of an array, analytic; an echo peaks at its onset with its own amplitude."""

    seq: int
    stamp_ns: int
    samples: ComplexArray = array((np.complex64, np.complex128), "n_channels", "n_samples")
    sample_rate_hz: float = float("nan")
    carrier_hz: float = float("nan")  # centre of the band that the pulse fills
    bandwidth_hz: float = float("nan")  # equivalent width of that band: range cells are c / 2B
    position_m: FloatArray = array(float, "n_channels", 3)  # of the hydrophones, sensor frame
    sound_speed_mps: float = 1500.0
    mount: Mount = field(default_factory=Mount)
    nav: NavState | None = None
