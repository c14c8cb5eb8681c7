"""Which process holds each node of a graph, and so what has to go between processes."""

from __future__ import annotations

from dataclasses import dataclass

from fls_flow.graph import Graph

__all__ = ["Placement", "controls", "takers"]


@dataclass(frozen=True)
class Placement:
    """Which process holds each node, and on which host each process runs."""

    process_of: dict[str, str]
    host_of: dict[str, str]
    holders: tuple[str, ...]  # the nodes that hold the window
    free: frozenset[str] = frozenset()  # the sinks that may lose pings

    def nodes(self, process: str) -> tuple[str, ...]:
        """The nodes of a process."""
        return tuple(node for node, place in self.process_of.items() if place == process)


def takers(graph: Graph, placement: Placement) -> dict[tuple[str, str, bool], set[str]]:
    """The processes that take each output, apart for sinks that may lose pings."""
    found: dict[tuple[str, str, bool], set[str]] = {}
    for node in graph.nodes:
        for wire in node.inputs:
            route = wire.node, wire.output, node.name in placement.free
            found.setdefault(route, set()).add(placement.process_of[node.name])
    return found


def controls(graph: Graph, placement: Placement) -> dict[str, set[str]]:
    """The processes that hear the control stream of each process, itself left out."""
    clock = placement.process_of[graph.clock]
    heard: dict[str, set[str]] = {process: set() for process in placement.host_of}
    for holder in placement.holders:
        heard[placement.process_of[holder]].add(clock)
    for stream in graph.streams:
        heard[clock].add(placement.process_of[stream])
    return {giver: listeners - {giver} for giver, listeners in heard.items()}
