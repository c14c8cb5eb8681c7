"""Words between the supervisor and a process it started: one JSON document a line, over a socket pair."""

from __future__ import annotations

import json
import logging
import os
import select
import socket
import threading
from typing import Any

__all__ = ["Bell", "Channel", "ChannelLog"]


class Channel:
    """One end of a socket pair; `receive` gives None when the other end is gone."""

    def __init__(self, end: socket.socket) -> None:
        self.socket = end
        self._buffer = b""
        self._lock = threading.Lock()

    def fileno(self) -> int:
        """For selectors."""
        return self.socket.fileno()

    def send(self, word: str, **values: Any) -> None:
        """Say something; if nobody is there any more, nothing happens: who listens notices by itself."""
        line = json.dumps({"word": word, **values}).encode() + b"\n"
        try:
            with self._lock:
                self.socket.sendall(line)
        except OSError:
            logging.getLogger(__name__).debug("nobody hears '%s'", word)

    def receive(self) -> dict[str, Any] | None:
        """The next document, waiting for it; None at the end."""
        while b"\n" not in self._buffer:
            if not self._fill():
                return None
        line, _, self._buffer = self._buffer.partition(b"\n")
        document: dict[str, Any] = json.loads(line)
        return document

    def drain(self) -> tuple[list[dict[str, Any]], bool]:
        """All documents that are here, without waiting; and whether the other end is still there."""
        there = self._fill(socket.MSG_DONTWAIT)
        *lines, self._buffer = self._buffer.split(b"\n")
        return [json.loads(line) for line in lines], there

    def pending(self) -> bool:
        """Whether `drain` would find something, be it the end."""
        return bool(select.select([self.socket], [], [], 0.0)[0])

    def wait_closed(self, timeout_s: float) -> bool:
        """Whether the other end has closed in time; what it still says is let go."""
        self.socket.settimeout(max(0.001, timeout_s))
        try:
            while self.socket.recv(1 << 16):
                pass
        except TimeoutError:
            return False
        except OSError:
            return True
        return True

    def _fill(self, flags: int = 0) -> bool:
        try:
            read = self.socket.recv(1 << 16, flags)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self._buffer += read
        return bool(read)

    def close(self) -> None:
        """Let go of the socket; the other end notices."""
        self.socket.close()


class Bell:
    """Wakes who selects on it, from other threads and from signal handlers."""

    def __init__(self) -> None:
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)

    def fileno(self) -> int:
        """For selectors."""
        return self._read

    def ring(self) -> None:
        """Wake; nothing happens when it rings already, or is closed."""
        try:
            os.write(self._write, b"!")
        except OSError:
            logging.getLogger(__name__).debug("it rings already, or nobody hears it any more")

    def silence(self) -> None:
        """Take note of it."""
        os.read(self._read, 4096)

    def close(self) -> None:
        """Let go of it; who rings now must not meet what is opened next under these numbers."""
        ends, self._read, self._write = (self._read, self._write), -1, -1
        for end in ends:
            os.close(end)


class ChannelLog(logging.Handler):
    """Sends log records to the supervisor, which writes and shows them."""

    def __init__(self, channel: Channel) -> None:
        super().__init__(logging.INFO)
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record, with its traceback as text."""
        text = record.getMessage()
        if record.exc_info:
            text += "\n" + logging.Formatter().formatException(record.exc_info)
        self._channel.send("log", level=record.levelno, name=record.name, text=text)
