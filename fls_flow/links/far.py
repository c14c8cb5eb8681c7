"""The streams of one process over Zenoh, to and from other hosts and sinks that may lose pings.

Keys, under what all keys of a run begin with:

    <stream>             packets of the stream: a header as attachment, bytes of `wire` as payload
    @answer/<process>    acknowledgements and gaps, to the process that gives

Each key is a `stream`: nothing is lost when a link is cut and made again. Callbacks only enqueue.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import msgspec
import zenoh

from fls_flow.errors import LinkError
from fls_flow.links._callbacks import Kept
from fls_flow.links.stream import NewestSender, Packet, Receiver, Sender

__all__ = ["Streams"]

S = TypeVar("S", bound=Sender)

_PACKER, _UNPACKER = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder(list[Any])

ANSWER_S = 0.02  # how long acknowledgements are gathered: they free memory, nothing waits for them


@dataclass
class _Inlet:
    """A stream that this process takes."""

    giver: str  # the process
    receiver: Receiver
    unanswered: bool = False


class Streams:
    """What a process gives and takes, each under its own key; `failed` is told of what makes no sense."""

    def __init__(
        self, session: zenoh.Session, prefix: str, process: str, failed: Callable[[Exception], None]
    ) -> None:
        self._session, self._prefix = session, prefix
        self._process, self._failed = process, failed
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._senders: dict[str, Sender] = {}
        self._inlets: dict[str, _Inlet] = {}
        self._answers: dict[str, zenoh.Publisher] = {}
        self._kept_threads = Kept()
        self._declared: list[Any] = []
        self._closing = threading.Event()
        self._subscribe(f"@answer/{process}", self._answered)
        self._threads = [
            threading.Thread(target=self._tick, name="zenoh-answers", daemon=True),
            threading.Thread(target=self._resend, name="zenoh-resend", daemon=True),  # a put may block
        ]

    def start(self) -> None:
        """Begin to answer and to send again, when all streams are there."""
        for thread in self._threads:
            thread.start()

    def give(self, key: str, receivers: Iterable[str]) -> Sender:
        """A stream to these processes."""
        publisher = self._publisher(key, zenoh.CongestionControl.BLOCK)
        return self._kept(key, publisher, Sender(partial(_put, publisher), sorted(receivers)))

    def give_newest(self, key: str, receiver: str, most: int) -> NewestSender:
        """A stream to a process that may lose packets: `most` of them may be on their way."""
        publisher = self._publisher(key, zenoh.CongestionControl.DROP)
        return self._kept(key, publisher, NewestSender(partial(_put, publisher), [receiver], most))

    def take(self, key: str, giver: str, deliver: Callable[[Packet], None]) -> None:
        """Hand on what a process gives."""
        if giver not in self._answers:
            self._answers[giver] = self._session.declare_publisher(
                f"{self._prefix}/@answer/{giver}",
                priority=zenoh.Priority.INTERACTIVE_HIGH,  # data that waits for a slow link must not drop it
            )
            self._declared.append(self._answers[giver])
        inlet = self._inlets[key] = _Inlet(giver, Receiver(deliver))
        self._subscribe(key, partial(self._arrived, key, inlet))

    def unmatched(self) -> list[str]:
        """The keys that somebody must subscribe to before a ping is started."""
        publishers = self._publishers | {f"@answer/{name}": one for name, one in self._answers.items()}
        return [key for key, publisher in publishers.items() if not _matched(publisher)]

    def idle(self) -> bool:
        """Whether everything that was sent has arrived."""
        return all(sender.idle for sender in self._senders.values())

    def close(self) -> None:
        """End threads and declarations; the session is its owner's."""
        self._closing.set()
        for thread in self._threads:
            thread.join(1.0)
        self._answer()
        for one in self._declared:
            one.undeclare()

    def _publisher(self, key: str, congestion: zenoh.CongestionControl) -> zenoh.Publisher:
        publisher = self._session.declare_publisher(
            f"{self._prefix}/{key}", congestion_control=congestion, reliability=zenoh.Reliability.RELIABLE
        )
        self._declared.append(publisher)
        self._publishers[key] = publisher
        return publisher

    def _kept(self, key: str, publisher: zenoh.Publisher, sender: S) -> S:
        def back(status: zenoh.MatchingStatus) -> None:
            if status.matching:  # whoever comes back after a cut misses what was put meanwhile
                sender.resend()

        self._declared.insert(0, publisher.declare_matching_listener(back))
        self._senders[key] = sender
        return sender

    def _subscribe(self, key: str, callback: Callable[[zenoh.Sample], None]) -> None:
        handler = zenoh.handlers.Callback(self._kept_threads(callback), indirect=False)
        self._declared.append(self._session.declare_subscriber(f"{self._prefix}/{key}", handler))

    # --- what comes ------------------------------------------------------------------------------

    def _arrived(self, key: str, inlet: _Inlet, sample: zenoh.Sample) -> None:
        try:
            number, *header = _attached(sample)
            gap = inlet.receiver.take(Packet(number, tuple(header), sample.payload.to_bytes()))
            inlet.unanswered = True
            if gap is not None:
                self._tell(inlet.giver, [self._process, "gap", key, *gap])
        except Exception as error:
            self._failed(error if isinstance(error, LinkError) else LinkError(f"{key}: {error!r}"))

    # --- answers ---------------------------------------------------------------------------------

    def _tick(self) -> None:
        while not self._closing.wait(ANSWER_S):
            self._answer()

    def _resend(self) -> None:
        while not self._closing.wait(ANSWER_S):
            for sender in self._senders.values():
                sender.tick()

    def _answer(self) -> None:
        upto: dict[str, dict[str, int]] = {}
        for key, inlet in self._inlets.items():
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
                    self._senders[key].acknowledged(receiver, number)
            else:
                key, first, last = rest
                self._senders[key].resend(first, last)
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
