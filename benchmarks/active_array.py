"""Continuity and false tracks of the active-array chains over SCR, and what each stage of a ping costs.

    python -m benchmarks.active_array [--seeds 50] [--pings 200] [--scr 0 3 5 7 10 13] [--correlation 0 3]
    python -m benchmarks.active_array --times            # CPU time per stage, at 500 m

Every seed draws one target (80 to 120 m away, 0.2 to 0.5 m/s) and its pings once; all chains get the same
images, from 20 to 180 m. The chains and their settings are those of graphs/active_array*.yaml; of three of
them `pfa` is varied too. SCR is per cell after beamforming. Scores are `fls_flow.evaluate`'s with a gate of
--gate-m; a correlation of n means that clutter keeps exp(-1 / n) of its amplitude from ping to ping. Velocity
errors are of confirmed tracks in the gate, from the 32nd ping on, along and across the line of sight. The
picture shows continuity over false tracks, a point per `pfa`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import track as progress
from rich.table import Table
from threadpoolctl import threadpool_limits

from fls_flow import HydrophoneBlock, Ping, Tracks, TrackStatus, Truth
from fls_flow import graph as graphs
from fls_flow.catalog import Catalog
from fls_flow.evaluate import Settings, score

FloatArray = npt.NDArray[np.float64]

CHAINS = {
    "blobs": ("active_array", (3e-4, 1e-3, 3e-3)),
    "integration": ("active_array_tbd", (None,)),
    "Karoui": ("active_array_karoui", (1e-4, 3e-4, 1e-3)),
    "Lo": ("active_array_lo", (1e-5, 3e-5, 1e-4)),
}
SCENE = {"target_min_m": 80.0, "target_max_m": 120.0, "speed_min_mps": 0.2, "speed_max_mps": 0.5}
NEAR_M, FAR_M = 20.0, 180.0
SETTLED_PINGS = 32


@dataclass
class Chain:
    """The nodes of a graph after its beams, one after the other, and what came out."""

    name: str
    pfa: float | None
    nodes: list[Any]
    tracks: list[Tracks] = field(default_factory=list)

    @classmethod
    def of(cls, name: str, graph: str, pfa: float | None) -> Chain:
        """The chain of a shipped graph, with its own settings but for pfa."""
        nodes = []
        for node in graphs.load(graph).nodes:
            if node.name in ("cfar", "merge", "clusters", "tracker"):
                given = dict(node.arguments)
                if node.name == "cfar" and pfa is not None:
                    given["pfa"] = pfa
                nodes.append(node.kind.cls(**given))
        return cls(name, pfa, nodes)

    def __call__(self, ping: Ping) -> None:
        """Take one ping through all nodes."""
        message: Any = ping
        for node in self.nodes:
            message = node(message)
        self.tracks.append(message)


def pings(seed: int, scr_db: float, correlation: float, count: int) -> Iterator[tuple[Ping, Truth]]:
    """The images of one target's run and the truth."""
    load = Catalog().load
    scene = load("array-scene").cls(
        pings=count,
        seed=seed,
        scr_db=scr_db,
        clutter_correlation_pings=correlation,
        range_max_m=FAR_M,
        **SCENE,
    )
    compression = load("pulse-compression").cls()
    beams = load("delay-and-sum").cls(range_min_m=NEAR_M, range_max_m=FAR_M - 1.0)
    for block, truth in scene():
        yield beams(compression(block)), truth


def scored(tracks: Sequence[Tracks], truth: Sequence[Truth], gate_m: float) -> dict[str, float]:
    """Continuity, false tracks and errors of velocity of one run."""
    with TemporaryDirectory() as folder:
        files = {kind: Path(folder) / f"{kind}.csv" for kind in ("track-csv", "truth-csv")}
        sinks = {kind: Catalog().load(kind).cls(path=path) for kind, path in files.items()}
        for one, true in zip(tracks, truth, strict=True):
            sinks["track-csv"](one)
            sinks["truth-csv"](true)
        for sink in sinks.values():
            sink.close()
        overall = score(files["track-csv"], files["truth-csv"], settings=Settings(gate_m=gate_m)).overall
    errors = velocity_errors(tracks, truth, gate_m)
    return {
        "continuity": overall["continuity"],
        "false": overall["false_tracks"],
        "confirmed_s": overall["time_to_confirm_s"],
        "radial": float(np.abs(errors[:, 0]).mean()) if len(errors) else float("nan"),
        "across": float(np.abs(errors[:, 1]).mean()) if len(errors) else float("nan"),
    }


def velocity_errors(tracks: Sequence[Tracks], truth: Sequence[Truth], gate_m: float) -> FloatArray:
    """Errors (n, 2) along and across the line of sight of tracks that are 32 pings old or older."""
    errors = []
    for one, true in zip(tracks, truth, strict=True):
        old = one.select((one.status == TrackStatus.CONFIRMED) & (one.age >= SETTLED_PINGS))
        for state in true.state:
            near = np.hypot(*(old.state[:, :2] - state[:2]).T) if len(old) else np.zeros(0)
            if near.size and near.min() < gate_m:
                off = old.state[near.argmin(), 2:] - state[2:]
                u = state[:2] / np.hypot(*state[:2])
                errors.append([u @ off, u[0] * off[1] - u[1] * off[0]])
    return np.array(errors).reshape(-1, 2)


