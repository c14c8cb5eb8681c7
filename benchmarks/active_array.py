"""Continuity and false tracks of the active-array chains over SCR, and what each stage of a ping costs.

    python -m benchmarks.active_array [--seeds 50] [--pings 150] [--scr 0 5 10 13] [--correlation 0 3]
        [--log runs.jsonl] [--every-pfa-at 10] [--chain blobs] [--picture docs/active_array.png]
    python -m benchmarks.active_array --times            # CPU time per stage, at 500 m

Every seed draws one target (80 to 120 m away, 0.2 to 0.5 m/s) and its clutter once; the strengths and all
chains share them (`active_array_images`). The window is that of the target's path, 15 m beyond its nearest
and farthest range; false tracks at more than 2 m of the target's range, those of clutter, are scaled from
the windows of all runs to 160 m. The chains and their settings are those of graphs/active_array*.yaml; of
three of them `pfa` is varied, over all its values only at the strengths `--every-pfa-at`, elsewhere without
the largest, which costs most. With `--log` a run that was broken off goes on where it was, and that of a
finished one is drawn again (`--seeds 0` draws what there is). SCR is per cell after beamforming; the tables
say what it is before compression. Scores are `fls_flow.evaluate`'s with a gate of --gate-m; a correlation of
n means that clutter keeps exp(-1 / n) of its amplitude from ping to ping. Velocity errors are of confirmed
tracks in the gate, from the 32nd ping on, along and across the line of sight. The picture shows continuity
over false tracks, a point per `pfa`.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import track as progress
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks.active_array_chains import CHAINS, Chain, SharedHits, chains
from benchmarks.active_array_images import Images, scene
from benchmarks.active_array_times import stage_times
from fls_flow import Tracks, TrackStatus, Truth
from fls_flow.evaluate import Settings, score
from fls_sinks.track_csv import TrackCsv
from fls_sinks.truth_csv import TruthCsv

FloatArray = npt.NDArray[np.float64]
Key = tuple[str, float | None, float, float]  # chain, pfa, correlation, SCR
Results = dict[Key, dict[int, dict[str, float]]]  # scores by seed

SETTLED_PINGS = 32
WINDOW_M = 160.0  # for which false tracks are said
BESIDE_M = 2.0  # of the target's range


def scored(
    tracks: Sequence[Tracks], truth: Sequence[Truth], gate_m: float, window_m: float
) -> dict[str, float]:
    """Continuity, false tracks near the target's range and far from it, errors of velocity of one run."""
    overall = evaluated(tracks, truth, gate_m)
    near, false = 0.0, overall["false_tracks"]
    if false:
        beside = those_beside(tracks, truth)
        kept = [one.select(np.isin(one.id, beside)) for one in tracks]
        near = evaluated(kept, truth, gate_m)["false_tracks"]
    errors = velocity_errors(tracks, truth, gate_m)
    return {
        "continuity": overall["continuity"],
        "near": near,
        "far": false - near,
        "window_m": window_m,
        "confirmed_s": overall["time_to_confirm_s"],
        "radial": float(np.abs(errors[:, 0]).mean()) if len(errors) else float("nan"),
        "across": float(np.abs(errors[:, 1]).mean()) if len(errors) else float("nan"),
    }


def evaluated(tracks: Sequence[Tracks], truth: Sequence[Truth], gate_m: float) -> dict[str, float]:
    """What `fls-flow evaluate` says of confirmed tracks."""
    with TemporaryDirectory() as folder:
        files = Path(folder) / "tracks.csv", Path(folder) / "truth.csv"
        into = TrackCsv(path=files[0]), TruthCsv(path=files[1])
        for one, true in zip(tracks, truth, strict=True):
            into[0](one.select(one.status != TrackStatus.TENTATIVE))  # they do not count
            into[1](true)
        for sink in into:
            sink.close()
        return score(*files, settings=Settings(gate_m=gate_m)).overall


def those_beside(tracks: Sequence[Tracks], truth: Sequence[Truth]) -> list[int]:
    """The ids of confirmed tracks that keep to the target's range, as those of its lobes do."""
    off: dict[int, list[float]] = defaultdict(list)
    for one, true in zip(tracks, truth, strict=True):
        sure = one.select((one.status == TrackStatus.CONFIRMED) & (len(true) > 0))
        apart = np.abs(np.hypot(*sure.state[:, :2].T) - np.hypot(*true.state[:1, :2].T))
        for i, metres in zip(sure.id.tolist(), apart.tolist(), strict=True):
            off[i].append(metres)
    return [i for i, metres in off.items() if np.mean(metres) <= BESIDE_M]


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


