"""The reference link: messages pass by reference inside one process."""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping

from fls_flow.errors import LinkError
from fls_flow.graph import Graph
from fls_flow.links import ClockEnd, Delivery, End, Finished, Item, Sample, SamplesEnd, Started
from fls_flow.messages import Message

__all__ = ["MemoryInbox", "MemoryLink", "Tap"]

Tap = Callable[[int, Message], None]


class MemoryInbox:
    """A node's items; an edge holds at most `room` deliveries that are not yet used."""

    def __init__(self, node: str, room: int) -> None:
        self._node, self._room = node, room
        self._items: deque[Item] = deque()
        self._load: Counter[str] = Counter()
        self._changed = threading.Condition()

    def post(self, item: Item) -> None:
        """Add an item; never blocks. Raises LinkError when the edge has no room left."""
        with self._changed:
            if isinstance(item, Delivery):
                self._load[item.port] += 1
                if self._load[item.port] > self._room:
                    raise LinkError(f"more than {self._room} messages wait at '{self._node}.{item.port}'")
            self._items.append(item)
            self._changed.notify()

    def get(self, timeout_s: float | None = None) -> Item | None:
        """The next item, or None when none has come in time; without a time limit it waits."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        with self._changed:
            while not self._items:
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0.0:
                    return None
                self._changed.wait(left)
            return self._items.popleft()

    def release(self, port: str) -> None:
        """Give back the room of one delivery on `port`."""
        with self._changed:
            self._load[port] -= 1


class MemoryLink:
    """Routes of one graph; `taps` see what an output gives, in the order of its index."""

    def __init__(self, graph: Graph, window: int, taps: Mapping[tuple[str, str], Tap] | None = None) -> None:
        self._inboxes = {node.name: MemoryInbox(node.name, 2 * window + 1) for node in graph.nodes}
        self._clock, self._streams = graph.clock, graph.streams
        self._taps = dict(taps or {})
        self._routes: dict[tuple[str, str], list[tuple[MemoryInbox, str]]] = defaultdict(list)
        for node in graph.nodes:
            for wire in node.inputs:
                self._routes[wire.node, wire.output].append((self._inboxes[node.name], wire.port))

    def inbox(self, node: str) -> MemoryInbox:
        """The inbox of a node."""
        return self._inboxes[node]

    def send(self, node: str, output: str, index: int, message: Message) -> None:
        """Deliver a value to all who take that output."""
        for inbox, port in self._routes.get((node, output), ()):
            inbox.post(Delivery(port, index, message))
        self._tap(node, output, index, message)

    def sample(self, node: str, output: str, message: Message) -> None:
        """Deliver a stream's message to all who take it."""
        for inbox, port in self._routes.get((node, output), ()):
            inbox.post(Sample(port, message))
        self._tap(node, output, -1, message)

    def _tap(self, node: str, output: str, index: int, message: Message) -> None:
        tap = self._taps.get((node, output))
        if tap is not None:
            tap(index, message)

    def end(self, node: str, last: int) -> None:
        """Tell all who take anything of `node` that firing `last` was its last."""
        for (giver, _), routes in self._routes.items():
            for inbox, port in routes if giver == node else ():
                inbox.post(SamplesEnd(port) if node in self._streams else End(port, last))

    def finished(self, node: str, index: int) -> None:
        """Tell the clock that `node` is done with a firing."""
        self._inboxes[self._clock].post(Finished(node, index))

    def started(self, stamp_ns: int) -> None:
        """Tell the streams that the clock has started a ping."""
        for name in self._streams:
            self._inboxes[name].post(Started(stamp_ns))

    def clock_end(self) -> None:
        """Tell the streams that no ping will be started any more."""
        for name in self._streams:
            self._inboxes[name].post(ClockEnd())
