"""CPU time per ping of each node of the diver graph, its trackers and classifiers side by side.

    python -m benchmarks.diver_nodes [--pings 300] [--seed 7]

The nodes and parameters of `graphs/diver_classification.yaml`, one after the other on one thread, over the
same pings; `nnkf` and `quadratic-discriminant` take the same inputs as `pdaf` and `linear-discriminant`
beside them. Shown are median and 95th percentile of the thread's CPU time after the warm-up of the
detector, the median over one copy of the ping's amplitudes, and how many tracks, chips and described tracks
a ping has. What the peers take for the same work: `benchmarks/features.py` and `benchmarks/temporal_cfar.py`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from fls_flow import graph as graphs

GRAPH = "diver_classification"
CHAIN = ("detect", "tracker", "chips", "regions", "static", "temporal", "label")
OTHERS = ("tracker=nnkf", "label=quadratic-discriminant")
WARM_UP = 60


class Stopwatch:
    """CPU ms of each node, ping by ping."""

    def __init__(self) -> None:
        self.spent: dict[str, list[float]] = {}

    def __call__(self, name: str, step: Callable[..., Any], *inputs: Any) -> Any:
        """What the step answers."""
        began = time.thread_time()
        answer = step(*inputs)
        self.spent.setdefault(name, []).append(1e3 * (time.thread_time() - began))
        return answer


def instances(pings: int, seed: int, use: Sequence[str]) -> dict[str, Any]:
    """The nodes of the graph."""
    graph = graphs.load(GRAPH, set_=[f"sonar.pings={pings}", f"sonar.seed={seed}"], use=use, sinkless=True)
    return {name: graph.node(name).kind.cls(**graph.node(name).arguments) for name in ("sonar", *CHAIN)}


def measure(pings: int, seed: int) -> tuple[Stopwatch, dict[str, float]]:
    """Times of all nodes and of a copy, and the mean counts of what a ping has."""
    node, other = instances(pings, seed, ()), instances(pings, seed, OTHERS)
    watch, counts = Stopwatch(), []
    for ping, _ in node["sonar"]():
        watch("copy", ping.amplitude.copy)
        found = watch("temporal-cfar", node["detect"], ping)
        tracks = watch("pdaf", node["tracker"], found.detections)
        watch("nnkf", other["tracker"], found.detections)
        chips = watch("chips", node["chips"], found.foreground, tracks)
        regions = watch("region-growing", node["regions"], chips)
        static = watch("static-features", node["static"], chips, regions, tracks)
        temporal = watch("temporal-features", node["temporal"], static)
        watch("linear-discriminant", node["label"], temporal, tracks)
        watch("quadratic-discriminant", other["label"], temporal, tracks)
        counts.append((len(found.detections), len(tracks), len(chips), len(static)))
    mean = np.mean(counts[WARM_UP:], axis=0).tolist()
    return watch, dict(zip(("detections", "tracks", "chips", "described"), mean, strict=True))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pings", type=int, default=300)
    parser.add_argument("--seed", type=int, default=7)
    options = parser.parse_args()
    measure(WARM_UP + 1, options.seed)  # compiles
    watch, counts = measure(options.pings, options.seed)
    said = ", ".join(f"{value:.1f} {name}" for name, value in counts.items())
    table = Table(title=f"CPU time of a ping; {said}")
    for name in ("node", "ms, median", "95 %", "copies of a ping"):
        table.add_column(name, justify="left" if name == "node" else "right")
    copy = float(np.median(watch.spent["copy"][WARM_UP:]))
    for name, spent in watch.spent.items():
        median, high = np.percentile(spent[WARM_UP:], [50, 95])
        table.add_row(name, f"{median:.3f}", f"{high:.3f}", f"{median / copy:.0f}")
    Console().print(table)


if __name__ == "__main__":
    main()
