"""One cell of a sweep: a graph with its parameters, run in order in the calling process, and scored."""

from __future__ import annotations

import copy
import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fls_flow.catalog import Catalog
from fls_flow.console import headline
from fls_flow.errors import FlsFlowError, RunError
from fls_flow.graph import Graph
from fls_flow.graph.check import checked
from fls_flow.graph.read import Source, override
from fls_flow.messages import Detections, Tracks
from fls_flow.runtime import Options, Report, Run, RunFolder, describe

__all__ = ["RUN_FIGURES", "Row", "Task", "Watched", "graph_of", "installed", "run_cell", "run_figures"]

# what a run tells without truth
RUN_FIGURES = ("pings", "detections", "confirmed_tracks")


@dataclass(frozen=True, slots=True)
class Watched:
    """An output to be written as a file for the scores, by a sink of the graph or, without one, by a tap."""

    node: str
    output: str
    kind: str  # of the sink that writes it
    sink: str | None = None


@dataclass(frozen=True, slots=True)
class Task:
    """All that a worker must know; the graph as it was read, so that no edit of its file reaches a cell."""

    index: int
    source: Source
    set_: tuple[str, ...]
    watched: tuple[Watched, ...]
    versions: Mapping[str, str]
    keep: Path | None = (
        None  # where the files of all sinks go; None: only what is scored is written, and dropped
    )


@dataclass(frozen=True, slots=True)
class Row:
    """What became of a cell; `scores` depend on the cell alone, `seconds` on the machine too."""

    index: int
    status: str  # ok, failed
    seconds: float = 0.0
    scores: dict[str, float | None] = field(default_factory=dict)  # None: could not be measured
    error: str | None = None


@cache
def installed() -> Catalog:
    """The kinds of this process, looked up once: that costs as much as a short run."""
    return Catalog()


def graph_of(source: Source, set_: tuple[str, ...]) -> Graph:
    """The checked graph of a cell; `source` stays as it is. Raises GraphError."""
    source = copy.deepcopy(source)
    override(source, (), set_)
    return checked(source, installed(), sinkless=True)


def run_cell(task: Task) -> Row:
    """Run and score one cell; whatever goes wrong becomes a row too."""
    began = time.monotonic()
    try:
        scores = _scores(task)
    except FlsFlowError as error:
        return Row(task.index, "failed", time.monotonic() - began, error=str(error).splitlines()[0])
    except Exception as error:
        text = " ".join(str(error).split())
        return Row(
            task.index,
            "failed",
            time.monotonic() - began,
            error=f"internal error: {type(error).__name__}: {text}",
        )
    return Row(task.index, "ok", time.monotonic() - began, scores)


def _scores(task: Task) -> dict[str, float | None]:
    graph = graph_of(task.source, task.set_)
    _same_versions(task.versions, describe(graph)["versions"])
    if task.keep is not None:
        return _kept(graph, task.watched, RunFolder.create(graph, task.keep))
    graph = _without_other_sinks(graph, task.watched)
    with TemporaryDirectory(prefix="fls-sweep-") as folder:
        report, files = _run(graph, task.watched, Path(folder))
        return _judged(graph, report, files)


def _kept(graph: Graph, watched: tuple[Watched, ...], folder: RunFolder) -> dict[str, float | None]:
    """The scores of a cell whose files stay, with the `run.json` that any run has."""
    about = describe(graph)
    folder.record({"status": "running", **about})
    report, files = _run(graph, watched, folder.path)
    folder.record({**about, **report.summary()})
    return _judged(graph, report, files)


def _without_other_sinks(graph: Graph, watched: tuple[Watched, ...]) -> Graph:
    """The graph without pictures and other files; as it is if nothing but its source would be left."""
    written = {one.sink for one in watched}
    nodes = tuple(node for node in graph.nodes if not node.is_sink or node.name in written)
    return graph if all(node.kind.source for node in nodes) else dataclasses.replace(graph, nodes=nodes)


def _same_versions(expected: Mapping[str, str], found: Mapping[str, str]) -> None:
    other = [
        f"{name} {found.get(name)} (not {value})"
        for name, value in expected.items()
        if found.get(name) != value
    ]
    if other:
        raise RunError(f"the worker has {', '.join(other)}; install the same on all workers")


def _run(graph: Graph, watched: tuple[Watched, ...], folder: Path) -> tuple[Report, dict[str, Path]]:
    catalog = installed()
    files = {one.kind: folder / f"{one.kind.removesuffix('-csv')}s.csv" for one in watched}
    sinks = {one: catalog.load(one.kind).cls(path=files[one.kind]) for one in watched}
    run = Run(
        graph,
        Options(in_order=True),
        out=folder,
        instances={one.sink: sink for one, sink in sinks.items() if one.sink is not None},
        taps={(one.node, one.output): _tap(sink) for one, sink in sinks.items() if one.sink is None},
    )
    report = run.start()
    for one, sink in sinks.items():
        if one.sink is None:
            sink.close()
    return report, files


def _judged(graph: Graph, report: Report, files: Mapping[str, Path]) -> dict[str, float | None]:
    """What a run that ended well tells; raises what ended it."""
    if report.error is not None:
        raise report.error
    return {**_figures(graph, report), **_scored(files)}


def _tap(sink: Any) -> Any:
    return lambda index, message: sink(message)


def run_figures(graph: Graph) -> tuple[str, ...]:
    """Those of `RUN_FIGURES` that runs of the graph tell."""
    given = {port.message for node in graph.nodes for port in node.kind.outputs}
    told = (True, Detections in given, Tracks in given)
    return tuple(name for name, one in zip(RUN_FIGURES, told, strict=True) if one)


def _figures(graph: Graph, report: Report) -> dict[str, float]:
    """The counts of the run, not its pace; detections that reach a tracker, or all if there is none."""
    told = {name.replace(" ", "_"): float(value) for name, value in headline(graph, report).items()}
    everything = {
        "detections": sum(tally.entries for tally in _tallies(graph, report, Detections)),
        "confirmed_tracks": sum(tally.confirmed for tally in _tallies(graph, report, Tracks)),
    }
    return {name: told.get(name, float(everything.get(name, 0))) for name in run_figures(graph)}


def _tallies(graph: Graph, report: Report, message: type) -> list[Any]:
    """What was counted at the outputs of that type."""
    return [
        report.counts[node.name].outputs[port.name]
        for node in graph.nodes
        for port in node.kind.outputs
        if port.message is message and port.name in report.counts[node.name].outputs
    ]


def _scored(files: Mapping[str, Path]) -> dict[str, float | None]:
    if "truth-csv" not in files:
        return {}
    from fls_flow.evaluate import score

    tracks, detections, estimates = map(files.get, ("track-csv", "detection-csv", "estimate-csv"))
    found = score(tracks, files["truth-csv"], detections=detections, estimates=estimates).overall
    return {name: float(value) if math.isfinite(value) else None for name, value in found.items()}
