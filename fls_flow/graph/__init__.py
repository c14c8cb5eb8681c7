"""Graph files: YAML in, a frozen `Graph` out; every mistake at once, each with `file:line`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from fls_flow.catalog import Catalog
from fls_flow.graph.check import checked
from fls_flow.graph.model import Graph, Input, Mode, Node, Recipe
from fls_flow.graph.read import find, override, read, shipped

__all__ = ["Graph", "Input", "Mode", "Node", "Recipe", "find", "load", "shipped"]


def load(
    name: str | Path,
    *,
    use: Iterable[str] = (),
    set_: Iterable[str] = (),
    catalog: Catalog | None = None,
    sinkless: bool = False,
) -> Graph:
    """The graph in a file, or of that name, with `--use` and `--set` laid over it.

    Raises GraphError with every problem in it, UserError when there is no such file.
    """
    use, set_ = tuple(use), tuple(set_)
    source = read(find(name))
    override(source, use, set_)
    graph = checked(source, catalog or Catalog(), sinkless=sinkless)
    return replace(graph, recipe=Recipe(str(name), use, set_))