def run(options: argparse.Namespace) -> Results:
    """The scores of all chains; what the log holds is not run again."""
    results = logged(options.log, options.pings)
    cells = [(seed, c) for seed in seeds_of(options) for c in options.correlation]
    for seed, correlation in progress(cells, description="runs"):
        todo = {}
        for scr in options.scr:
            made = chains(options.chain or list(CHAINS), scr in options.every_pfa_at)
            todo[scr] = [one for one in made if seed not in results[one.name, one.pfa, correlation, scr]]
        todo = {scr: made for scr, made in todo.items() if made}
        if not todo:
            continue
        images = Images(seed, correlation, tuple(todo), options.pings)
        truth = played(images, list(todo.values()))
        window_m = images.far_m - images.near_m
        for scr, made in todo.items():
            for chain in made:
                one = scored(chain.tracks, truth, options.gate_m, window_m)
                results[chain.name, chain.pfa, correlation, scr][seed] = one
                if options.log:
                    note(options.log, (chain.name, chain.pfa, correlation, scr), seed, len(truth), one)
    return results


def played(images: Images, todo: list[list[Chain]]) -> list[Truth]:
    """The truth of a run whose images went through the chains `todo` of their strengths."""
    shared: dict[float, SharedHits] = {}
    for chain in (chain for made in todo for chain in made):
        if chain.pfa is not None and chain.hits is not None:
            shared.setdefault(chain.pfa, SharedHits(chain.hits))
    truth = []
    for place in images:
        truth.append(place.truth)
        found = {pfa: list(hits.of(place)) for pfa, hits in shared.items()}
        none = [None] * len(todo)
        for k, made in enumerate(todo):
            for chain in made:
                chain(place.images[k], found.get(chain.pfa or 0.0, none)[k])
    return truth


def seeds_of(options: argparse.Namespace) -> range:
    """The seeds of the runs."""
    return range(options.first_seed, options.first_seed + options.seeds)


def logged(path: Path | None, pings: int) -> Results:
    """The scores in a log of runs of so many pings; none without one."""
    results: Results = defaultdict(dict)
    if path is not None and path.exists():
        for line in path.read_text().splitlines():
            one = json.loads(line)
            if one["pings"] == pings:
                key = (one["chain"], one["pfa"], one["correlation"], one["scr"])
                results[key][one["seed"]] = one["scores"]
    return results


def note(path: Path, key: Key, seed: int, pings: int, scores: dict[str, float]) -> None:
    """Add the scores of a run and chain to the log."""
    line = dict(zip(("chain", "pfa", "correlation", "scr"), key, strict=True))
    with path.open("a") as log:
        log.write(json.dumps(line | {"seed": seed, "pings": pings, "scores": scores}) + "\n")


def table(results: Results, options: argparse.Namespace, correlation: float) -> Table:
    """Mean continuity, mean false tracks and velocity errors for one kind of clutter."""
    kind = "white clutter" if correlation == 0 else f"clutter correlated over {correlation:g} pings"
    counts = [len(runs) for key, runs in results.items() if key[2] == correlation and runs]
    seeds = f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{counts[0]}"
    before = ", ".join(
        f"{scene(0, correlation, scr, 1).scr_before_compression_db:.0f}" for scr in options.scr
    )
    shown = Table(
        title=f"{kind}, {seeds} seeds, {options.pings} pings: mean continuity / mean false tracks",
        caption=f"SCR is per cell after beamforming; in a channel before compression it is {before} dB",
    )
    shown.add_column("chain")
    shown.add_column("pfa", justify="right")
    for scr in options.scr:
        shown.add_column(f"{scr:g} dB", justify="right")
    shown.add_column(f"velocity error at {options.scr[-1]:g} dB, m/s", justify="right")
    for name, pfa in rows_of(results, options):
        cells = [list(results[name, pfa, correlation, scr].values()) for scr in options.scr]
        means = [f"{mean(one, 'continuity'):.2f} / {false_tracks(one):.1f}" if one else "" for one in cells]
        errors = f"{mean(cells[-1], 'radial'):.3f}, {mean(cells[-1], 'across'):.3f}" if cells[-1] else ""
        shown.add_row(name, "" if pfa is None else f"{pfa:g}", *means, errors)
    return shown


