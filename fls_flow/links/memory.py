"""The reference link: messages pass by reference inside one process."""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Container, Mapping

from fls_flow.errors import LinkError
from fls_flow.graph import Graph
from fls_flow.links import ClockEnd, Delivery, End, Finished, Item, Sample, SamplesEnd, Started
from fls_flow.messages import Message

__all__ = ["MemoryInbox", "MemoryLink", "Tap"]

Tap = Callable[[int, Message], None]


class MemoryInbox:
    """A node's items; an edge holds at most `room` deliveries that are not yet used.

    With `newest`, an edge that is full lets its oldest delivery go instead of failing.
    """

    def __init__(self, node: str, room: int, *, newest: bool = False) -> None:
        self._node, self._room, self._newest = node, room, newest
        self._items: deque[Item] = deque()
        self._load: Counter[str] = Counter()
        self._changed = threading.Condition()

    def post(self, item: Item) -> None:
        """Add an item; never blocks. Raises LinkError when the edge has no room left."""
        with self._changed:
            if isinstance(item, Delivery):
                self._load[item.port] += 1
                if self._load[item.port] > self._room and not self._drop_oldest(item.port):
                    raise LinkError(f"more than {self._room} messages wait at '{self._node}.{item.port}'")
            self._items.append(item)
            self._changed.notify()

    def _drop_oldest(self, port: str) -> bool:
        """Make room on an edge that may lose pings; whether it did."""
        if not self._newest:
            return False
        for place, item in enumerate(self._items):
            if isinstance(item, Delivery) and item.port == port:
                del self._items[place]
                self._load[port] -= 1
                return True
        return True  # all of them are with the node already, which keeps the newest

    def __len__(self) -> int:
        return sum(self._load.values())

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
    """Routes of one graph, or of those of its `nodes` that live here; `taps` see what an output gives.

    `free` are the sinks that may lose pings.
    """

    def __init__(
        self,
        graph: Graph,
        window: int,
        taps: Mapping[tuple[str, str], Tap] | None = None,
        nodes: Container[str] | None = None,
        free: Container[str] = (),
    ) -> None:
        here = [node for node in graph.nodes if nodes is None or node.name in nodes]
        room = 2 * window + 1
        self._inboxes = {node.name: MemoryInbox(node.name, room, newest=node.name in free) for node in here}
        self._clock = graph.clock
        self._stream_names = frozenset(graph.streams)
        self._streams = tuple(name for name in graph.streams if name in self._inboxes)
        self._taps = dict(taps or {})
        # by output, and whether the taker may lose pings: between processes these are different streams
        self._routes: dict[tuple[str, str, bool], list[tuple[MemoryInbox, str]]] = defaultdict(list)
        for node in here:
            for wire in node.inputs:
                route = self._routes[wire.node, wire.output, node.name in free]
                route.append((self._inboxes[node.name], wire.port))

    def inbox(self, node: str) -> MemoryInbox:
        """The inbox of a node."""
        return self._inboxes[node]

    def send(self, node: str, output: str, index: int, message: Message) -> None:
        """Deliver a value to all who take that output."""
        for free in (False, True):
            self.deliver((node, output, free), index, message)
        self._tap(node, output, index, message)

    def deliver(self, route: tuple[str, str, bool], index: int, message: Message) -> None:
        """Deliver a value to the takers of one kind: those that may lose pings, or those that may not."""
        for inbox, port in self._routes.get(route, ()):
            inbox.post(Delivery(port, index, message))

    def sample(self, node: str, output: str, message: Message) -> None:
        """Deliver a stream's message to all who take it."""
        for free in (False, True):
            self.deliver_sample((node, output, free), message)
        self._tap(node, output, -1, message)

    def deliver_sample(self, route: tuple[str, str, bool], message: Message) -> None:
        """Deliver a stream's message to the takers of one kind."""
        for inbox, port in self._routes.get(route, ()):
            inbox.post(Sample(port, message))

    def _tap(self, node: str, output: str, index: int, message: Message) -> None:
        tap = self._taps.get((node, output))
        if tap is not None:
            tap(index, message)

    def end(self, node: str, last: int) -> None:
        """Tell all who take anything of `node` that firing `last` was its last."""
        for route in self._routes:
            if route[0] == node:
                self.deliver_end(route, last)

    def deliver_end(self, route: tuple[str, str, bool], last: int) -> None:
        """Tell the takers of one kind."""
        for inbox, port in self._routes.get(route, ()):
            inbox.post(SamplesEnd(port) if route[0] in self._stream_names else End(port, last))

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
