"""Runs a graph inside this process: a thread per node, or one node after the other, with the same bits."""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from fls_flow.errors import FlsFlowError, NodeError
from fls_flow.graph import Graph
from fls_flow.links.memory import MemoryLink, Tap
from fls_flow.observe import NodeCounts
from fls_flow.parameters import resolve
from fls_flow.runtime.node import NodeHost
from fls_flow.runtime.source import ClockHost, StreamHost
from fls_flow.runtime.threads import pin_this_thread, single_threaded

__all__ = ["Options", "Report", "Run"]

log = logging.getLogger(__name__)

Host = NodeHost | ClockHost | StreamHost
REPLAY_WINDOW, LIVE_WINDOW = 8, 2


@dataclass(frozen=True)
class Options:
    """How a graph is run; none of it changes what comes out, but a live or paced source sheds pings.

    window: pings in flight; None: 8 in replay, 2 in live. rate: replay at that multiple of the recording's
    pace, shedding like a live source; None: as fast as the nodes go. in_order: one node after the other in
    the calling thread. stream_wait_s: how long a live ping waits for a stream. grace_s: how long pings in
    flight may take after a stop. samples_taken: by node and port, how many samples of a stream each ping of a
    live run got, so that its replay repeats it.
    """

    window: int | None = None
    rate: float | None = None
    in_order: bool = False
    stream_wait_s: float = 0.2
    grace_s: float = 1.5
    samples_taken: Mapping[str, Mapping[str, Sequence[int]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.window is not None and self.window < 1:
            raise ValueError(f"window is {self.window}; at least one ping is in flight")
        if self.rate is not None and not self.rate > 0.0:
            raise ValueError(f"rate is {self.rate}; it is greater than 0")


@dataclass
class Report:
    """How a run ended, and what its nodes did."""

    status: Literal["finished", "interrupted", "failed"]
    pings: int
    seconds: float
    counts: dict[str, NodeCounts]
    samples_taken: dict[str, dict[str, list[int]]] = field(default_factory=dict)  # of a live run
    error: FlsFlowError | None = None

    @property
    def pings_per_s(self) -> float:
        """Pings that went all the way through, per second."""
        return self.pings / self.seconds if self.seconds > 0.0 else 0.0

    def summary(self) -> dict[str, Any]:
        """The report as plain values, for `run.json`."""
        return {
            "status": self.status,
            "error": str(self.error) if self.error else None,
            "pings": self.pings,
            "seconds": round(self.seconds, 3),
            "counts": {name: counts.summary() for name, counts in self.counts.items()},
            "samples_taken": {name: ports for name, ports in self.samples_taken.items() if ports},
        }


class Run:
    """One run of a graph; `start()` returns when it has ended, `stop()` ends it from another thread.

    `instances` stand in for nodes that would otherwise be made from their parameters, `taps` see what outputs
    give, `out` is the folder under which sinks write.
    """

    def __init__(
        self,
        graph: Graph,
        options: Options | None = None,
        *,
        out: Path | None = None,
        instances: Mapping[str, Any] | None = None,
        taps: Mapping[tuple[str, str], Tap] | None = None,
        on_finished: Callable[[int], None] = lambda pings: None,
    ) -> None:
        self.id = uuid.uuid4().hex[:12]
        self.graph, self.options = graph, options or Options()
        self._instances = _made(graph, out or Path.cwd(), instances or {})
        clock = self._instances[graph.clock]
        live = bool(getattr(clock, "live", False)) or self.options.rate is not None
        self.window = self.options.window or (LIVE_WINDOW if live else REPLAY_WINDOW)
        self._link = MemoryLink(graph, self.window, taps)
        self._finished_pings = 0
        self._error: FlsFlowError | None = None
        self._interrupted = False
        self._aborted = threading.Event()
        self._stuck: set[str] = set()
        self._hosts = self._make_hosts(live, on_finished)
        self._clock = next(host for host in self._hosts if isinstance(host, ClockHost))

    @property
    def total(self) -> int | None:
        """How many pings the clock says will come; None when it does not know."""
        clock = self._instances[self.graph.clock]
        return len(clock) if hasattr(clock, "__len__") else None

    def start(self) -> Report:
        """Run to the end and close every node; never raises what a node raised, but reports it."""
        began = time.monotonic()
        try:
            with single_threaded():
                if self.options.in_order:
                    self._in_order()
                else:
                    self._in_threads()
        finally:
            self._close()
        while (item := self._clock.inbox.get(0.0)) is not None:
            self._clock.take(item)  # what finished after the last ping had started
        status: Literal["finished", "interrupted", "failed"] = (
            "interrupted" if self._interrupted else "finished"
        )
        return Report(
            "failed" if self._error else status,
            self._finished_pings,
            time.monotonic() - began,
            {host.node.name: host.counts for host in self._hosts},
            {
                host.node.name: {port: list(taken) for port, taken in host.samples_taken.items()}
                for host in self._hosts
                if isinstance(host, NodeHost)
            },
            self._error,
        )

    def stop(self) -> None:
        """Start no further ping, finish those in flight, close. From any thread or a signal handler."""
        self._interrupted = True
        self._clock.stop()

    def _make_hosts(self, live: bool, on_finished: Callable[[int], None]) -> list[Host]:
        holders = _holders(self.graph)

        def count(pings: int) -> None:
            self._finished_pings = pings
            on_finished(pings)

        hosts: list[Host] = []
        for node in self.graph.nodes:
            instance = self._instances[node.name]
            if node.name == self.graph.clock:
                clock = ClockHost(
                    node,
                    instance,
                    self._link,
                    holders=holders,
                    window=self.window,
                    rate=self.options.rate,
                    on_finished=count,
                )
                hosts.append(clock)
            elif node.kind.source:
                hosts.append(StreamHost(node, instance, self._link))
            else:
                wait_s = self.options.stream_wait_s if live else None
                holds = node.name in holders
                taken = self.options.samples_taken.get(node.name)
                host = NodeHost(node, instance, self._link, holds_window=holds, wait_s=wait_s, repeat=taken)
                hosts.append(host)
        return hosts

    # --- scheduling ------------------------------------------------------------------------------

    def _in_order(self) -> None:
        pin_this_thread()
        while not all(host.done for host in self._hosts):
            if self._aborted.is_set():
                return
            moved = [self._advance(host) for host in self._hosts]
            if not any(moved):
                self._idle()

    def _advance(self, host: Host) -> bool:
        """Let a node do all it can; the clock starts one ping at a time."""
        moved = False
        while (item := host.inbox.get(0.0)) is not None:
            host.take(item)
            moved = True
        while self._step(host):
            moved = True
            if isinstance(host, ClockHost):
                break
        return moved

    def _idle(self) -> None:
        """Nothing can fire: wait for the clock's next ping, or for a stream until its time is over."""
        waits = [host.patience_s() for host in self._hosts if not host.done]
        patience = min((wait for wait in waits if wait is not None), default=0.05)
        item = self._clock.inbox.get(min(patience, 0.05))
        if item is not None:
            self._clock.take(item)

    def _in_threads(self) -> None:
        threads = [
            threading.Thread(target=self._serve, args=(host,), name=host.node.name, daemon=True)
            for host in self._hosts
        ]
        for thread in threads:
            thread.start()
        self._watch(threads)

    def _watch(self, threads: Sequence[threading.Thread]) -> None:
        """Wait for the threads; after a stop or a failure, no longer than the grace time."""
        deadline: float | None = None
        for thread in threads:
            while thread.is_alive():
                thread.join(0.05)  # short, so that a signal handler gets its turn
                if deadline is None and self._clock.stopping.is_set():
                    deadline = time.monotonic() + self.options.grace_s
                if deadline is not None and time.monotonic() > deadline:
                    self._aborted.set()
                    thread.join(max(0.0, deadline + 0.3 - time.monotonic()))
                    break
        self._stuck = {thread.name for thread in threads if thread.is_alive()}

    def _serve(self, host: Host) -> None:
        pin_this_thread()
        while not (host.done or self._aborted.is_set()):
            if self._step(host) or host.done:
                continue
            patience = host.patience_s()
            item = host.inbox.get(0.2 if patience is None else min(patience, 0.2))
            if item is not None:
                host.take(item)

    def _step(self, host: Host) -> bool:
        try:
            return host.step()
        except FlsFlowError as error:
            self._fail(host, error)
        except (
            Exception
        ) as error:  # a defect of the runtime itself: still one line, and the traceback in the log
            log.exception("node '%s': internal error", host.node.name)
            self._fail(host, NodeError(host.node.name, host.index, None, f"internal error: {error!r}"))
        return False

    def _fail(self, host: Host, error: FlsFlowError) -> None:
        """Keep the first error; what was answered before it still goes to the end of the graph."""
        log.error("%s", error, exc_info=error.__cause__)
        self._error = self._error or error
        self._clock.stop()
        host.finish()

    def _close(self) -> None:
        for host in self._hosts:
            if host.node.name in self._stuck:
                log.error("node '%s' did not end in time; its files may lack the last pings", host.node.name)
                continue
            try:
                getattr(host.instance, "close", _nothing)()
            except Exception as error:
                cause = f"while closing: {type(error).__name__}: {error}"
                failure = NodeError(host.node.name, None, None, cause)
                log.error("%s", failure, exc_info=error)
                self._error = self._error or failure
            if not isinstance(host, NodeHost):
                host.join(1.0)


def _nothing() -> None:
    """The `close` of a node that has none."""


def _made(graph: Graph, out: Path, instances: Mapping[str, Any]) -> dict[str, Any]:
    return {
        node.name: instances[node.name]
        if node.name in instances
        else node.kind.cls(**(resolve(node.parameters(), out) if node.is_sink else node.arguments))
        for node in graph.nodes
    }


def _holders(graph: Graph) -> tuple[str, ...]:
    """Who holds the window: the nodes after which nothing waits, which in a whole graph are its sinks."""
    awaited = {wire.node for node in graph.nodes for wire in node.inputs if wire.mode == "now"}
    sources = {node.name for node in graph.nodes if node.kind.source}
    return tuple(node.name for node in graph.nodes if node.name not in awaited | sources)
