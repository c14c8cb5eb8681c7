"""`fls-flow sweep`."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fls_flow.cli.common import JSON, USE, screen
from fls_flow.errors import UserError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from fls_flow.tools.cell import Row, Task
    from fls_flow.tools.records import Records
    from fls_flow.tools.summary import Group
    from fls_flow.tools.sweep import Sweep

__all__ = ["sweep"]


@click.command()
@click.argument("graph")
@click.option(
    "--set",
    "set_",
    multiple=True,
    metavar="NODE.PARAM=VALUES",
    help="Values a,b,c or a range start:stop[:step]; of paths, a folder or a pattern. A comma in quotes or "
    "brackets is part of a value. Repeatable.",
)
@click.option(
    "--metric",
    multiple=True,
    help="Score to show: gospa, ospa, pd, phd_ospa, ..., pings, detections. Repeatable.",
)
@click.option("--over", multiple=True, metavar="NODE.PARAM", help="Average over this too, as over seeds.")
@click.option("--tracks", metavar="NODE", help="Whose tracks are scored, when there are several.")
@click.option("--detections", metavar="NODE", help="Whose detections are scored, likewise.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the results [sweeps/GRAPH/DIGEST].")
@click.option("--workers", type=click.IntRange(1, 1024), help="Processes here [all processors].")
@click.option("--dask", metavar="ADDRESS", help="Run on the Dask cluster of this scheduler instead.")
@click.option("--keep", is_flag=True, help="Keep the files of all sinks, in a folder per cell.")
@click.option("--no-progress", is_flag=True, help="No progress bar.")
@USE
@JSON
def sweep(graph: str, as_json: bool, **options: Any) -> int:
    """Run GRAPH over a grid of parameters or a folder of recordings, and score every cell.

    \b
    Examples:
      fls-flow sweep surface_obstacle --set cfar.pfa=1e-5,1e-6,1e-7 --set sonar.seed=0:20 --metric gospa
      fls-flow sweep surface_obstacle --set cfar.pfa=1e-4,1e-5 --metric pd --detections cfar
      fls-flow sweep graph.yaml --set sonar.path=recordings/ --metric detections
    The same command goes on where a sweep was stopped.
    """
    from fls_flow.tools.records import Records
    from fls_flow.tools.sweep import prepare

    prepared = prepare(
        graph,
        use=options["use"],
        set_=options["set_"],
        metrics=options["metric"],
        tracks=options["tracks"],
        detections=options["detections"],
    )
    for name in options["over"]:
        if name not in {axis.name for axis in prepared.grid.axes}:
            raise UserError(f"--over {name}: is no axis of the grid; give its values with --set")
    out = options["out"] or prepared.folder
    with Records(out, prepared.about) as records:
        interrupted = not _cells(prepared, records, options, shown=not (as_json or options["no_progress"]))
        return _report(prepared, records, options["over"], as_json=as_json, interrupted=interrupted)


def _cells(prepared: Sweep, records: Records, options: dict[str, Any], *, shown: bool) -> bool:
    """Do what is missing; False when a signal came before the end."""
    from fls_flow import console

    done = [row.index for row in records.rows.values() if row.status == "ok"]
    keep = (records.path / "cells").absolute() if options["keep"] else None
    tasks = prepared.tasks(done, keep)
    if shown:
        already = f", {len(done)} of them done" if done else ""
        click.echo(f"{len(prepared.grid)} cells{already}; writing to {records.path}", err=True)
    if not tasks:
        return True
    terminal = screen(stderr=True)
    try:
        with console.log_to(terminal, debug=False), _signals(), _progress(terminal, shown=shown) as bar:
            shown_task = bar.add_task("cells", total=len(prepared.grid), completed=len(done))
            with contextlib.closing(_rows(tasks, options)) as rows:
                for row in rows:
                    records.append(row)
                    bar.advance(shown_task)
                    if row.error is None:
                        _known(prepared, list(row.scores))
                    else:
                        bar.console.print(_failure(prepared, row), markup=False, soft_wrap=True)
    except KeyboardInterrupt:
        return False
    return True


def _failure(prepared: Sweep, row: Row) -> str:
    where = " ".join(f"{name}={label}" for name, label in prepared.grid.labels(row.index).items())
    return f"cell {row.index} ({where}) failed: {row.error}"


def _progress(terminal: Console, *, shown: bool) -> Progress:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, Remaining(), console=terminal, disable=not shown, refresh_per_second=4)


@contextlib.contextmanager
def _signals() -> Iterator[None]:
    """SIGTERM ends a sweep as Ctrl-C does."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _rows(tasks: list[Task], options: dict[str, Any]) -> Generator[Row, None, None]:
    if options["dask"] is not None:
        from fls_flow.tools.cluster import on_cluster

        return on_cluster(tasks, options["dask"])
    from fls_flow.tools.workers import in_processes

    return in_processes(tasks, options["workers"] or len(os.sched_getaffinity(0)))


def _report(
    prepared: Sweep, records: Records, over: tuple[str, ...], *, as_json: bool, interrupted: bool
) -> int:
    from fls_flow.tools import summary

    rows = records.rows
    good = [row for row in rows.values() if row.status == "ok"]
    records.write("cells.csv", summary.csv_text(prepared, rows))
    found = summary.groups(prepared, rows, over)
    if good:
        _known(prepared, summary.known_metrics(good))
        _draw(prepared, records.path, found)
    if as_json:
        cells = [prepared.document(rows[index]) for index in sorted(rows)]
        click.echo(json.dumps({"out": str(records.path), **prepared.about, "cells": cells}))
    else:
        screen(stderr=False).print(summary.table(prepared, found))
        click.echo(f"wrote {records.path}/cells.csv" + (f" and {records.path}/sweep.png" if good else ""))
    if interrupted:
        click.echo(
            f"interrupted: {len(good)} of {len(prepared.grid)} cells are done; the same command goes on",
            err=True,
        )
        return 130
    failed = len(rows) - len(good)
    if failed:
        click.echo(
            f"error: {failed} of {len(prepared.grid)} cells failed; the same command tries them again",
            err=True,
        )
    return 1 if failed else 0


def _known(prepared: Sweep, names: list[str]) -> None:
    """Raise UserError for a metric that no cell has."""
    from fls_flow.catalog import suggest

    for metric in prepared.metrics:
        if metric not in names:
            near = suggest(metric, names) or f"; there are {', '.join(names)}"
            raise UserError(f"--metric {metric}: is no score of these cells{near}")


def _draw(prepared: Sweep, out: Path, found: list[Group]) -> None:
    from fls_flow.tools import curves

    curves.save(out / "sweep.png", prepared, found)
