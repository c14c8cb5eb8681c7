"""Latency and throughput between two processes of one host, side by side with the peers.

    pip install -e ".[bench]"
    python -m benchmarks.transport [--rounds 5] [--quick] [--only ring,zenoh] [--json FILE]

Each contestant runs in fresh processes, all of them once per round, in turn; medians over the rounds. Latency
is one way, from before the sender's first copy to a numpy array at the receiver, at 100 Hz (4 MiB: 30 Hz);
throughput is unpaced. Ratios are taken within a round: compare those between machines, not the microseconds.
On a machine that has other work, `chrt -r 10` before the command keeps that out of all contestants alike.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from benchmarks.transport_peers.report import fan_out_table, goals_table, size_table, stall_table
from benchmarks.transport_peers.results import Result
from benchmarks.transport_peers.rig import Step
from benchmarks.transport_peers.running import Contestant, measure, measure_stall

SIZES = {"1 kB": 1024, "78 kB": 78_000, "624 kB": 624_000, "4 MiB": 4 << 20}
FAN_OUT = ("zenoh", "zenoh-tcp", "ezmsg", "ring", "link")
STALL = {"zenoh": "over_zenoh", "ring": "over_ring", "link": "over_link"}


CONTESTANTS = (
    Contestant("memcpy", "memcpy", "", "numpy"),
    Contestant("pipe", "pipe", "", "numpy"),
    Contestant("zenoh", "over_zenoh", "default", "zenoh"),
    Contestant("zenoh-tcp", "over_zenoh", "tcp", "zenoh"),
    Contestant("shm+zenoh", "plain_shm", "tcp", "zenoh"),
    Contestant("dora-drop", "over_dora", "drop_oldest", "dora", "pip install dora-rs dora-rs-cli"),
    Contestant("dora-backpressure", "over_dora", "backpressure", "dora", "pip install dora-rs dora-rs-cli"),
    Contestant("ezmsg", "over_ezmsg", "", "ezmsg", "pip install ezmsg"),
    Contestant("ring", "over_ring", "tcp", "fls_flow.links.ring"),
    Contestant("link", "over_link", "tcp", "fls_flow.links.zenoh"),
    Contestant("link-32", "over_link", "tcp-32", "fls_flow.links.zenoh"),  # in flight as ezmsg has
    Contestant("runtime", "over_runtime", "tcp", "fls_flow.runtime.run"),
)


def steps_of(quick: bool) -> list[Step]:
    """Per size: paced for latency, then unpaced for throughput."""
    steps = []
    for size in SIZES.values():
        rate_hz = 30.0 if size > 1 << 20 else 100.0
        paced = Step(size, int(rate_hz) if quick else int(1.6 * rate_hz), rate_hz)
        unpaced = Step(size, 20_000, 0.0, limit_s=0.4 if quick else 0.8)
        steps += [paced, unpaced]
    return steps


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="two short rounds at most")
    parser.add_argument("--only", default="", help="names, separated by commas")
    parser.add_argument("--parts", default="sizes,fan-out,stall", help="which tables, separated by commas")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds per measurement")
    parser.add_argument("--json", type=Path, help="write every result of the sizes here too")
    options = parser.parse_args()
    console = Console(width=120)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # through `finally`: its processes end with it
    rounds = min(2, options.rounds) if options.quick else options.rounds
    chosen = installed(options.only, console)
    if "sizes" in options.parts:
        results = play(chosen, rounds, options, console)
        for number, size in enumerate(SIZES):
            console.print(size_table(size, number, results))
        console.print(goals_table(list(SIZES), results))
        if options.json:
            options.json.write_text(json.dumps(results, default=vars), encoding="utf-8")
    if "fan-out" in options.parts:
        console.print(fan_out_table(fan_out(chosen, rounds, options.limit)))
    if "stall" in options.parts:
        console.print(stall_table(stall(chosen, 2.0 if options.quick else 8.0, options.limit)))


def installed(only: str, console: Console) -> list[Contestant]:
    """Those that were asked for and can be run; says which cannot."""
    chosen = [contestant for contestant in CONTESTANTS if not only or contestant.name in only.split(",")]
    for contestant in chosen:
        if not contestant.is_there:
            console.print(f"{contestant.name}: not there; {contestant.hint}", markup=False)
    locked = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if os.geteuid() and 0 <= locked < 32 << 20:
        console.print(f"only {locked} bytes can be locked: zenoh and dora may go without shared memory")
    return [contestant for contestant in chosen if contestant.is_there]


def play(
    chosen: Sequence[Contestant], rounds: int, options: argparse.Namespace, console: Console
) -> dict[str, list[Result | None]]:
    """The results of every contestant, round by round; None where it failed, which is said."""
    results: dict[str, list[Result | None]] = {contestant.name: [] for contestant in chosen}
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("measuring", total=rounds * len(chosen))
        for _ in range(rounds):
            for contestant in chosen:
                progress.update(task, description=contestant.name)
                result = measure(contestant, steps_of(options.quick), options.limit)
                if isinstance(result, str):
                    console.print(f"{contestant.name} failed: {result}", markup=False)
                results[contestant.name].append(None if isinstance(result, str) else result)
                progress.advance(task)
    return results


def fan_out(
    chosen: Sequence[Contestant], rounds: int, limit_s: float
) -> dict[str, dict[int, list[Result | None]]]:
    """The results with one, two and four receiving processes."""
    steps = [Step(624_000, 60, 30.0)]
    results: dict[str, dict[int, list[Result | None]]] = {}
    for _ in range(rounds):
        for contestant in (c for c in chosen if c.name in FAN_OUT):
            for readers in (1, 2, 4):
                result = measure(contestant, steps, limit_s, readers)
                found = results.setdefault(contestant.name, {}).setdefault(readers, [])
                found.append(None if isinstance(result, str) else result)
    return results


def stall(
    chosen: Sequence[Contestant], stall_s: float, limit_s: float
) -> dict[tuple[str, float], tuple[Result, Result] | str]:
    """The results without and with a reader that sleeps."""
    names = [c.name for c in chosen]
    return {
        (name, seconds): measure_stall(module, seconds, limit_s)
        for name, module in STALL.items()
        if name in names
        for seconds in (0.0, stall_s)
    }


if __name__ == "__main__":
    main()
