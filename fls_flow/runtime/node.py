"""Hosts a node on a link: gathers the inputs of one ping, fires, checks the answer, passes it on."""

from __future__ import annotations

import logging
import time
from array import array
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fls_flow.errors import NodeError
from fls_flow.graph import Node
from fls_flow.links import Delivery, End, Item, Link, Sample, SamplesEnd
from fls_flow.messages import Message
from fls_flow.observe import NodeCounts
from fls_flow.runtime import answer
from fls_flow.runtime.calls import answered, cause_of, not_ctrl_c
from fls_flow.runtime.position import Position

__all__ = ["NodeHost", "StreamInput"]

log = logging.getLogger(__name__)


@dataclass
class StreamInput:
    """The samples of a stream that wait for their ping: each is delivered once, in stamp order."""

    waiting: deque[Message] = field(default_factory=deque)
    newest_ns: int | None = None
    delivered_ns: int | None = None
    ended: bool = False
    dropped: int = 0

    def add(self, sample: Message) -> None:
        """Take a sample; one whose stamp does not increase is dropped and counted."""
        if self.newest_ns is not None and sample.stamp_ns <= self.newest_ns:
            self.dropped += 1
            return
        self.newest_ns = sample.stamp_ns
        self.waiting.append(sample)

    def covers(self, stamp_ns: int) -> bool:
        """Whether all samples up to the first at or after `stamp_ns` are here."""
        return self.ended or (self.newest_ns is not None and self.newest_ns >= stamp_ns)

    def take_number(self, number: int) -> tuple[Message, ...]:
        """The next so many samples, fewer at the end of the stream: what a live ping got."""
        taken = [self.waiting.popleft() for _ in range(min(number, len(self.waiting)))]
        return tuple(taken)

    def take(self, stamp_ns: int) -> tuple[Message, ...]:
        """The samples up to the first at or after `stamp_ns` that were not delivered before."""
        taken: list[Message] = []
        while self.waiting and (self.delivered_ns is None or self.delivered_ns < stamp_ns):
            taken.append(self.waiting.popleft())
            self.delivered_ns = taken[-1].stamp_ns
        return tuple(taken)


