"""Time per ping from hydrophone samples to the polar image, beside a straight NumPy delay and sum.

    python -m benchmarks.beamforming [--rounds 7]

One ping of the floater: 4 x 63,158 samples at 96 kHz, 500 m, 360 beams of 1 degree, range cells of 3.8 cm.
The straight ones take the same compressed samples and give the same cells: "by spectra" turns every beam's
phases over the whole spectrum and transforms it back, at the full rate, then takes the nearest samples; "by
interpolation" delays the baseband samples with numpy.interp. Their images are checked against ours first.

Rounds are interleaved: each times every stage in turn, CPU time of the thread, one thread. Shown are the
median, and for the beamformers the median over the rounds of the ratio to `delay-and-sum`.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from fls_beamformers.capon import Capon
from fls_beamformers.delay_and_sum import DelayAndSum
from fls_beamformers.messages import CompressedBlock
from fls_beamformers.pulse_compression import PulseCompression
from fls_flow import Ping
from fls_sources.array_scene import ArrayScene

Image = npt.NDArray[np.float32]
Beamformer = Callable[[CompressedBlock], Ping]
Straight = Callable[[CompressedBlock, Ping], Image]


def delays_s(block: CompressedBlock, bearing_rad: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """tau = -p.u / c, (n_channels, n_beams)."""
    u = np.stack([np.cos(bearing_rad), np.sin(bearing_rad), np.zeros_like(bearing_rad)])
    return np.asarray(-(block.position_m @ u) / block.sound_speed_mps)


def by_spectra(block: CompressedBlock, like: Ping) -> Image:
    """Every beam as phases over the whole spectrum, and back."""
    n = block.samples.shape[1]
    spectrum = np.fft.fft(block.samples, n)
    f = np.arange(n) * (block.sample_rate_hz / n)
    tau = delays_s(block, like.bearing_rad)
    at = np.rint(2.0 * like.range_m / block.sound_speed_mps * block.sample_rate_hz).astype(np.int64)
    image = np.empty(like.amplitude.shape, np.float32)
    for beam in range(tau.shape[1]):
        turned = np.mean(spectrum * np.exp(2j * np.pi * f * tau[:, beam, None]), axis=0)
        image[:, beam] = np.abs(np.fft.ifft(turned))[at]
    return image


def by_interpolation(block: CompressedBlock, like: Ping) -> Image:
    """Every beam by linear interpolation of the baseband samples."""
    n, rate, f = block.samples.shape[1], block.sample_rate_hz, block.carrier_hz
    time_s = np.arange(n) / rate
    base = block.samples * np.exp(-2j * np.pi * f * time_s)
    tau = delays_s(block, like.bearing_rad)
    cell_s = 2.0 * like.range_m / block.sound_speed_mps
    image = np.empty(like.amplitude.shape, np.float32)
    for beam in range(tau.shape[1]):
        total = np.zeros(cell_s.size, complex)
        for channel, delay in enumerate(tau[:, beam]):
            total += np.interp(cell_s + delay, time_s, base[channel]) * np.exp(2j * np.pi * f * delay)
        image[:, beam] = np.abs(total) / tau.shape[0]
    return image


def alike(ours: Image, other: Image, name: str, within: float) -> None:
    """Fail unless the rms difference is at most `within` of the rms."""
    rms = float(np.sqrt(np.mean(np.square(ours - other)) / np.mean(np.square(ours))))
    if rms > within:
        raise SystemExit(f"{name} differs from delay-and-sum by {rms:.3f} of its rms")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    console = Console(width=100)
    with threadpool_limits(1):
        times, cells = measured(rounds)
    table = Table(title=f"CPU ms per ping of 4 x 63,158 samples, {cells}, median of {rounds} rounds")
    table.add_column("stage")
    table.add_column("ms", justify="right")
    table.add_column("times delay-and-sum", justify="right")
    for name, values in times.items():
        ratio = statistics.median(a / b for a, b in zip(values, times["delay-and-sum"], strict=True))
        compared = "" if name in ("array-scene", "pulse-compression") else f"{ratio:.2f}"
        table.add_row(name, f"{statistics.median(values):.1f}", compared)
    front = [a + b for a, b in zip(times["pulse-compression"], times["delay-and-sum"], strict=True)]
    console.print(table)
    console.print(f"pulse-compression and delay-and-sum together: {statistics.median(front):.1f} ms per ping")


def measured(rounds: int) -> tuple[dict[str, list[float]], str]:
    """CPU ms of every stage, a value per round; and the size of the image."""
    pings = iter(ArrayScene(pings=rounds + 1, scr_db=13.0)())
    compress = PulseCompression()
    ours: dict[str, Beamformer] = {
        "delay-and-sum": DelayAndSum(focus=False),
        "delay-and-sum, near focus": DelayAndSum(),
        "delay-and-sum, double": DelayAndSum(focus=False, precision="double"),
        "capon": Capon(),
    }
    straight: dict[str, Straight] = {
        "NumPy, by interpolation": by_interpolation,
        "NumPy, by spectra": by_spectra,
    }
    block = compress(next(pings).block)  # machine code is loaded, tables are made
    images = {name: node(block) for name, node in ours.items()}
    like = images["delay-and-sum"]
    for (name, method), within in zip(straight.items(), (0.1, 0.2), strict=True):
        alike(np.asarray(like.amplitude, np.float32), method(block, like), name, within)

    times: dict[str, list[float]] = {}
    for _ in range(rounds):
        ping = timed(times, "array-scene", lambda: next(pings))
        block = timed(times, "pulse-compression", partial(compress, ping.block))
        for name, node in ours.items():
            timed(times, name, partial(node, block))
        for name, method in straight.items():
            timed(times, name, partial(method, block, like))
    return times, f"{like.amplitude.shape[0]:,} cells x {like.amplitude.shape[1]} beams"


Answer = TypeVar("Answer")


def timed(times: dict[str, list[float]], name: str, work: Callable[[], Answer]) -> Answer:
    """What `work` gives; its CPU ms are added to `times`."""
    began = time.thread_time()
    answer = work()
    times.setdefault(name, []).append((time.thread_time() - began) * 1e3)
    return answer


if __name__ == "__main__":
    main()
