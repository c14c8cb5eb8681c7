"""A message as one buffer, and back: a checked prefix, a flat msgpack header, raw array segments.

The class's field annotations say what is read and written, so a plugin's own message types need no
registration and a buffer is never asked which class to build. Layout, byte for byte: docs/wire.md.

The checksums find accidents, not attackers; a crafted buffer still ends in `WireError` or in a message that
its class accepts, and costs no memory beyond a small multiple of its own size.
"""

from __future__ import annotations

import struct
from itertools import islice
from typing import Any, NamedTuple, TypeVar

import msgpack
import numpy as np
import numpy.typing as npt
from xxhash import xxh3_64, xxh3_64_intdigest

from fls_flow._codecs import Schema, Sink, Source, aligned, short
from fls_flow._schemas import record
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
_PREFIX = _OPENING.size + _SIZES.size
_PAYLOAD_CHECKED = 1

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
    view = _bytes(buffer)
    head = _head(view)
    items = _items(view, head)
    expected = record(message_type)
    _expect(expected.schema, items)
    if head.flags & _PAYLOAD_CHECKED and xxh3_64_intdigest(view[head.end :]) != head.payload_sum:
        raise WireError(f"{expected.name}: the payload's checksum differs; the buffer was altered on its way")
    source = Source(view, items[2:], head.end)
    try:
        message: M = expected.read(source)
    except StopIteration:
        raise WireError("the header has too few items") from None
    source.finish()
    return message


def peek(buffer: Buffer) -> Peek:
    """Type, seq and stamp of the message in `buffer`, its payload unread; WireError as for `decode`."""
    view = _bytes(buffer)
    name, _, seq, stamp_ns = _items(view, _head(view), first=4)
    if type(name) is not str or type(seq) is not int or type(stamp_ns) is not int:
        raise WireError("the header does not begin with type, schema, seq and stamp_ns")
    return Peek(name, seq, stamp_ns)


def schema(message_type: type) -> Schema:
    """The schema of a message class; WireError when the wire cannot carry it."""
    return record(message_type).schema


class Layout(NamedTuple):
    """A message laid out for writing: its size is known, no array is copied yet."""

    size: int
    header: bytes
    segments: tuple[tuple[npt.NDArray[Any], np.dtype[Any], int], ...]  # array, dtype on the wire, offset

    def to_bytes(self, *, checksum: bool = True) -> bytes:
        """The whole buffer."""
        end = _PREFIX + len(self.header)
        pieces: list[bytes | memoryview] = []
        for array, dtype, start in self.segments:
            pieces.append(bytes(start - end))
            pieces.append(np.ascontiguousarray(array, dtype).data)
            end = start + array.nbytes
        digest = xxh3_64()
        for piece in pieces if checksum else ():
            digest.update(piece)
        return b"".join((self._prefix(digest.intdigest() if checksum else None), self.header, *pieces))

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
        view[:start_of_payload] = self._prefix(payload_sum) + self.header
        return self.size

    def _prefix(self, payload_sum: int | None) -> bytes:
        flags = 0 if payload_sum is None else _PAYLOAD_CHECKED
        sizes = _SIZES.pack(flags, len(self.header), self.size, payload_sum or 0)
        return _OPENING.pack(MAGIC, VERSION, xxh3_64_intdigest(sizes + self.header)) + sizes


def layout(message: Message) -> Layout:
    """The message laid out for writing; WireError when it cannot be carried."""
    plan = record(type(message))
    sink = Sink([plan.name, plan.schema.fingerprint], [])
    plan.write(message, sink)
    try:
        header: bytes = msgpack.packb(sink.items)
    except (ValueError, OverflowError, MemoryError) as error:
        raise WireError(f"{plan.name} has a header that cannot be packed: {error}") from error
    end, segments = _PREFIX + len(header), []
    for array, dtype in sink.arrays:
        start = aligned(end)
        segments.append((array, dtype, start))
        end = start + array.nbytes
    return Layout(end, header, tuple(segments))


def _bytes(buffer: Buffer) -> memoryview:
    try:
        return memoryview(buffer).cast("B")
    except (TypeError, ValueError) as error:
        raise WireError(f"{type(buffer).__name__} is no contiguous buffer of bytes: {error}") from error


class _Head(NamedTuple):
    flags: int
    end: int  # of prefix and header
    payload_sum: int


def _head(view: memoryview) -> _Head:
    """Prefix, checked as far as it reaches: magic, version, sizes, header checksum."""
    if len(view) < _PREFIX:
        raise WireError(f"{len(view)} bytes are no message: the prefix alone has {_PREFIX}")
    magic, version, head_sum = _OPENING.unpack_from(view)
    if magic != MAGIC:
        raise WireError(f"the buffer begins with {magic!r}, not with {MAGIC!r}: it is no message")
    if version != VERSION:
        raise WireError(f"the buffer has wire version {version}, this is {VERSION}: update the older side")
    flags, header_size, size, payload_sum = _SIZES.unpack_from(view, _OPENING.size)
    if size != len(view):
        raise WireError(f"the buffer has {len(view)} bytes, its prefix says {size}: it is cut or joined")
    end = _PREFIX + header_size
    if end > size or xxh3_64_intdigest(view[_OPENING.size : end]) != head_sum:
        raise WireError("the header's checksum differs; the buffer was altered on its way")
    if flags & ~_PAYLOAD_CHECKED or (payload_sum and not flags):
        raise WireError(f"flags {flags:#x} are not known to wire version {VERSION}")
    return _Head(flags, end, payload_sum)


def _items(view: memoryview, head: _Head, first: int | None = None) -> list[Any]:
    """All items of the header, or only the `first`; the header is one flat array of scalars."""
    header = view[_PREFIX : head.end]
    # Containers inside the header are refused before msgpack makes room for what they claim to hold.
    limits = dict.fromkeys(("max_array_len", "max_map_len", "max_bin_len", "max_ext_len"), 0)
    size = max(len(header), 1)
    unpacker = msgpack.Unpacker(None, read_size=size, max_buffer_size=size, strict_map_key=True, **limits)
    try:
        unpacker.feed(header)
        count = unpacker.read_array_header()
        items = list(islice(unpacker, count if first is None else first))
    except Exception as error:  # whatever msgpack finds wrong, of whichever class
        raise WireError(f"the header cannot be unpacked: {error}") from error
    if len(items) != (first or count) or count < 4 or (first is None and unpacker.tell() != len(header)):
        raise WireError(f"the header does not hold the {count} items that it says")
    return items


def _expect(expected: Schema, items: list[Any]) -> None:
    name, fingerprint = items[0], items[1]
    if name != expected.name:
        raise WireError(f"the buffer holds {short(name)}, not the expected {expected.name}")
    if fingerprint != expected.fingerprint:
        raise WireError(
            f"the buffer holds {name} with schema {_hex(fingerprint)}, expected is {name} with schema "
            f"{_hex(expected.fingerprint)}: sender and receiver have different versions of the class"
        )


def _hex(fingerprint: Any) -> str:
    return f"{fingerprint:016x}" if type(fingerprint) is int else short(fingerprint)
