"""Whole trackers, with their initiation, beside Stone Soup's: time and errors on the same detections.

    pip install -e ".[bench]" && python -m benchmarks.tracking [--seeds 10] [--soup-seeds 3] [--scene few]

Each seed draws detections once; every tracker gets them, writes the CSV contract, and is scored by
`fls_flow.evaluate` (OSPA and GOSPA with p = 1, c = 10 m; a target is followed within 4 m). Times per scan are
CPU time of the thread and wall time; rounds are interleaved, seed by seed. Shown are the median over the
seeds and, in brackets, the worst. Ours runs with the preset `points` and nothing else (NNKF, which has no
presets, with `OUR_SETTINGS`); Stone Soup's settings stand in `tracking_stonesoup.SETTINGS`, as found by
`benchmarks.tracking_search`. Its trackers are slow: they may take fewer of the same seeds. At the end, the
exact probabilities of one cluster.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks import tracking_stonesoup as soup
from benchmarks.tracking_scenes import P_D, SCENES, Scene, Seen
from fls_flow import Tracks
from fls_flow.catalog import Catalog
from fls_flow.evaluate import Settings, score
from fls_trackers.association import associate
from fls_trackers.gating import Gated

Tracking = Callable[[Scene, Sequence[Seen]], tuple[list[Tracks], list[float]]]

OURS = {"JPDA": "jpda", "PDA": "pda", "GNN": "gnn", "NNKF": "nnkf"}  # those that are installed
POINTS: dict[str, Any] = {"preset": "points"}
OUR_SETTINGS: dict[str, dict[str, Any]] = {
    "nnkf": {
        "p_d": P_D,
        "velocity_walk_mps": 0.02,
        "extent_sd_m": 0.0,
        "group_m": 0.0,
        "gamma": 9.0,
        "speed_sd_mps": 0.3,
        "m1": 8,
        "start_score": 11.0,
        "max_propagate": 10,
    }
}
CLUSTERS = (6, 8, 10, 12)  # tracks that all gate two detections more than they are
SCORES = {
    "gospa": "GOSPA m",
    "ospa": "OSPA m",
    "continuity": "continuity",
    "false_tracks": "false",
    "redundant_tracks": "redundant",
    "id_switches": "switches",
}
SMALLER_IS_WORSE = ("continuity",)
SCORING = Settings(cutoff_m=10.0, order=1.0, gate_m=4.0)


@dataclass
class Outcome:
    """One tracker on one run."""

    mean_ms: float  # CPU
    worst_ms: float
    wall_ms: float
    scores: dict[str, float]


def ours(kind: str) -> Tracking:
    """Our tracker of that kind; it takes the noise from the view."""
    cls = Catalog().load(kind).cls

    def run(scene: Scene, seen: Sequence[Seen]) -> tuple[list[Tracks], list[float]]:
        tracker = cls(**OUR_SETTINGS.get(kind, POINTS))
        found, times = [], []
        for one in seen:
            began = time.thread_time()
            tracks = tracker(one.detections)
            times.append(time.thread_time() - began)
            found.append(tracks)
        return found, times

    return run


def theirs(method: str, settings: soup.SoupSettings | None = None) -> Tracking:
    """Stone Soup's tracker."""
    names = {scene.name: name for name, scene in SCENES.items()}

    def run(scene: Scene, seen: Sequence[Seen]) -> tuple[list[Tracks], list[float]]:
        return soup.track(method, scene, seen, settings or soup.SETTINGS[names[scene.name]][method])

    return run


def outcome(tracking: Tracking, scene: Scene, seen: Sequence[Seen]) -> Outcome:
    """Time and scores of a tracker on the same detections as all others."""
    began = time.perf_counter()
    found, times = tracking(scene, seen)
    wall_ms = 1e3 * (time.perf_counter() - began) / len(seen)
    with TemporaryDirectory() as folder:
        files = {kind: Path(folder) / f"{kind}.csv" for kind in ("track-csv", "truth-csv")}
        sinks = {kind: Catalog().load(kind).cls(path=path) for kind, path in files.items()}
        for one, tracks in zip(seen, found, strict=True):
            sinks["track-csv"](tracks)
            sinks["truth-csv"](one.truth)
        for sink in sinks.values():
            sink.close()
        overall = score(files["track-csv"], files["truth-csv"], settings=SCORING).overall
    return Outcome(
        1e3 * float(np.mean(times)), 1e3 * max(times), wall_ms, {name: overall[name] for name in SCORES}
    )


