"""What nodes tell each other, whatever carries it: `memory` inside one process, later Zenoh between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from fls_flow.messages import Message

__all__ = [
    "ClockEnd",
    "Coming",
    "Delivery",
    "End",
    "Finished",
    "Inbox",
    "Item",
    "Link",
    "Sample",
    "SamplesEnd",
    "Started",
    "Wake",
]


@dataclass(slots=True)
class Delivery:
    """The value of a port for the firing `index`."""

    port: str
    index: int
    message: Message


@dataclass(slots=True)
class End:
    """Nothing comes on a port after firing `last`; -1: nothing at all."""

    port: str
    last: int


@dataclass(slots=True)
class Sample:
    """One message of a stream; streams have no index."""

    port: str
    message: Message


@dataclass(slots=True)
class Coming:
    """A delivery, or without `index` a sample, whose message is still as it travelled.

    Whoever takes it opens it, so that the thread that reads a channel only enqueues.
    """

    port: str
    index: int | None
    message: Callable[[], Message]

    def opened(self) -> Delivery | Sample:
        """What the node takes. Raises LinkError when the message cannot be read."""
        if self.index is None:
            return Sample(self.port, self.message())
        return Delivery(self.port, self.index, self.message())


@dataclass(slots=True)
class SamplesEnd:
    """A stream has ended."""

    port: str


@dataclass(slots=True)
class Finished:
    """Node `node` is done with firing `index`: it moves the window."""

    node: str
    index: int


@dataclass(slots=True)
class Started:
    """The clock has started a ping: streams may run up to its stamp."""

    stamp_ns: int


@dataclass(slots=True)
class ClockEnd:
    """The clock has started its last ping."""


@dataclass(slots=True)
class Wake:
    """Something outside the link has changed: look again."""


Item: TypeAlias = Delivery | End | Sample | SamplesEnd | Finished | Started | ClockEnd | Wake


class Inbox(Protocol):
    """Where the items for one node arrive, in order per sender."""

    def post(self, item: Item | Coming) -> None:
        """Add an item; never blocks. Raises LinkError when an edge has no room left."""

    def get(self, timeout_s: float | None = None) -> Item | None:
        """The next item, or None when none has come in time."""

    def release(self, port: str) -> None:
        """Give back the room of one delivery on `port`, after it was used."""

    def __len__(self) -> int:
        """How many deliveries wait or are in use."""


class Link(Protocol):
    """Carries items between the nodes of one graph."""

    def inbox(self, node: str) -> Inbox:
        """The inbox of a node."""

    def send(self, node: str, output: str, index: int, message: Message) -> None:
        """Deliver a value to all who take that output."""

    def sample(self, node: str, output: str, message: Message) -> None:
        """Deliver a stream's message to all who take it."""

    def end(self, node: str, last: int) -> None:
        """Tell all who take anything of `node` that firing `last` was its last."""

    def finished(self, node: str, index: int) -> None:
        """Tell the clock that `node`, which holds the window, is done with a firing."""

    def started(self, stamp_ns: int) -> None:
        """Tell the streams that the clock has started a ping."""

    def clock_end(self) -> None:
        """Tell the streams that no ping will be started any more."""
