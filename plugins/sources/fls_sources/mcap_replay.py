"""Play one topic of an MCAP recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from fls_flow import Message, hookimpl
from fls_flow.recording import Recording

__all__ = ["McapReplay"]


@dataclass
class McapReplay:
    """The messages of `topic`, as they were recorded by the sink `mcap`, in that order.

    Without a `topic` it is the only one of the recording. The file says of which class the messages are, so
    it must be there when the graph is checked. A recording that a crash cut off is played up to its last
    whole chunk, and the log says so. Memory is bounded by a chunk.

    Raises InputError for a file that is missing, damaged, of another version, or has no such topic.
    """

    path: Path
    topic: str | None = None
    first: int = 0  # index of the first message to play
    pings: int | None = None  # how many to play; None: to the end

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if self.first < 0:
            raise ValueError(f"first must be 0 or more, not {self.first}")
        if self.pings is not None and self.pings < 1:
            raise ValueError(f"pings must be 1 or more, not {self.pings}")

    def output_type(self) -> type:
        """The class of the messages, read from the file."""
        return self._recording.message_type(self._topic())

    def __len__(self) -> int:
        first, stop = self._selection()
        return stop - first

    def __call__(self) -> Iterator[Message]:
        """Read message by message."""
        first, stop = self._selection()
        return islice(self._recording.messages(self._topic()), first, stop)

    @property
    def _recording(self) -> Recording:
        return Recording(self.path)

    def _topic(self) -> str:
        return self._recording.one_topic() if self.topic is None else self.topic

    def _selection(self) -> tuple[int, int]:
        topic, topics = self._topic(), self._recording.topics()
        count = topics[topic].messages if topic in topics else 0
        if topic in topics and count and self.first >= count:
            raise self._recording.fault(
                f"has {count} messages of '{topic}'; first = {self.first} lies beyond"
            )
        return self.first, count if self.pings is None else min(self.first + self.pings, count)


@hookimpl
def fls_node() -> type[McapReplay]:
    """The kind `mcap-replay`."""
    return McapReplay
