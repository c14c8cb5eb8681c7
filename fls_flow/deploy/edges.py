"""Edges of a graph across a deployment: which may lose pings, which loops wait for the network."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from fls_flow.catalog import suggest
from fls_flow.deploy.draft import Draft
from fls_flow.deploy.model import Edge
from fls_flow.document import Value, shown

__all__ = ["feedback", "latest"]


def latest(draft: Draft) -> frozenset[Edge]:
    """The edges that may lose pings; all edges into one sink must agree."""
    found: dict[Edge, Value] = {}
    for text, value in draft.mapping("qos", 'edges "node -> sink" to latest or lossless').items():
        if value.data not in ("latest", "lossless"):
            draft.problems.append(value.at(f"qos of '{text}' is {shown(value)}; it is latest or lossless"))
        edges = _edges(draft, text, value)
        if value.data == "latest":
            found |= dict.fromkeys(edges, value)
        else:
            found = {edge: one for edge, one in found.items() if edge not in edges}
    for sink in dict.fromkeys(sink for _, _, sink in found):
        _whole(draft, sink, found)
    return frozenset(found)


def _whole(draft: Draft, sink: str, latest: Mapping[Edge, Value]) -> None:
    """A sink fires when all its inputs are there, so it cannot wait for some and lose others."""
    wires = [(wire.node, wire.output, sink) for wire in draft.graph.node(sink).inputs]
    rest = [f"{node}.{output}" for node, output, _ in wires if (node, output, sink) not in latest]
    if rest:
        value = next(value for edge, value in latest.items() if edge[2] == sink)
        what = f"sink '{sink}' takes {', '.join(rest)} too, losslessly; write \"* -> {sink}\": latest for all"
        draft.problems.append(value.at(f"qos: {what}"))


def _edges(draft: Draft, text: str, value: Value) -> list[Edge]:
    """The edges that `node -> sink`, `node.port -> sink` or `* -> sink` means."""
    giver, arrow, sink = (part.strip() for part in text.partition("->"))
    node, dot, output = giver.partition(".")
    if not (arrow and node and sink) or (dot and not output):
        draft.problems.append(value.at(f"qos '{text}': write NODE -> SINK, NODE.OUTPUT -> SINK or * -> SINK"))
        return []
    for name in [sink] if node == "*" else [node, sink]:
        if name not in draft.nodes:
            near = suggest(name, draft.nodes) or f"; it has {', '.join(draft.nodes)}"
            draft.problems.append(value.at(f"qos '{text}': the graph has no node '{name}'{near}"))
            return []
    if not draft.graph.node(sink).is_sink:
        what = f"'{sink}' is no sink; only what ends in a sink may be lost ({', '.join(draft.graph.sinks)})"
        draft.problems.append(value.at(f"qos '{text}': {what}"))
        return []
    wires = [(wire.node, wire.output, sink) for wire in draft.graph.node(sink).inputs]
    edges = [edge for edge in wires if node in ("*", edge[0]) and output in ("", edge[1])]
    if not edges:
        takes = ", ".join(f"{giver}.{port}" for giver, port, _ in wires)
        draft.problems.append(value.at(f"qos '{text}': there is no such edge; '{sink}' takes {takes}"))
    return edges


def feedback(draft: Draft) -> None:
    """Add a note for each @previous wire that closes a loop over several hosts."""
    for node in draft.graph.nodes:
        for wire in (wire for wire in node.inputs if wire.mode == "previous"):
            loop = _loop(draft, node.name, wire.node)
            hosts = sorted({draft.host_of[one] for one in loop if one in draft.host_of})
            if len(hosts) > 1:
                way = f"{wire.node}.{wire.output}@previous -> {node.name}"
                draft.notes.append(
                    f"the feedback {way} crosses hosts ({', '.join(hosts)}): each ping waits for the network "
                    "before the next can be done; keep the loop on one host if you can"
                )


def _loop(draft: Draft, taker: str, giver: str) -> set[str]:
    """The nodes between `taker` and `giver`: within a ping, or else over several."""
    for modes in (("now",), ("now", "previous")):
        wires = [
            (wire.node, node.name) for node in draft.graph.nodes for wire in node.inputs if wire.mode in modes
        ]
        loop = _reach(taker, wires) & _reach(giver, [(after, before) for before, after in wires])
        if loop:
            return loop
    return set()


def _reach(start: str, wires: Iterable[tuple[str, str]]) -> set[str]:
    """`start` and all that come after it."""
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            waiting += [after for before, after in wires if before == name]
    return seen
