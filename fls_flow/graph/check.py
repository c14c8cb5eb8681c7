"""Every check of a graph before anything starts: kinds, parameters, wires, order, clock, loose ends."""

from __future__ import annotations

from fls_flow.catalog import Catalog
from fls_flow.errors import GraphError, Problem
from fls_flow.graph.check_nodes import check_files, check_kind, check_on_error, check_parameters
from fls_flow.graph.check_whole import check_ends, find_clock, find_order
from fls_flow.graph.check_wires import check_references, check_wires
from fls_flow.graph.findings import Findings
from fls_flow.graph.model import Graph, Node
from fls_flow.graph.read import Source

__all__ = ["checked"]


def checked(source: Source, catalog: Catalog, *, sinkless: bool = False) -> Graph:
    """The graph, ready to run.

    Raises GraphError with every problem, those of `source` included. With `sinkless`, a graph may end in
    outputs that nobody takes.
    """
    found = Findings(source, catalog)
    for draft in source.drafts.values():
        check_kind(found, draft)
    for draft in source.drafts.values():
        if draft.name in found.kinds:
            check_wires(found, draft, found.kinds[draft.name])
        else:
            check_references(found, draft)
    if not sinkless:
        check_ends(found)
    for name, kind in found.kinds.items():
        check_parameters(found, source.drafts[name], kind)
        check_on_error(found, source.drafts[name], kind)
    clock = find_clock(found)
    order = find_order(found)
    check_files(found)
    if not source.drafts and not source.problems:
        found.problem(source.where, "the graph has no nodes")
    if source.problems:
        raise GraphError(sorted(dict.fromkeys(source.problems), key=_place))
    return Graph(
        source.name, tuple(_node(found, name) for name in order), clock, source.path, tuple(source.notes)
    )


def _place(problem: Problem) -> tuple[str, int]:
    file, _, line = problem.where.rpartition(":")
    return (file, int(line)) if file and line.isdigit() else (problem.where, 0)


def _node(found: Findings, name: str) -> Node:
    draft = found.source.drafts[name]
    on_error = "skip" if draft.on_error is not None and draft.on_error.data == "skip" else "stop"
    wires = tuple(found.wires[name])
    return Node(name, found.kinds[name], found.arguments[name], wires, on_error, draft.where)  # type: ignore[arg-type]
