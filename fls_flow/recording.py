"""Recordings: MCAP files of messages in wire form, a channel per port (docs/recordings.md).

Schema and message encoding are `fls-wire`; a schema's data are its fingerprint there and the text of it.
"""

from __future__ import annotations

import io
import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from fls_flow import messages as _messages
from fls_flow import wire
from fls_flow.errors import InputError, WireError
from fls_flow.messages import Message, is_message_type

__all__ = ["Recording", "RecordingWriter", "Topic"]

log = logging.getLogger(__name__)

ENCODING = "fls-wire"
PROFILE = "fls-flow"
MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 1 << 20
MOST_BYTES = 1 << 30  # of one record, compressed or not: a claim beyond it is damage


@dataclass
class RecordingWriter:
    """Writes the messages of each firing; the file is made at the first one and never replaces another.

    A chunk holds `chunk_pings` firings, or fewer if they are large; what was written before the last whole
    chunk is readable after a crash. Raises InputError when the file is there or cannot be written.
    """

    path: Path
    chunk_pings: int = 16
    _file: io.BufferedWriter | None = field(default=None, init=False, repr=False)
    _writer: Any = field(default=None, init=False, repr=False)
    _channels: dict[str, tuple[int, type]] = field(default_factory=dict, init=False, repr=False)
    _count: int = field(default=0, init=False, repr=False)
    _closed: bool = field(default=False, init=False, repr=False)

    def write(self, firing: Mapping[str, Message]) -> None:
        """Append the messages of one firing, by topic."""
        if self._writer is None:
            self._open()
        try:
            for topic in sorted(firing):
                self._add(topic, firing[topic])
            self._count += 1
            if self._count % self.chunk_pings == 0:
                self._writer.flush()
        except OSError as error:
            raise self._fault(error) from error

    def close(self) -> None:
        """Write the summary and close the file; one without messages is a valid recording too."""
        if self._closed:
            return
        self._closed = True
        if self._writer is None:
            self._open()
        assert self._file is not None
        try:
            self._writer.finish()
            self._file.close()
        except OSError as error:
            raise self._fault(error) from error

    def _open(self) -> None:
        from mcap.writer import CompressionType, Writer  # slow to load

        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("xb")
            self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile=PROFILE, library="fls_flow")
            self._file.flush()
        except OSError as error:
            raise self._fault(error) from error

    def _add(self, topic: str, message: Message) -> None:
        channel, kind = self._channels.get(topic) or self._channel(topic, type(message))
        if type(message) is not kind:
            raise InputError(
                f"{self.path}: topic '{topic}' takes {kind.__name__}, not {type(message).__name__}"
            )
        if message.stamp_ns < 0:
            raise InputError(
                f"{self.path}: stamp_ns {message.stamp_ns} lies before 1970; MCAP has no such times"
            )
        self._writer.add_message(
            channel,
            log_time=message.stamp_ns,
            publish_time=message.stamp_ns,
            sequence=self._count & 0xFFFFFFFF,
            data=wire.encode(message),
        )

    def _channel(self, topic: str, kind: type) -> tuple[int, type]:
        described = wire.schema(kind)
        data = f"{described.fingerprint:016x} {described.text}".encode()
        schema = self._writer.register_schema(described.name, ENCODING, data)
        metadata = {"wire_version": str(wire.VERSION)}
        self._channels[topic] = self._writer.register_channel(topic, ENCODING, schema, metadata), kind
        return self._channels[topic]

    def _fault(self, error: OSError) -> InputError:
        if isinstance(error, FileExistsError):
            return InputError(f"{self.path}: exists already; choose another path, or move it away")
        return InputError(f"{self.path}: {error.strerror or error}; check path and free space")


@dataclass(frozen=True, slots=True)
class Topic:
    """One channel of a recording."""

    name: str
    type_name: str  # as the wire calls it
    fingerprint: int  # of the schema that it was recorded with
    messages: int


