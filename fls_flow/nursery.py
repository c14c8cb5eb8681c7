"""The handle of the process that brings up the others (`fls_flow.nursery_process`).

Light on purpose: it is started before anything heavy is imported, so that both sides load at once.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import sys
from typing import TYPE_CHECKING, BinaryIO

from fls_flow.channel import Channel
from fls_flow.errors import RunError, UserError

if TYPE_CHECKING:
    from fls_flow.deploy import Group
    from fls_flow.graph import Graph
    from fls_flow.runtime.worker import Assignment

__all__ = ["Nursery"]

log = logging.getLogger(__name__)

PART_S = 1.0  # how long processes may take to exit after the end
MAX_PROCESSES = 120  # what one message with file descriptors can carry


class Nursery:
    """The process that forks the others; start it early, it loads while the graph is being read."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        numbers = str(theirs.fileno()), str(os.getpid())
        command = [sys.executable, "-m", "fls_flow.nursery_process", *numbers]
        self.process = subprocess.Popen(
            command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, process_group=0
        )
        theirs.close()
        self.channel = Channel(ours)

    def bear(
        self, graph: Graph, assignment: Assignment, groups: tuple[Group, ...]
    ) -> dict[str, tuple[Channel, BinaryIO]]:
        """Fork a child per group: its channel and what it prints, by name."""
        if graph.recipe is None:
            raise UserError("a graph that was not loaded by fls_flow.graph.load cannot run as processes")
        if len(groups) > MAX_PROCESSES:
            raise UserError(f"{len(groups)} processes on one host; group nodes to at most {MAX_PROCESSES}")
        children: dict[str, tuple[Channel, BinaryIO]] = {}
        given: list[int] = []
        for group in groups:
            ours, theirs = socket.socketpair()
            read, write = os.pipe()
            os.set_blocking(read, False)  # a process that a node has started may hold the other end for ever
            given += [theirs.detach(), write]
            children[group.name] = (Channel(ours), os.fdopen(read, "rb", buffering=0))
        document = {
            "modules": sorted({node.kind.cls.__module__ for node in graph.nodes}),
            "graph": graph.recipe.name,
            "use": graph.recipe.use,
            "set": graph.recipe.set_,
            "assignment": assignment.to_document(),
            "groups": [{"name": one.name, "nodes": one.nodes, "threads": one.threads} for one in groups],
        }
        line = json.dumps(document, default=str).encode() + b"\n"
        try:
            sent = socket.send_fds(self.channel.socket, [line], given)
            self.channel.socket.sendall(line[sent:])
        except OSError as error:
            said = self.channel.receive() or {"text": "it died"}
            raise RunError(f"the process that starts the others failed: {said['text']}") from error
        finally:
            for descriptor in given:
                os.close(descriptor)
        return children

    def end(self) -> None:
        """Let it go; it ends with its last child."""
        self.channel.close()
        try:
            self.process.wait(PART_S)
        except subprocess.TimeoutExpired:
            self.kill()

    def kill(self) -> None:
        """End it and all its children at once."""
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            log.debug("the processes have ended by themselves")
        self.process.wait()
