"""Tables of what was measured: medians over the rounds, ratios within each round."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from rich.table import Table

from benchmarks.transport_peers.results import Result

__all__ = ["Results", "fan_out_table", "goals_table", "size_table", "stall_table"]

Results = Mapping[str, Sequence[Result | None]]
BASE = "zenoh"


class Goal(NamedTuple):
    """A bound of our p50 or throughput over a peer's."""

    against: str
    size: str
    what: str
    bound: float
    asked: bool = True  # else to reach for


def median(values: Sequence[float]) -> float:
    """The median of those that are there, NaN without any."""
    found = [value for value in values if not math.isnan(value)]
    return statistics.median(found) if found else float("nan")


def over_rounds(results: Results, name: str, figure: Callable[[Result], float]) -> float:
    """The median of a figure."""
    return median([figure(result) for result in results.get(name, ()) if result is not None])


def ratio(results: Results, name: str, base: str, figure: Callable[[Result], float]) -> float:
    """The median of the ratios to `base` in the same round."""
    pairs = zip(results.get(name, ()), results.get(base, ()), strict=False)
    return median([figure(a) / figure(b) for a, b in pairs if a is not None and b is not None and figure(b)])


def size_table(size: str, number: int, results: Results) -> Table:
    """One size: its steps are 2 x number (paced) and the next (unpaced)."""
    paced, unpaced = 2 * number, 2 * number + 1
    table = Table(title=f"{size}, numpy array to numpy array, {_rounds(results)} rounds")
    for column in ("", "p50 us", "p99 us", "p50 ratio", "send us", "msg/s", "GB/s", "ratio", "lost", "torn"):
        table.add_column(column, justify="right" if column else "left")
    for name in results:
        lost = over_rounds(results, name, lambda r: r.lost(unpaced))
        lost_paced = over_rounds(results, name, lambda r: r.lost(paced))
        table.add_row(
            name,
            _text(over_rounds(results, name, lambda r: r.p50_us[paced]), ".0f"),
            _text(over_rounds(results, name, lambda r: r.p99_us[paced]), ".0f"),
            _text(ratio(results, name, BASE, lambda r: r.p50_us[paced]), ".2f"),
            _text(over_rounds(results, name, lambda r: r.send_us[paced]), ".0f"),
            _text(over_rounds(results, name, lambda r: r.rate[unpaced]), ".0f"),
            _text(over_rounds(results, name, lambda r: r.gbps[unpaced]), ".2f"),
            _text(ratio(results, name, BASE, lambda r: r.rate[unpaced]), ".2f"),
            f"{_text(100 * lost_paced, '.1f')} / {_text(100 * lost, '.1f')} %",
            _text(over_rounds(results, name, lambda r: float(r.torn + r.disordered)), ".0f"),
        )
    table.caption = f"ratios to '{BASE}' within a round; lost: paced / unpaced"
    return table


def goals_table(sizes: Sequence[str], results: Results) -> Table:
    """The goals for our own transport, each a ratio within a round, and what lies beyond them."""
    table = Table(title="goals, lossless; in brackets: to reach for")
    for column in ("ours", "against", "size", "what", "goal", "seen", ""):
        table.add_column(column)
    for ours in (name for name in ("ring", "link", "link-32") if name in results):
        for goal in _goals(sizes):
            step = 2 * sizes.index(goal.size)
            if goal.what == "p50":
                seen = ratio(results, ours, goal.against, lambda r, at=step: r.p50_us[at])  # type: ignore[misc]
                met, sign = seen <= goal.bound, "<="
            else:
                seen = ratio(results, ours, goal.against, lambda r, at=step + 1: r.rate[at])  # type: ignore[misc]
                met, sign = seen >= goal.bound, ">="
            if not math.isnan(seen):
                bound = f"{sign} {goal.bound}" if goal.asked else f"({sign} {goal.bound})"
                said = "met" if met else "MISSED" if goal.asked else "not reached"
                table.add_row(ours, goal.against, goal.size, goal.what, bound, f"{seen:.2f}", said)
    return table


def fan_out_table(results: Mapping[str, Mapping[int, Sequence[Result | None]]]) -> Table:
    """For each contestant and number of receiving processes: what sending costs, and the latency."""
    table = Table(title="624 kB at 30 Hz to several processes")
    for column in ("", "readers", "send us", "p50 us", "p99 us", "lost"):
        table.add_column(column, justify="right" if column else "left")
    for name, by_readers in results.items():
        for readers, found in by_readers.items():
            one = {name: found}
            table.add_row(
                name,
                str(readers),
                _text(over_rounds(one, name, lambda r: r.send_us[0]), ".0f"),
                _text(over_rounds(one, name, lambda r: r.p50_us[0]), ".0f"),
                _text(over_rounds(one, name, lambda r: r.p99_us[0]), ".0f"),
                f"{_text(100 * over_rounds(one, name, lambda r: r.lost(0)), '.1f')} %",
            )
    return table


def stall_table(results: Mapping[tuple[str, float], tuple[Result, Result] | str]) -> Table:
    """A topic whose reader sleeps, and another one over the same session."""
    table = Table(
        title="500 messages of 624 kB at 100 Hz, their reader asleep once; 1 kB at 100 Hz beside them"
    )
    for column in ("", "asleep s", "received", "disordered", "other p50 us", "other p99 us", "other lost"):
        table.add_column(column, justify="right" if column else "left")
    for (name, stall_s), found in results.items():
        if isinstance(found, str):
            table.add_row(name, f"{stall_s:.0f}", found)
            continue
        first, second = found
        table.add_row(
            name,
            f"{stall_s:.0f}",
            f"{first.received[0]} of {first.sent[0]}",
            str(first.disordered + first.torn),
            f"{second.p50_us[0]:.0f}",
            f"{second.p99_us[0]:.0f}",
            f"{100 * second.lost(0):.1f} %",
        )
    return table


def _goals(sizes: Sequence[str]) -> list[Goal]:
    large = [size for size in ("624 kB", "4 MiB") if size in sizes]
    return [
        Goal(BASE, "4 MiB", "p50", 0.5),
        Goal(BASE, "624 kB", "p50", 1.1),
        Goal(BASE, "624 kB", "p50", 0.8, asked=False),
        *(Goal("dora-drop", size, "p50", 1.0) for size in sizes),
        *(Goal("shm+zenoh", size, "p50", 1.5, asked=size == "4 MiB") for size in sizes),
        *(Goal("ezmsg", size, "throughput", 0.9) for size in large),
        *(Goal("dora-backpressure", size, "throughput", 2.0) for size in large),
        *(Goal("dora-drop", size, "throughput", 2.0, asked=False) for size in large),  # which loses messages
    ]


def _rounds(results: Results) -> int:
    return max((len(found) for found in results.values()), default=0)


def _text(value: float, how: str) -> str:
    return "-" if math.isnan(value) else format(value, how)