class NodeHost:
    """A node that is no source; `take` what arrives, then `step` as long as it fires."""

    def __init__(
        self,
        node: Node,
        instance: Any,
        link: Link,
        *,
        holds_window: bool,
        wait_s: float | None,
        newest: bool = False,
        repeat: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        self.node, self.instance, self.link = node, instance, link
        self.inbox = link.inbox(node.name)
        self.counts = NodeCounts()
        self.index = 0
        self.last: int | None = None
        self.done = False
        self.position: Position = [0, 0]  # pings begun, pings done
        self.firing_since: float | None = None  # while the node is at work
        self.samples_taken: dict[str, array[int]] = {}  # by port, for each ping of a live run
        self._repeat = repeat or {}
        self._holds_window, self._wait_s, self._newest = holds_window, wait_s, newest
        self._ended: set[str] = set()
        self._modes = {wire.port: wire.mode for wire in node.inputs}
        self._plain = [port for port, mode in self._modes.items() if mode == "now"]
        self._values: dict[str, dict[int, Message]] = {
            port: {} for port, mode in self._modes.items() if mode != "time"
        }
        self._streams = {port: StreamInput() for port, mode in self._modes.items() if mode == "time"}
        self._complete_at: float | None = None
        self._keeps_state = node.on_error == "skip" and node.kind.stateful and node.kind.restorable

    def take(self, item: Item) -> None:
        """Keep what has arrived."""
        if isinstance(item, Delivery):
            self._values[item.port][item.index] = item.message
        elif isinstance(item, End):
            # what a node answered last can still be somebody's previous value one firing later
            self._ended.add(item.port)
            last = item.last + (self._modes[item.port] == "previous")
            self.last = last if self.last is None else min(self.last, last)
        elif isinstance(item, Sample):
            self._streams[item.port].add(item.message)
        elif isinstance(item, SamplesEnd):
            self._streams[item.port].ended = True

    def patience_s(self) -> float | None:
        """How long to wait for items before `step` is worth a try; None: until one comes."""
        if self._complete_at is None or self._wait_s is None:
            return None
        return max(0.0, self._complete_at + self._wait_s - time.monotonic())

    def step(self) -> bool:
        """Fire once if all inputs of the ping are here; whether it fired."""
        if self.done:
            return False
        if self._newest:
            self._skip()
        if self.last is not None and self.index > self.last:
            self.finish()
            return False
        if not self._ready():
            return False
        self._fire()
        return True

    def _skip(self) -> None:
        """Go on to the newest ping that is here whole; what was before it is dropped."""
        whole = set.intersection(*(set(self._values[port]) for port in self._plain))
        whole = {index for index in whole if index >= self.index}
        if whole:
            target = max(whole)
        elif self.last is not None and self._ended >= set(self._plain):
            target = self.last + 1  # nothing whole will come any more
        else:
            return
        self.counts.dropped += target - self.index
        self.index = target
        for port, values in self._values.items():
            oldest = target - (self._modes[port] == "previous")
            for index in [one for one in values if one < oldest]:
                del values[index]
                self.inbox.release(port)

    def finish(self) -> None:
        """Tell the others that nothing more comes."""
        self.done = True
        self.counts.dropped += sum(stream.dropped for stream in self._streams.values())
        self.link.end(self.node.name, self.index - 1)

    def _ready(self) -> bool:
        for port, mode in self._modes.items():
            index = self.index - (mode == "previous")
            if mode != "time" and index >= 0 and index not in self._values[port]:
                return False
        stamp_ns = self._values[self._plain[0]][self.index].stamp_ns
        if all(self._covered(port, stamp_ns) for port in self._streams):
            return True
        if self._wait_s is None:
            return False
        if self._complete_at is None:
            self._complete_at = time.monotonic()
        return time.monotonic() >= self._complete_at + self._wait_s

    def _covered(self, port: str, stamp_ns: int) -> bool:
        stream, taken = self._streams[port], self._repeat.get(port)
        if taken is None or self.index >= len(taken):
            return stream.covers(stamp_ns)
        return stream.ended or len(stream.waiting) >= taken[self.index]

    def _samples(self, port: str, stamp_ns: int) -> tuple[Message, ...]:
        stream, taken = self._streams[port], self._repeat.get(port)
        if taken is not None and self.index < len(taken):
            return stream.take_number(taken[self.index])
        samples = stream.take(stamp_ns)
        if self._wait_s is not None:
            self.samples_taken.setdefault(port, array("I")).append(len(samples))
        return samples

    def _fire(self) -> None:
        self.position[0] = self.index + 1
        inputs = self._inputs()
        ping = inputs[self._plain[0]]
        before: dict[str, Any] | None = None
        self.firing_since = time.monotonic()
        started = time.perf_counter()
        try:
            before = self.instance.snapshot() if self._keeps_state else None
            outputs = answer.named(self.node.kind, answered(self.instance, inputs))
            answer.same_ping(outputs.values(), ping.seq, ping.stamp_ns)
        except BaseException as error:  # whatever it is, the run must end, not hang
            not_ctrl_c(error)
            outputs = self._failed(error, ping, before)
        self.counts.timed(time.perf_counter() - started)
        self.firing_since = None
        for port, message in outputs.items():
            self.counts.given(port, message)
            self.link.send(self.node.name, port, self.index, message)
        if self._holds_window:
            self.link.finished(self.node.name, self.index)
        self.index += 1
        self.position[1] = self.index
        self._complete_at = None

    def _inputs(self) -> dict[str, Any]:
        inputs: dict[str, Any] = {}
        for port, mode in self._modes.items():
            if mode == "time":
                stamp_ns = self._values[self._plain[0]][self.index].stamp_ns
                inputs[port] = self._samples(port, stamp_ns)
            elif mode == "previous" and self.index == 0:
                inputs[port] = None
            else:
                inputs[port] = self._values[port][self.index - (mode == "previous")]
        for port, mode in self._modes.items():
            if mode != "time" and not (mode == "previous" and self.index == 0):
                del self._values[port][self.index - (mode == "previous")]
                self.inbox.release(port)
        return inputs

    def _failed(
        self, error: BaseException, ping: Message, before: dict[str, Any] | None
    ) -> dict[str, Message]:
        cause = str(error) if isinstance(error, answer.AnswerError) else cause_of(error)
        failure = NodeError(self.node.name, self.index, ping.seq, cause)
        if self.node.on_error != "skip":
            raise failure from error
        log.warning("%s; skipped", failure)
        self.counts.failed += 1
        if before is not None:
            self.instance.restore(before)
        return answer.empty(self.node.kind, ping.seq, ping.stamp_ns)
