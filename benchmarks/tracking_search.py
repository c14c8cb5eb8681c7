"""Search Stone Soup's settings for `benchmarks/tracking.py`, on seeds that it does not use.

    python -m benchmarks.tracking_search --scene many --method GNN [--scans 100] [--seeds 1001]

One setting after the other takes the value with the least mean GOSPA over the first `--scans` scans, the
others being what they are by then; printed are all that were tried. In the dense scene it does some two scans
a second, so that a search of one method takes ten minutes per seed.
"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks import tracking_stonesoup as soup
from benchmarks.tracking import outcome, theirs
from benchmarks.tracking_scenes import SCENES, Seen

GRID: dict[str, tuple[Any, ...]] = {
    "min_points": (4, 5, 6, 8),
    "hold_steps": (2, 3, 4),
    "missed_distance": (3.0, 4.0),
    "start_speed_sd_mps": (0.3, 0.5),
    "delete_steps": (4, 6, 10, 15),
}


def gospa_m(name: str, method: str, settings: soup.SoupSettings, drawn: list[list[Seen]]) -> float:
    """The mean GOSPA over the runs, which it prints with the other scores."""
    found = [outcome(theirs(method, settings), SCENES[name], seen).scores for seen in drawn]
    means = {key: float(np.mean([one[key] for one in found])) for key in found[0]}
    print(settings, {key: round(value, 3) for key, value in means.items()}, flush=True)
    return means["gospa"]


def search(name: str, method: str, drawn: list[list[Seen]]) -> soup.SoupSettings:
    """The settings that one pass over the grid ends with."""
    best = soup.SETTINGS[name][method]
    least = gospa_m(name, method, best, drawn)
    for key, values in GRID.items():
        start = best
        for value in values:
            tried = dataclasses.replace(start, **{key: value})
            if value == getattr(start, key):
                continue
            score = gospa_m(name, method, tried, drawn)
            if score < least:
                best, least = tried, score
    return best


def main() -> None:
    """Print the search."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--scene", choices=list(SCENES), default="many")
    parser.add_argument("--method", choices=list(soup.METHODS), action="append", required=True)
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1001])
    options = parser.parse_args()
    drawn = [SCENES[options.scene].draw(seed)[: options.scans] for seed in options.seeds]
    with threadpool_limits(1):
        for method in options.method:
            print(options.scene, method, "best:", search(options.scene, method, drawn))


if __name__ == "__main__":
    main()
