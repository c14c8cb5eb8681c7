"""Play the message stream of a Blueprint Oculus from a file."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from fls_flow import InputError, Mount, Ping, hookimpl
from fls_sources.oculus_protocol import (
    HEADER_BYTES,
    MAX_MESSAGE_BYTES,
    SIMPLE_PING_RESULT,
    Header,
    PingResult,
    header,
    ping_result,
)

__all__ = ["OculusRaw", "PingClock", "amplitude"]

TICKS = 2**32  # after so many the counter of version 1 begins anew
MAX_GAP_S = 30 * 86_400.0  # a longer gap in seconds is a clock that was set
_LOG = logging.getLogger(__name__)


@dataclass
class OculusRaw:
    """The pings among the messages, in the order of the file; other messages are passed over.

    Raises InputError, naming the byte, for what is no whole message; memory is bounded by one message.
    """

    path: Path
    start_ns: int = 0  # stamp of the first ping; the others follow by the sonar's clock
    tick_ns: float = 1.0  # of the sonar's counter in messages of version 1
    undo_gain: bool = True  # divide by the gain of each row, where the sonar sends it
    mount: Mount = field(default_factory=Mount)

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if not 0.0 < self.tick_ns < 1e9:
            raise ValueError(f"tick_ns must lie between 0 and 1e9, not {self.tick_ns}")

    def __len__(self) -> int:
        """How many whole pings there are, up to the first fault."""
        count = 0
        try:
            for _, head, _ in self._messages(bodies=False):
                count += head.message_id == SIMPLE_PING_RESULT
        except InputError:
            _LOG.debug("%s is damaged after %d pings", self.path, count)
        return count

    def __call__(self) -> Iterator[Ping]:
        """Read message by message."""
        clock = PingClock(self.start_ns, self.tick_ns)
        for offset, _, message in self._messages(bodies=True):
            if message is None:
                continue
            try:
                result = ping_result(message)
            except ValueError as err:
                raise self._fault(offset, str(err)) from err
            yield self._ping(result, clock.stamp_ns(result.version, result.ping_start))

    def _ping(self, result: PingResult, stamp_ns: int) -> Ping:
        image, valid = amplitude(result, self.undo_gain)
        speed = result.sound_speed_mps
        return Ping(
            result.ping_id,
            stamp_ns,
            image,
            result.range_m,
            result.bearing_rad,
            valid,
            sound_speed_mps=speed if math.isfinite(speed) else 1500.0,
            frequency_hz=result.frequency_hz,
            mount=self.mount,
        )

    def _messages(self, bodies: bool) -> Iterator[tuple[int, Header, bytes | None]]:
        """Offset and header of every message, and with `bodies` the whole of each ping."""
        try:
            with self.path.open("rb") as file:
                offset = 0
                while raw := file.read(HEADER_BYTES):
                    head = self._header(raw, offset)
                    rest = head.message_bytes - HEADER_BYTES
                    if bodies and head.message_id == SIMPLE_PING_RESULT:
                        body = file.read(rest)
                        found, message = len(body), raw + body
                    else:
                        found, message = _passed(file, rest), None
                    if found < rest:
                        raise self._truncated(offset, head.message_bytes, HEADER_BYTES + found)
                    yield offset, head, message
                    offset += head.message_bytes
        except OSError as err:
            raise InputError(f"{self.path}: {err.strerror or err}; check the path") from err

    def _header(self, raw: bytes, offset: int) -> Header:
        if len(raw) < HEADER_BYTES:
            raise self._truncated(offset, HEADER_BYTES, len(raw))
        try:
            head = header(raw)
        except ValueError as err:
            raise self._fault(offset, str(err)) from err
        if head.message_bytes > MAX_MESSAGE_BYTES:
            raise self._fault(offset, f"a message claims {head.message_bytes} bytes")
        return head

    def _fault(self, offset: int, what: str) -> InputError:
        return InputError(f"{self.path}: at byte {offset}: {what}; is this an unaltered Oculus TCP stream?")

    def _truncated(self, offset: int, expected: int, found: int) -> InputError:
        return InputError(
            f"{self.path}: ends within the message at byte {offset} ({found} of {expected} bytes); "
            f"cut it to {offset} bytes to play the rest"
        )


@dataclass
class PingClock:
    """Strictly increasing stamps out of the sonar's own clock.

    The counter of version 1 may wrap once between two pings. Where a clock stands still, falls, jumps by
    more than a month or changes its kind, the next stamp is 1 ns later and counting begins anew from there.
    """

    start_ns: int
    tick_ns: float
    _version: int = field(default=0, init=False, repr=False)
    _previous: float = field(default=0.0, init=False, repr=False)
    _elapsed: float = field(default=0.0, init=False, repr=False)  # since the anchor, in the clock's own unit
    _anchor_ns: int = field(default=0, init=False, repr=False)
    _stamp_ns: int = field(default=0, init=False, repr=False)

    def stamp_ns(self, version: int, ping_start: float) -> int:
        """The stamp of the next ping."""
        unit_ns = self.tick_ns if version == 1 else 1e9
        step = (ping_start - self._previous) % TICKS if version == 1 else ping_start - self._previous
        elapsed = self._elapsed + step
        known = version == self._version and 0.0 < step * unit_ns < MAX_GAP_S * 1e9
        stamp = self._anchor_ns + math.floor(elapsed * unit_ns + 0.5) if known else 0
        if not self._version:
            self._anchor_ns, elapsed, stamp = self.start_ns, 0.0, self.start_ns
        elif not known or stamp <= self._stamp_ns:
            _LOG.warning(
                "the sonar's clock went from %s to %s: stamps go on by 1 ns", self._previous, ping_start
            )
            self._anchor_ns, elapsed, stamp = self._stamp_ns + 1, 0.0, self._stamp_ns + 1
        self._version, self._previous, self._elapsed, self._stamp_ns = version, ping_start, elapsed, stamp
        return stamp


def amplitude(
    result: PingResult, undo_gain: bool
) -> tuple[
    npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32], npt.NDArray[np.bool_] | None
]:
    """The image in the dtype of a `Ping`, and the mask of its cells with data (None: all).

    Samples of more than 16 bits become float32, exact up to 24 bits. Undoing the gain gives float32, too;
    rows whose gain is 0 have no data.
    """
    sample, gain = result.sample, result.row_gain
    if gain is None or not undo_gain:
        return (sample if sample.dtype.itemsize < 4 else sample.astype(np.float32)), None
    known = gain > 0
    scale = np.where(known, 1.0 / np.sqrt(np.maximum(gain, 1)), 0.0)
    valid = None if known.all() else np.repeat(known[:, None], sample.shape[1], axis=1)
    return (sample * scale[:, None]).astype(np.float32), valid


def _passed(file: BinaryIO, size: int) -> int:
    """Read over `size` bytes; how many there were."""
    passed = 0
    while passed < size and (chunk := file.read(min(size - passed, 2**20))):
        passed += len(chunk)
    return passed


@hookimpl
def fls_node() -> type[OculusRaw]:
    """Return the node of kind `oculus-raw`."""
    return OculusRaw