@dataclass(frozen=True)
class Recording:
    """A recording to read; one that was never closed, as after a crash, is read up to where it ends.

    All raise InputError: one line about a file that is no recording, is damaged, or holds something else.
    """

    path: Path

    def topics(self) -> dict[str, Topic]:
        """The topics by name."""
        found = self._summary()
        return self._counted() if found is None else found

    def message_type(self, topic: str) -> type:
        """The class of a topic's messages."""
        return self._type_of(self._topic(topic))

    def one_topic(self, message_type: type | None = None) -> str:
        """The only topic, or the only one of that class."""
        name = None if message_type is None else wire.schema(message_type).name
        known = self.topics()
        fitting = [topic.name for topic in known.values() if name in (None, topic.type_name)]
        if len(fitting) == 1:
            return fitting[0]
        what = "topics" if message_type is None else f"topics of {message_type.__name__}"
        raise self.fault(
            f"has {len(fitting)} {what}; name one of: {', '.join(sorted(fitting or known)) or 'none'}"
        )

    def messages(self, topic: str) -> Iterator[Message]:
        """The messages of a topic in the order in which they were recorded."""
        described = self._topic(topic)
        message_type = self._type_of(described)
        return self._decoded(topic, message_type)

    def _decoded(self, topic: str, message_type: type) -> Iterator[Message]:
        from mcap.records import Channel
        from mcap.records import Message as Record

        wanted: set[int] = set()
        for record in self._records():
            if isinstance(record, Channel) and record.topic == topic:
                wanted.add(record.id)
            elif isinstance(record, Record) and record.channel_id in wanted:
                try:
                    yield wire.decode(record.data, message_type)
                except WireError as error:
                    raise self.fault(f"topic '{topic}', message {record.sequence}: {error}") from error

    def _topic(self, name: str) -> Topic:
        known = self.topics()
        if name not in known:
            raise self.fault(f"has no topic '{name}'; it has {', '.join(sorted(known)) or 'none'}")
        return known[name]

    def _type_of(self, topic: Topic) -> type:
        kind = _types().get(topic.type_name)
        if kind is None:
            raise self.fault(f"topic '{topic.name}' holds {topic.type_name}, which is no message of fls_flow")
        if wire.schema(kind).fingerprint != topic.fingerprint:
            raise self.fault(
                f"topic '{topic.name}' holds {topic.type_name} of another version of fls_flow; use that one"
            )
        return kind

    def _summary(self) -> dict[str, Topic] | None:
        """What the end of the file says of it; None when it says nothing."""
        from mcap.reader import SeekingReader

        with self._opened() as file:
            try:
                summary = SeekingReader(file, record_size_limit=MOST_BYTES).get_summary()
            except Exception:  # whatever is missing or wrong there: the messages before it count
                return None
        if summary is None or summary.statistics is None:
            return None
        counts = summary.statistics.channel_message_counts
        return self._by_name(
            self._described(channel, summary.schemas.get(channel.schema_id), counts.get(channel.id, 0))
            for channel in summary.channels.values()
        )

    def _counted(self) -> dict[str, Topic]:
        from mcap.records import Channel, Schema
        from mcap.records import Message as Record

        schemas: dict[int, Any] = {}
        channels: dict[int, Any] = {}
        counts: dict[int, int] = {}
        for record in self._records():
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Record):
                counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
        return self._by_name(
            self._described(channel, schemas.get(channel.schema_id), counts.get(number, 0))
            for number, channel in channels.items()
        )

    def _by_name(self, topics: Iterable[Topic]) -> dict[str, Topic]:
        """The topics; several channels of one are one topic, if they hold the same."""
        found: dict[str, Topic] = {}
        for topic in topics:
            other = found.get(topic.name, replace(topic, messages=0))
            if replace(other, messages=0) != replace(topic, messages=0):
                raise self.fault(f"topic '{topic.name}' holds both {other.type_name} and {topic.type_name}")
            found[topic.name] = replace(topic, messages=topic.messages + other.messages)
        return found

    def _described(self, channel: Any, schema: Any, count: int) -> Topic:
        if channel.message_encoding != ENCODING or schema is None or schema.encoding != ENCODING:
            return Topic(channel.topic, f"{channel.message_encoding or 'unknown'} messages", 0, count)
        try:
            fingerprint = int(schema.data[:16], 16)
        except ValueError as error:
            raise self.fault(f"topic '{channel.topic}' has a schema without a fingerprint") from error
        return Topic(channel.topic, schema.name, fingerprint, count)

    def _records(self) -> Iterator[Any]:
        """Schemas, channels and messages in the order of the file, chunk by chunk."""
        from mcap.records import Chunk, DataEnd
        from mcap.stream_reader import StreamReader

        with self._opened() as file:
            reader = StreamReader(file, emit_chunks=True, record_size_limit=MOST_BYTES)
            records = reader.records
            while True:
                try:
                    record = next(records, None)
                except Exception as error:  # of whichever library, and of whatever bytes
                    if file.tell() > len(MAGIC) and not file.read(1):
                        log.warning("%s was never closed: it is read up to where it ends", self.path)
                        return
                    what = str(error) or "the file ends"
                    raise self.fault(
                        f"at byte {max(file.tell(), 0)}: {what}; is this an MCAP file?"
                    ) from error
                if record is None or isinstance(record, DataEnd):
                    return
                if isinstance(record, Chunk):
                    yield from self._within(record, file.tell())
                else:
                    yield record

    def _within(self, chunk: Any, place: int) -> list[Any]:
        from mcap.stream_reader import breakup_chunk

        if chunk.uncompressed_size > MOST_BYTES:
            raise self.fault(f"the chunk before byte {place} claims {chunk.uncompressed_size} bytes")
        try:
            return list(breakup_chunk(chunk, validate_crc=True))
        except Exception as error:  # of whichever decompressor
            raise self.fault(f"the chunk before byte {place} is damaged: {error}") from error

    def _opened(self) -> io.BufferedReader:
        try:
            return self.path.open("rb")
        except OSError as error:
            raise InputError(f"{self.path}: {error.strerror or error}; check the path") from error

    def fault(self, what: str) -> InputError:
        """One line about this file."""
        return InputError(f"{self.path}: {' '.join(what.split())}")


@cache
def _types() -> dict[str, type]:
    """The message classes of fls_flow by their names on the wire."""
    classes = [getattr(_messages, name) for name in _messages.__all__]
    return {wire.schema(cls).name: cls for cls in classes if is_message_type(cls)}
