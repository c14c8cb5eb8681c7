"""Brings up the processes of a run quickly: loads everything once, then forks one child per group of nodes.

Started as `python -m fls_flow.nursery_process FD PID` before the supervisor PID has even read the graph, so
that both import side by side. It opens no Zenoh session and starts no thread: a forked child may do both.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import shutil
import signal
import socket
import sys
from typing import Any

__all__ = ["main"]

PR_SET_PDEATHSIG = 1  # linux/prctl.h
MAX_PROCESSES = 250  # what one message with file descriptors can carry


def main() -> None:
    """Wait for an assignment, fork, tell of every child that ends; end when all have."""
    end = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the supervisor's to answer
    _die_with_supervisor(True)  # while it loads, perhaps compiles, it listens to nobody
    if os.getppid() != int(sys.argv[2]):
        return  # it has died already
    try:
        _bring_up(end)
    except Exception as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        end.sendall(json.dumps({"word": "failed", "text": text}).encode() + b"\n")
        sys.exit(1)


def _bring_up(end: socket.socket) -> None:
    from fls_flow import graph as graphs
    from fls_flow import kernels
    from fls_flow.channel import Channel
    from fls_flow.deploy import Group
    from fls_flow.links import ring
    from fls_flow.runtime import worker

    kernels.prepare()  # while the supervisor reads the graph; nearly every graph has compiled nodes
    message, descriptors, _, _ = socket.recv_fds(end, 1 << 16, 2 * MAX_PROCESSES)
    if not message:
        return
    _die_with_supervisor(False)  # from here on it has to tidy up after it
    channel = Channel(end)
    while not message.endswith(b"\n"):
        message += end.recv(1 << 16)
    said = json.loads(message)
    _preload(said["modules"])
    graph = graphs.load(said["graph"], use=said["use"], set_=said["set"])
    assignment = worker.Assignment.of_document(said["assignment"])
    groups = [Group(one["name"], tuple(one["nodes"]), one["threads"]) for one in said["groups"]]
    gc.freeze()  # what is loaded stays shared between the children
    children: dict[int, str] = {}
    for number, group in enumerate(groups):
        ends = descriptors[2 * number], descriptors[2 * number + 1]
        child = os.fork()
        if child == 0:
            _become(
                ends, descriptors, end, lambda own, group=group: worker.serve(graph, assignment, group, own)
            )
        children[child] = group.name
        channel.send("born", process=group.name)
    for descriptor in descriptors:
        os.close(descriptor)
    while children:
        child, status = os.wait()
        channel.send("exit", process=children.pop(child), code=os.waitstatus_to_exitcode(status))
    while (
        channel.receive() is not None
    ):  # to the end of its supervisor, which may still look at what is there
        pass
    # a killed process leaves shared memory, a killed supervisor the folder of sockets
    ring.sweep(assignment.arenas)
    shutil.rmtree(assignment.sockets, ignore_errors=True)


def _die_with_supervisor(yes: bool) -> None:
    """Let Linux kill this process when its parent dies, or not any more."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL if yes else 0)


def _preload(modules: list[str]) -> None:
    import importlib

    for name in modules:
        importlib.import_module(name)


def _become(ends: tuple[int, int], descriptors: list[int], nursery: socket.socket, serve: Any) -> None:
    """Be the child: keep its own ends alone, write to its own log pipe, end without the parent's clean-up."""
    from fls_flow.channel import Channel

    own, output = ends
    code = 1
    try:
        os.dup2(output, 1)
        os.dup2(output, 2)
        for descriptor in descriptors:
            if descriptor != own:
                os.close(descriptor)
        nursery.detach()
        serve(Channel(socket.socket(fileno=own)))
        code = 0
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):  # a node may have closed it, or put another in its place
                stream.flush()
        os._exit(code)


if __name__ == "__main__":
    main()
