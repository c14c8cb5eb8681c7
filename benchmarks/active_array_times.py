"""CPU time of each stage of the active-array chains: `python -m benchmarks.active_array --times`."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.table import Table

from fls_flow import HydrophoneBlock
from fls_flow import graph as graphs
from fls_flow.catalog import Catalog

__all__ = ["stage_times"]

FloatArray = npt.NDArray[np.float64]


def straight_delay_and_sum(block: HydrophoneBlock, bearing_rad: FloatArray) -> npt.NDArray[np.float32]:
    """Compression and delay and sum as one writes them in NumPy: spectra, a phase per channel and beam."""
    n = block.samples.shape[1] + block.waveform.size
    frequency = np.fft.rfftfreq(n, 1.0 / block.sample_rate_hz)
    spectra = np.fft.rfft(block.samples, n) * np.conj(np.fft.rfft(block.waveform, n))
    u = np.stack([np.cos(bearing_rad), np.sin(bearing_rad)], axis=1)
    delay = -(u @ block.position_m[:, :2].T) / block.sound_speed_mps
    rows = []
    for one in delay:
        total = (spectra * np.exp(2j * np.pi * frequency * one[:, None])).mean(axis=0)
        analytic = np.zeros(n, complex)
        analytic[: total.size] = 2.0 * total
        rows.append(np.abs(np.fft.ifft(analytic))[: block.samples.shape[1]].astype(np.float32))
    return np.stack(rows, axis=1)


def stage_times(rounds: int) -> Table:
    """CPU ms of every stage of a ping at 500 m, median of `rounds`."""
    nodes = {
        node.name: node
        for graph in ("active_array", "active_array_tbd")
        for node in graphs.load(graph).nodes
        if node.inputs
    }
    whole = {"beams": {"range_min_m": 10.0, "range_max_m": 500.0}}
    chain = [
        nodes[name].kind.cls(**dict(nodes[name].arguments) | whole.get(name, {}))
        for name in ("compression", "beams", "cfar", "merge")
    ]
    trackers = {
        "ncv-auction": graphs.load("active_array").node("tracker"),
        "multi-ping-integration": graphs.load("active_array_tbd").node("tracker"),
    }
    ready = {name: node.kind.cls(**node.arguments) for name, node in trackers.items()}
    times: dict[str, list[float]] = defaultdict(list)
    scene = Catalog().load("array-scene").cls(pings=rounds + 5, seed=1)
    for block, _ in scene():
        message: Any = block
        image: Any = None
        for name, node in zip(("compression", "beams", "cfar", "merge"), chain, strict=True):
            began = time.thread_time()
            message = node(message)
            times[name].append(1e3 * (time.thread_time() - began))
            image = message if name == "beams" else image
        for name, node in ready.items():
            began = time.thread_time()
            if name == "multi-ping-integration":
                node(image)
            else:
                node(message, image)
            times[name].append(1e3 * (time.thread_time() - began))
    began = time.thread_time()
    straight_delay_and_sum(block, image.bearing_rad)
    straight = 1e3 * (time.thread_time() - began)
    middle = {name: float(np.median(values[5:])) for name, values in times.items()}
    shown = Table(title=f"CPU ms per ping, 4 x {block.samples.shape[1]} samples, median of {rounds}")
    shown.add_column("stage")
    shown.add_column("ms", justify="right")
    for name, value in middle.items():
        shown.add_row(name, f"{value:.1f}")
    shown.add_row("chain of active_array", f"{sum(middle.values()) - middle['multi-ping-integration']:.1f}")
    together = middle["compression"] + middle["beams"] + middle["multi-ping-integration"]
    shown.add_row("chain of active_array_tbd", f"{together:.1f}")
    shown.add_row("straight NumPy compression and delay and sum", f"{straight:.0f}")
    return shown
