"""fls_flow's own link: messages of `wire` in shared memory, numbered and acknowledged, within a window.

Two processes of one graph, without the runtime around them: the source starts a message when the sink has
finished the one eight before it, or as many as the variant says ("tcp-32").
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import zenoh

from benchmarks.transport_peers.over_zenoh import session
from benchmarks.transport_peers.rig import Bytes, Setting, Tally
from fls_flow import array
from fls_flow.catalog import describe
from fls_flow.graph import Graph
from fls_flow.graph.model import Input, Node
from fls_flow.links import Delivery, Finished
from fls_flow.links.placement import Placement
from fls_flow.links.zenoh import ZenohLink
from fls_flow.messages import Sealed

__all__ = [
    "Array",
    "Block",
    "Taker",
    "failed",
    "graph",
    "link",
    "publish",
    "receive",
    "send",
    "subscribe",
    "window",
]


@dataclass(frozen=True, eq=False)
class Block(Sealed):
    """What the peers send: an array."""

    seq: int
    stamp_ns: int
    cells: Bytes = array(np.uint8, "n")


@dataclass
class Array:
    """Where the messages come from; never called here."""

    def __call__(self) -> Iterator[Block]:
        """Give nothing."""
        return iter(())


@dataclass
class Taker:
    """Where they go; never called here."""

    def __call__(self, block: Block) -> None:
        """Take one."""


def send(setting: Setting) -> None:
    """Send each array as a message's samples."""
    with session(setting, listen=True) as opened:
        publish(opened, setting)


def publish(opened: zenoh.Session, setting: Setting) -> None:
    """The same over a session that is there."""
    own = link(opened, setting, "source")
    setting.wait_ready()
    while own.unmatched():
        time.sleep(0.005)
    inbox, finished = own.inbox("source"), dict.fromkeys(_takers(setting), -1)
    index, most = 0, window(setting)
    for item in setting.messages():
        if isinstance(item, float):
            time.sleep(item)
            continue
        while min(finished.values()) < index - most:
            found = inbox.get(0.5)
            if isinstance(found, Finished):
                finished[found.node] = found.index
            elif setting.all_done():
                break
        own.send("source", "block", index, Block(index, index, item))
        index += 1
    own.close()


def receive(setting: Setting, tally: Tally) -> None:
    """Take the samples of each message."""
    with session(setting, listen=False) as opened:
        subscribe(opened, setting, tally)


def subscribe(opened: zenoh.Session, setting: Setting, tally: Tally) -> None:
    """The same over a session that is there."""
    name = _takers(setting)[tally.index]
    own = link(opened, setting, name)
    inbox, more = own.inbox(name), True
    while own.unmatched():
        time.sleep(0.005)
    setting.ready(tally.index)
    while more:
        found = inbox.get()
        if isinstance(found, Delivery):
            index = found.index
            assert isinstance(found.message, Block)
            more = tally.take(found.message.cells)
            found = None  # its slot is free when nothing refers to it
            inbox.release("block")
            own.finished(name, index)
    tally.save()
    own.close()


def window(setting: Setting) -> int:
    """How many messages may be in flight; by default as many as in a replay."""
    return int(setting.variant.partition("-")[2] or 8)


def _takers(setting: Setting) -> tuple[str, ...]:
    return tuple(f"taker-{index}" for index in range(setting.readers))


def graph(setting: Setting) -> Graph:
    """The source, and a taker per reader."""
    wire = Input("block", "source", "block")
    nodes = (
        Node("source", describe(Array), {}),
        *(Node(taker, describe(Taker), {}, inputs=(wire,)) for taker in _takers(setting)),
    )
    return Graph("g", nodes, "source")


def link(opened: zenoh.Session, setting: Setting, process: str) -> ZenohLink:
    """The link of one process: each node has its own, named as the node."""
    takers = _takers(setting)
    everywhere = ("source", *takers)
    placement = Placement(
        dict(zip(everywhere, everywhere, strict=True)), dict.fromkeys(everywhere, "here"), takers
    )
    prefix, arena = f"fls/{setting.key}", f"fls-{setting.key}-{process}"
    return ZenohLink(
        opened,
        prefix,
        graph(setting),
        placement,
        process,
        window(setting),
        failed,
        meeting=setting.folder,
        arena=arena,
    )


def failed(error: Exception) -> None:
    """Nothing may go wrong here."""
    raise error
