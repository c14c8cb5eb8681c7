"""The ends of what goes between processes: kinds of packets, who gives and takes, what the clock is told."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import wire
from fls_flow.links.memory import MemoryInbox
from fls_flow.links.near import Line
from fls_flow.links.stream import Sender
from fls_flow.messages import Message

__all__ = [
    "CLOCK_END",
    "DELIVERY",
    "END",
    "FINISHED",
    "PLACED",
    "SAMPLE",
    "STARTED",
    "Arrived",
    "Held",
    "Input",
    "Output",
    "Report",
]

DELIVERY, SAMPLE, END, FINISHED, STARTED, CLOCK_END = range(6)  # the kinds of packets
PLACED = 8  # beside a kind: the message lies in shared memory
CLOSE_S = 1e-3  # firings that follow each other more closely may be told together


Held = bytes | Callable[[], npt.NDArray[np.uint8]]  # a message as it travelled, or what gives its bytes


@dataclass
class Output:
    """Where a port's messages go."""

    number: int  # among the outputs of the graph
    lines: list[Line] = field(default_factory=list)  # of this host
    streams: list[Sender] = field(default_factory=list)


@dataclass
class Input:
    """What takes a port's messages here."""

    route: tuple[str, str, bool]  # node, port, whether it may lose pings
    message_type: type[Any]
    reader: int = 0  # which of the processes of this host that take them
    opening: threading.Lock = field(default_factory=threading.Lock)


class Report:
    """What the clock is told of a node that holds the window: the newest firing that it has finished.

    While firings follow each other closely some are told together: at most half a window waits, and nothing
    while the node waits.
    """

    def __init__(self, tell: Callable[[int], None], inbox: MemoryInbox, window: int) -> None:
        self._tell, self._inbox, self._most = tell, inbox, max(1, window // 2)
        self._index = self._told = -1
        self._when = 0.0

    def finished(self, index: int) -> None:
        """The node is done with a firing."""
        self._index = index
        if index - self._told >= self._most or time.monotonic() - self._when >= CLOSE_S:
            self.tell()
        else:
            self._inbox.before_waiting = self.tell

    def tell(self) -> None:
        """Tell what was not told."""
        self._inbox.before_waiting = None
        if self._index > self._told:
            self._told, self._when = self._index, time.monotonic()
            self._tell(self._index)


class Arrived:
    """A message as it travelled; the first of its takers opens it for all, under `lock`."""

    __slots__ = ("_held", "_lock", "_message", "_type")

    def __init__(
        self,
        held: Held,
        message_type: type[Any],
        lock: threading.Lock,
    ) -> None:
        self._held: Held = held
        self._type, self._lock = message_type, lock
        self._message: Message | None = None

    def __call__(self) -> Message:
        """The message; raises LinkError or WireError when it cannot be read."""
        with self._lock:
            if self._message is None:
                held = self._held if isinstance(self._held, bytes) else self._held().data
                self._message = wire.decode(held, self._type)
                self._held = b""
            return self._message
