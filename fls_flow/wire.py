"""A message as one buffer, and back: a checked prefix, a flat msgpack header, raw array segments.

The class's field annotations say what is read and written, so a plugin's own message types need no
registration and a buffer is never asked which class to build. Layout, byte for byte: docs/wire.md.

The checksums find accidents, not attackers; a crafted buffer still ends in `WireError` or in a message that
its class accepts, and costs no memory beyond a small multiple of its own size.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
from xxhash import xxh3_64, xxh3_64_intdigest

from fls_flow._array_codec import aligned
from fls_flow._codecs import short
from fls_flow._records import Schema
from fls_flow._schemas import carrier
from fls_flow.errors import WireError
from fls_flow.messages import Message

__all__ = [
    "VERSION",
    "Layout",
    "Peek",
    "Schema",
    "decode",
    "encode",
    "encode_into",
    "encoded_size",
    "layout",
    "peek",
    "schema",
]

VERSION = 1
MAGIC = b"FLSW"

_OPENING = struct.Struct("<4sIQ")  # magic, version, checksum of all up to the end of the header
_SIZES = struct.Struct("<IIQQ")  # flags, header size, buffer size, checksum of the payload
_WHOLE = struct.Struct("<4sIQIIQQ")  # both
_PREFIX = _WHOLE.size
_PAYLOAD_CHECKED = 1

_PACKER = msgspec.msgpack.Encoder()
_UNPACKER = msgspec.msgpack.Decoder(list[bool | int | float | str])  # a container inside is refused unread

Buffer = bytes | bytearray | memoryview
M = TypeVar("M", bound=Message)


class Peek(NamedTuple):
    """What a header says of its message."""

    type_name: str
    seq: int
    stamp_ns: int


def encode(message: Message, *, checksum: bool = True) -> bytes:
    """The message as one buffer; the same values give the same bytes.

    Without `checksum` the payload is left out of the checksums (for memory shared on one host).
    Raises WireError when the class or a value of it cannot be carried.
    """
    return layout(message).to_bytes(checksum=checksum)


def encoded_size(message: Message) -> int:
    """How many bytes `encode` gives."""
    return layout(message).size


def encode_into(message: Message, buffer: bytearray | memoryview, *, checksum: bool = True) -> int:
    """Write what `encode` gives to the start of `buffer`; each array is copied once. Returns the size."""
    return layout(message).write_into(buffer, checksum=checksum)


def decode(buffer: Buffer, message_type: type[M]) -> M:
    """The message in `buffer`; its arrays are read-only views into the buffer.

    Arrays are aligned to 64 bytes if the buffer is. Raises WireError when the buffer is not whole and
    unaltered, or holds another type, another schema, or values that `message_type` refuses.
    """
    view = _bytes(buffer).toreadonly()
    end, checked, payload_sum = _head(view)
    items = _items(view[_PREFIX:end])
    expected = carrier(message_type)
    rest = iter(items)
    take = rest.__next__
    if take() != expected.schema.name or take() != expected.schema.fingerprint:
        raise _unexpected(expected.schema, items)
    if checked and xxh3_64_intdigest(view[end:]) != payload_sum:
        name = expected.schema.name
        raise WireError(f"{name}: the payload's checksum differs; the buffer was altered on its way")
    try:
        message, end = expected.read(take, view, end)
    except StopIteration:
        raise WireError("the header has too few items") from None
    if next(rest, None) is not None:
        raise WireError("the header has too many items")
    if end != len(view):
        raise WireError(f"the arrays end at byte {end} of {len(view)}")
    read: M = message
    return read


def peek(buffer: Buffer) -> Peek:
    """Type, seq and stamp of the message in `buffer`, its payload unread; WireError as for `decode`."""
    view = _bytes(buffer)
    name, _, seq, stamp_ns = _items(view[_PREFIX : _head(view)[0]])[:4]
    if type(name) is not str or type(seq) is not int or type(stamp_ns) is not int:
        raise WireError("the header does not begin with type, schema, seq and stamp_ns")
    return Peek(name, seq, stamp_ns)


def schema(message_type: type) -> Schema:
    """The schema of a message class; WireError when the wire cannot carry it."""
    return carrier(message_type).schema


class Layout(NamedTuple):
    """A message laid out for writing: its size is known, no array is copied yet."""

    size: int
    header: bytes
    segments: tuple[tuple[npt.NDArray[Any], np.dtype[Any], int], ...]  # array, dtype on the wire, offset

    def to_bytes(self, *, checksum: bool = True, before: bytes = b"") -> bytes:
        """The whole buffer, after what stands `before` it."""
        end = _PREFIX + len(self.header)
        pieces: list[bytes | memoryview] = []
        for array, dtype, start in self.segments:
            pieces += (bytes(start - end), np.ascontiguousarray(array, dtype).data)
            end = start + array.nbytes
        if not checksum:
            return b"".join((before, self._prefix(None), *pieces))
        digest = xxh3_64()
        for piece in pieces:
            digest.update(piece)
        return b"".join((before, self._prefix(digest.intdigest()), *pieces))

    def write_into(self, buffer: bytearray | memoryview, *, checksum: bool = True) -> int:
        """Write the whole buffer to the start of `buffer`, and return its size."""
        view = _bytes(buffer)
        if view.readonly or len(view) < self.size:
            raise WireError(f"needs {self.size} writable bytes; the buffer has {len(view)}")
        end = start_of_payload = _PREFIX + len(self.header)
        for array, dtype, start in self.segments:
            view[end:start] = bytes(start - end)  # reused memory: padding is part of the checksum
            np.ndarray(array.shape, dtype, view, start)[...] = array
            end = start + array.nbytes
        payload_sum = xxh3_64_intdigest(view[start_of_payload:end]) if checksum else None
        view[:start_of_payload] = self._prefix(payload_sum)
        return self.size

    def _prefix(self, payload_sum: int | None) -> bytes:
        """All up to the payload."""
        flags = 0 if payload_sum is None else _PAYLOAD_CHECKED
        rest = _SIZES.pack(flags, len(self.header), self.size, payload_sum or 0) + self.header
        return _OPENING.pack(MAGIC, VERSION, xxh3_64_intdigest(rest)) + rest


def layout(message: Message) -> Layout:
    """The message laid out for writing; WireError when it cannot be carried."""
    own = carrier(type(message))
    items, arrays = own.write(message)
    try:
        header = _PACKER.encode(items)
    except (ValueError, OverflowError, MemoryError) as error:
        raise WireError(f"{own.schema.name} has a header that cannot be packed: {error}") from error
    end, segments = _PREFIX + len(header), []
    for array, dtype in arrays:
        start = aligned(end)
        segments.append((array, dtype, start))
        end = start + array.nbytes
    return Layout(end, header, tuple(segments))


def _bytes(buffer: Buffer) -> memoryview:
    try:
        return memoryview(buffer).cast("B")
    except (TypeError, ValueError) as error:
        raise WireError(f"{type(buffer).__name__} is no contiguous buffer of bytes: {error}") from error


def _head(view: memoryview) -> tuple[int, bool, int]:
    """Where the header ends, whether the payload has a checksum, and that; all is checked before."""
    if len(view) < _PREFIX:
        raise WireError(f"{len(view)} bytes are no message: the prefix alone has {_PREFIX}")
    magic, version, head_sum, flags, header_size, size, payload_sum = _WHOLE.unpack_from(view)
    if magic != MAGIC:
        raise WireError(f"the buffer begins with {magic!r}, not with {MAGIC!r}: it is no message")
    if version != VERSION:
        raise WireError(f"the buffer has wire version {version}, this is {VERSION}: update the older side")
    if size != len(view):
        raise WireError(f"the buffer has {len(view)} bytes, its prefix says {size}: it is cut or joined")
    end = _PREFIX + header_size
    if end > size or xxh3_64_intdigest(view[_OPENING.size : end]) != head_sum:
        raise WireError("the header's checksum differs; the buffer was altered on its way")
    if flags & ~_PAYLOAD_CHECKED or (payload_sum and not flags):
        raise WireError(f"flags {flags:#x} are not known to wire version {VERSION}")
    return end, flags == _PAYLOAD_CHECKED, payload_sum


def _items(header: memoryview) -> list[Any]:
    """The items of the header, which is one flat array of at least four scalars."""
    count = _count(header)
    if not 4 <= count <= len(header):  # before room is made for what it claims to hold
        raise WireError(f"the header does not hold the {count} items that it says")
    try:
        items: list[Any] = _UNPACKER.decode(header)
    except (ValueError, RecursionError) as error:
        raise WireError(f"the header cannot be unpacked: {error}") from error
    return items


def _count(header: memoryview) -> int:
    """How many items a msgpack array says that it has."""
    first = header[0] if header else 0
    if first >> 4 == 0x9:
        return first & 0xF
    if first not in (0xDC, 0xDD):
        raise WireError("the header cannot be unpacked: it is no array")
    return int.from_bytes(header[1 : 3 if first == 0xDC else 5], "big")


def _unexpected(expected: Schema, items: list[Any]) -> WireError:
    """What to say of a buffer that holds something else."""
    name, fingerprint = items[0], items[1]
    if name != expected.name:
        return WireError(f"the buffer holds {short(name)}, not the expected {expected.name}")
    return WireError(
        f"the buffer holds {name} with schema {_hex(fingerprint)}, expected is {name} with schema "
        f"{_hex(expected.fingerprint)}: sender and receiver have different versions of the class"
    )


def _hex(fingerprint: Any) -> str:
    return f"{fingerprint:016x}" if type(fingerprint) is int else short(fingerprint)
