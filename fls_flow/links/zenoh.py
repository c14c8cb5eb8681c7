"""Carries the items of a graph between processes; inside a process they pass by reference.

To processes of other hosts they go over Zenoh, under `fls/<graph>/<run>`, as streams (`far`):

    <node>/<port>                    what an output gives: bytes of `wire`
    <node>/<port>/@latest/<process>  the same for sinks of that process that may lose pings, on any host
    @control/<process>               finished firings, started pings, the end of the clock, from that process
    @answer/<process>                acknowledgements and gaps, to that process

To processes of the same host they go over sockets (`near`), and large messages lie in shared memory (`ring`):
the packet says where. Neither loses anything, and what reads a channel only enqueues.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from fls_flow import wire
from fls_flow.graph import Graph
from fls_flow.links import ClockEnd, Finished, Inbox, Started
from fls_flow.links._ends import (
    CLOCK_END,
    DELIVERY,
    END,
    FINISHED,
    PLACED,
    SAMPLE,
    STARTED,
    Arrived,
    Held,
    Input,
    Output,
    Report,
)
from fls_flow.links.far import Streams
from fls_flow.links.memory import MemoryInbox, MemoryLink
from fls_flow.links.near import HEAD, Door, Line, Take
from fls_flow.links.placement import Placement, controls, takers
from fls_flow.links.ring import MAX_READERS, Arena, Descriptor, Slot, Window
from fls_flow.links.stream import Packet, Sender
from fls_flow.messages import Message

__all__ = ["ZenohLink"]

SHARED_FROM = 128 << 10  # bytes; below that, a copy costs less than a lease

_PLACE = struct.Struct("<QQQQ")  # a descriptor without its name: slot, offset, size, generation


class ZenohLink:
    """The link of one process: `local` for its own nodes, lines and streams to and from all others.

    `failed` is told when something arrives that cannot be used. `meeting` is a folder of this user alone in
    which the processes of this host have their sockets, and `arena` names this process's shared memory;
    without the one all messages go over Zenoh, without the other as bytes.
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
        *,
        meeting: Path | None = None,
        arena: str | None = None,
    ) -> None:
        self._graph, self._placement = graph, placement
        self._process, self._window, self._meeting = process, window, meeting
        self._nodes = frozenset(placement.nodes(process))
        self._local = MemoryLink(graph, window, nodes=self._nodes, free=placement.free)
        ports = [(node.name, port.name, port.message) for node in graph.nodes for port in node.kind.outputs]
        self._ports = [(node, port) for node, port, _ in ports]
        self._types: dict[tuple[str, str], type[Any]] = {(node, port): kind for node, port, kind in ports}
        self._reports = {
            node: Report(partial(self._tell_finished, node), inbox, window)
            for node in placement.holders
            if node in self._nodes and isinstance(inbox := self._local.inbox(node), MemoryInbox)
        }
        self._arena = None if arena is None or meeting is None else Arena(arena)
        self._shared = Window()
        self._lines: dict[str, Line] = {}
        self._outputs: dict[tuple[str, str], Output] = {}
        self._listeners: list[Line] = []  # of this process's control, on this host
        self._control_stream: Sender | None = None
        self._inputs: dict[tuple[str, str], Input] = {}
        self._streams = Streams(session, prefix, process, failed)
        self._declare()
        self._streams.start()
        self._door = None if meeting is None else Door(meeting / f"{process}.in", self._enter, failed)

    # --- the Link protocol -----------------------------------------------------------------------

    def inbox(self, node: str) -> Inbox:
        """The inbox of a node of this process."""
        return self._local.inbox(node)

    def send(self, node: str, output: str, index: int, message: Message) -> None:
        """Deliver a value to all who take that output."""
        self._local.send(node, output, index, message)
        self._put(node, output, DELIVERY, index, message)

    def sample(self, node: str, output: str, message: Message) -> None:
        """Deliver a stream's message to all who take it."""
        self._local.sample(node, output, message)
        self._put(node, output, SAMPLE, -1, message)

    def end(self, node: str, last: int) -> None:
        """Tell all who take anything of `node` that firing `last` was its last."""
        if node in self._reports:
            self._reports[node].tell()
        self._local.end(node, last)
        for (giver, _), output in self._outputs.items():
            if giver == node:
                for line in output.lines:
                    line.send(HEAD.pack(last, 0, output.number, END))
                for stream in output.streams:
                    stream.finish((END, last))

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
            self._control(STARTED, stamp_ns)

    def clock_end(self) -> None:
        """Tell the streams that no ping will be started any more."""
        self._local.clock_end()
        if any(name not in self._nodes for name in self._graph.streams):
            self._control(CLOCK_END, 0)

    # --- life ------------------------------------------------------------------------------------

    def unmatched(self) -> list[str]:
        """The keys and processes that somebody must take, or be, before a ping is started."""
        return [
            *self._streams.unmatched(),
            *(name for name, one in self._lines.items() if not one.connected()),
        ]

    def idle(self) -> bool:
        """Whether everything that was sent has arrived."""
        return self._streams.idle()

    def close(self) -> None:
        """End threads and declarations; the session is its owner's."""
        self._streams.close()
        for line in self._lines.values():
            line.close()
        if self._door is not None:
            self._door.close()
        self._shared.close()
        if self._arena is not None:
            self._arena.close()

    # --- wiring ----------------------------------------------------------------------------------

    def _declare(self) -> None:
        for (node, port, free), found in takers(self._graph, self._placement).items():
            giver = self._placement.process_of[node]
            if free:
                for taker in sorted(found - {giver}):
                    self._declare_free(node, port, giver, taker)
            else:
                self._declare_port(node, port, giver, found - {giver})
        for giver, found in controls(self._graph, self._placement).items():
            near, far = self._apart(giver, found)
            if giver == self._process:
                self._listeners = [self._line(name) for name in sorted(near)]
                self._control_stream = self._streams.give(f"@control/{giver}", far) if far else None
            elif self._process in far:
                self._streams.take(f"@control/{giver}", giver, self._take_control_stream)

    def _declare_port(self, node: str, port: str, giver: str, found: set[str]) -> None:
        near, far = self._apart(giver, found)
        if giver == self._process:
            if near:
                self._output(node, port).lines += [self._line(name) for name in sorted(near)]
            if far:
                self._output(node, port).streams.append(self._streams.give(f"{node}/{port}", far))
        elif self._process in near:
            self._inputs[node, port] = self._input(node, port, reader=sorted(near).index(self._process))
        elif self._process in far:
            taken = self._input(node, port)
            self._streams.take(f"{node}/{port}", giver, partial(self._take_stream, taken))

    def _declare_free(self, node: str, port: str, giver: str, taker: str) -> None:
        key = f"{node}/{port}/@latest/{taker}"
        if giver == self._process:
            stream = self._streams.give_newest(key, taker, self._window)
            self._output(node, port).streams.append(stream)
        elif taker == self._process:
            self._streams.take(key, giver, partial(self._take_stream, self._input(node, port, free=True)))

    def _apart(self, giver: str, found: set[str]) -> tuple[set[str], set[str]]:
        """Those that lines reach, and those that only streams reach."""
        host_of = self._placement.host_of
        near = {name for name in found if self._meeting is not None and host_of[name] == host_of[giver]}
        return near, found - near

    def _output(self, node: str, port: str) -> Output:
        return self._outputs.setdefault((node, port), Output(self._ports.index((node, port))))

    def _input(self, node: str, port: str, reader: int = 0, *, free: bool = False) -> Input:
        return Input((node, port, free), self._types[node, port], reader)

    def _line(self, process: str) -> Line:
        assert self._meeting is not None  # else nobody is near
        arena = "" if self._arena is None else self._arena.name
        return self._lines.setdefault(process, Line(self._meeting / f"{process}.in", arena))

    # --- out -------------------------------------------------------------------------------------

    def _put(self, node: str, port: str, kind: int, index: int, message: Message) -> None:
        output = self._outputs.get((node, port))
        if output is None:
            return
        layout = wire.layout(message)
        if output.lines:
            packet = self._packet(layout, output, kind, index)
            for line in output.lines:
                line.send(packet)
        if output.streams:
            payload = layout.to_bytes()
            for stream in output.streams:
                stream.send((kind, index), payload)

    def _packet(self, layout: wire.Layout, output: Output, kind: int, index: int) -> bytes:
        """The message as it goes to processes of this host: where it lies, or its bytes."""
        slot = self._slot(layout.size, len(output.lines))
        if slot is None:
            head = HEAD.pack(index, layout.size, output.number, kind)
            return layout.to_bytes(checksum=False, before=head)
        layout.write_into(slot.view, checksum=False)
        return HEAD.pack(index, _PLACE.size, output.number, kind | PLACED) + _PLACE.pack(*slot.descriptor[1:])

    def _slot(self, size: int, readers: int) -> Slot | None:
        """Shared memory for a large message, if there is room: else its bytes travel."""
        if size < SHARED_FROM or self._arena is None or readers > MAX_READERS:
            return None
        return self._arena.place(size, (1 << readers) - 1)

    def _tell_finished(self, node: str, index: int) -> None:
        self._control(FINISHED, index, node)

    def _control(self, kind: int, number: int, node: str | None = None) -> None:
        place = 0 if node is None else self._placement.holders.index(node)
        for line in self._listeners:
            line.send(HEAD.pack(number, 0, place, kind))
        if self._control_stream is not None:
            self._control_stream.send((kind, number, place))

    # --- in --------------------------------------------------------------------------------------

    def _enter(self, arena: str) -> Take:
        """What takes the packets of a process of this host, whose large messages lie in `arena`."""
        return partial(self._take_line, arena)

    def _take_line(self, arena: str, kind: int, place: int, number: int, payload: bytes) -> None:
        if kind >= FINISHED and not kind & PLACED:
            self._take_control(kind, number, place)
            return
        taken = self._inputs[self._ports[place]]
        if kind & PLACED:
            where = Descriptor(arena, *_PLACE.unpack(payload))
            self._take_data(taken, kind ^ PLACED, number, partial(self._shared.open, where, taken.reader))
        else:
            self._take_data(taken, kind, number, payload)

    def _take_stream(self, taken: Input, packet: Packet) -> None:
        kind, number = packet.header
        self._take_data(taken, kind, number, packet.payload)

    def _take_control_stream(self, packet: Packet) -> None:
        self._take_control(*packet.header)

    def _take_data(self, taken: Input, kind: int, number: int, held: Held) -> None:
        if kind == END:
            self._local.deliver_end(taken.route, number)
            return
        arrived = Arrived(held, taken.message_type, taken.opening)
        self._local.deliver_coming(taken.route, number if kind == DELIVERY else None, arrived)

    def _take_control(self, kind: int, number: int, place: int) -> None:
        if kind == FINISHED:
            if self._graph.clock in self._nodes:
                self._local.inbox(self._graph.clock).post(Finished(self._placement.holders[place], number))
            return
        for name in self._graph.streams:
            if name in self._nodes:
                self._local.inbox(name).post(Started(number) if kind == STARTED else ClockEnd())
