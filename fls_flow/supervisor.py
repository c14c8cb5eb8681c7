"""Runs a graph as processes: starts them, waits until they have met, watches, stops, tidies up."""

from __future__ import annotations

import logging
import selectors
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import zenoh

from fls_flow.channel import Bell
from fls_flow.children import Child, Children
from fls_flow.deploy import Deployment
from fls_flow.errors import FlsFlowError, RunError
from fls_flow.graph import Graph
from fls_flow.hosts import Hosts, RunTerms, ask, offer
from fls_flow.links import ring
from fls_flow.local_runs import announce, meeting_place
from fls_flow.nursery import Nursery
from fls_flow.observe import NodeCounts
from fls_flow.runtime import Options, Pace, Report, pace_of, pings_of
from fls_flow.runtime.worker import HUB, Assignment, close_session, open_session

__all__ = ["ProcessError", "Supervisor"]

log = logging.getLogger(__name__)

DRAIN_S = 0.8  # of that, for the pings in flight: closing takes time too, a picture's most
STOP_S = 1.9  # from a stop until what has not ended is killed


class ProcessError(RunError):
    """A process of the run died, hung or was lost; the text names its nodes, the ping and the cause."""


class Supervisor:
    """One run of a graph as processes of this host; the counterpart of `runtime.Run`.

    `start()` returns when the run has ended, `stop()` ends it from a signal handler or another thread.
    """

    def __init__(
        self,
        graph: Graph,
        deployment: Deployment,
        options: Options,
        nursery: Nursery,
        *,
        host: str,
        out: Path,
        on_finished: Callable[[int], None] = lambda pings: None,
    ) -> None:
        self.id = uuid.uuid4().hex[:12]
        self.graph, self.deployment, self.host = graph, deployment, host
        self._out, self._on_finished = out, on_finished
        clock = graph.node(graph.clock)
        instance = clock.kind.cls(**clock.arguments)
        self.total = pings_of(instance)
        window = options.window or deployment.window
        self._pace = pace_of(Options(window=window, rate=options.rate), instance)
        self.window = self._pace.window
        self._options = {
            "rate": options.rate,
            "stream_wait_s": options.stream_wait_s,
            "grace_s": min(options.grace_s, DRAIN_S),
            "deadline_s": deployment.deadline_s,
            "samples_taken": options.samples_taken,
        }
        self._children = Children(nursery, deployment.groups(host))
        self._bell = Bell()
        self._stopped_at: float | None = None
        self._interrupted = False
        self._error: FlsFlowError | None = None
        self._went = False
        self._pings = 0
        self._first: float | None = None
        self._watched = 0.0
        self._stop_asked = threading.Event()
        self._hosts: Hosts | None = None
        self._began = time.monotonic()  # to wait for the other hosts
        self._offer: Any = None

    def start(self) -> Report:
        """Run to the end; reports what went wrong in the run.

        Raises UserError and RunError when the hosts do not come together.
        """
        began = time.monotonic()
        ring.sweep("fls-", abandoned=True)  # of runs that were killed whole
        with meeting_place(self.id, [HUB, *self._names()]) as place:
            hub = f"unixsock-stream/{place}/{HUB}"
            session = open_session(self.deployment.zenoh_config(self.host, listen=[hub]))
            try:
                terms = self._agree(session)
                if terms is None:
                    return self._never_began(time.monotonic() - began)
                assignment = self._assignment(terms, place)
                announce(place, self.graph.name, terms.run, self.host, hub)
                self._meet(session, assignment)
                try:
                    self._watch()
                finally:
                    self._watched = time.monotonic()
                    self._part()
                    ring.sweep(assignment.arenas)
            finally:
                close_session(session)
        return self._report(time.monotonic() - began)

    def _agree(self, session: zenoh.Session) -> RunTerms | None:
        """The terms of the run: the leader's own, or what it answers; None when stopped before."""
        if self.host != self.deployment.leader:
            terms = ask(session, self.deployment, self.graph.digest, self._stop_asked)
            if terms is None:
                return None
            self.id, self._pace = terms.run, Pace(terms.window, terms.live)
            self.window = terms.window
            return terms
        digests = self.graph.digest, self.deployment.digest
        terms = RunTerms(self.id, *digests, self._pace.window, self._pace.live, self._options)
        if len(self.deployment.hosts) > 1:
            self._offer = offer(session, self.deployment, terms, lambda: self._went)
        return terms

    def _assignment(self, terms: RunTerms, place: Path) -> Assignment:
        return Assignment(
            terms.run,
            self.host,
            self.graph.name,
            str(place),
            str(self._out),
            self._pace,
            terms.options,
            self.deployment.to_document(),
        )

    def _meet(self, session: zenoh.Session, assignment: Assignment) -> None:
        self._began = time.monotonic()
        if len(self.deployment.hosts) > 1:
            self._hosts = Hosts(session, self.deployment, assignment.prefix, self.host, self._bell.ring)
        try:
            self._children.bear(self.graph, assignment)
        except FlsFlowError as error:
            if self._hosts is not None:  # so that nobody waits for this host
                self._hosts.say("failed", error=str(error))
                self._hosts.close()
            raise
        self._advance()

    def stop(self) -> None:
        """Start no further ping, finish those in flight, close."""
        self._interrupted = True
        self._stop_asked.set()
        self._bell.ring()

    def _names(self) -> list[str]:
        return [group.name for group in self.deployment.groups(self.host)]

    # --- watching --------------------------------------------------------------------------------

    def _watch(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._bell, selectors.EVENT_READ, self._woken)
            selector.register(self._children.nursery.channel, selectors.EVENT_READ, self._nursery_said)
            for child in self._children:
                selector.register(child.channel, selectors.EVENT_READ, lambda c=child: self._said(c))
                selector.register(child.output, selectors.EVENT_READ, child.show_printed)
            while not self._over():
                for key, _ in selector.select(0.1):
                    if key.data() is False:
                        selector.unregister(key.fileobj)
                self._check_time()

    def _woken(self) -> bool:
        self._bell.silence()
        if self._interrupted:
            self._halt("stopping")
        if self._hosts is not None:
            self._news(self._hosts)
        self._advance()
        return True

    def _news(self, hosts: Hosts) -> None:
        """Do as the other hosts do."""
        failure = hosts.failure()
        if failure is not None and self._error is None:
            self._fail(RunError(failure))
        if not self._interrupted and hosts.stopped():
            self._interrupted = True
            self._halt("stopping")
        if self.host != self.deployment.leader:
            self._pings = hosts.pings()
            self._on_finished(self._pings)

    def _advance(self) -> None:
        """Say how far this host is; start the nodes when all hosts are ready, the clock last."""
        if self._went:
            if self._hosts is not None and self._children.done and self._done():
                self._hosts.say("done", error=str(self._error) if self._error else None)
            return
        if self._stopped_at is not None or not self._children.ready:
            return
        if self._hosts is not None:
            self._hosts.say("ready")
            leads = self.host == self.deployment.leader
            others = self._hosts.all_in("ready") if leads else self._follows(self._hosts)
            if not others:
                return
            self._hosts.say("go")
        self._went = True
        self._children.go(last=self.deployment.process_of(self.graph.clock))

    def _follows(self, hosts: Hosts) -> bool:
        return hosts.state(self.deployment.leader) in ("go", "done")

    def _over(self) -> bool:
        if not self._children.done:
            return False
        if self._hosts is None:
            return self._went or self._stopped_at is not None
        self._hosts.say("done", error=str(self._error) if self._error else None) if self._done() else None
        patience = self._stopped_at is not None and time.monotonic() - self._stopped_at > STOP_S
        return self._done() and (self._hosts.parted() or patience)

    def _done(self) -> bool:
        """Whether nothing more happens on this host: its own processes have ended, and the others' too."""
        if self._children:
            return self._went or self._stopped_at is not None
        hosts = self._hosts  # a host that only relays stays until the others are done
        return hosts is None or self._stopped_at is not None or hosts.all_in("done")

    def _halt(self, state: Literal["stopping", "failed"]) -> None:
        """Tell everybody to stop; those who do not are killed after a while."""
        if self._hosts is not None:
            self._hosts.say(state, error=str(self._error) if self._error else None)
        if self._stopped_at is None:
            self._stopped_at = time.monotonic()
            self._children.tell("stop")

    def _fail(self, error: FlsFlowError) -> None:
        log.error("%s", error)
        self._error = self._error or error
        self._halt("failed")

    def _check_time(self) -> None:
        if self._hosts is not None and self._error is None and (lost := self._lost(self._hosts)) is not None:
            self._fail(RunError(lost))
        late = self._stopped_at is not None and time.monotonic() - self._stopped_at > STOP_S
        if late and not self._children.done:
            self._children.kill()
        elif self._went:
            for child, silent_s in self._children.silent(self.deployment.lost_after_s):
                why = (
                    "stopped, or in code that holds Python's lock; the deployment's lost_after_s allows more"
                )
                self._fail(ProcessError(f"{child} is silent for {silent_s:.1f} s ({why})"))
        elif self._stopped_at is None:  # each gives up by itself a little earlier, unless it hangs
            patience_s = self.deployment.connect_timeout_s + self.deployment.lost_after_s
            for child in self._children.late(patience_s):
                self._fail(ProcessError(f"{child} was not ready after {patience_s:g} s"))

    def _lost(self, hosts: Hosts) -> str | None:
        """Why the run cannot go on without another host: it fell silent, or never came."""
        patience_s = self.deployment.connect_timeout_s
        if self._went or time.monotonic() - self._began < patience_s or not (names := hosts.missing()):
            return hosts.lost()
        who = ", ".join(f"'{name}'" for name in names)
        doubts = self.deployment.doubts(self.host, "here")
        return f"host {who} did not come within {patience_s:g} s; {doubts}"

    def _said(self, child: Child) -> bool:
        documents, there = child.channel.drain()
        child.heard = time.monotonic()
        for said in documents:
            getattr(self, f"_on_{said.pop('word')}")(child, **said)
        if not there and not child.done:
            self._children.wait_for_exit(child)
            self._died(child)
        return there

    def _died(self, child: Child) -> None:
        child.done = True
        child.look()
        self._fail(ProcessError(f"{child} died{child.cause}"))

    def _on_ready(self, child: Child) -> None:
        child.ready = True
        self._advance()

    def _on_beat(self, child: Child) -> None:
        """It lives: that it was heard is noted already."""

    def _on_pings(self, child: Child, pings: int) -> None:
        self._pings = pings
        if pings and self._first is None:
            self._first = time.monotonic()
        self._on_finished(pings)
        if self._hosts is not None:
            self._hosts.count(pings)

    def _on_failed(self, child: Child, text: str) -> None:
        self._fail(RunError(text))

    def _on_done(self, child: Child, report: dict[str, Any] | None) -> None:
        child.done, child.report = True, report
        if report is not None and report["error"] is not None and self._error is None:
            self._fail(RunError(report["error"]))  # found while closing: nobody has told of it yet
        clock = (report or {}).get("counts", {}).get(self.graph.clock)
        if clock and self._hosts is not None and self._stopped_at is None:
            self._hosts.count(clock["fired"])  # the clock does not wait for the last to be finished

    def _on_log(self, child: Child, level: int, name: str, text: str) -> None:
        logging.getLogger(name).log(level, "[%s] %s", child.group.name, text)

    def _nursery_said(self) -> bool:
        there, wrong = self._children.hear_nursery()
        if wrong is not None:
            self._fail(ProcessError(wrong))
            for child in self._children:
                child.done = True
        for child in self._children.ended():  # a process that it has forked may hold its channel open
            while not child.done and child.channel.pending():
                self._said(child)
            if not child.done:
                self._died(child)
        return there and wrong is None

    # --- the end ---------------------------------------------------------------------------------

    def _part(self) -> None:
        self._children.part()
        if self._hosts is not None:
            self._hosts.close()
        self._end()

    def _end(self) -> None:
        self._children.close()
        self._bell.close()

    def _never_began(self, seconds: float) -> Report:
        """The report of a host that was stopped while it waited for the leader."""
        self._end()
        counts = {name: NodeCounts() for name in self.deployment.nodes(self.host)}
        return Report("interrupted", 0, seconds, counts)

    def _report(self, seconds: float) -> Report:
        status: Literal["finished", "interrupted", "failed"] = (
            "interrupted" if self._interrupted else "finished"
        )
        counts = {name: NodeCounts() for name in self.deployment.nodes(self.host)} | self._children.counts()
        here = [name for name in self.deployment.holders(self.graph) if name in counts]
        if not here and status == "finished" and self._error is None:  # all that was started went through
            here = [name for name in counts if name not in self.graph.streams]
        pings = max(min((counts[name].fired for name in here), default=0), self._pings)
        self._on_finished(pings)
        after = 0.0 if self._first is None else self._watched - self._first
        taken = self._children.samples_taken()
        return Report("failed" if self._error else status, pings, seconds, counts, taken, self._error, after)
