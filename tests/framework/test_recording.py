"""MCAP recordings: written whole, readable by others and after a crash, and every fault is one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import Writer

from fls_flow import Detections, InputError, NavState, Ping, Tracks, wire
from fls_flow.recording import Recording, RecordingWriter


def ping(n, shape=(30, 20)):
    image = np.random.default_rng(n).rayleigh(10.0, shape).astype(np.float32)
    nav = NavState(n, n * 10, (1.0, 2.0, float(n)))
    return Ping(n, n * 1000, image, np.arange(1.0, shape[0] + 1), np.linspace(-1, 1, shape[1]), nav=nav)


def firing(n):
    tracks = Tracks(n, n * 1000, [n], [1], [[1.0, 2.0, 3.0, n]], np.eye(4)[None], [1], [1])
    return {"sonar": ping(n), "tracker": tracks}


@pytest.fixture
def recorded(tmp_path):
    path = tmp_path / "deep" / "run.mcap"
    writer = RecordingWriter(path, chunk_pings=4)
    for n in range(10):
        writer.write(firing(n))
    writer.close()
    return path


def test_what_is_written_is_read_bit_for_bit(recorded):
    recording = Recording(recorded)
    topics = recording.topics()
    assert {name: topic.messages for name, topic in topics.items()} == {"sonar": 10, "tracker": 10}
    assert recording.message_type("sonar") is Ping
    assert recording.one_topic(Tracks) == "tracker"
    for topic in topics:
        found = [wire.encode(message) for message in recording.messages(topic)]
        assert found == [wire.encode(firing(n)[topic]) for n in range(10)]


def test_the_reader_of_the_format_reads_it(recorded):
    with recorded.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert {channel.topic for channel in summary.channels.values()} == {"sonar", "tracker"}
        assert {schema.name for schema in summary.schemas.values()} == {"fls_flow.Ping", "fls_flow.Tracks"}
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        assert len(summary.chunk_indexes) == 3
        entries = list(reader.iter_messages(topics=["sonar"]))[3:6]
    assert [record.log_time for _, _, record in entries] == [3000, 4000, 5000]
    assert [record.sequence for _, _, record in entries] == [3, 4, 5]
    for schema, channel, record in entries:
        assert (schema.encoding, channel.message_encoding) == ("fls-wire", "fls-wire")
        assert wire.decode(record.data, Ping).seq == record.sequence


def test_the_same_messages_give_the_same_bytes(recorded, tmp_path):
    again = RecordingWriter(tmp_path / "again.mcap", chunk_pings=4)
    for n in range(10):
        again.write(dict(reversed(firing(n).items())))
    again.close()
    assert (tmp_path / "again.mcap").read_bytes() == recorded.read_bytes()


def test_a_recording_without_messages_is_one(tmp_path):
    writer = RecordingWriter(tmp_path / "empty.mcap")
    writer.close()
    writer.close()
    assert Recording(tmp_path / "empty.mcap").topics() == {}
    with pytest.raises(InputError, match="has 0 topics"):
        Recording(tmp_path / "empty.mcap").one_topic()


def test_a_recording_never_replaces_a_file(recorded):
    with pytest.raises(InputError, match="exists already"):
        RecordingWriter(recorded).write(firing(0))


@pytest.mark.parametrize("end", ["chunk", "record", "summary", "magic"])
def test_a_recording_that_was_cut_off_is_read_up_to_there(recorded, tmp_path, end, caplog):
    whole = recorded.read_bytes()
    with recorded.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    last = chunks[2]
    cut = {
        "chunk": last.chunk_start_offset,
        "record": last.chunk_start_offset + last.chunk_length // 2,
        "summary": len(whole) - 60,
        "magic": len(whole) - 3,
    }[end]
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[:cut])
    expected = 8 if end in ("chunk", "record") else 10
    assert Recording(path).topics()["sonar"].messages == expected
    assert [message.seq for message in Recording(path).messages("tracker")] == list(range(expected))
    assert ("was never closed" in caplog.text) == (expected == 8)


CRASH = """
import sys, time
import numpy as np
from pathlib import Path
from fls_flow import Detections
from fls_flow.recording import RecordingWriter
writer = RecordingWriter(Path(sys.argv[1]), chunk_pings=5)
for n in range(1_000_000):
    writer.write({"detections": Detections(n, n)})
    if n == 23:
        print("written", flush=True)
        time.sleep(60)
