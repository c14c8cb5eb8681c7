"""A graph that has been checked: what runs, with which parameters, wired how."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fls_flow.catalog import Kind

__all__ = ["Graph", "Input", "Mode", "Node", "Recipe"]

Mode = Literal["now", "previous", "time"]


@dataclass(frozen=True, slots=True)
class Input:
    """A wire into a port: whose output, and which value of it."""

    port: str
    node: str
    output: str
    mode: Mode = "now"

    def __str__(self) -> str:
        return f"{self.node}.{self.output}" + ("" if self.mode == "now" else f"@{self.mode}")


@dataclass(frozen=True)
class Node:
    """One use of a kind in a graph."""

    name: str
    kind: Kind
    arguments: Mapping[str, Any]
    inputs: tuple[Input, ...] = ()
    on_error: Literal["stop", "skip"] = "stop"
    where: str = ""

    @property
    def is_sink(self) -> bool:
        """Whether it only takes."""
        return not self.kind.outputs

    def parameters(self) -> dict[str, Any]:
        """All parameters, defaults included."""
        defaults = {one.name: one.default for one in self.kind.parameters}
        return {**defaults, **self.arguments}


@dataclass(frozen=True, slots=True)
class Recipe:
    """How the graph was asked for: another process gets the same one by it."""

    name: str
    use: tuple[str, ...] = ()
    set_: tuple[str, ...] = ()


@dataclass(frozen=True)
class Graph:
    """Nodes in an order in which each comes after those that it waits for."""

    name: str
    nodes: tuple[Node, ...]
    clock: str
    path: Path | None = None
    notes: tuple[str, ...] = ()
    recipe: Recipe | None = None

    def node(self, name: str) -> Node:
        """The node of that name; raises KeyError."""
        found = next((node for node in self.nodes if node.name == name), None)
        if found is None:
            raise KeyError(name)
        return found

    @property
    def sinks(self) -> tuple[str, ...]:
        """The names of the nodes that only take."""
        return tuple(node.name for node in self.nodes if node.is_sink)

    @property
    def streams(self) -> tuple[str, ...]:
        """The names of the sources beside the clock."""
        return tuple(node.name for node in self.nodes if node.kind.source and node.name != self.clock)

    def consumers(self, node: str, output: str) -> tuple[tuple[str, Input], ...]:
        """Who takes that output: names of nodes, and their wires."""
        return tuple(
            (other.name, wire)
            for other in self.nodes
            for wire in other.inputs
            if (wire.node, wire.output) == (node, output)
        )

    @property
    def digest(self) -> str:
        """The same for graphs that compute the same: of names, kinds, parameters and wires, not of places."""
        nodes = {
            node.name: [
                node.kind.name,
                {name: _portable(value) for name, value in node.parameters().items()},
                {wire.port: str(wire) for wire in node.inputs},
                node.on_error,
            ]
            for node in self.nodes
        }
        text = json.dumps([self.name, nodes], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _portable(value: Any) -> Any:
    return value.name if isinstance(value, Path) else value
