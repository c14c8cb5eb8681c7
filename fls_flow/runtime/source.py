"""Hosts the sources: the clock, which starts pings inside the window, and the streams beside it."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from fls_flow.graph import Node
from fls_flow.links import ClockEnd, Finished, Inbox, Item, Link, Started, Wake
from fls_flow.messages import Message
from fls_flow.observe import NodeCounts
from fls_flow.runtime.calls import abandoned, iterated, made, source_outputs
from fls_flow.runtime.position import Position

__all__ = ["ClockHost", "Feed", "StreamHost"]

log = logging.getLogger(__name__)


class Feed:
    """Iterates a source in a thread of its own; of what nobody takes in time it keeps the newest.

    `places` is how many wait at most; what is pushed out is counted in `shed`. With `rate`, messages come at
    that multiple of the pace of their stamps.
    """

    def __init__(
        self, node: Node, iterator: Iterator[Any], inbox: Inbox, *, places: int, rate: float | None = None
    ) -> None:
        self.shed = 0
        self.error: Exception | None = None
        self._node, self._iterator, self._inbox = node, iterator, inbox
        self._waiting: deque[Any] = deque(maxlen=places)
        self._rate = rate
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=f"{node.name}-feed", daemon=True)
        self._thread.start()

    def take(self) -> Any | None:
        """The oldest that waits, or None."""
        with self._lock:
            return self._waiting.popleft() if self._waiting else None

    @property
    def empty(self) -> bool:
        """Whether the source has ended and everything was taken."""
        with self._lock:
            return self._ended and not self._waiting

    def stop(self) -> None:
        """Let the thread end at its next message; does not wait for it."""
        self._stop.set()

    def join(self, timeout_s: float) -> bool:
        """Whether the thread has ended in time."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            pace = _Pace(self._rate)
            for index in itertools.count():
                produced = made(self._node, self._iterator, index)
                if produced is None or not pace.wait(produced, self._stop):
                    break
                with self._lock:
                    self.shed += len(self._waiting) == self._waiting.maxlen
                    self._waiting.append(produced)
                self._inbox.post(Wake())
            abandoned(self._node, self._iterator, index)
        except Exception as error:
            self.error = error
        finally:
            with self._lock:
                self._ended = True
            self._inbox.post(Wake())


class _Pace:
    """Waits until a message is due by its stamp."""

    def __init__(self, rate: float | None) -> None:
        self._rate = rate
        self._start: tuple[float, int] | None = None

    def wait(self, produced: Any, stop: threading.Event) -> bool:
        """Whether the message's time has come; False when `stop` came first."""
        if self._rate is None:
            return not stop.is_set()
        stamp_ns = (produced if hasattr(produced, "stamp_ns") else produced[0]).stamp_ns
        if self._start is None:
            self._start = (time.monotonic(), stamp_ns)
        began, first_ns = self._start
        due = began + (stamp_ns - first_ns) * 1e-9 / self._rate
        return not stop.wait(max(0.0, due - time.monotonic()))


class _SourceHost:
    """What both sources share."""

    def __init__(self, node: Node, instance: Any, link: Link) -> None:
        self.node, self.instance, self.link = node, instance, link
        self.inbox = link.inbox(node.name)
        self.counts = NodeCounts()
        self.index = 0
        self.done = False
        self.position: Position = [0, 0]  # pings begun, pings done
        self._iterator: Iterator[Any] | None = None
        self._feed: Feed | None = None

    def patience_s(self) -> float | None:
        """A source waits for items alone."""
        return None

    def _iterate(self) -> Iterator[Any]:
        if self._iterator is None:
            self._iterator = iterated(self.node, self.instance)
        return self._iterator

    def _next(self) -> dict[str, Message] | None:
        started = time.perf_counter()
        if self._feed is not None:
            produced = self._feed.take()
            self._count_shed(self._feed.shed)
        else:
            produced = made(self.node, self._iterate(), self.index)
        if produced is None:
            return None
        outputs = source_outputs(self.node, produced, self.index)
        self.counts.timed(time.perf_counter() - started)
        for port, message in outputs.items():
            self.counts.given(port, message)
        return outputs

    def _count_shed(self, shed: int) -> None:
        """Count what the feed has let go so far."""
        self.counts.shed = shed

    def _exhausted(self) -> bool:
        """Whether nothing more comes, after `_next` gave nothing; raises what the feed met."""
        if self._feed is None:
            return True
        if self._feed.empty and self._feed.error is not None:
            raise self._feed.error
        return self._feed.empty

    def finish(self) -> None:
        """Tell the others that nothing more comes; raises NodeError when the source cannot be closed."""
        if self.done:
            return
        self.done = True
        self._tell_end()
        if self._feed is not None:
            self._feed.stop()
            self._count_shed(self._feed.shed)
        elif self._iterator is not None:
            abandoned(self.node, self._iterator, self.index)

    def _tell_end(self) -> None:
        self.link.end(self.node.name, self.index - 1)

    def join(self, timeout_s: float) -> None:
        """Wait for the thread that iterates a live source, after its `close()`."""
        if self._feed is not None and not self._feed.join(timeout_s):
            log.warning("node '%s': its source did not end within %g s of close()", self.node.name, timeout_s)


