"""Byte layout of the messages that a Blueprint Oculus sends over TCP (little-endian, packed)."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = [
    "HEADER_BYTES",
    "MAX_MESSAGE_BYTES",
    "SIMPLE_PING_RESULT",
    "Header",
    "PingResult",
    "header",
    "ping_result",
]

MAGIC = 0x4F53
SIMPLE_PING_RESULT = 0x23
HEADER_BYTES = 16
MAX_MESSAGE_BYTES = 2**25  # 512 beams x 4 bytes x 16,000 ranges; real ones have at most a few MB
GAIN_BYTES = 4

_HEADER = struct.Struct("<HHHHHIH")
_SAMPLE_BYTES = {0: 1, 1: 2, 2: 3, 3: 4}  # by the field `data size`
_KNOWN_SPEED_MPS = (1000.0, 2000.0)


class _Layout(NamedTuple):
    """Where the fields of a SimplePingResult lie, bytes from the start of the message."""

    ping_id: int  # u32
    frequency: int  # f64
    sound_speed: int  # f64
    ping_start: tuple[str, int]  # v1: u32 ticks, v2: f64 seconds
    geometry: int  # data size u8, range resolution f64, ranges u16, beams u16
    image: int  # offset, size and message size, u32 each
    bearings: int  # i16 each; also the length of all that is fixed


_LAYOUTS = {
    1: _Layout(53, 61, 85, ("<I", 93), 97, 110, 122),
    2: _Layout(89, 97, 145, ("<d", 153), 161, 190, 202),
}


@dataclass(frozen=True, slots=True)
class Header:
    """The first 16 bytes of every message."""

    message_id: int
    version: int
    message_bytes: int  # with the header


@dataclass(frozen=True, slots=True)
class PingResult:
    """What a SimplePingResult says."""

    version: int  # of the layout, 1 or 2
    ping_id: int
    ping_start: float  # v1: ticks of a counter of 32 bits; v2: seconds
    frequency_hz: float  # nan if the message has none
    sound_speed_mps: float  # nan if the message has none
    range_resolution_m: float
    bearing_rad: npt.NDArray[np.float64]  # (n_beams,)
    sample: npt.NDArray[Any]  # (n_ranges, n_beams) uint8, uint16 or uint32
    row_gain: npt.NDArray[np.uint32] | None  # (n_ranges,): sample / sqrt(gain) is free of it

    @property
    def range_m(self) -> npt.NDArray[np.float64]:
        """Range of each row's centre: row i reaches from i to i + 1 resolutions."""
        return np.arange(0.5, self.sample.shape[0], dtype=np.float64) * self.range_resolution_m


def header(raw: bytes) -> Header:
    """The header in the first 16 bytes; raises ValueError that says what is wrong."""
    magic, _, _, message_id, version, payload, _ = _HEADER.unpack_from(raw)
    if magic != MAGIC:
        raise ValueError(f"no message begins here (0x{magic:04x} instead of 0x{MAGIC:04x})")
    return Header(message_id, version, HEADER_BYTES + payload)


def ping_result(message: bytes) -> PingResult:
    """The content of a whole SimplePingResult; its arrays share the memory of `message`.

    Raises ValueError that says which field is impossible.
    """
    version = 2 if header(message).version == 2 else 1
    at = _LAYOUTS[version]
    if len(message) < at.bearings:
        raise ValueError(f"{len(message)} bytes are too few for a ping of version {version}")
    size_code, resolution, n_ranges, n_beams = struct.unpack_from("<BdHH", message, at.geometry)
    offset, image_bytes, message_bytes = struct.unpack_from("<III", message, at.image)
    if message_bytes != len(message):
        raise ValueError(f"the ping counts {message_bytes} bytes, its header {len(message)}")
    if size_code not in _SAMPLE_BYTES:
        raise ValueError(f"data size {size_code} is unknown")
    if not 0.0 < resolution < 100.0:
        raise ValueError(f"range resolution {resolution:g} m is impossible")
    if not n_ranges or not n_beams:
        raise ValueError(f"the image has {n_ranges} ranges x {n_beams} beams")
    if offset < at.bearings + 2 * n_beams or offset + image_bytes > len(message):
        raise ValueError(
            f"the image (bytes {offset} to {offset + image_bytes}) lies outside the message's {len(message)}"
        )
    sample, gain = _image(message, offset, image_bytes, (n_ranges, n_beams), _SAMPLE_BYTES[size_code])
    code, start_at = at.ping_start
    return PingResult(
        version,
        _number("<I", message, at.ping_id),
        _number(code, message, start_at),
        _within(_number("<d", message, at.frequency), 1e3, 1e8),
        _within(_number("<d", message, at.sound_speed), *_KNOWN_SPEED_MPS),
        resolution,
        _bearings(message, at.bearings, n_beams),
        sample,
        gain,
    )


def _number(code: str, message: bytes, offset: int) -> Any:
    return struct.unpack_from(code, message, offset)[0]


def _within(value: float, low: float, high: float) -> float:
    return value if low <= value <= high else math.nan


def _bearings(message: bytes, offset: int, n_beams: int) -> npt.NDArray[np.float64]:
    hundredths = np.frombuffer(message, "<i2", n_beams, offset)
    step = np.diff(hundredths.astype(int))
    if not ((step > 0).all() or (step < 0).all()):
        raise ValueError("the bearings are not monotonic")
    return np.radians(0.01 * hundredths)


def _image(
    message: bytes, offset: int, image_bytes: int, shape: tuple[int, int], sample_bytes: int
) -> tuple[npt.NDArray[Any], npt.NDArray[np.uint32] | None]:
    n_ranges, n_beams = shape
    stride, rest = divmod(image_bytes, n_ranges)
    gain_bytes = stride - n_beams * sample_bytes
    if rest or gain_bytes not in (0, GAIN_BYTES):
        raise ValueError(
            f"{image_bytes} bytes do not fit {n_ranges} x {n_beams} samples of {sample_bytes} bytes"
        )
    rows = np.frombuffer(message, np.uint8, image_bytes, offset).reshape(n_ranges, stride)
    gain = rows[:, :gain_bytes].copy().view("<u4")[:, 0] if gain_bytes else None
    return _samples(rows[:, gain_bytes:], sample_bytes), gain


def _samples(rows: npt.NDArray[np.uint8], sample_bytes: int) -> npt.NDArray[Any]:
    if sample_bytes == 3:
        low, middle, high = (rows[:, i::3].astype(np.uint32) for i in range(3))
        return low | middle << 8 | high << 16
    return np.ascontiguousarray(rows).view(f"<u{sample_bytes}")