def shown(values: Sequence[float], *, least: bool = False) -> str:
    """The median and the worst."""
    return f"{statistics.median(values):.3g} ({min(values) if least else max(values):.3g})"


def row(outcomes: list[Outcome], reference_ms: float) -> list[str]:
    """The cells of one tracker."""
    mean = statistics.median(one.mean_ms for one in outcomes)
    cells = [str(len(outcomes)), f"{mean:.4g}", f"{max(one.worst_ms for one in outcomes):.3g}"]
    cells.append(f"{statistics.median(one.wall_ms for one in outcomes):.4g}")
    cells.append(f"{mean / reference_ms:,.0f}x")
    scores = {name: [one.scores[name] for one in outcomes] for name in SCORES}
    return cells + [shown(values, least=name in SMALLER_IS_WORSE) for name, values in scores.items()]


def compare(scene: Scene, methods: Sequence[str], seeds: int, soup_seeds: int) -> Table:
    """The table of one scene."""
    drawn = [scene.draw(seed) for seed in range(seeds)]
    installed = Catalog().names()
    trackers = {
        f"fls_flow {name}": (ours(kind), seeds) for name, kind in OURS.items() if kind in installed
    } | {f"Stone Soup {name}": (theirs(name), soup_seeds) for name in methods if soup_seeds}
    table = Table(title=f"{scene.name}, {scene.scans} scans: median of the seeds (worst)")
    for name in ("tracker", "seeds", "CPU ms", "max", "wall ms", "CPU time", *SCORES.values()):
        table.add_column(name, justify="left" if name == "tracker" else "right")
    outcomes: dict[str, list[Outcome]] = {name: [] for name in trackers}
    for name, (tracking, _) in trackers.items():
        tracking(scene, drawn[0][:20] if name.startswith("Stone") else drawn[0])  # compiles and loads
    for k, seen in enumerate(drawn):
        for name, (tracking, count) in trackers.items():
            if k < count:
                outcomes[name].append(outcome(tracking, scene, seen))
    reference_ms = statistics.median(one.mean_ms for one in next(iter(outcomes.values())))
    for name, found in outcomes.items():
        table.add_row(name, *row(found, reference_ms))
    return table


def clusters() -> Table:
    """Time and error of the probabilities of n tracks that all gate n + 2 detections, as JPDA has them."""
    table = Table(title="one cluster, n tracks gating n + 2 detections: CPU ms")
    for name in ("n", "exact", "propagated", "largest error of a beta"):
        table.add_column(name, justify="right")
    for n in CLUSTERS:
        likelihood = np.random.default_rng(n).uniform(0.01, 1.0, n * (n + 2))
        start = (n + 2) * np.arange(n + 1)
        gated = Gated(start, np.tile(np.arange(n + 2), n), likelihood)
        given = (gated, np.full(n + 2, 0.1), np.zeros(n, np.int64))
        found, times = [], []
        for max_shared in (16, 1):
            rounds = []
            for _ in range(21):
                began = time.thread_time()
                got = associate(*given, p_d=P_D, p_g=0.99, max_shared=max_shared)
                rounds.append(1e3 * (time.thread_time() - began))
            found.append(got.beta)
            times.append(f"{statistics.median(rounds):.3g}")
        table.add_row(str(n), *times, f"{np.abs(found[0] - found[1]).max():.2g}")
    return table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--soup-seeds", type=int, default=3)
    parser.add_argument("--scene", choices=list(SCENES), help="only this one")
    parser.add_argument(
        "--method", choices=list(soup.METHODS), action="append", help="only these of Stone Soup"
    )
    options = parser.parse_args()
    with threadpool_limits(1):
        for name in [options.scene] if options.scene else SCENES:
            # Its plain JPDA enumerates all joint events: in the dense scene it does not end.
            usual = [method for method in soup.METHODS if name == "few" or method != "JPDA"]
            table = compare(SCENES[name], options.method or usual, options.seeds, options.soup_seeds)
            Console(width=170).print(table)
        Console(width=170).print(clusters())


if __name__ == "__main__":
    main()
