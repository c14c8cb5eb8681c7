"""A stream that loses nothing over a channel that may: numbers, acknowledgements, retransmission.

No transport in here: `Sender` is given a way to put bytes, `Receiver` is handed what arrives. The channel may
drop (a link that was cut and made again), repeat and reorder; what comes out is every item once, in order.
Memory is bounded by the number of items in flight, which the window of a run bounds.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

__all__ = ["NewestSender", "Packet", "Receiver", "Sender"]

SLOWEST_S = 16.0  # between two rounds of sending again to somebody who does not answer


class Packet(NamedTuple):
    """One item as it travels: its number in the stream, a small header, and a message's bytes or none."""

    number: int
    header: tuple[Any, ...]
    payload: bytes = b""


class Sender:
    """Keeps each packet until every receiver has acknowledged it.

    `put` sends a packet to all receivers; it may lose it, and it may block while the channel is full. Only
    `send` and `tick` call it; `acknowledged` and `resend` never wait for them: they are for the thread that
    reads the channel, which has to go on reading if the other side's `put` is ever to end. Packets go out
    again when a receiver reports a gap, when the channel comes back (both `resend`), and when
    nothing was acknowledged for `patience_s`, which doubles with every round in vain.
    """

    def __init__(
        self, put: Callable[[Packet], None], receivers: Iterable[str], patience_s: float = 2.0
    ) -> None:
        self._put, self._patience_s = put, patience_s
        self._acknowledged = dict.fromkeys(receivers, -1)
        self._waiting: dict[int, Packet] = {}
        self._again: set[int] = set()
        self._next = 0
        self._wait_s = patience_s
        self._progress = time.monotonic()
        self._channel = threading.Lock()  # one packet at a time, the first time in order; taken before _lock
        self._lock = threading.Lock()  # never held during `put`

    def send(self, header: tuple[Any, ...], payload: bytes = b"") -> None:
        """Number an item and put it on the channel."""
        with self._channel:
            with self._lock:
                packet = Packet(self._next, header, payload)
                self._next += 1
                if not self._waiting:
                    self._restart_clock()
                self._waiting[packet.number] = packet
            self._put(packet)

    def finish(self, header: tuple[Any, ...]) -> None:
        """Send what must not be lost whatever else is, such as the end."""
        self.send(header)

    def acknowledged(self, receiver: str, number: int) -> None:
        """A receiver has everything up to `number`."""
        with self._lock:
            if receiver not in self._acknowledged or number <= self._acknowledged[receiver]:
                return
            self._acknowledged[receiver] = number
            self._restart_clock()
            everywhere = min(self._acknowledged.values())
            for done in [one for one in self._waiting if one <= everywhere]:
                del self._waiting[done]

    def resend(self, first: int = 0, last: int | None = None) -> None:
        """Let the next `tick` put what waits again, from `first` to `last`."""
        with self._lock:
            self._again.update(
                one for one in self._waiting if first <= one <= (one if last is None else last)
            )

    def tick(self) -> None:
        """Put again what was asked for, or everything after a time without an answer; call it often."""
        with self._lock:
            if self._waiting and time.monotonic() - self._progress >= self._wait_s:
                self._again.update(self._waiting)
                self._progress = time.monotonic()
                self._wait_s = min(2.0 * self._wait_s, SLOWEST_S)
            numbers, self._again = sorted(self._again), set()
        for number in numbers:
            with self._channel:
                with self._lock:
                    packet = self._waiting.get(number)
                if packet is not None:  # else it was acknowledged meanwhile
                    self._put(packet)

    @property
    def idle(self) -> bool:
        """Whether every receiver has everything."""
        with self._lock:
            return not self._waiting

    def _restart_clock(self) -> None:
        self._progress, self._wait_s = time.monotonic(), self._patience_s


class NewestSender(Sender):
    """A sender that never holds more than `most` packets: of those beyond, the newest waits, the others go.

    So a link that is slow or cut costs pings, and nothing else. What went is counted in `dropped`.
    """

    def __init__(
        self,
        put: Callable[[Packet], None],
        receivers: Iterable[str],
        most: int,
        patience_s: float = 2.0,
    ) -> None:
        super().__init__(put, receivers, patience_s)
        self.dropped = 0
        self._most = most
        self._newest: tuple[tuple[Any, ...], bytes] | None = None

    def send(self, header: tuple[Any, ...], payload: bytes = b"") -> None:
        """Number an item and put it on the channel, or let it wait in the place of the one that waits."""
        with self._lock:
            self.dropped += self._newest is not None
            self._newest = None
            if len(self._waiting) >= self._most:
                self._newest = (header, payload)
                return
        super().send(header, payload)

    def finish(self, header: tuple[Any, ...]) -> None:
        """Send what must not be lost after what waits."""
        self._release(self._most + 1)
        super().send(header)

    def tick(self) -> None:
        """Send what waits, if there is room for it now."""
        self._release(self._most)
        super().tick()

    def _release(self, most: int) -> None:
        with self._lock:
            newest = self._newest
            if newest is None or len(self._waiting) >= most:
                return
            self._newest = None
        super().send(*newest)

    @property
    def idle(self) -> bool:
        """Whether every receiver has everything, and nothing waits."""
        with self._lock:
            return self._newest is None and not self._waiting


class Receiver:
    """Hands on every packet once, in order; says what it has and what it misses.

    `ahead` bounds how many packets may wait for a missing one; what is further ahead is dropped, since it
    will be sent again.
    """

    def __init__(self, deliver: Callable[[Packet], None], ahead: int = 64) -> None:
        self._deliver, self._ahead = deliver, ahead
        self._early: dict[int, Packet] = {}
        self._lock = threading.RLock()
        self.expected = 0
        self._asked = -1

    def take(self, packet: Packet) -> tuple[int, int] | None:
        """Take a packet as it arrives; first and last missing number, when this is the first to show it."""
        with self._lock:
            if packet.number == self.expected and not self._early:
                self._deliver(packet)
                self.expected += 1
                return None
            if packet.number < self.expected:
                return None
            if packet.number <= self.expected + self._ahead:
                self._early[packet.number] = packet
            while (following := self._early.pop(self.expected, None)) is not None:
                self._deliver(following)
                self.expected += 1
            nearest = min(self._early, default=packet.number)
            if nearest <= self.expected or self._asked == self.expected:
                return None
            self._asked = self.expected
            return self.expected, nearest - 1
