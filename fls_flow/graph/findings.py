"""What the checks of a graph find out, each for the next."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from fls_flow.catalog import Catalog, InPort, Kind
from fls_flow.errors import Problem
from fls_flow.graph.model import Input
from fls_flow.graph.read import Source
from fls_flow.parameters import Models

__all__ = ["Findings"]


@dataclass
class Findings:
    """What the checks know of a graph while they go through it."""

    source: Source
    catalog: Catalog
    kinds: dict[str, Kind] = field(default_factory=dict)
    wires: dict[str, list[Input]] = field(default_factory=dict)
    arguments: dict[str, dict[str, Any]] = field(default_factory=dict)
    unwired: list[InPort] = field(default_factory=list)  # whose giver is unknown
    models: Models = field(default_factory=dict)
    places: dict[tuple[str, str], str] = field(default_factory=dict)  # (node, port) -> where its wire stands

    def problem(self, where: str, what: str) -> None:
        """A mistake: the graph cannot be run."""
        self.source.problems.append(Problem(where, what))

    def note(self, what: str) -> None:
        """What is done on the user's behalf."""
        self.source.notes.append(what)
