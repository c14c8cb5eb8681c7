"""What a person sees of a run: progress, tables, one line per error."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from fls_flow.catalog import Kind, Listing
from fls_flow.graph import Graph
from fls_flow.messages import Detections, Tracks
from fls_flow.parameters import type_name
from fls_flow.runtime import Report

__all__ = ["Counting", "headline", "kind_table", "kinds_table", "log_to", "nodes_table", "progress"]

STARTING = "starting (a first run compiles)"
SHOWN = 1000  # characters of a logged line


class Counting(Protocol):
    """Takes how many pings are done."""

    def __call__(self, pings: int) -> None:
        """Show `pings` as done."""


@contextmanager
def progress(console: Console, total: int | None, *, shown: bool) -> Iterator[Counting]:
    """A progress bar over pings; without a known total it counts."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not (shown and console.is_terminal),
        refresh_per_second=8,
    )
    with bar:
        task = bar.add_task(STARTING, total=total, rate="")

        def count(pings: int) -> None:
            speed = bar.tasks[0].speed
            rate = f"{speed:.0f}/s" if speed else ""
            bar.update(task, completed=pings, description="pings" if pings else STARTING, rate=rate)

        yield count


@contextmanager
def log_to(console: Console, *, debug: bool) -> Iterator[None]:
    """Show warnings on the console; errors are reported once, at the end."""
    handler = RichHandler(console=console, show_path=False, show_time=False, markup=False)
    handler.setFormatter(_ShortLines("%(message)s"))
    handler.setLevel(logging.DEBUG if debug else logging.WARNING)
    handler.addFilter(lambda record: debug or record.levelno < logging.ERROR)
    root = logging.getLogger()
    before = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(handler)
        root.setLevel(before)


class _ShortLines(logging.Formatter):
    """Cuts lines that no terminal could show: breaking them takes time that grows with their square."""

    def format(self, record: logging.LogRecord) -> str:
        """The message, with a word on what is cut; `run.log` has it whole."""
        return "\n".join(map(self._cut, super().format(record).split("\n")))

    def _cut(self, line: str) -> str:
        return line if len(line) <= SHOWN else f"{line[:SHOWN]}... ({len(line):,} characters, see run.log)"


def headline(graph: Graph, report: Report) -> dict[str, float]:
    """The main figures of a run: pings, detections that reach a tracker, confirmed tracks, pings/s."""
    figures: dict[str, float] = {"pings": report.pings}
    measured = {
        (wire.node, wire.output) for node in graph.nodes for wire in node.inputs if _tracks(node.kind)
    }
    if measured:
        figures["detections"] = sum(
            tally.entries
            for name, counts in report.counts.items()
            for output, tally in counts.outputs.items()
            if (name, output) in measured and _gives(graph.node(name).kind, output, Detections)
        )
        figures["confirmed tracks"] = sum(
            tally.confirmed for counts in report.counts.values() for tally in counts.outputs.values()
        )
    shed = report.counts[graph.clock].shed if graph.clock in report.counts else 0
    return {**figures, **({"shed pings": shed} if shed else {}), "pings/s": round(report.pings_per_s, 1)}


def _tracks(kind: Kind) -> bool:
    return any(port.message is Tracks for port in kind.outputs)


def _gives(kind: Kind, output: str, message: type) -> bool:
    port = kind.output(output)
    return port is not None and port.message is message


def nodes_table(graph: Graph, report: Report) -> Table:
    """A row per node: firings, time, and what came out."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("node", "kind"):
        table.add_column(name)
    for name in ("fired", "ms p50", "ms p99"):
        table.add_column(name, justify="right")
    table.add_column("gave")
    for node in graph.nodes:
        counts = report.counts.get(node.name)
        if counts is None:  # it runs on another host
            continue
        gave = [f"{tally.entries:,} {name}" for name, tally in counts.outputs.items() if tally.entries]
        gave += [f"{counts.failed} failed"] * bool(counts.failed) + [f"{counts.shed} shed"] * bool(
            counts.shed
        )
        gave += [f"{counts.dropped} dropped"] * bool(counts.dropped)
        taken = [counts.percentile_ms(q) for q in (50, 99)]  # unknown of one that died
        times = ["" if math.isnan(ms) else f"{ms:.2f}" for ms in taken]
        table.add_row(node.name, node.kind.name, str(counts.fired), *times, ", ".join(gave))
    return table


def kinds_table(listings: tuple[Listing, ...]) -> Table:
    """The installed kinds."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("kind", "distribution", "version", "module"):
        table.add_column(name)
    for one in listings:
        table.add_row(one.kind, one.distribution, one.version, one.module)
    return table


def kind_table(kind: Kind) -> Table:
    """Ports and parameters of one kind."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for port in kind.inputs:
        message = port.message.__name__
        shown = f"tuple[{message}, ...] @time" if port.stream else message
        shown += " | None (@previous allowed)" if port.nullable else ""
        table.add_row("input", port.name, shown, "optional" if port.optional else "")
    if kind.takes_any is not None:
        table.add_row("input", "any name", kind.takes_any.__name__, "optional")
    for out in kind.outputs:
        table.add_row("output", out.name, out.message.__name__, "")
    for one in kind.parameters:
        default = "required" if one.required else f"= {one.default!r}"
        table.add_row("parameter", one.name, type_name(one.annotation), default)
    return table
