"""How simulated divers move, beside real ones: speed, turns, size over time, how long they stay.

    python -m benchmarks.diver_motion --picture docs/diver_motion.png

The real ones are boxes in sonar sequences of unknown scale (tests/golden/diver_motion, DeMarco 2013): so
speeds are in body lengths a second. Both go through the same steps: boxes every half second, centres averaged
over 1.5 s, motion over 1 s.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_sources.harbour_scene import HarbourScene

FloatArray = npt.NDArray[np.float64]
Track = tuple[FloatArray, FloatArray]  # time_s (n,), boxes (n, 4): centre x, y, width, height

REAL = Path(__file__).parents[1] / "tests" / "golden" / "diver_motion" / "tracks.csv"
STEP_S = 0.5
LEAST_MOTION = 0.05  # lengths a second, below which a heading means nothing
MEASURES = {
    "speed": "speed, lengths/s",
    "turn": "turn, rad/s",
    "size": "sd of ln(area) in a stay",
    "aspect": "long over short side of the box",
    "stay": "stay, s",
}


def real_tracks() -> list[Track]:
    """The boxes of real divers, cut where frames are missing."""
    with REAL.open(newline="") as file:
        rows = np.array([[float(x) for x in row.values()] for row in csv.DictReader(file)])
    tracks = []
    for diver in np.unique(rows[:, 0]):
        one = rows[rows[:, 0] == diver]
        parts = np.split(one, np.flatnonzero(np.diff(one[:, 1]) > 5.0) + 1)
        tracks += [(part[:, 1] / 10.0, part[:, 2:]) for part in parts]
    return tracks


def simulated_tracks(seeds: range, pings: int = 2000) -> list[Track]:
    """The boxes around the bodies of simulated divers of all circuits, without their bubbles."""
    tracks = []
    for seed in seeds:
        scene = HarbourScene(pings=pings, seed=seed, seals=0, dolphins=0, fish_schools=0)
        planned = scene._plan(scene._sonar(), scene._stamps())
        end_s = pings * scene.ping_interval_s
        for place in range(planned.who.shape[1]):
            visits: dict[int, list[FloatArray]] = {}
            for time_s in np.arange(0.0, end_s, STEP_S):
                places, who = planned.present(float(time_s))
                if place in places:
                    w = int(who[np.flatnonzero(places == place)[0]])
                    box = _box(planned, place, w, float(time_s))
                    visits.setdefault(w, []).append(np.array([time_s, *box]))
            tracks += [(np.array(v)[:, 0], np.array(v)[:, 1:]) for v in visits.values()]
    return tracks


def _box(planned: Any, place: int, w: int, time_s: float) -> FloatArray:
    visitor = planned.visitors[w]
    x, y, _, _, heading, turn = planned.states(time_s, np.array([place]))[0]
    offset = visitor.body.echoes(time_s - visitor.start_s, float(turn)).offset_m
    c, s = np.cos(heading), np.sin(heading)
    body = offset @ np.array([[c, s], [-s, c]]) + [x, y]
    low, high = body.min(axis=0) - 0.15, body.max(axis=0) + 0.15  # the blur of cell and beam
    return np.concatenate([(low + high) / 2.0, high - low])


def measured(tracks: list[Track]) -> dict[str, FloatArray]:
    """Every measure over all tracks: a value per second of motion, or one per stay."""
    found: dict[str, list[float]] = {name: [] for name in MEASURES}
    for time_s, box in tracks:
        if len(time_s) < 6:
            continue
        length = float(np.median(box[:, 2:].max(axis=1)))
        centre = np.stack([np.convolve(box[:, k], np.ones(3) / 3.0, "valid") for k in (0, 1)], axis=1)
        velocity = (centre[2:] - centre[:-2]) / length  # over 1 s
        speed = np.hypot(*velocity.T)
        heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        moves = (speed[2:] > LEAST_MOTION) & (speed[:-2] > LEAST_MOTION)
        found["speed"] += speed.tolist()
        found["turn"] += np.abs(heading[2:] - heading[:-2])[moves].tolist()
        found["size"].append(float(np.log(box[:, 2] * box[:, 3]).std()))
        found["aspect"] += (box[:, 2:].max(axis=1) / box[:, 2:].min(axis=1)).tolist()
        found["stay"].append(float(time_s[-1] - time_s[0]))
    return {name: np.array(values) for name, values in found.items()}


def distance(one: FloatArray, other: FloatArray) -> float:
    """The largest difference between two distribution functions (Kolmogorov-Smirnov)."""
    at = np.sort(np.concatenate([one, other]))
    share = [np.searchsorted(np.sort(x), at, side="right") / x.size for x in (one, other)]
    return float(np.abs(share[0] - share[1]).max())


def table(real: dict[str, FloatArray], simulated: dict[str, FloatArray]) -> str:
    """Quartiles of both, and their distance."""
    lines = [f"{'':34}{'real: 25 % / 50 / 75':>24}{'simulated':>24}{'KS':>7}"]
    for name, words in MEASURES.items():
        quartiles = [
            " / ".join(f"{q:.2f}" for q in np.percentile(x[name], [25, 50, 75])) for x in (real, simulated)
        ]
        lines.append(
            f"{words:34}{quartiles[0]:>24}{quartiles[1]:>24}{distance(real[name], simulated[name]):7.2f}"
        )
    return "\n".join(lines)


def draw(real: dict[str, FloatArray], simulated: dict[str, FloatArray], path: Path) -> None:
    """The distribution functions of both."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 3.2), layout="constrained")
    axes = figure.subplots(1, len(MEASURES))
    for axis, (name, words) in zip(axes, MEASURES.items(), strict=True):
        for values, label in ((real[name], "real"), (simulated[name], "simulated")):
            axis.plot(np.sort(values), np.arange(1, values.size + 1) / values.size, label=label)
        axis.set_xlabel(words)
        axis.set_xlim(0.0, np.percentile(np.concatenate([real[name], simulated[name]]), 98.0))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("share below")
    axes[0].legend()
    figure.savefig(path, dpi=90)


def main() -> None:
    """Print the table; draw the picture if asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    real, simulated = measured(real_tracks()), measured(simulated_tracks(range(options.seeds)))
    print(table(real, simulated))
    if options.picture:
        draw(real, simulated, options.picture)


if __name__ == "__main__":
    main()
