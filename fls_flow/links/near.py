"""Packets between the processes of one host, over Unix sockets: each at once, in order, none lost.

A process has a `Door` in a folder that only its user can enter; whoever gives it something has a `Line`
there. What is sent arrives, or the process is gone, which its supervisor notices. A socket takes a small
packet from thread to thread in less than half the time of a Zenoh session (`benchmarks/transport.py`).

A line begins with its greeting (two bytes of length, then text); each packet has a `HEAD`, then its payload.
"""

from __future__ import annotations

import logging
import socket
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from fls_flow.errors import LinkError

__all__ = ["HEAD", "Door", "Line", "Take"]

log = logging.getLogger(__name__)

HEAD = struct.Struct("<qQHH")  # number, size of the payload, route, kind
Take = Callable[[int, int, int, bytes], None]  # kind, route, number, payload

_GREETING = struct.Struct("<H")
_READ_AHEAD = 64 << 10  # bytes: what came together is read together
_LINES = 128  # that may wait to be let in


class Line:
    """A way to the process whose door is at `path`; threads may share it."""

    def __init__(self, path: Path, greeting: str) -> None:
        self._path, self._greeting = path, greeting.encode()
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._open = True

    def connected(self) -> bool:
        """Whether the process is there; if it was not, tries again."""
        if self._socket is None:
            tried = socket.socket(socket.AF_UNIX)
            try:
                tried.connect(str(self._path))
                tried.sendall(_GREETING.pack(len(self._greeting)) + self._greeting)
            except (FileNotFoundError, ConnectionError):
                tried.close()
                return False
            self._socket = tried
        return True

    def send(self, packet: bytes) -> None:
        """Send a head and its payload; waits while the other side does not read.

        Raises LinkError when nobody was ever there.
        """
        if self._socket is None and not self.connected():
            raise LinkError(f"no process listens at {self._path}")
        assert self._socket is not None
        with self._lock:
            if not self._open:
                return
            try:
                self._socket.sendall(packet)
            except ConnectionError as error:  # who died is named by the supervisor
                log.debug("%s: %s", self._path, error)
                self._open = False

    def close(self) -> None:
        """Hang up; what was sent still arrives."""
        if self._socket is not None:
            self._socket.close()


class Door:
    """Lets the lines of other processes in, each with a thread that hands on its packets.

    `enter` is given a line's greeting, and gives what takes its packets. `failed` is told when a greeting or
    a packet cannot be used.
    """

    def __init__(self, path: Path, enter: Callable[[str], Take], failed: Callable[[Exception], None]) -> None:
        self._path, self._enter, self._failed = path, enter, failed
        self._lock = threading.Lock()
        self._lines: set[socket.socket] = set()
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(str(path))
        self._socket.listen(_LINES)
        threading.Thread(target=self._listen, name="door", daemon=True).start()

    def close(self) -> None:
        """Let nobody in any more, and end all lines."""
        self._path.unlink(missing_ok=True)
        _end(self._socket)
        with self._lock:
            for line in self._lines:
                _end(line)

    def _listen(self) -> None:
        with self._socket:
            while True:
                try:
                    line, _ = self._socket.accept()
                except OSError as error:
                    log.debug("%s: %s", self._path, error)  # it was closed
                    return
                with self._lock:
                    self._lines.add(line)
                try:
                    threading.Thread(target=self._read, args=(line,), name="line", daemon=True).start()
                except RuntimeError as error:  # the limits of the process leave no room for a thread
                    self._failed(LinkError(f"{self._path}: {error}"))
                    line.close()

    def _read(self, line: socket.socket) -> None:
        try:
            with line, open(line.fileno(), "rb", buffering=_READ_AHEAD, closefd=False) as packets:
                take = self._enter(_greeting(packets))
                while True:
                    number, size, route, kind = HEAD.unpack(_exactly(packets, HEAD.size))
                    take(kind, route, number, _exactly(packets, size) if size else b"")
        except EOFError:  # its giver has hung up, or died
            log.debug("%s: a line has ended", self._path)
        except ConnectionError as error:
            log.debug("%s: %s", self._path, error)
        except Exception as error:
            self._failed(error if isinstance(error, LinkError) else LinkError(f"{self._path}: {error!r}"))
        finally:
            with self._lock:
                self._lines.discard(line)


def _greeting(packets: BinaryIO) -> str:
    (size,) = _GREETING.unpack(_exactly(packets, _GREETING.size))
    return _exactly(packets, size).decode()


def _exactly(packets: BinaryIO, size: int) -> bytes:
    found = packets.read(size)
    if len(found) < size:
        raise EOFError
    return found


def _end(one: socket.socket) -> None:
    """Wake whoever waits for it."""
    try:
        one.shutdown(socket.SHUT_RDWR)
    except OSError as error:
        log.debug("closing: %s", error)  # the other side was faster
