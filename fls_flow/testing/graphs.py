"""Run a graph in this process, on lists instead of sonars."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fls_flow import graph as graphs
from fls_flow.catalog import Catalog
from fls_flow.messages import Message
from fls_flow.runtime import Options, Run

__all__ = ["run_graph"]


@dataclass
class _Playback:
    """Stands in for a source: gives what a test has listed."""

    produced: Sequence[Any]

    def __call__(self) -> Iterator[Any]:
        return iter(self.produced)

    def __len__(self) -> int:
        return len(self.produced)


def run_graph(
    graph: str | Path | graphs.Graph,
    inputs: Mapping[str, Iterable[Any]] | None = None,
    collect: Iterable[str] = (),
    *,
    use: Iterable[str] = (),
    set_: Iterable[str] = (),
    catalog: Catalog | None = None,
    options: Options | None = None,
    out: Path | None = None,
) -> dict[str, list[Message]]:
    """What the outputs named in `collect` (`node.port`) give, ping by ping, in this process.

    `inputs` replaces sources by lists: of messages, or of the source's NamedTuple. Sinks write under `out`.
    Raises GraphError for a graph that cannot run, KeyError for a name that is none of its sources or outputs,
    and what ended the run.
    """
    if not isinstance(graph, graphs.Graph):
        graph = graphs.load(graph, use=use, set_=set_, catalog=catalog, sinkless=True)
    collected: dict[str, list[Message]] = {name: [] for name in collect}
    taps = {_port(graph, name): _keep(into) for name, into in collected.items()}
    played = {_source(graph, name): _Playback(list(messages)) for name, messages in (inputs or {}).items()}
    report = Run(graph, options, out=out, instances=played, taps=taps).start()
    if report.error is not None:
        raise report.error
    return collected


def _source(graph: graphs.Graph, name: str) -> str:
    sources = [node.name for node in graph.nodes if node.kind.source]
    if name not in sources:
        raise KeyError(f"inputs: '{name}' is no source of graph '{graph.name}'; it has {', '.join(sources)}")
    return name


def _port(graph: graphs.Graph, name: str) -> tuple[str, str]:
    node, _, output = name.partition(".")
    nodes = [one.name for one in graph.nodes]
    if node not in nodes:
        raise KeyError(f"{name}: graph '{graph.name}' has no node '{node}'; it has {', '.join(nodes)}")
    outputs = [port.name for port in graph.node(node).kind.outputs]
    if output not in outputs:
        raise KeyError(f"{name}: node '{node}' gives {', '.join(outputs)}; write NODE.OUTPUT")
    return node, output


def _keep(into: list[Message]) -> Any:
    return lambda index, message: into.append(message)
