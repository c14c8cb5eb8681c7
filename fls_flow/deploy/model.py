"""A deployment that has been checked: which node runs where, and how the parts reach each other."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fls_flow.deploy import session
from fls_flow.deploy.session import Mode, Zenoh
from fls_flow.graph import Graph

__all__ = ["LIVE_WINDOW", "LOCAL", "REPLAY_WINDOW", "Deployment", "Edge", "Group"]

REPLAY_WINDOW, LIVE_WINDOW = 8, 2
LOCAL = "local"  # the only host of a deployment that names none
Edge = tuple[str, str, str]  # node, its output, the sink that takes it


@dataclass(frozen=True, slots=True)
class Group:
    """One process: the nodes that share it, in the order of the graph."""

    name: str
    nodes: tuple[str, ...]
    threads: int = 1  # of BLAS, numba and OpenCV


@dataclass(frozen=True)
class Deployment:
    """Where the nodes of a graph run; plain values, the same on every host.

    window: pings in flight; None: 8 in replay, 2 in live. groups_of: the processes of each host, in the order
    of the file; a host without processes only relays. latest: edges into sinks that may lose pings.
    deadline_s: a node that makes no progress for so long has crashed. lost_after_s: a host or process that is
    silent for so long is lost. connect_timeout_s: how long the hosts wait for each other at the start.
    control: whether `swap` and `stop` may come from outside. zenoh: the settings of each host.
    """

    name: str
    leader: str  # the host of the graph's clock
    groups_of: Mapping[str, tuple[Group, ...]]
    window: int | None = None
    latest: frozenset[Edge] = frozenset()
    deadline_s: float = 60.0
    lost_after_s: float = 3.0
    connect_timeout_s: float = 60.0
    control: bool = False
    zenoh: Mapping[str, Zenoh] = field(default_factory=dict)
    path: Path | None = None
    notes: tuple[str, ...] = ()

    @property
    def hosts(self) -> tuple[str, ...]:
        """The names of the hosts, in the order of the file."""
        return tuple(self.groups_of)

    def groups(self, host: str) -> tuple[Group, ...]:
        """The processes of a host; raises KeyError."""
        return self.groups_of[host]

    def host_of(self, node: str) -> str:
        """The host that runs a node; raises KeyError."""
        return self._place(node)[0]

    def process_of(self, node: str) -> str:
        """The process that runs a node, by a name that no other host uses; raises KeyError."""
        return self._place(node)[1].name

    def nodes(self, host: str) -> tuple[str, ...]:
        """The nodes that a host runs, process by process; raises KeyError."""
        return tuple(node for group in self.groups(host) for node in group.nodes)

    def threads(self, process: str) -> int:
        """How many BLAS, numba and OpenCV threads a process may use; raises KeyError."""
        for groups in self.groups_of.values():
            for group in groups:
                if group.name == process:
                    return group.threads
        raise KeyError(process)

    def window_for(self, live: bool) -> int:
        """Pings in flight."""
        return self.window or (LIVE_WINDOW if live else REPLAY_WINDOW)

    def is_latest(self, node: str, output: str, sink: str) -> bool:
        """Whether that edge may lose pings, and so never holds them up."""
        return (node, output, sink) in self.latest

    def holders(self, graph: Graph) -> tuple[str, ...]:
        """Who holds the window: the nodes after which nothing waits, sinks that may lose pings aside."""
        free = {sink for _, _, sink in self.latest}
        awaited = {
            wire.node
            for node in graph.nodes
            for wire in node.inputs
            if node.name not in free and wire.mode == "now"
        }
        sources = {node.name for node in graph.nodes if node.kind.source}
        return tuple(node.name for node in graph.nodes if node.name not in awaited | sources | free)

    def doubts(self, host: str, where: str) -> str:
        """What to look at when somebody does not meet `host`, or the other way round: one question."""
        settings = self.zenoh.get(host, Zenoh())
        asked = ["is it running", f"does 'connect' lead {where}"]
        asked += ["do the passwords fit"] * (settings.user is not None)
        asked += ["do the certificates fit"] * (settings.tls is not None)
        return f"{', '.join(asked[:-1])}, and {asked[-1]}?"

    def zenoh_config(
        self,
        host: str,
        *,
        mode: Mode | None = None,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
    ) -> dict[str, Any]:
        """Paths and values for `zenoh.Config.insert_json5` of the session by which a host reaches the others.

        Several processes of a host cannot listen on one address: one session takes this, in `mode` router
        (by default) so that it relays, and the host's own processes connect to it with `worker_config`.
        `listen`, `connect`: further endpoints, on this host only, for those processes; access control lets
        them in. Raises InputError when a password or certificate file cannot be used.
        """
        settings = self.zenoh.get(host, Zenoh())
        if mode is not None:
            settings = replace(settings, mode=mode)
        return session.config(settings, listen, connect)

    def worker_config(
        self, host: str, *, listen: Sequence[str] = (), connect: Sequence[str] = ()
    ) -> dict[str, Any]:
        """The same for a process that stays on its host and connects to the session that has `zenoh_config`.

        Those that listen find each other and talk directly; one that listens nowhere is a client, and all
        that it says goes through that session. It shows the host's user and password, since a session that
        asks for them asks everybody. Raises InputError.
        """
        mode: Mode = "peer" if listen else "client"
        settings = self.zenoh.get(host, Zenoh())
        return session.config(replace(settings, mode=mode, listen=(), connect=()), listen, connect)

    def to_document(self) -> dict[str, Any]:
        """Plain values for JSON; `of_document` gives an equal deployment."""
        return {
            "name": self.name,
            "leader": self.leader,
            "groups_of": {
                host: [{"name": one.name, "nodes": list(one.nodes), "threads": one.threads} for one in groups]
                for host, groups in self.groups_of.items()
            },
            "window": self.window,
            "latest": sorted(map(list, self.latest)),
            "deadline_s": self.deadline_s,
            "lost_after_s": self.lost_after_s,
            "connect_timeout_s": self.connect_timeout_s,
            "control": self.control,
            "zenoh": {host: one.to_document() for host, one in self.zenoh.items()},
            "path": None if self.path is None else str(self.path),
            "notes": list(self.notes),
        }

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> Deployment:
        """The deployment that `to_document` wrote."""
        values = dict(document)
        values["groups_of"] = {
            host: tuple(Group(one["name"], tuple(one["nodes"]), one["threads"]) for one in groups)
            for host, groups in values["groups_of"].items()
        }
        values["latest"] = frozenset((node, output, sink) for node, output, sink in values["latest"])
        values["zenoh"] = {host: Zenoh.of_document(one) for host, one in values["zenoh"].items()}
        values["path"] = None if values["path"] is None else Path(values["path"])
        values["notes"] = tuple(values["notes"])
        return cls(**values)

    @property
    def digest(self) -> str:
        """The same on hosts that agree: of all that is here except where files lie, and notes."""
        document = self.to_document()
        del document["path"], document["notes"]
        for one in document["zenoh"].values():
            one["password_file"] = one["password_file"] is not None
            one["tls"] = one["tls"] and {"mutual": one["tls"]["mutual"]}
        text = json.dumps(document, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _place(self, node: str) -> tuple[str, Group]:
        for host, groups in self.groups_of.items():
            for group in groups:
                if node in group.nodes:
                    return host, group
        raise KeyError(node)
