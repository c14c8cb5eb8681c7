"""The reference link: messages pass by reference inside one process."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Container, Mapping
from queue import Empty, SimpleQueue
from typing import TypeAlias, TypeGuard

from fls_flow.errors import LinkError
from fls_flow.graph import Graph
from fls_flow.links import ClockEnd, Coming, Delivery, End, Finished, Item, Sample, SamplesEnd, Started
from fls_flow.messages import Message

__all__ = ["MemoryInbox", "MemoryLink", "NewestInbox", "Tap"]

LINGER_S = 0.2e-3

Tap = Callable[[int, Message], None]


class MemoryInbox:
    """A node's items; an edge holds at most `room` deliveries that are not yet used.

    `before_waiting` is called, once, when the next `get` finds nothing for `LINGER_S`: what may wait until
    the node has nothing to do. Only the node's thread sets it.
    """

    def __init__(self, node: str, room: int) -> None:
        self.before_waiting: Callable[[], None] | None = None
        self._node, self._room = node, room
        self._items: SimpleQueue[Item | Coming] = SimpleQueue()
        self._load: dict[str, int] = {}
        self._lock = threading.Lock()

    def post(self, item: Item | Coming) -> None:
        """Add an item; never blocks. Raises LinkError when the edge has no room left."""
        if _fills(item):
            with self._lock:
                load = self._load[item.port] = self._load.get(item.port, 0) + 1
            if load > self._room:
                raise LinkError(f"more than {self._room} messages wait at '{self._node}.{item.port}'")
        self._items.put(item)

    def __len__(self) -> int:
        with self._lock:
            return sum(self._load.values())

    def get(self, timeout_s: float | None = None) -> Item | None:
        """The next item, or None when none has come in time; without a time limit it waits.

        Raises LinkError when its message cannot be read.
        """
        try:
            if self.before_waiting is not None:
                item = self._lingering(timeout_s)
            else:
                item = self._items.get(timeout_s != 0.0, timeout_s)
        except Empty:
            return None
        return item.opened() if isinstance(item, Coming) else item

    def _lingering(self, timeout_s: float | None) -> Item | Coming:
        try:
            return self._items.get(timeout_s != 0.0, LINGER_S)
        except Empty:
            call, self.before_waiting = self.before_waiting, None
            if call is not None:
                call()
            return self._items.get(timeout_s != 0.0, timeout_s)

    def release(self, port: str) -> None:
        """Give back the room of one delivery on `port`."""
        with self._lock:
            self._load[port] -= 1


class NewestInbox:
    """The same for a sink that may lose pings: an edge that is full lets its oldest delivery go."""

    def __init__(self, room: int) -> None:
        self._room = room
        self._items: deque[Item | Coming] = deque()
        self._load: Counter[str] = Counter()
        self._changed = threading.Condition()

    def post(self, item: Item | Coming) -> None:
        """Add an item; never blocks."""
        with self._changed:
            if _fills(item):
                self._load[item.port] += 1
                if self._load[item.port] > self._room:
                    self._drop_oldest(item.port)
            self._items.append(item)
            self._changed.notify()

    def _drop_oldest(self, port: str) -> None:
        """Make room; when all of them are with the node already, that one keeps the newest."""
        for place, item in enumerate(self._items):
            if _fills(item) and item.port == port:
                del self._items[place]
                self._load[port] -= 1
                return

    def __len__(self) -> int:
        with self._changed:
            return sum(self._load.values())

    def get(self, timeout_s: float | None = None) -> Item | None:
        """The next item, or None when none has come in time; without a time limit it waits.

        Raises LinkError when its message cannot be read.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._items, timeout_s):
                return None
            item = self._items.popleft()
        return item.opened() if isinstance(item, Coming) else item

    def release(self, port: str) -> None:
        """Give back the room of one delivery on `port`."""
        with self._changed:
            self._load[port] -= 1


AnyInbox: TypeAlias = MemoryInbox | NewestInbox


def _fills(item: Item | Coming) -> TypeGuard[Delivery | Coming]:
    """Whether the item takes room on its edge: samples are bounded by their stream."""
    return isinstance(item, Delivery) or (isinstance(item, Coming) and item.index is not None)


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
        self._inboxes: dict[str, MemoryInbox | NewestInbox] = {
            node.name: NewestInbox(room) if node.name in free else MemoryInbox(node.name, room)
            for node in here
        }
        self._clock = graph.clock
        self._stream_names = frozenset(graph.streams)
        self._streams = tuple(name for name in graph.streams if name in self._inboxes)
        self._taps = dict(taps or {})
        # by output, and whether the taker may lose pings: between processes these are different streams
        self._routes: dict[tuple[str, str, bool], list[tuple[AnyInbox, str]]] = defaultdict(list)
        for node in here:
            for wire in node.inputs:
                route = self._routes[wire.node, wire.output, node.name in free]
                route.append((self._inboxes[node.name], wire.port))

    def inbox(self, node: str) -> AnyInbox:
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

    def deliver_coming(
        self, route: tuple[str, str, bool], index: int | None, message: Callable[[], Message]
    ) -> None:
        """Deliver a value, or without `index` a stream's message, that its taker opens."""
        for inbox, port in self._routes.get(route, ()):
            inbox.post(Coming(port, index, message))

    def sample(self, node: str, output: str, message: Message) -> None:
        """Deliver a stream's message to all who take it."""
        for free in (False, True):
            for inbox, port in self._routes.get((node, output, free), ()):
                inbox.post(Sample(port, message))
        self._tap(node, output, -1, message)

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