Results = dict[tuple[str, float | None, float, float], list[dict[str, float]]]


def measured(options: argparse.Namespace) -> Results:
    """The scores of all chains: a dict per seed, by chain, pfa, correlation and SCR."""
    results: Results = defaultdict(list)
    cells = [
        (seed, correlation, scr)
        for seed in range(options.first_seed, options.first_seed + options.seeds)
        for correlation in options.correlation
        for scr in options.scr
    ]
    for seed, correlation, scr in progress(cells, description="runs"):
        chains = [
            Chain.of(name, graph, pfa)
            for name, (graph, factors) in CHAINS.items()
            if not options.chain or name in options.chain
            for pfa in factors
        ]
        truth = []
        for ping, true in pings(seed, scr, correlation, options.pings):
            truth.append(true)
            for chain in chains:
                chain(ping)
        for chain in chains:
            one = scored(chain.tracks, truth, options.gate_m)
            results[chain.name, chain.pfa, correlation, scr].append(one)
            if options.log:
                with options.log.open("a") as log:
                    line = {"chain": chain.name, "pfa": chain.pfa, "correlation": correlation, "scr": scr}
                    log.write(json.dumps(line | {"seed": seed} | one) + "\n")
    return results


def table(results: Results, options: argparse.Namespace, correlation: float) -> Table:
    """Mean continuity, mean false tracks and velocity errors for one kind of clutter."""
    kind = "white clutter" if correlation == 0 else f"clutter correlated over {correlation:g} pings"
    shown = Table(
        title=f"{kind}, {options.seeds} seeds, {options.pings} pings: mean continuity / mean false tracks"
    )
    shown.add_column("chain")
    shown.add_column("pfa", justify="right")
    for scr in options.scr:
        shown.add_column(f"{scr:g} dB", justify="right")
    shown.add_column(f"velocity error at {options.scr[-1]:g} dB, m/s", justify="right")
    for name, pfa in dict.fromkeys((one, pfa) for one, pfa, *_ in results):
        cells = [results[name, pfa, correlation, scr] for scr in options.scr]
        means = [f"{mean(one, 'continuity'):.2f} / {mean(one, 'false'):.1f}" for one in cells]
        errors = f"{mean(cells[-1], 'radial'):.3f}, {mean(cells[-1], 'across'):.3f}"
        shown.add_row(name, "" if pfa is None else f"{pfa:g}", *means, errors)
    return shown


def mean(runs: Sequence[dict[str, float]], what: str) -> float:
    """Mean over the runs that have it."""
    values = [one[what] for one in runs if np.isfinite(one[what])]
    return float(np.mean(values)) if values else float("nan")


def draw(results: Results, options: argparse.Namespace) -> None:
    """Continuity over false tracks, a panel per SCR and clutter."""
    from matplotlib.figure import Figure  # only where a picture is wanted

    figure = Figure(figsize=(3.0 * len(options.scr), 3.2 * len(options.correlation)), layout="constrained")
    panels = figure.subplots(len(options.correlation), len(options.scr), sharey=True, squeeze=False)
    for row, correlation in enumerate(options.correlation):
        for column, scr in enumerate(options.scr):
            axes = panels[row, column]
            for name in CHAINS:
                runs = [results[key] for key in results if key[0] == name and key[2:] == (correlation, scr)]
                x, y = [mean(one, "false") for one in runs], [mean(one, "continuity") for one in runs]
                axes.plot(x, y, "o-", label=name)
            axes.axhline(0.9, color="0.8", zorder=0)
            axes.axvline(2.0, color="0.8", zorder=0)
            axes.set(xscale="symlog", xlim=(-0.1, None), ylim=(-0.02, 1.02))
            axes.set_title(f"{scr:g} dB, correlation {correlation:g}", fontsize=9)
            axes.set_xlabel("false tracks per run")
    panels[0, 0].set_ylabel("continuity")
    panels[0, 0].legend(fontsize=8)
    figure.savefig(options.picture, dpi=110)


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
            node(image if name == "multi-ping-integration" else message)
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


def main() -> None:
    """Print the tables and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--pings", type=int, default=200)
    parser.add_argument("--scr", type=float, nargs="+", default=[0.0, 3.0, 5.0, 7.0, 10.0, 13.0])
    parser.add_argument("--correlation", type=float, nargs="+", default=[0.0, 3.0], help="pings; 0 is white")
    parser.add_argument("--chain", choices=list(CHAINS), action="append", help="only these")
    parser.add_argument("--gate-m", type=float, default=10.0)
    parser.add_argument("--picture", type=Path, default=Path("active_array.png"))
    parser.add_argument("--log", type=Path, help="append a line of JSON per run and chain")
    parser.add_argument("--times", action="store_true", help="only the times of the stages")
    parser.add_argument("--rounds", type=int, default=15, help="pings timed")
    options = parser.parse_args()
    console = Console(width=150)
    with threadpool_limits(1):
        if options.times:
            console.print(stage_times(options.rounds))
            return
        results = measured(options)
    for correlation in options.correlation:
        console.print(table(results, options, correlation))
    draw(results, options)


if __name__ == "__main__":
    main()
