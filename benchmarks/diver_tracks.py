"""How long one track holds a diver: three divers for 1,200 pings, among animals, in clutter.

    python -m benchmarks.diver_tracks [--use tracker=nnkf] [--clutter k] [--alone] [--no-animals] [--slow]

For each diver: the longest run of pings in which it was in the sector, as nothing holds one that has left;
the share of its pings after the warm-up in which a confirmed track is within 2.5 m (its own bubbles pull the
track behind it), the longest run of pings on one track (in both runs with gaps of at most ten pings), and how
many tracks followed it. Beside it, confirmed tracks that follow nobody, per ping. Below, how many divers one
track held for 1,000 pings, how many were not in view that long, and the CPU time of the tracker for a ping.
With `--alone`, each circuit is in a scene of its own, without animals; with `--slow`, divers hardly move:
0.05 to 0.1 m/s.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Tracks, TrackStatus, Truth
from fls_flow import graph as graphs
from fls_sources.harbour_plan import GAITS

GRAPH = "diver_training"
GATE_M, WARM_UP, MOST_GAP = 2.5, 40, 10
GOAL = 1000  # pings on one track
NO_ANIMALS = ("sonar.seals=0", "sonar.dolphins=0", "sonar.fish_schools=0")
SLOW_MPS = (0.05, 0.1)
CIRCUITS = ("open_divers", "semi_closed_divers", "closed_divers")


def followed(tracks: list[Tracks], truths: list[Truth], target: int) -> list[int]:
    """The confirmed track on a target, per ping in which it is there; -1 for none.

    A track that was on it stays on it as long as it is within the gate; else the nearest one is (CLEAR MOT).
    """
    found: list[int] = []
    for track, truth in zip(tracks[WARM_UP:], truths[WARM_UP:], strict=True):
        at = np.flatnonzero(truth.target_id == target)
        if not at.size:
            continue
        sure = track.select(track.status == TrackStatus.CONFIRMED)
        apart = np.hypot(*(sure.state[:, :2] - truth.state[at[0], :2]).T)
        near = apart.size > 0 and apart.min() <= GATE_M
        before = np.flatnonzero(sure.id == found[-1]) if found else np.zeros(0, int)
        if before.size and apart[before[0]] <= GATE_M:
            found.append(found[-1])
        else:
            found.append(int(sure.id[apart.argmin()]) if near else -1)
    return found


def longest(found: list[int]) -> int:
    """The longest stretch of pings held by one track, gaps of `MOST_GAP` pings allowed."""
    return max((stretch(np.array(found) == one) for one in set(found) - {-1}), default=0)


def in_view(truths: list[Truth], target: int) -> int:
    """The longest stretch of pings after the warm-up with a target in the sector, with the same gaps."""
    return stretch(np.array([bool((truth.target_id == target).any()) for truth in truths[WARM_UP:]]))


def stretch(holds: npt.NDArray[np.bool_]) -> int:
    """The longest run of true ones, over gaps of at most `MOST_GAP`."""
    at = np.flatnonzero(holds)
    if not at.size:
        return 0
    cuts = np.flatnonzero(np.diff(at) > MOST_GAP + 1)
    starts, ends = at[np.r_[0, cuts + 1]], at[np.r_[cuts, at.size - 1]]
    return int((ends - starts + 1).max())


def strays(tracks: list[Tracks], truths: list[Truth]) -> float:
    """Confirmed tracks farther than 5 m from every target, per ping."""
    count = 0
    for track, truth in zip(tracks[WARM_UP:], truths[WARM_UP:], strict=True):
        sure = track.select(track.status == TrackStatus.CONFIRMED).state[:, :2]
        apart = np.linalg.norm(sure[:, None] - truth.state[None, :, :2], axis=-1)
        count += int((apart.min(axis=1, initial=np.inf) > 5.0).sum())
    return count / (len(tracks) - WARM_UP)


def played(given: Sequence[str], use: Sequence[str]) -> tuple[list[Tracks], list[Truth], float]:
    """Tracks and truth of a scene, and the median CPU ms of the tracker for a ping."""
    graph = graphs.load(GRAPH, use=use, set_=given, sinkless=True)
    nodes = (graph.node(name) for name in ("sonar", "detect", "tracker"))
    sonar, detect, tracker = (node.kind.cls(**node.arguments) for node in nodes)
    tracks, truths, spent = [], [], []
    for ping, truth in sonar():
        events = detect(ping).detections
        began = time.thread_time()
        tracks.append(tracker(events))
        spent.append(1e3 * (time.thread_time() - began))
        truths.append(truth)
    return tracks, truths, statistics.median(spent)


class Held(NamedTuple):
    """How long one track held a diver, and how long it could have, in pings."""

    pings: int
    in_view: int


def judged(seed: int, given: Sequence[str], use: Sequence[str]) -> tuple[list[Held], float]:
    """Print a row per diver of a scene; gives how long one track held each, and the ms per ping."""
    tracks, truths, spent_ms = played([f"sonar.seed={seed}", *given], use)
    away, held = strays(tracks, truths), []
    for target, name in zip(truths[0].target_id, truths[0].class_name, strict=True):
        if name.startswith("diver"):
            found = followed(tracks, truths, int(target))
            held.append(Held(longest(found), in_view(truths, int(target))))
            print(
                f"{seed:5d} {name[6:]:12} {len(found):6d} {held[-1].in_view:8d} "
                f"{np.mean(np.array(found) >= 0):6.3f} {held[-1].pings:8d} "
                f"{len(set(found) - {-1}):7d}   {away:.3f}",
                flush=True,
            )
    return held, spent_ms


def told(held: list[Held], ms: float) -> None:
    """Print the lines below the table."""
    many = sum(one.pings >= GOAL for one in held)
    unseen = sum(one.in_view < GOAL for one in held)
    middle = statistics.median(one.pings for one in held)
    print(f"one track held {many} of {len(held)} divers for {GOAL} pings or more; median {middle:.0f}")
    print(f"{unseen} of them were in view for fewer pings in a row than that")
    print(f"tracker: {ms:.3f} ms per ping")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first", type=int, default=2001, help="seed")
    parser.add_argument("--pings", type=int, default=1200)
    parser.add_argument("--clutter", default="rayleigh", choices=("rayleigh", "k", "measured"))
    parser.add_argument("--alone", action="store_true", help="one diver at a time, no animals")
    parser.add_argument("--no-animals", action="store_true", help="three divers")
    parser.add_argument("--use", action="append", default=[], help="NODE=KIND")
    parser.add_argument("--set", action="append", default=[], help="NODE.PARAM=VALUE")
    parser.add_argument("--slow", action="store_true", help="divers that hardly move")
    options = parser.parse_args()
    if options.slow:
        GAITS["diver"] = GAITS["diver"]._replace(speed_mps=SLOW_MPS)
    given = [f"sonar.pings={options.pings}", f"sonar.clutter={options.clutter}"]
    given += ["sonar.stay_s=100000", "sonar.name_circuits=true"]
    given += NO_ANIMALS if options.alone or options.no_animals else ()
    scenes = [[f"sonar.{other}=0" for other in CIRCUITS if other != one] for one in CIRCUITS]
    columns = f"{'pings':>6} {'in view':>8} {'held':>6} {'longest':>8} {'tracks':>7}   strays/ping"
    print(f"{'seed':>5} {'diver':12} {columns}")
    held, spent_ms = [], []
    for seed in range(options.first, options.first + options.seeds):
        for scene in scenes if options.alone else [[]]:
            runs, ms = judged(seed, [*given, *scene, *options.set], options.use)
            held += runs
            spent_ms.append(ms)
    told(held, statistics.median(spent_ms))


if __name__ == "__main__":
    main()
