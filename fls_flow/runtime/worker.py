"""One process of a run: hosts its nodes on a Zenoh link, does as the supervisor says."""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from fls_flow.channel import Channel, ChannelLog
from fls_flow.deploy import Deployment, Group
from fls_flow.errors import FlsFlowError, RunError
from fls_flow.graph import Graph
from fls_flow.links.placement import Placement
from fls_flow.links.zenoh import ZenohLink
from fls_flow.runtime import position
from fls_flow.runtime.live import LiveState
from fls_flow.runtime.run import Run
from fls_flow.runtime.terms import Options, Pace, Share

__all__ = ["HUB", "Assignment", "close_session", "open_session", "placement_of", "serve"]

log = logging.getLogger(__name__)

HUB = "the.hub"  # where the supervisor listens: no process has a name with a dot
BEAT_S = 0.5
FLUSH_S = 30.0  # how long the last messages of a run may take to arrive
SPAWN_POLL_S = 0.005
CLOSE_S = 0.5


@dataclass(frozen=True)
class Assignment:
    """What a process must know of the run that it is part of."""

    run: str
    host: str
    graph: str  # name, as in keys
    sockets: str  # the folder in which the processes of this host meet
    out: str
    pace: Pace
    options: dict[str, Any]
    deployment: dict[str, Any]

    @property
    def prefix(self) -> str:
        """What all keys of the run begin with."""
        return f"fls/{self.graph}/{self.run}"

    @property
    def arenas(self) -> str:
        """What the names of the run's shared memory on this host begin with."""
        return f"fls-{self.run}-{self.host}-"

    def positions(self, name: str) -> Path:
        """The file in which the process `name` of this host keeps how far its nodes are."""
        return Path(self.sockets) / f"{name}.at"

    def endpoint(self, name: str) -> str:
        """Where the process `name` of this host listens."""
        return f"unixsock-stream/{self.sockets}/{name}"

    def to_document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {**vars(self), "pace": vars(self.pace)}

    @classmethod
    def of_document(cls, document: dict[str, Any]) -> Assignment:
        """The assignment that `to_document` wrote."""
        return cls(**{**document, "pace": Pace(**document["pace"])})


def open_session(settings: dict[str, Any]) -> zenoh.Session:
    """A Zenoh session with these settings; never in a process that was forked from one with a session.

    Raises RunError when it cannot listen where it should.
    """
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        cause = re.sub(r" at \S+\.rs:\d+\.?", "", str(error))  # the places in Zenoh's own source
        raise RunError(f"no Zenoh session: {cause}; look at 'listen', and at who listens there") from error


def close_session(session: zenoh.Session) -> None:
    """Close a session; one that cannot say goodbye, because its link is dead, ends with the process."""

    def close() -> None:
        try:
            session.close()  # type: ignore[no-untyped-call]  # the stub of zenoh lacks it
        except zenoh.ZError as error:
            log.debug("closing: %s", error)

    thread = threading.Thread(target=close, name="closing", daemon=True)
    thread.start()
    thread.join(CLOSE_S)


def placement_of(graph: Graph, deployment: Deployment) -> Placement:
    """Where everything is, as a link needs it."""
    hosts = {group.name: host for host in deployment.hosts for group in deployment.groups(host)}
    processes = {node.name: deployment.process_of(node.name) for node in graph.nodes}
    free = frozenset(sink for _, _, sink in deployment.latest)
    return Placement(processes, hosts, deployment.holders(graph), free)


def serve(graph: Graph, assignment: Assignment, group: Group, channel: Channel) -> None:
    """Run the nodes of `group` from "go" to the end, and say how it went."""
    logging.getLogger().addHandler(ChannelLog(channel))
    logging.getLogger().setLevel(logging.INFO)
    try:
        _Worker(graph, assignment, group, channel).run()
    except Exception as error:  # whatever it is, the supervisor must hear of it
        log.exception("process '%s'", group.name)
        text = str(error) if isinstance(error, FlsFlowError) else f"{type(error).__name__}: {error}"
        channel.send("failed", text=f"process '{group.name}' failed: {text}")
        channel.send("done", report=None)


class _Worker:
    def __init__(self, graph: Graph, assignment: Assignment, group: Group, channel: Channel) -> None:
        self._group, self._channel = group, channel
        deployment = Deployment.of_document(assignment.deployment)
        # gossip tries each of the others once; these connections are tried until they stand
        groups = [one.name for one in deployment.groups(assignment.host)]
        earlier = groups[: groups.index(group.name)]
        listen = [assignment.endpoint(group.name)]
        connect = [assignment.endpoint(name) for name in (HUB, *earlier)]
        self._connect_s = deployment.connect_timeout_s
        self._session = open_session(
            deployment.worker_config(assignment.host, listen=listen, connect=connect)
        )
        placement = placement_of(graph, deployment)
        self._link = ZenohLink(
            self._session,
            assignment.prefix,
            graph,
            placement,
            group.name,
            assignment.pace.window,
            self._link_failed,
            meeting=Path(assignment.sockets),
            arena=f"{assignment.arenas}{group.name}",
        )
        share = Share(
            frozenset(group.nodes),
            self._link,
            assignment.pace,
            self._failed,
            placement.holders,
            placement.free,
            position.kept(assignment.positions(group.name), group.nodes),
        )
        options = Options(window=assignment.pace.window, threads=group.threads, **assignment.options)
        out = Path(assignment.out)
        self._run = Run(graph, options, out=out, on_finished=self._count, share=share)
        self._live = LiveState(self._session, assignment.prefix, assignment.host, group.name, self._run)
        self._go, self._bye, self._stopped = threading.Event(), threading.Event(), threading.Event()
        self._pings = 0

    def run(self) -> None:
        """Meet the others, run, wait until all that was sent has arrived, part."""
        threading.Thread(target=self._listen, name="supervisor", daemon=True).start()
        self._meet()
        self._go.wait()
        beat = threading.Thread(target=self._beat, name="beat", daemon=True)
        beat.start()
        report = self._run.start()
        flushed = time.monotonic() + FLUSH_S
        while not (self._link.idle() or self._stopped.wait(SPAWN_POLL_S)) and time.monotonic() < flushed:
            pass
        self._channel.send("done", report=report.summary())
        self._bye.wait()  # others may still take what went out last
        self._live.close()
        self._link.close()
        close_session(self._session)

    def _meet(self) -> None:
        deadline = time.monotonic() + self._connect_s
        while (missing := self._link.unmatched()) and not self._go.is_set():
            if time.monotonic() > deadline:
                raise FlsFlowError(f"nobody takes {', '.join(missing)} after {self._connect_s:g} s")
            time.sleep(SPAWN_POLL_S)
        self._channel.send("ready")

    def _listen(self) -> None:
        while (said := self._channel.receive()) is not None:
            if said["word"] == "go":
                self._go.set()
            elif said["word"] == "stop":
                self._stop()
            elif said["word"] == "bye":
                self._bye.set()
        # the supervisor is gone: close the files and end
        self._stop()
        self._bye.set()

    def _stop(self) -> None:
        self._stopped.set()
        self._run.stop()
        self._go.set()

    def _beat(self) -> None:
        while not self._bye.wait(BEAT_S):
            self._live.beat()
            self._channel.send("beat")

    def _count(self, pings: int) -> None:
        self._pings = pings
        self._channel.send("pings", pings=pings)

    def _failed(self, error: FlsFlowError) -> None:
        self._channel.send("failed", text=str(error))

    def _link_failed(self, error: Exception) -> None:
        self._run.fail(error if isinstance(error, FlsFlowError) else FlsFlowError(str(error)))
