"""Record messages to an MCAP file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from fls_flow import Message, hookimpl
from fls_flow.recording import RecordingWriter

__all__ = ["Mcap"]


@dataclass
class Mcap:
    """A channel per port, named as the port; log times are the stamps of the messages.

    Wire any outputs to ports of any names. Chunks of `chunk_pings` pings (or of 1 MiB, if that is less) are
    compressed by zstd and are on disk when they are full: what a crash leaves is readable up to there.
    `mcap-replay` plays the topics.
    """

    path: Path = Path("run.mcap")
    chunk_pings: int = 16
    _writer: RecordingWriter = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.chunk_pings < 1:
            raise ValueError(f"chunk_pings must be at least 1, not {self.chunk_pings}")
        self._writer = RecordingWriter(Path(self.path), self.chunk_pings)

    def __call__(self, **ports: Message) -> None:
        """Append the messages of one ping."""
        self._writer.write(ports)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


@hookimpl
def fls_node() -> type[Mcap]:
    """The kind `mcap`."""
    return Mcap