def rows_of(results: Results, options: argparse.Namespace) -> list[tuple[str, float | None]]:
    """The chains and pfa that have results."""
    have = {key[:2] for key, runs in results.items() if runs}
    names = options.chain or list(CHAINS)
    return [(name, pfa) for name in names for pfa in CHAINS[name][1] if (name, pfa) in have]


def mean(runs: Sequence[dict[str, float]], what: str) -> float:
    """Mean over the runs that have it."""
    values = [one[what] for one in runs if np.isfinite(one[what])]
    return float(np.mean(values)) if values else float("nan")


def false_tracks(runs: Sequence[dict[str, float]]) -> float:
    """Mean false tracks per run in `WINDOW_M` of range: those near the target, and those of clutter."""
    clutter_m = sum(one["window_m"] - 2.0 * BESIDE_M for one in runs)
    of_clutter = sum(one["far"] for one in runs) / clutter_m * (WINDOW_M - 2.0 * BESIDE_M)
    return mean(runs, "near") + of_clutter


def draw(results: Results, options: argparse.Namespace) -> None:
    """Continuity over false tracks, a panel per SCR and clutter."""
    from matplotlib.figure import Figure  # only where a picture is wanted

    figure = Figure(
        figsize=(2.6 * len(options.scr) + 1.0, 2.7 * len(options.correlation)), layout="constrained"
    )
    panels = figure.subplots(
        len(options.correlation), len(options.scr), sharex=True, sharey=True, squeeze=False
    )
    for row, correlation in enumerate(options.correlation):
        for column, scr in enumerate(options.scr):
            axes = panels[row, column]
            axes.fill_between([-0.1, 2.0], 0.9, 1.02, color="0.93", zorder=0)
            axes.axvline(2.0, color="0.7", linewidth=0.8, zorder=0)
            axes.axhline(0.9, color="0.7", linewidth=0.8, zorder=0)
            for index, name in enumerate(options.chain or list(CHAINS)):
                runs = [
                    list(results[one, pfa, correlation, scr].values())
                    for one, pfa in rows_of(results, options)
                    if one == name
                ]
                x = [false_tracks(one) for one in runs if one]
                y = [mean(one, "continuity") for one in runs if one]
                axes.plot(x, y, "osD^"[index % 4] + "-", color=f"C{index}", markersize=5, label=name)
            axes.set_xscale("symlog", linthresh=1.0)
            axes.set(xlim=(-0.1, 300.0), ylim=(-0.02, 1.02), xticks=[0, 1, 10, 100])
            axes.xaxis.set_major_formatter("{x:g}")
            kind = "white" if correlation == 0.0 else f"correlated, {correlation:g} pings"
            axes.set_title(f"{scr:g} dB, {kind}", fontsize=9)
    for axes in panels[-1]:
        axes.set_xlabel("false tracks per run, 160 m", fontsize=9)
    for axes in panels[:, 0]:
        axes.set_ylabel("continuity", fontsize=9)
    panels[0, 0].legend(fontsize=8, loc="center right")
    figure.savefig(options.picture, dpi=110)


def main() -> None:
    """Print the tables and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--pings", type=int, default=150)
    parser.add_argument("--scr", type=float, nargs="+", default=[0.0, 5.0, 10.0, 13.0])
    parser.add_argument("--every-pfa-at", type=float, nargs="*", default=[10.0], metavar="SCR")
    parser.add_argument("--correlation", type=float, nargs="+", default=[0.0, 3.0], help="pings; 0 is white")
    parser.add_argument("--chain", choices=list(CHAINS), action="append", help="only these")
    parser.add_argument("--gate-m", type=float, default=10.0)
    parser.add_argument("--picture", type=Path, default=Path("active_array.png"))
    parser.add_argument("--log", type=Path, help="a line of JSON per run and chain, to go on from")
    parser.add_argument("--times", action="store_true", help="only the times of the stages")
    parser.add_argument("--rounds", type=int, default=15, help="pings timed")
    options = parser.parse_args()
    console = Console(width=150)
    with threadpool_limits(1):
        if options.times:
            console.print(stage_times(options.rounds))
            return
        results = run(options)
    for correlation in options.correlation:
        console.print(table(results, options, correlation))
    draw(results, options)


if __name__ == "__main__":
    main()
