"""What the diver chain sees: chips with their regions, ping by ping, and features over time.

python -m benchmarks.diver_pictures --recording docs/diver_recording.png --simulated docs/diver_chips.png
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fls_flow.testing import run_graph

PORTS = ("chips.chips", "regions.regions", "static.features", "tracker.tracks")
COLUMNS = 10
GATE_M = 1.5
Row = tuple[str, list[tuple[Any, Any, int, int]]]  # a name; chips, regions, which of them, seq


def seen(graph: str, ports: Sequence[str], settings: Sequence[str]) -> dict[str, list[Any]]:
    """What the ports give."""
    with TemporaryDirectory() as out:
        return run_graph(graph, collect=ports, set_=settings, out=Path(out))


def by_track(found: dict[str, list[Any]]) -> dict[int, list[tuple[Any, Any, int, int]]]:
    """The described chips of each track."""
    rows: dict[int, list[tuple[Any, Any, int, int]]] = {}
    for chips, regions in zip(found["chips.chips"], found["regions.regions"], strict=True):
        for k, track in enumerate(chips.track_id.tolist()):
            if regions.kept[k]:
                rows.setdefault(track, []).append((chips, regions, k, chips.seq))
    return rows


def draw_chips(axes: Any, rows: list[Row], half_m: float) -> None:
    """A row of chips, evenly over the time of each track, in metres about the track."""
    for line, (name, chips_of) in zip(axes, rows, strict=False):
        chosen = np.linspace(0, len(chips_of) - 1, COLUMNS).astype(int)
        for axis, number in zip(line, chosen, strict=True):
            chips, regions, k, seq = chips_of[number]
            r, b = chips.range_m[k], chips.bearing_rad[k]
            b = b - b[chips.centre[k, 1]]
            x, y = r[:, None] * np.cos(b), r[:, None] * np.sin(b)
            axis.pcolormesh(y, x - r[chips.centre[k, 0]], chips.amplitude[k], cmap="inferno", rasterized=True)
            axis.contour(y, x - r[chips.centre[k, 0]], regions.mask[k], [0.5], colors="c", linewidths=0.7)
            axis.set(xlim=(-half_m, half_m), ylim=(-half_m, half_m), aspect="equal", xticks=[], yticks=[])
            axis.set_title(f"ping {seq}", fontsize=6)
        line[0].set_ylabel(name, fontsize=7)


def recording(path: Path) -> None:
    """The real recording: chips of the longest tracks, and two features of them."""
    from matplotlib.figure import Figure

    found = seen("diver_on_recording", PORTS, ["picture.pings=[80]"])
    longest = sorted(by_track(found).items(), key=lambda item: -len(item[1]))[:3]
    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(3, 2))
    upper, lower = parts
    axes = upper.subplots(3, COLUMNS, squeeze=False)
    draw_chips(axes, [(f"track {track}", chips) for track, chips in longest], 0.8)
    plots = lower.subplots(1, 3)
    for axis, name in zip(plots, ("area_m2", "major_axis_m", "mean"), strict=True):
        for track, _ in longest:
            points = [
                (one.seq, one.values[k, one.names.index(name)])
                for one in found["static.features"]
                for k in np.flatnonzero(one.track_id == track)
            ]
            axis.plot(*zip(*points, strict=True), ".-", label=f"track {track}")
        axis.set(xlabel="ping", ylabel=name)
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=80)


def simulated(path: Path, seed: int) -> None:
    """Simulated swimmers: the longest track on each kind."""
    from matplotlib.figure import Figure

    settings = [f"sonar.seed={seed}", "sonar.pings=300", "sonar.name_circuits=true", "sonar.stay_s=40"]
    found = seen("diver_training", (*PORTS, "sonar.truth"), settings)
    kinds: dict[str, tuple[int, int]] = {}
    names: dict[int, dict[str, int]] = {}
    for tracks, truth in zip(found["tracker.tracks"], found["sonar.truth"], strict=True):
        if not len(truth):
            continue
        for track, state in zip(tracks.id.tolist(), tracks.state, strict=True):
            apart = np.hypot(*(truth.state[:, :2] - state[:2]).T)
            if apart.min() < GATE_M:
                name = truth.class_name[int(apart.argmin())]
                names.setdefault(track, {}).setdefault(name, 0)
                names[track][name] += 1
    chips_of = by_track(found)
    for track, chips in chips_of.items():
        if track in names:
            name = max(names[track], key=lambda one: names[track][one])
            kinds[name] = max(kinds.get(name, (0, 0)), (len(chips), track))
    rows: list[Row] = [(name, chips_of[track]) for name, (_, track) in sorted(kinds.items())]
    figure = Figure(figsize=(11.0, 1.15 * len(rows) + 0.3), layout="constrained")
    draw_chips(figure.subplots(len(rows), COLUMNS, squeeze=False), rows, 3.5)
    figure.savefig(path, dpi=80)


def main() -> None:
    """Draw what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--simulated", type=Path)
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    if options.recording:
        recording(options.recording)
    if options.simulated:
        simulated(options.simulated, options.seed)


if __name__ == "__main__":
    main()