class ClockHost(_SourceHost):
    """The source of the pings: starts `index` once `index - window` is finished by all holders."""

    def __init__(
        self,
        node: Node,
        instance: Any,
        link: Link,
        *,
        holders: tuple[str, ...],
        window: int,
        rate: float | None,
        on_finished: Callable[[int], None],
    ) -> None:
        super().__init__(node, instance, link)
        self.stopping = threading.Event()
        self._finished = dict.fromkeys(holders, -1)
        self._window, self._rate, self._on_finished = window, rate, on_finished
        self._live = bool(getattr(instance, "live", False))

    def take(self, item: Item) -> None:
        """Move the window."""
        if isinstance(item, Finished):
            self._finished[item.node] = item.index
            self._on_finished(min(self._finished.values()) + 1)

    def step(self) -> bool:
        """Start one ping if the window and the source have one; whether it did."""
        if self.done:
            return False
        if self.stopping.is_set():
            self.finish()
            return False
        if self._feed is None and (self._live or self._rate is not None):
            rate = None if self._live else self._rate
            self._feed = Feed(self.node, self._iterate(), self.inbox, places=1, rate=rate)
        if self.index - self._window > min(self._finished.values(), default=self.index):
            return False
        self.position[0] = self.index + 1
        outputs = self._next()
        if outputs is None:
            self.position[0] = self.index
            if self._exhausted():
                self.finish()
            return False
        self.link.started(next(iter(outputs.values())).stamp_ns)
        for port, message in outputs.items():
            self.link.send(self.node.name, port, self.index, message)
        self.index += 1
        self.position[1] = self.index
        return True

    def stop(self) -> None:
        """Start no further ping; those in flight go on. From any thread."""
        self.stopping.set()
        self.inbox.post(Wake())

    def _tell_end(self) -> None:
        super()._tell_end()
        self.link.clock_end()


class StreamHost(_SourceHost):
    """A source beside the clock: a replayed one runs up to the stamp of the newest started ping."""

    PLACES = 4096  # samples of a live stream that may wait

    def __init__(self, node: Node, instance: Any, link: Link) -> None:
        super().__init__(node, instance, link)
        self._needed_ns: int | None = None
        self._newest_ns: int | None = None
        self._clock_ended = False
        self._unordered = 0
        self._live = bool(getattr(instance, "live", False))

    def take(self, item: Item) -> None:
        """Learn how far the pings are."""
        if isinstance(item, Started):
            self._needed_ns = (
                item.stamp_ns if self._needed_ns is None else max(self._needed_ns, item.stamp_ns)
            )
        elif isinstance(item, ClockEnd):
            self._clock_ended = True

    def step(self) -> bool:
        """Give one sample if a ping needs it; whether it did."""
        if self.done:
            return False
        if self._live and self._feed is None:
            self._feed = Feed(self.node, self._iterate(), self.inbox, places=self.PLACES)
        if not self._needed():
            if self._clock_ended:
                self.finish()
            return False
        outputs = self._next()
        if outputs is None:
            if self._exhausted() or self._clock_ended:
                self.finish()
            return False
        stamp_ns = next(iter(outputs.values())).stamp_ns
        if self._newest_ns is not None and stamp_ns <= self._newest_ns:
            self._unordered += 1
            self.counts.dropped += 1
            return True
        self._newest_ns = stamp_ns
        for port, message in outputs.items():
            self.link.sample(self.node.name, port, message)
        self.index += 1
        return True

    def _needed(self) -> bool:
        if self._live:
            return True
        if self._needed_ns is None:
            return False
        return self._newest_ns is None or self._newest_ns < self._needed_ns

    def _count_shed(self, shed: int) -> None:
        self.counts.dropped = self._unordered + shed
