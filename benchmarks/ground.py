"""Time per ping of each node of the ground-obstacle chain, in one process.

    python -m benchmarks.ground [--pings 60]

Medians over the pings after a warm-up, one thread per library, nodes one after the other; the simulator's
time is in the table, too. The tracker alone is then run on made-up detections of many objects.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.table import Table

from fls_flow import Detections
from fls_flow import graph as graphs
from fls_flow.runtime import Options, Run
from fls_sources.ground_scene import GroundScene
from fls_trackers.nav_ukf import NavUkf

GRAPH = Path(__file__).parents[1] / "graphs" / "ground_obstacle.yaml"
SIZES = {"40x1000": (40, 1000, 1.5), "40x4000": (40, 4000, 1.5), "256x2048": (256, 2048, 0.25)}
OBJECTS = (2, 30, 200)


def measure(size: str, pings: int) -> dict[str, float]:
    """Median ms per ping of each node."""
    beams, ranges, spacing_deg = SIZES[size]
    settings = [
        f"sonar.pings={pings}",
        f"sonar.n_beams={beams}",
        f"sonar.n_ranges={ranges}",
        f"sonar.beam_spacing_deg={spacing_deg}",
        f"sonar.beamwidth_deg={spacing_deg}",
        "picture.pings=[]",
    ]
    graph = graphs.load(GRAPH, set_=settings)
    for _ in range(2):  # the first run compiles
        with TemporaryDirectory() as out:
            report = Run(graph, Options(in_order=True), out=Path(out)).start()
        if report.error is not None:
            raise report.error
    return {name: counts.percentile_ms(50) for name, counts in report.counts.items()}


def tracker_ms(objects: int, pings: int, step: str) -> float:
    """Median ms per ping of the tracker with so many objects 20 m apart, in NED."""
    views = list(GroundScene(mode="points", sequence="empty", nav=True, pings=pings)())
    range_m, bearing_rad = np.meshgrid(20.0 + 20.0 * np.arange(20), np.linspace(-0.5, 0.5, 10))
    where = np.stack([range_m.ravel(), bearing_rad.ravel()])[:, :objects]
    tracker, times = NavUkf(step=step, limit_m=3.0), []  # type: ignore[arg-type]  # one of its literals
    for view in views:
        found = Detections.of(
            view.ping, range_m=where[0], bearing_rad=where[1], amplitude=np.ones(where.shape[1])
        )
        found = replace(found, view=replace(found.view, nav=view.ping.nav))
        began = time.perf_counter()
        tracker(found)
        times.append(time.perf_counter() - began)
    return statistics.median(times[pings // 2 :]) * 1e3


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pings", type=int, default=60)
    pings = parser.parse_args().pings
    console = Console(width=100)
    columns = {size: measure(size, pings) for size in SIZES}
    table = Table(title=f"ms per ping, median of {pings} pings (nav: per sample)")
    table.add_column("node")
    for size in SIZES:
        table.add_column(size, justify="right")
    for node in next(iter(columns.values())):
        table.add_row(node, *(f"{times[node]:.3f}" for times in columns.values()))
    console.print(table)
    table = Table(title="nav-ukf alone, ms per ping")
    table.add_column("objects", justify="right")
    for step in ("exact", "euler"):
        table.add_column(step, justify="right")
    for objects in OBJECTS:
        table.add_row(
            str(objects), *(f"{tracker_ms(objects, pings, step):.3f}" for step in ("exact", "euler"))
        )
    console.print(table)


if __name__ == "__main__":
    main()
