"""Time per ping of each node of the surface-obstacle chain, in one process, pings preloaded in memory.

    python -m benchmarks.chain [--pings 60]

The base line for later work: medians over the pings after a warm-up, one thread per library, nodes one after
the other. Beside each time stands its ratio to one copy of the ping's amplitudes (`memcpy`), measured in the
same run: compare ratios between machines.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from fls_flow import Ping
from fls_flow import graph as graphs
from fls_flow.runtime import Options, Run

GRAPH = Path(__file__).parents[1] / "graphs" / "surface_obstacle.yaml"
SIZES = {"39x1000": (39, 1000, 1.5), "39x4000": (39, 4000, 1.5), "512x2048": (512, 2048, 0.25)}


@dataclasses.dataclass
class Preloaded:
    """A source whose pings lie in memory."""

    produced: list[Any]

    def __call__(self) -> Iterator[Any]:
        """Give them in turn."""
        return iter(self.produced)


def settings(size: str, pings: int) -> list[str]:
    """The `--set` options for a size."""
    beams, ranges, spacing_deg = SIZES[size]
    return [
        f"sonar.n_beams={beams}",
        f"sonar.n_ranges={ranges}",
        f"sonar.beam_spacing_deg={spacing_deg}",
        f"sonar.beamwidth_deg={spacing_deg}",
        f"sonar.pings={pings}",
    ]


def copy_ms(ping: Ping) -> float:
    """Median time of one copy of the amplitudes, ms."""
    target = np.empty_like(ping.amplitude)
    times = []
    for _ in range(200):
        began = time.perf_counter()
        np.copyto(target, ping.amplitude)
        times.append(time.perf_counter() - began)
    return statistics.median(times) * 1e3


def measure(size: str, pings: int) -> tuple[dict[str, float], float]:
    """Median ms per ping of each node, and of one copy."""
    graph = graphs.load(GRAPH, set_=settings(size, pings))
    sonar = graph.node("sonar")
    produced = list(sonar.kind.cls(**sonar.arguments)())
    for _ in range(2):  # the first run compiles
        with TemporaryDirectory() as out:
            instances = {"sonar": Preloaded(produced)}
            report = Run(graph, Options(in_order=True), out=Path(out), instances=instances).start()
        if report.error is not None:
            raise report.error
    times = {name: counts.percentile_ms(50) for name, counts in report.counts.items() if name != "sonar"}
    return times, copy_ms(produced[0].ping)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pings", type=int, default=60)
    pings = parser.parse_args().pings
    columns = {size: measure(size, pings) for size in SIZES}
    table = Table(title=f"ms per ping (times one memcpy of the image), median of {pings} pings")
    table.add_column("node")
    for size in SIZES:
        table.add_column(size, justify="right")
    for node in next(iter(columns.values()))[0]:
        table.add_row(
            node, *(f"{times[node]:.3f} ({times[node] / copy:.0f}x)" for times, copy in columns.values())
        )
    table.add_section()
    table.add_row("sum", *(f"{sum(times.values()):.3f}" for times, _ in columns.values()))
    table.add_row("memcpy", *(f"{copy:.4f}" for _, copy in columns.values()))
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