"""


def test_kill_9_leaves_whole_chunks(tmp_path):
    path = tmp_path / "crash.mcap"
    process = subprocess.Popen([sys.executable, "-c", CRASH, path], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "written\n"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert [message.seq for message in Recording(path).messages("detections")] == list(range(20))
    with path.open("rb") as file:  # and the format's own reader gets as far
        found = []
        with pytest.raises(EndOfFile):
            found.extend(
                record.log_time for _, _, record in NonSeekingReader(file).iter_messages(log_time_order=False)
            )
    assert found == list(range(20))


@pytest.mark.parametrize("place", [0.2, 0.5, 0.8])
def test_a_changed_byte_is_named(recorded, tmp_path, place):
    changed = bytearray(recorded.read_bytes())
    with recorded.open("rb") as file:
        first = make_reader(file).get_summary().chunk_indexes[0]
    changed[first.chunk_start_offset + int(place * first.chunk_length)] ^= 0x55
    path = tmp_path / "changed.mcap"
    path.write_bytes(changed)
    with pytest.raises(InputError, match="damaged") as caught:
        list(Recording(path).messages("sonar"))
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"no recording", b"\x89MCAP0\r\n" + b"\xff" * 40, bytes(100)])
def test_what_is_no_recording_is_one_line(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        Recording(path).one_topic()
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_random_damage_never_is_anything_but_one_line(recorded, tmp_path):
    rng = np.random.default_rng(1)
    whole = recorded.read_bytes()
    for trial in range(60):
        changed = bytearray(whole)
        for place in rng.integers(0, len(whole), 3):
            changed[place] = rng.integers(0, 256)
        path = tmp_path / f"{trial}.mcap"
        path.write_bytes(changed)
        found = []
        with suppress(InputError):  # any other error fails the test
            found += [message.seq for message in Recording(path).messages("sonar")]
        assert found == list(range(len(found)))


def test_missing_files_topics_and_ambiguous_ones_are_named(recorded, tmp_path):
    with pytest.raises(InputError, match="No such file"):
        Recording(tmp_path / "none.mcap").topics()
    with pytest.raises(InputError, match="has no topic 'nav'; it has sonar, tracker"):
        Recording(recorded).message_type("nav")
    with pytest.raises(InputError, match="has 2 topics; name one of: sonar, tracker"):
        Recording(recorded).one_topic()
    with pytest.raises(InputError, match="has 0 topics of Detections"):
        Recording(recorded).one_topic(Detections)


@dataclass(frozen=True)
class Whistle:
    seq: int
    stamp_ns: int
    pitch_hz: float = 0.0


def test_messages_of_others_are_recorded_but_their_class_is_not_guessed(tmp_path):
    path = tmp_path / "whistle.mcap"
    writer = RecordingWriter(path)
    writer.write({"whistle": Whistle(1, 2, 440.0)})
    with pytest.raises(InputError, match="topic 'whistle' takes Whistle, not NavState"):
        writer.write({"whistle": NavState(2, 3)})
    with pytest.raises(InputError, match="stamp_ns -5 lies before 1970"):
        writer.write({"whistle": Whistle(1, -5)})
    writer.close()
    assert Recording(path).topics()["whistle"].messages == 1
    with pytest.raises(InputError, match=r"holds .*Whistle, which is no message of fls_flow"):
        Recording(path).messages("whistle")


def test_channels_of_other_programs_and_other_versions_are_told_apart(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        json = writer.register_schema("Pose", "jsonschema", b"{}")
        channel = writer.register_channel("pose", "json", json)
        writer.add_message(channel, 5, b"{}", 5)
        old = writer.register_schema("fls_flow.Ping", "fls-wire", b"0123456789abcdef Ping(seq:int)")
        writer.register_channel("old", "fls-wire", old)
        writer.finish()
    assert Recording(path).topics()["pose"].type_name == "json messages"
    with pytest.raises(InputError, match="holds json messages"):
        Recording(path).message_type("pose")
    with pytest.raises(InputError, match="of another version of fls_flow"):
        Recording(path).message_type("old")


def test_several_channels_of_a_topic_are_one_if_they_hold_the_same(tmp_path):
    described = wire.schema(Detections)
    for second, expected in (("fls-wire", 3), ("json", None)):
        path = tmp_path / f"{second}.mcap"
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            schema = writer.register_schema(
                described.name, "fls-wire", f"{described.fingerprint:016x} x".encode()
            )
            first, other = (writer.register_channel("echoes", name, schema) for name in ("fls-wire", second))
            for n, channel in enumerate((first, other, first)):
                writer.add_message(channel, n, wire.encode(Detections(n, n)), n)
            writer.finish()
        if expected is None:
            with pytest.raises(InputError, match="topic 'echoes' holds both"):
                Recording(path).topics()
        else:
            assert Recording(path).topics()["echoes"].messages == expected
            assert [message.seq for message in Recording(path).messages("echoes")] == [0, 1, 2]


def test_a_full_disk_is_one_line():
    if not Path("/dev/full").exists():
        return  # nothing to fill up elsewhere
    writer = RecordingWriter(Path("/dev/full"))
    with pytest.raises(InputError, match="/dev/full"):
        writer.write(firing(0))
