"""What is known of a deployment while its file is read."""

from __future__ import annotations

from dataclasses import dataclass, field

from fls_flow.deploy.model import LOCAL
from fls_flow.document import Value, shown
from fls_flow.errors import Problem
from fls_flow.graph import Graph

__all__ = ["Draft"]


@dataclass
class Draft:
    """What is known of a deployment while it is read."""

    graph: Graph
    root: Value
    problems: list[Problem]
    notes: list[str] = field(default_factory=list)
    host_of: dict[str, str] = field(default_factory=dict)  # in the order of the graph
    hosts: tuple[str, ...] = (LOCAL,)
    process_of: dict[str, str] = field(default_factory=dict)
    threads: dict[str, int] = field(default_factory=dict)

    @property
    def nodes(self) -> tuple[str, ...]:
        """The names of the graph's nodes, in its order."""
        return tuple(node.name for node in self.graph.nodes)

    def get(self, key: str) -> Value | None:
        """The value of a key; None when it is missing or empty."""
        value = self.root.mapping.get(key)
        return None if value is None or value.data is None else value

    def mapping(self, key: str, of: str) -> dict[str, Value]:
        """The values of a key that maps names to something."""
        value = self.get(key)
        if value is not None and not isinstance(value.data, dict):
            self.problems.append(value.at(f"'{key}' is {shown(value)}; it maps {of}"))
        return {} if value is None else value.mapping
