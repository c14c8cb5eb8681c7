"""What a run is asked for, what it shares with other processes, and what it says when it has ended."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from fls_flow.deploy import LIVE_WINDOW, REPLAY_WINDOW
from fls_flow.errors import FlsFlowError, InputError
from fls_flow.graph import Graph
from fls_flow.links import Link
from fls_flow.observe import NodeCounts
from fls_flow.runtime.position import Position

__all__ = ["Options", "Pace", "Report", "Share", "finished_pings", "holders", "pace_of", "pings_of"]

log = logging.getLogger(__name__)

SLOWEST_RATE, FASTEST_RATE = 1e-3, 1e6


@dataclass(frozen=True)
class Options:
    """How a graph is run; none of it changes what comes out, but a live or paced source sheds pings.

    window: pings in flight; None: 8 in replay, 2 in live. rate: replay at that multiple of the recording's
    pace, shedding like a live source; None: as fast as the nodes go. in_order: one node after the other in
    the calling thread. stream_wait_s: how long a live ping waits for a stream. grace_s: how long pings in
    flight may take after a stop. deadline_s: a node at work on one ping for so long has hung (on its
    first, which compiles: ten times as long). threads: of BLAS, OpenCV and numba. samples_taken: by node and
    port, how many samples of a stream each ping of a live run got, so that its replay repeats it.
    """

    window: int | None = None
    rate: float | None = None
    in_order: bool = False
    stream_wait_s: float = 0.2
    grace_s: float = 1.5
    deadline_s: float = 60.0
    threads: int = 1
    samples_taken: Mapping[str, Mapping[str, Sequence[int]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.window is not None and self.window < 1:
            raise ValueError(f"window is {self.window}; at least one ping is in flight")
        if self.rate is not None and not SLOWEST_RATE <= self.rate <= FASTEST_RATE:
            raise ValueError(f"rate is {self.rate:g}; it lies between {SLOWEST_RATE:g} and {FASTEST_RATE:g}")


@dataclass(frozen=True)
class Pace:
    """How many pings are in flight, and whether they come in real time; the same in all processes."""

    window: int
    live: bool


@dataclass(frozen=True)
class Share:
    """The part of a graph that runs in this process, and its link to the others."""

    nodes: frozenset[str]
    link: Link
    pace: Pace
    on_failed: Callable[[FlsFlowError], None]
    holders: tuple[str, ...]  # the nodes that hold the window
    free: frozenset[str] = frozenset()  # the sinks that may lose pings
    positions: Mapping[str, Position] = field(default_factory=dict)  # where each node says how far it is


@dataclass
class Report:
    """How a run ended, and what its nodes did."""

    status: Literal["finished", "interrupted", "failed"]
    pings: int
    seconds: float
    counts: dict[str, NodeCounts]
    samples_taken: dict[str, dict[str, list[int]]] = field(default_factory=dict)  # of a live run
    error: FlsFlowError | None = None
    after_first_s: float = 0.0  # from the end of the first ping, before which kernels are compiled

    @property
    def pings_per_s(self) -> float:
        """Pings that went all the way through after the first, per second."""
        return (self.pings - 1) / self.after_first_s if self.pings > 1 and self.after_first_s > 0.0 else 0.0

    def summary(self) -> dict[str, Any]:
        """The report as plain values, for `run.json`."""
        return {
            "status": self.status,
            "error": str(self.error) if self.error else None,
            "pings": self.pings,
            "seconds": round(self.seconds, 3),
            "pings_per_s": round(self.pings_per_s, 2),
            "counts": {name: counts.summary() for name, counts in self.counts.items()},
            "samples_taken": {name: ports for name, ports in self.samples_taken.items() if ports},
        }


def holders(graph: Graph) -> tuple[str, ...]:
    """Who holds the window: the nodes after which nothing waits, which in a whole graph are its sinks."""
    awaited = {wire.node for node in graph.nodes for wire in node.inputs if wire.mode == "now"}
    sources = {node.name for node in graph.nodes if node.kind.source}
    return tuple(node.name for node in graph.nodes if node.name not in awaited | sources)


def finished_pings(graph: Graph, counts: Mapping[str, NodeCounts]) -> int:
    """How many pings went all the way through, as far as the holders among these nodes know."""
    return min((counts[name].fired for name in holders(graph) if name in counts), default=0)


def pings_of(clock: Any) -> int | None:
    """How many pings a source says will come; None when it does not know.

    Raises InputError when it finds that what it should read cannot be read.
    """
    try:
        return len(clock) if hasattr(clock, "__len__") else None
    except InputError:
        raise
    except Exception as error:  # only the progress bar needs it
        log.warning("%s.__len__ raised %s: %s", type(clock).__name__, type(error).__name__, error)
        return None


def pace_of(options: Options, clock: Any) -> Pace:
    """The window, and whether the pings come in real time, for the source instance `clock`."""
    live = bool(getattr(clock, "live", False)) or options.rate is not None
    return Pace(options.window or (LIVE_WINDOW if live else REPLAY_WINDOW), live)
