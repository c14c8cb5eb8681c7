"""Deployment files: YAML in, a frozen `Deployment` out; every mistake at once, each with `file:line`."""

from __future__ import annotations

from fls_flow.deploy.model import LIVE_WINDOW, LOCAL, REPLAY_WINDOW, Deployment, Edge, Group
from fls_flow.deploy.read import find, load, shipped
from fls_flow.deploy.session import Tls, Zenoh
from fls_flow.graph import Graph

__all__ = [
    "LIVE_WINDOW",
    "LOCAL",
    "REPLAY_WINDOW",
    "Deployment",
    "Edge",
    "Group",
    "Tls",
    "Zenoh",
    "find",
    "load",
    "local",
    "shipped",
]


def local(graph: Graph, window: int | None = None) -> Deployment:
    """One process per node on this machine, and no way in from another."""
    if window is not None and window < 1:
        raise ValueError(f"window is {window}; at least one ping is in flight")
    groups = tuple(Group(node.name, (node.name,)) for node in graph.nodes)
    return Deployment(graph.name, LOCAL, {LOCAL: groups}, window, zenoh={LOCAL: Zenoh()})
