"""Carries the items of a graph between processes over Zenoh; inside a process they pass by reference.

Keys, under `fls/<graph>/<run>`:

    <node>/<port>               what an output gives, for processes on other hosts: bytes of `wire`
    <node>/<port>/@host/<host>  the same for processes on that host: of large messages, where they lie in the
                                shared memory of `ring`
    <node>/<port>/@latest/<process>  the same for sinks of that process that may lose pings
    @control/<process>          finished firings, started pings, the end of the clock, from that process
    @answer/<process>           acknowledgements and gaps, to that process

Each key is a `stream`: nothing is lost when a link is cut and made again. Callbacks only enqueue.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import msgspec
import zenoh

from fls_flow import wire
from fls_flow.errors import LinkError
from fls_flow.graph import Graph
from fls_flow.links import ClockEnd, Finished, Inbox, Started
from fls_flow.links._callbacks import Kept
from fls_flow.links._ends import (
    CLOCK_END,
    DELIVERY,
    END,
    FINISHED,
    SAMPLE,
    STARTED,
    Arrived,
    Inlet,
    Outlet,
    Report,
)
from fls_flow.links.memory import MemoryInbox, MemoryLink
from fls_flow.links.placement import Placement, controls, takers
from fls_flow.links.ring import MAX_READERS, Arena, Descriptor, Window
from fls_flow.links.stream import NewestSender, Packet, Receiver, Sender
from fls_flow.messages import Message

__all__ = ["ZenohLink"]

log = logging.getLogger(__name__)

SHARED_FROM = 128 << 10  # bytes; below that, a copy costs less than a lease
_PACKER, _UNPACKER = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder(list[Any])

ANSWER_S = 0.02  # how long acknowledgements are gathered: they free memory, nothing waits for them


class ZenohLink:
    """The link of one process: `local` for its own nodes, streams to and from all others.

    `failed` is told when something arrives that cannot be used. `arena` names this process's shared memory;
    None: all messages go as bytes.
    """

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        graph: Graph,
        placement: Placement,
        process: str,
        window: int,
        failed: Callable[[Exception], None],
        arena: str | None = None,
    ) -> None:
        self._session, self._prefix, self._graph = session, prefix, graph
        self._placement, self._process, self._failed = placement, process, failed
        self._window = window
        self._nodes = frozenset(placement.nodes(process))
        self._local = MemoryLink(graph, window, nodes=self._nodes, free=placement.free)
        self._types: dict[tuple[str, str], type[Any]] = {
            (node.name, port.name): port.message for node in graph.nodes for port in node.kind.outputs
        }
        self._arena = None if arena is None else Arena(arena)
        self._shared = Window()
        self._senders: dict[str, Outlet] = {}
        self._outputs: dict[tuple[str, str], list[Outlet]] = {}
        self._receivers: dict[str, Inlet] = {}
        self._answers: dict[str, zenoh.Publisher] = {}
        self._reports = {
            node: Report(partial(self._tell_finished, node), inbox, window)
            for node in placement.holders
            if node in self._nodes and isinstance(inbox := self._local.inbox(node), MemoryInbox)
        }
        self._kept_threads = Kept()
        self._closing = threading.Event()
        self._declared: list[Any] = []
        self._declare()
        self._threads = [
            threading.Thread(target=self._tick, name="zenoh-answers", daemon=True),
            threading.Thread(target=self._resend, name="zenoh-resend", daemon=True),  # a put may block
        ]
        for thread in self._threads:
            thread.start()

    # --- the Link protocol -----------------------------------------------------------------------

    def inbox(self, node: str) -> Inbox:
        """The inbox of a node of this process."""
        return self._local.inbox(node)

    def send(self, node: str, output: str, index: int, message: Message) -> None:
        """Deliver a value to all who take that output."""
        self._local.send(node, output, index, message)
        self._put(node, output, (DELIVERY, index), message)

    def sample(self, node: str, output: str, message: Message) -> None:
        """Deliver a stream's message to all who take it."""
        self._local.sample(node, output, message)
        self._put(node, output, (SAMPLE, -1), message)

    def end(self, node: str, last: int) -> None:
        """Tell all who take anything of `node` that firing `last` was its last."""
        if node in self._reports:
            self._reports[node].tell()
        self._local.end(node, last)
        for (giver, _), outlets in self._outputs.items():
            for outlet in outlets if giver == node else ():
                outlet.end(last)

    def finished(self, node: str, index: int) -> None:
        """Tell the clock that `node`, which holds the window, is done with a firing."""
        if self._graph.clock in self._nodes:
            self._local.finished(node, index)
        else:
            self._reports[node].finished(index)

    def started(self, stamp_ns: int) -> None:
        """Tell the streams that the clock has started a ping."""
        self._local.started(stamp_ns)
        if any(name not in self._nodes for name in self._graph.streams):
            self._control((STARTED, stamp_ns))

    def clock_end(self) -> None:
        """Tell the streams that no ping will be started any more."""
        self._local.clock_end()
        if any(name not in self._nodes for name in self._graph.streams):
            self._control((CLOCK_END,))

    # --- life ------------------------------------------------------------------------------------

    def unmatched(self) -> list[str]:
        """The keys that somebody must subscribe to before a ping is started."""
        publishers = {key: outlet.publisher for key, outlet in self._senders.items()}
        publishers |= {f"@answer/{name}": publisher for name, publisher in self._answers.items()}
        return [key for key, publisher in publishers.items() if not _matched(publisher)]

    def idle(self) -> bool:
        """Whether everything that was sent has arrived."""
        return all(outlet.sender.idle for outlet in self._senders.values())

    def close(self) -> None:
        """End threads and declarations; the session is its owner's."""
        self._closing.set()
        for thread in self._threads:
            thread.join(1.0)
        self._answer()
        for one in self._declared:
            one.undeclare()
        self._shared.close()
        if self._arena is not None:
            self._arena.close()

    # --- wiring ----------------------------------------------------------------------------------

    def _declare(self) -> None:
        for (node, port, free), found in takers(self._graph, self._placement).items():
            giver = self._placement.process_of[node]
            remote = found - {giver}
            if free:
                for taker in sorted(remote):
                    self._declare_free(node, port, giver, taker)
            elif giver == self._process:
                self._declare_giver(node, port, remote)
            elif self._process in remote:
                self._declare_taker(node, port, giver, remote)
        for giver, receivers in controls(self._graph, self._placement).items():
            if giver == self._process and receivers:
                self._outlet(f"@control/{giver}", receivers)
            elif self._process in receivers:
                self._inlet(f"@control/{giver}", giver, None, 0)
        self._subscribe(f"@answer/{self._process}", self._answered)

    def _declare_giver(self, node: str, port: str, remote: set[str]) -> None:
        """One stream for the processes of this host, one for those of all others."""
        here = self._placement.host_of[self._process]
        near = {taker for taker in remote if self._placement.host_of[taker] == here}
        for receivers, host in ((near, here), (remote - near, None)):
            if receivers:
                outlet = self._outlet(_data_key(node, port, host), receivers, shares=host is not None)
                self._outputs.setdefault((node, port), []).append(outlet)

    def _declare_taker(self, node: str, port: str, giver: str, remote: set[str]) -> None:
        here = self._placement.host_of[self._process]
        same = self._placement.host_of[giver] == here
        readers = sorted(taker for taker in remote if self._placement.host_of[taker] == here)
        key = _data_key(node, port, here if same else None)
        self._inlet(key, giver, (node, port, False), readers.index(self._process))

    def _declare_free(self, node: str, port: str, giver: str, taker: str) -> None:
        key = f"{node}/{port}/@latest/{taker}"
        if giver == self._process:
            publisher = self._publisher(key, zenoh.CongestionControl.DROP)
            sender = NewestSender(lambda packet: _put(publisher, packet), [taker], self._window)
            outlet = self._kept(key, Outlet(publisher, sender))
            self._outputs.setdefault((node, port), []).append(outlet)
        elif taker == self._process:
            self._inlet(key, giver, (node, port, True), 0)

    def _publisher(self, key: str, congestion: zenoh.CongestionControl) -> zenoh.Publisher:
        publisher = self._session.declare_publisher(
            f"{self._prefix}/{key}", congestion_control=congestion, reliability=zenoh.Reliability.RELIABLE
        )
        self._declared.append(publisher)
        return publisher

    def _outlet(self, key: str, receivers: Iterable[str], *, shares: bool = False) -> Outlet:
        publisher = self._publisher(key, zenoh.CongestionControl.BLOCK)
        receivers = sorted(receivers)
        sender = Sender(lambda packet: _put(publisher, packet), receivers)
        readers = len(receivers) if shares and self._arena and len(receivers) <= MAX_READERS else 0
        return self._kept(key, Outlet(publisher, sender, readers, far=not shares))

    def _kept(self, key: str, outlet: Outlet) -> Outlet:
        def back(status: zenoh.MatchingStatus) -> None:
            if status.matching:  # whoever comes back after a cut misses what was put meanwhile
                outlet.sender.resend()

        self._declared.insert(0, outlet.publisher.declare_matching_listener(back))
        self._senders[key] = outlet
        return outlet

    def _inlet(self, key: str, giver: str, route: tuple[str, str, bool] | None, reader: int) -> None:
        if giver not in self._answers:
            publisher = self._session.declare_publisher(
                f"{self._prefix}/@answer/{giver}",
                priority=zenoh.Priority.INTERACTIVE_HIGH,  # data that waits for a slow link must not drop it
            )
            self._answers[giver] = publisher
            self._declared.append(publisher)

        opening = threading.Lock()
        if route is None:
            inlet = Inlet(giver, Receiver(self._take_control))
        else:
            inlet = Inlet(
                giver, Receiver(partial(self._take_data, route, self._types[route[:2]], reader, opening))
            )
        self._receivers[key] = inlet
        self._subscribe(key, partial(self._arrived, key, inlet))

    def _subscribe(self, key: str, callback: Callable[[zenoh.Sample], None]) -> None:
        handler = zenoh.handlers.Callback(self._kept_threads(callback), indirect=False)
        self._declared.append(self._session.declare_subscriber(f"{self._prefix}/{key}", handler))

    # --- out -------------------------------------------------------------------------------------

    def _put(self, node: str, output: str, header: tuple[Any, ...], message: Message) -> None:
        outlets = self._outputs.get((node, output))
        if not outlets:
            return
        layout = wire.layout(message)
        payloads: dict[bool, bytes] = {}
        for outlet in outlets:
            place = self._placed(layout, outlet.readers)
            if place is not None:
                outlet.sender.send((*header, *place))
                continue
            if outlet.far not in payloads:
                payloads[outlet.far] = layout.to_bytes(checksum=outlet.far)
            outlet.sender.send(header, payloads[outlet.far])

    def _placed(self, layout: wire.Layout, readers: int) -> Descriptor | None:
        """The message in shared memory; None when it is small or there is no room: then bytes travel."""
        if not readers or layout.size < SHARED_FROM or self._arena is None:
            return None
        slot = self._arena.place(layout.size, (1 << readers) - 1)
        if slot is None:
            return None
        layout.write_into(slot.view, checksum=False)
        return slot.descriptor

    def _tell_finished(self, node: str, index: int) -> None:
        self._control((FINISHED, node, index))

    def _control(self, header: tuple[Any, ...]) -> None:
        self._senders[f"@control/{self._process}"].sender.send(header)

    # --- in --------------------------------------------------------------------------------------

    def _arrived(self, key: str, inlet: Inlet, sample: zenoh.Sample) -> None:
        try:
            number, *header = _attached(sample)
            gap = inlet.receiver.take(Packet(number, tuple(header), sample.payload.to_bytes()))
            inlet.unanswered = True
            if gap is not None:
                self._tell(inlet.giver, [self._process, "gap", key, *gap])
        except Exception as error:
            self._failed(error if isinstance(error, LinkError) else LinkError(f"{key}: {error!r}"))

    def _take_data(
        self,
        route: tuple[str, str, bool],
        message_type: type[Any],
        reader: int,
        opening: threading.Lock,
        packet: Packet,
    ) -> None:
        kind, number, *place = packet.header
        if kind == END:
            self._local.deliver_end(route, number)
            return
        held = partial(self._shared.open, Descriptor(*place), reader) if place else packet.payload
        arrived = Arrived(held, message_type, opening)
        self._local.deliver_coming(route, number if kind == DELIVERY else None, arrived)

    def _take_control(self, packet: Packet) -> None:
        kind, *values = packet.header
        if kind == FINISHED and self._graph.clock in self._nodes:
            self._local.inbox(self._graph.clock).post(Finished(*values))
        elif kind in (STARTED, CLOCK_END):
            for name in self._graph.streams:
                if name in self._nodes:
                    self._local.inbox(name).post(Started(*values) if kind == STARTED else ClockEnd())

    # --- answers ---------------------------------------------------------------------------------

    def _tick(self) -> None:
        while not self._closing.wait(ANSWER_S):
            self._answer()

    def _resend(self) -> None:
        while not self._closing.wait(ANSWER_S):
            for outlet in self._senders.values():
                outlet.sender.tick()

    def _answer(self) -> None:
        upto: dict[str, dict[str, int]] = {}
        for key, inlet in self._receivers.items():
            if inlet.unanswered:
                inlet.unanswered = False
                upto.setdefault(inlet.giver, {})[key] = inlet.receiver.expected - 1
        for giver, streams in upto.items():
            self._tell(giver, [self._process, "has", streams])

    def _tell(self, giver: str, answer: list[Any]) -> None:
        self._answers[giver].put(b"", attachment=_PACKER.encode(answer))

    def _answered(self, sample: zenoh.Sample) -> None:
        try:
            receiver, word, *rest = _attached(sample)
            if word == "has":
                for key, number in rest[0].items():
                    self._senders[key].sender.acknowledged(receiver, number)
            else:
                key, first, last = rest
                self._senders[key].sender.resend(first, last)
        except Exception as error:
            self._failed(LinkError(f"an answer that makes no sense: {error!r}"))


def _put(publisher: zenoh.Publisher, packet: Packet) -> None:
    publisher.put(packet.payload, attachment=_PACKER.encode((packet.number, *packet.header)))


def _matched(publisher: zenoh.Publisher) -> bool:
    status: Any = publisher.matching_status  # the stub says bool; it is an object that is always true
    return bool(status.matching)


def _attached(sample: zenoh.Sample) -> list[Any]:
    attachment = sample.attachment
    if attachment is None:
        raise LinkError(f"{sample.key_expr}: a message without its header")
    return _UNPACKER.decode(attachment.to_bytes())


def _data_key(node: str, port: str, host: str | None) -> str:
    return f"{node}/{port}" if host is None else f"{node}/{port}/@host/{host}"
