"""A graph over a grid of parameters: what is swept, what is scored, and which cells are left to do."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from fls_flow.errors import GraphError, Problem, UserError
from fls_flow.graph import Graph, find
from fls_flow.graph.read import Source, override, read
from fls_flow.messages import Detections, Intensity, Message, Tracks, Truth
from fls_flow.runtime import describe
from fls_flow.tools.cell import RUN_FIGURES, Row, Task, Watched, graph_of, installed, run_figures
from fls_flow.tools.grid import Axis, Grid, axes_of

__all__ = ["Sweep", "prepare"]

DETECTOR_METRICS = ("pd", "false_alarms_per_ping", "detections_per_ping")
PHD_METRICS = "phd_"  # with which their names begin


class _Scored(NamedTuple):
    """What is scored, or against what."""

    message: type[Message]
    kind: str  # of the sink that writes it
    word: str  # the option that names one of several, if there is one


TRACKS = _Scored(Tracks, "track-csv", "tracks")
DETECTIONS = _Scored(Detections, "detection-csv", "detections")
INTENSITY = _Scored(Intensity, "estimate-csv", "intensity")
TRUTH = _Scored(Truth, "truth-csv", "truth")


@dataclass(frozen=True)
class Sweep:
    """All that is decided before the first cell starts."""

    name: str
    source: Source  # with --use laid over it
    grid: Grid
    watched: tuple[Watched, ...]
    metrics: tuple[str, ...]
    about: dict[str, Any]  # equal for sweeps whose cells may stand in one folder

    @property
    def folder(self) -> Path:
        """Where the sweep's records are by default: the same for the same sweep."""
        text = json.dumps(self.about, sort_keys=True)
        return Path("sweeps") / self.name / hashlib.sha256(text.encode()).hexdigest()[:10]

    @property
    def varied(self) -> tuple[Axis, ...]:
        """The axes with more than one value."""
        return tuple(axis for axis in self.grid.axes if len(axis.values) > 1)

    def tasks(self, done: Iterable[int], keep: Path | None = None) -> list[Task]:
        """What is left to do, in the order of the cells; `keep` is the folder for the files of all sinks."""
        finished = set(done)
        digits = len(str(len(self.grid) - 1))
        return [
            Task(
                index,
                self.source,
                self.grid.settings(index),
                self.watched,
                self.about["versions"],
                None if keep is None else _unused(keep / f"{index:0{digits}}"),
            )
            for index in range(len(self.grid))
            if index not in finished
        ]

    def document(self, row: Row) -> dict[str, Any]:
        """A cell's row with its parameters."""
        return {
            "cell": row.index,
            "set": self.grid.labels(row.index),
            "status": row.status,
            "error": row.error,
            "seconds": round(row.seconds, 3),
            "scores": row.scores,
        }


def prepare(
    name: str,
    *,
    use: Iterable[str] = (),
    set_: Iterable[str] = (),
    metrics: Iterable[str] = (),
    tracks: str | None = None,
    detections: str | None = None,
) -> Sweep:
    """The sweep of the graph called `name`; every value of every axis has been checked.

    `tracks` and `detections` name the sink or the node whose tracks or detections are scored, if there are
    several. Raises UserError with every mistake: in the graph, in a value, in what cannot be scored.
    """
    set_, use = tuple(set_), tuple(use)
    source = read(find(name))
    override(source, use, ())
    grid = axes_of(set_, _reads_files(source))
    graph = _every_value(source, grid)
    wanted = tuple(metrics)
    watched = _watched(graph, wanted, tracks, detections)
    wanted = wanted or (("gospa",) if watched else run_figures(graph)[1:] or run_figures(graph))
    described = describe(graph)
    about = {
        "graph": graph.name,
        "digest": graph.digest,
        "use": list(use),
        "set": {axis.name: list(axis.values) for axis in grid.axes},
        "scored": [f"{one.node}.{one.output}" for one in watched],
        "versions": described["versions"],
    }
    return Sweep(graph.name, source, grid, watched, wanted, about)


def _reads_files(source: Source) -> Any:
    """Tells of `node.parameter` whether it is the path of a file that the node reads."""
    catalog = installed()

    def is_path(name: str) -> bool:
        node, _, parameter = name.partition(".")
        draft = source.drafts.get(node)
        if draft is None or draft.use is None or draft.use.data not in catalog.names():
            return False  # the check of the graph says what is wrong
        kind = catalog.load(draft.use.data)
        types = {one.name: one.annotation for one in kind.parameters}
        return bool(kind.outputs) and types.get(parameter) in (Path, Path | None)

    return is_path


def _every_value(source: Source, grid: Grid) -> Graph:
    """The graph of the first cell, after each value of each axis has passed the graph's checks."""
    problems: list[Problem] = []
    first: Graph | None = None
    for index in grid.crosses():
        try:
            graph = graph_of(source, grid.settings(index))
            first = first or graph
        except GraphError as error:
            problems += error.problems
    if problems or first is None:
        raise GraphError(dict.fromkeys(problems))
    return first


def _watched(
    graph: Graph, metrics: tuple[str, ...], tracks: str | None, detections: str | None
) -> tuple[Watched, ...]:
    """What has to be written for the metrics, the truth at the end; without truth, nothing.

    Raises UserError for a metric of what the graph does not give.
    """
    named = {what: name for what, name in ((TRACKS, tracks), (DETECTIONS, detections)) if name is not None}
    needed = {_scored_of(metric): metric for metric in reversed(metrics) if metric not in RUN_FIGURES}
    truth = _giver(graph, TRUTH, None)
    found = []
    for what in dict.fromkeys([*needed, *named]) or [TRACKS]:
        one = _giver(graph, what, named.get(what))
        if what in needed and (one is None or truth is None):
            raise UserError(
                f"--metric {needed[what]}: graph '{graph.name}' has no {what.word} and truth to score; "
                f"without them there are {', '.join(RUN_FIGURES)}"
            )
        found += [one] if one is not None else []
    return (*found, truth) if found and truth is not None else ()


def _scored_of(metric: str) -> _Scored:
    if metric.startswith(PHD_METRICS):
        return INTENSITY
    return DETECTIONS if metric in DETECTOR_METRICS else TRACKS


def _giver(graph: Graph, what: _Scored, chosen: str | None) -> Watched | None:
    """The output that the graph's sink of that kind takes; without one, the only output of that type."""
    sinks = [
        Watched(wire.node, wire.output, what.kind, node.name)
        for node in graph.nodes
        if node.kind.name == what.kind
        for wire in node.inputs[:1]
    ]
    outputs = [
        Watched(node.name, port.name, what.kind)
        for node in graph.nodes
        for port in node.kind.outputs
        if port.message is what.message
    ]
    if chosen is not None:
        found = [one for one in sinks if one.sink == chosen] or [one for one in outputs if one.node == chosen]
        if not found:
            raise UserError(f"--{what.word} {chosen}: no node of that name gives or writes {what.word}")
        return found[0]
    for candidates in (sinks, outputs):
        if len(candidates) == 1:
            return candidates[0]
        if candidates:
            names = ", ".join(one.sink or one.node for one in candidates)
            mend = f"name one with --{what.word}" if what in (TRACKS, DETECTIONS) else "leave one of them"
            raise UserError(f"graph '{graph.name}' has several {what.message.__name__}: {names}; {mend}")
    return None


def _unused(folder: Path) -> Path:
    """The folder, or the next that a failed attempt at the cell has not left."""
    path, n = folder, 1
    while path.exists():
        n += 1
        path = folder.with_name(f"{folder.name}-{n}")
    return path
