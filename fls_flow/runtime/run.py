"""Runs a graph inside this process: a thread per node, or one node after the other, with the same bits."""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from fls_flow.errors import FlsFlowError, NodeError
from fls_flow.graph import Graph, Node
from fls_flow.links import Link
from fls_flow.links.memory import MemoryLink, Tap
from fls_flow.parameters import resolve
from fls_flow.runtime.calls import cause_of, closed
from fls_flow.runtime.node import NodeHost
from fls_flow.runtime.source import ClockHost, StreamHost
from fls_flow.runtime.terms import Options, Report, Share, finished_pings, holders, pace_of, pings_of
from fls_flow.runtime.threads import limit_this_thread, limited_threads

__all__ = ["Run"]

log = logging.getLogger(__name__)

FIRST_PING = 10  # how much longer than later ones it may take: kernels are compiled then

Host = NodeHost | ClockHost | StreamHost


class Run:
    """One run of a graph; `start()` returns when it has ended, `stop()` ends it from another thread.

    `instances` stand in for nodes that would otherwise be made from their parameters, `taps` see what outputs
    give, `out` is the folder under which sinks write. With a `share`, only some nodes run here, on its link;
    without the clock among them, `stop()` ends what waits for other processes after the grace time.
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
        share: Share | None = None,
    ) -> None:
        self.id = uuid.uuid4().hex[:12]
        self.graph, self.options = graph, options or Options()
        here = [node for node in graph.nodes if share is None or node.name in share.nodes]
        self._instances = _made(here, out or Path.cwd(), instances or {})
        pace = share.pace if share else pace_of(self.options, self._instances[graph.clock])
        self.window = pace.window
        self._link: Link = share.link if share else MemoryLink(graph, self.window, taps)
        self._on_failed = share.on_failed if share else _ignore
        self._error: FlsFlowError | None = None
        self._interrupted = False
        self._aborted = threading.Event()
        self._stuck: set[str] = set()
        self._stopping = threading.Event()
        self._holders = share.holders if share else holders(graph)
        self._free = share.free if share else frozenset()
        self._first: float | None = None  # when the first ping had gone all the way through

        def finished(pings: int) -> None:
            if pings and self._first is None:
                self._first = time.monotonic()
            on_finished(pings)

        self._on_end: Callable[[int], None] = _ignore if share else on_finished
        self._hosts = self._make_hosts(here, pace.live, finished)
        for host in self._hosts:
            host.position = share.positions.get(host.node.name, host.position) if share else host.position
        self._clock = next((host for host in self._hosts if isinstance(host, ClockHost)), None)

    @property
    def total(self) -> int | None:
        """How many pings the clock says will come; None when it does not know."""
        return pings_of(self._instances[self.graph.clock])

    def start(self) -> Report:
        """Run to the end and close every node; never raises what a node raised, but reports it."""
        began = time.monotonic()
        try:
            with limited_threads(self.options.threads):
                if self.options.in_order:
                    self._in_order()
                else:
                    self._in_threads()
        finally:
            ended = time.monotonic()
            self._close()
        status: Literal["finished", "interrupted", "failed"] = (
            "interrupted" if self._interrupted else "finished"
        )
        counts = {host.node.name: host.counts for host in self._hosts}
        pings = finished_pings(self.graph, counts)
        self._on_end(pings)  # the clock has not waited for the last to be finished
        return Report(
            "failed" if self._error else status,
            pings,
            time.monotonic() - began,
            counts,
            {
                host.node.name: {port: list(taken) for port, taken in host.samples_taken.items()}
                for host in self._hosts
                if isinstance(host, NodeHost)
            },
            self._error,
            0.0 if self._first is None else ended - self._first,
        )

    def hung(self) -> NodeError | None:
        """A node that has been at work on one ping for too long."""
        now = time.monotonic()
        for host in self._hosts:
            since = host.firing_since if isinstance(host, NodeHost) else None
            allowed = self.options.deadline_s * (1 if host.index else FIRST_PING)
            if since is not None and now - since > allowed:
                return NodeError(host.node.name, host.index, None, f"no answer for {allowed:g} s")
        return None

    def status(self) -> dict[str, dict[str, Any]]:
        """What each node has done so far and how much waits for it, as plain values."""
        return {
            host.node.name: {**host.counts.summary(), "kind": host.node.kind.name, "queue": len(host.inbox)}
            for host in self._hosts
        }

    def fired(self) -> dict[str, int]:
        """How many pings each node has done so far."""
        return {host.node.name: host.counts.fired for host in self._hosts}

    def stop(self) -> None:
        """Start no further ping, finish those in flight, close. From any thread or a signal handler."""
        self._interrupted = True
        self._halt()

    def fail(self, error: FlsFlowError) -> None:
        """Note a failure from outside the nodes, such as of the link, and stop."""
        self._error = self._error or error
        self._halt()
        self._on_failed(error)

    def _halt(self) -> None:
        self._stopping.set()
        if self._clock is not None:
            self._clock.stop()

    def _make_hosts(self, here: Sequence[Node], live: bool, on_finished: Callable[[int], None]) -> list[Host]:

        hosts: list[Host] = []
        for node in here:
            instance = self._instances[node.name]
            if node.name == self.graph.clock:
                clock = ClockHost(
                    node,
                    instance,
                    self._link,
                    holders=self._holders,
                    window=self.window,
                    rate=self.options.rate,
                    on_finished=on_finished,
                )
                hosts.append(clock)
            elif node.kind.source:
                hosts.append(StreamHost(node, instance, self._link))
            else:
                wait_s = self.options.stream_wait_s if live else None
                holds = node.name in self._holders
                taken = self.options.samples_taken.get(node.name)
                host = NodeHost(
                    node,
                    instance,
                    self._link,
                    holds_window=holds,
                    wait_s=wait_s,
                    newest=node.name in self._free,
                    repeat=taken,
                )
                hosts.append(host)
        return hosts

    # --- scheduling ------------------------------------------------------------------------------

    def _in_order(self) -> None:
        limit_this_thread(self.options.threads)
        while not all(host.done for host in self._hosts):
            if self._aborted.is_set():
                return
            moved = [self._advance(host) for host in self._hosts]
            if not any(moved):
                self._idle()

    def _advance(self, host: Host) -> bool:
        """Let a node do all it can; the clock starts one ping at a time."""
        moved = False
        while self._receive(host, 0.0):
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
        if self._clock is not None and (item := self._clock.inbox.get(min(patience, 0.05))) is not None:
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
                if deadline is None and (hung := self.hung()) is not None:
                    log.error("%s", hung)
                    self.fail(hung)
                if deadline is None and self._stopping.is_set():
                    deadline = time.monotonic() + self.options.grace_s
                if deadline is not None and time.monotonic() > deadline:
                    self._aborted.set()
                    thread.join(max(0.0, deadline + 0.3 - time.monotonic()))
                    break
        self._stuck = {thread.name for thread in threads if thread.is_alive()}

    def _serve(self, host: Host) -> None:
        try:
            self._drive(host)
        except BaseException as error:  # such as what a node raises in all threads: still, the run must end
            host.done = True
            self.fail(NodeError(host.node.name, host.index, None, f"its thread died: {cause_of(error)}"))

    def _drive(self, host: Host) -> None:
        limit_this_thread(self.options.threads)
        while not (host.done or self._aborted.is_set()):
            if self._step(host) or host.done:
                continue
            patience = host.patience_s()
            self._receive(host, 0.2 if patience is None else min(patience, 0.2))

    def _receive(self, host: Host, timeout_s: float) -> bool:
        """Let a node take one item; whether one came."""
        try:
            item = host.inbox.get(timeout_s)
        except FlsFlowError as error:
            self._fail(host, error)
            return False
        if item is None:
            return False
        host.take(item)
        return True

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
        host.finish()
        self.fail(error)

    def _close(self) -> None:
        for host in self._hosts:
            if host.node.name in self._stuck:
                log.error("node '%s' did not end in time; its files may lack the last pings", host.node.name)
                continue
            failure = closed(host.node, host.instance, self.options.deadline_s)
            if failure is not None:
                log.error("%s", failure, exc_info=failure.__cause__)
                self._error = self._error or failure
            if not isinstance(host, NodeHost):
                host.join(1.0)


def _ignore(news: object) -> None:
    """Nobody else wants to know."""


def _made(nodes: Iterable[Node], out: Path, instances: Mapping[str, Any]) -> dict[str, Any]:
    return {
        node.name: instances[node.name]
        if node.name in instances
        else node.kind.cls(**(resolve(node.parameters(), out) if node.is_sink else node.arguments))
        for node in nodes
    }
