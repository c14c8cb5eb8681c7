"""What a sparse array sees of sources elsewhere: ambiguous lobes, the width of the main lobe."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_beamformers.grid import arrival_delays_s, beam_directions

__all__ = ["ambiguity_pattern", "main_lobe_width_rad"]

FloatArray = npt.NDArray[np.float64]
WIDTH_STEPS = 720  # bearings over which the main lobe's width is averaged


def ambiguity_pattern(
    position_m: FloatArray,
    beam_rad: FloatArray,
    source_rad: FloatArray,
    carrier_hz: float,
    bandwidth_hz: float,
    sound_speed_mps: float,
    *,
    lags: int = 1,
) -> FloatArray:
    """What beams (rows) give of a unit echo from other bearings (columns), (n_beams, n_sources), in [0, 1].

    |(1/M) sum_m sinc(B (t + d_m)) exp(j 2 pi f d_m)|, d_m = tau_m(beam) - tau_m(source): plane waves, a pulse
    of flat spectrum of width B around f. With `lags` 1 at the echo's own time; with more, the largest over
    that many times in +-1/B, since a lobe's echo may peak in another range cell. With B = 0: narrow band.
    """
    to_beams = arrival_delays_s(position_m, beam_rad, sound_speed_mps)
    to_sources = arrival_delays_s(position_m, source_rad, sound_speed_mps)
    difference = to_beams[:, :, None] - to_sources[:, None, :]
    turned = np.exp(2j * np.pi * carrier_hz * difference)
    moved = bandwidth_hz * difference
    times = np.linspace(-1.0, 1.0, lags) if lags > 1 else np.zeros(1)
    answers = [np.abs(np.mean(np.sinc(time + moved) * turned, axis=0)) for time in times]
    return np.asarray(np.max(answers, axis=0))


def main_lobe_width_rad(position_m: FloatArray, carrier_hz: float, sound_speed_mps: float) -> float:
    """-3 dB width of the main lobe, averaged over all bearings, rad; nan for an array without extent.

    For small turns e the response is 1 - V (2 pi f e / c)^2 / 2, V the variance of the hydrophones' places
    across the beam; the width is where a Gaussian of that curvature has half power.
    """
    across = beam_directions(np.linspace(-np.pi, np.pi, WIDTH_STEPS, endpoint=False) + np.pi / 2.0)
    spread = (position_m @ across.T).std(axis=0)
    if not np.all(spread > 0.0):
        return float("nan")
    width = 2.0 * np.sqrt(np.log(2.0)) * sound_speed_mps / (2.0 * np.pi * carrier_hz * spread)
    return float(width.mean())
