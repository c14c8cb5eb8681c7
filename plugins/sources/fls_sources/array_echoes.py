"""Echoes of moving point targets at the hydrophones of a moving array: exact delays and Doppler."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_sources.array_waveform import Chirp

__all__ = ["Array", "add_echoes", "echo_delays_s"]

FloatArray = npt.NDArray[np.float64]
ROUNDS = 6  # of the fixed point for the time of reflection; each gains a factor v / c


@dataclass(frozen=True, eq=False)
class Array:
    """A projector and hydrophones in the sensor frame, the water, and the samples that are taken."""

    hydrophone_m: FloatArray  # (n_channels, 3)
    projector_m: FloatArray  # (3,)
    sound_speed_mps: float
    sample_rate_hz: float
    n_samples: int
    pulse: Chirp


def echo_delays_s(
    array: Array, position_m: FloatArray, velocity_mps: FloatArray, own_mps: FloatArray, emitted_s: float
) -> FloatArray:
    """Times (n_targets, n_channels) from emission to reception of what is sent `emitted_s` into the pulse.

    Positions (n_targets, 3) and velocities hold at the start of transmission, in a frame that stands still
    where the sensor was then. The echo comes from where the target is when the sound reaches it, and is heard
    where the hydrophone is when it returns.
    """
    c = array.sound_speed_mps
    sent_from = array.projector_m + own_mps * emitted_s
    out = np.linalg.norm(position_m - sent_from, axis=-1) / c
    for _ in range(ROUNDS):
        struck = position_m + velocity_mps * (emitted_s + out)[:, None]
        out = np.linalg.norm(struck - sent_from, axis=-1) / c
    back = np.broadcast_to(out[:, None], (len(position_m), len(array.hydrophone_m)))
    for _ in range(ROUNDS):
        heard_at = array.hydrophone_m + own_mps * (emitted_s + out[:, None] + back)[..., None]
        back = np.linalg.norm(struck[:, None] - heard_at, axis=-1) / c
    return np.asarray(out[:, None] + back)


def add_echoes(
    samples: npt.NDArray[np.float32],
    array: Array,
    delays_s: tuple[FloatArray, FloatArray],
    amplitude: FloatArray,
) -> None:
    """Add a pulse times `amplitude` (n_targets,) to (n_channels, n_samples), for each target and channel.

    `delays_s` are those (n_targets, n_channels) of the pulse's first and last moment; between them the time
    scale is stretched evenly, which is the Doppler effect of a constant velocity.
    """
    rate, pulse = array.sample_rate_hz, array.pulse
    first_s, last_s = delays_s
    stretch = 1.0 + (last_s - first_s) / pulse.duration_s
    begin = np.ceil(first_s * rate).astype(np.int64)
    length = int(np.ceil(pulse.duration_s * rate * float(stretch.max(initial=1.0)))) + 1
    within = np.arange(length)
    since_s = ((begin[..., None] + within) / rate - first_s[..., None]) / stretch[..., None]
    echoes = amplitude[:, None, None] * pulse.at(since_s)
    for target, channel in np.ndindex(first_s.shape):
        at = int(begin[target, channel])
        stop = min(at + length, array.n_samples)
        if 0 <= at < stop:
            samples[channel, at:stop] += echoes[target, channel, : stop - at]
