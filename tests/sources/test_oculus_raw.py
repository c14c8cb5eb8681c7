"""The Oculus message stream: both layouts, all sample sizes, gain, clock, and one line for every fault."""

import logging
import math
import random
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import InputError
from fls_sources.oculus_protocol import MAX_MESSAGE_BYTES
from fls_sources.oculus_raw import OculusRaw, PingClock

GOLDEN = Path(__file__).parents[1] / "golden" / "oculus"
HEADER = struct.Struct("<HHHHHIH")
CODES = {1: 0, 2: 1, 3: 2, 4: 3}
BEARINGS = np.array([-3000, -1000, 0, 1500, 3000])


def samples(size, shape=(6, 5)):
    return np.random.default_rng(size).integers(0, 256**size, shape, dtype=np.uint32)


def message(body, message_id=0x23, version=0, magic=0x4F53, size=None):
    return HEADER.pack(magic, 1, 2, message_id, version, len(body) if size is None else size, 0) + body


def pixels(image, size, gain=None):
    rows = []
    for i, row in enumerate(image):
        rows.append(b"" if gain is None else struct.pack("<I", gain[i]))
        rows.extend(int(value).to_bytes(size, "little") for value in row)
    return b"".join(rows)


def ping(
    image=None, *, version=1, size=1, gain=None, ping_id=7, start=0, bearings=BEARINGS, resolution=0.5,
    frequency=2.1e6, speed=1490.0, offset=300, **wrong,
):  # fmt: skip
    """A SimplePingResult written field by field; `wrong` replaces fields of the geometry."""
    image = samples(size) if image is None else image
    raw = pixels(image, size, gain)
    fire = struct.pack("<5B4d", 2, 0, 25, 127, 4 if gain is not None else 0, 2.0, 50.0, 0.0, 0.0)
    total = offset + len(raw)
    fields = {
        "code": CODES[size], "resolution": resolution, "ranges": image.shape[0], "beams": image.shape[1],
        "offset": offset, "image_bytes": len(raw), "total": total,
    } | wrong  # fmt: skip
    geometry = struct.pack("<BdHH", *(fields[k] for k in ("code", "resolution", "ranges", "beams")))
    places = struct.pack("<III", *(fields[k] for k in ("offset", "image_bytes", "total")))
    if version == 1:
        body = (
            fire + struct.pack("<IIddddI", ping_id, 0, frequency, 20.0, 1.0, speed, start) + geometry + places
        )
    else:
        body = fire + struct.pack("<9I", *range(9))
        body += struct.pack(
            "<IIddd3ddd", ping_id, 0, frequency, 20.0, 1.0, 0.1, 0.2, 0.3, speed, float(start)
        )
        body += geometry + struct.pack("<4I", 1, 2, 3, 4) + places
    body += np.asarray(bearings, "<i2").tobytes()
    body = body.ljust(offset - 16, b"\xaa") + raw
    return message(body, version=0 if version == 1 else 2)


@pytest.fixture
def write(tmp_path):
    def written(*messages):
        path = tmp_path / "stream.raw"
        path.write_bytes(b"".join(messages))
        return path

    return written


def fault(path):
    with pytest.raises(InputError) as caught:
        list(OculusRaw(path)())
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    assert "\n" not in said
    return said


def test_the_layout_is_the_documented_one():
    assert len(ping(version=1, offset=122 + 10)) == 132 + 30
    assert len(ping(version=2, offset=202 + 10)) == 212 + 30


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(("size", "dtype"), [(1, np.uint8), (2, np.uint16), (3, np.float32), (4, np.float32)])
def test_every_field_arrives(write, version, size, dtype):
    (got,) = OculusRaw(write(ping(version=version, size=size, ping_id=123456)), start_ns=99)()
    assert (got.seq, got.stamp_ns) == (123456, 99)
    assert got.amplitude.dtype == dtype
    assert_array_equal(got.amplitude, samples(size).astype(dtype))
    assert_allclose(got.bearing_rad, np.radians(BEARINGS / 100))
    assert_allclose(got.range_m, [0.25, 0.75, 1.25, 1.75, 2.25, 2.75])
    assert (got.frequency_hz, got.sound_speed_mps, got.valid) == (2.1e6, 1490.0, None)


def test_24_bits_are_exact(write):
    image = np.array([[0xFFFFFF, 0xFFFFFE, 1, 0x010203, 0]])
    (got,) = OculusRaw(write(ping(image, size=3)))()
    assert_array_equal(got.amplitude.astype(int), image)


@pytest.mark.parametrize("size", [1, 2, 4])
@pytest.mark.parametrize("version", [1, 2])
def test_gain_of_each_row_is_undone(write, version, size):
    gain = [1, 4, 100, 2**32 - 1, 9, 2]
    path = write(ping(version=version, size=size, gain=gain))
    (got,) = OculusRaw(path)()
    assert got.amplitude.dtype == np.float32
    assert_allclose(got.amplitude, samples(size) / np.sqrt(gain)[:, None], rtol=1e-6)
    assert got.valid is None
    (raw,) = OculusRaw(path, undo_gain=False)()
    assert_array_equal(raw.amplitude, samples(size).astype(raw.amplitude.dtype))


def test_a_row_without_gain_has_no_data(write):
    (got,) = OculusRaw(write(ping(gain=[1, 1, 0, 1, 1, 1])))()
    assert_array_equal(got.valid.all(axis=1), [True, True, False, True, True, True])
    assert (got.amplitude[2] == 0).all()


def test_other_messages_are_passed_over(write):
    others = [
        message(bytes(n), message_id) for n, message_id in [(0, 0xFF), (300, 0x22), (5, 0x80), (37, 0x15)]
    ]
    path = write(others[0], ping(ping_id=1), *others, ping(ping_id=2, start=5), others[2])
    assert [p.seq for p in OculusRaw(path)()] == [1, 2]
    assert len(OculusRaw(path)) == 2


def test_an_empty_stream_has_no_pings(write):
    path = write()
    assert list(OculusRaw(path)()) == []
    assert len(OculusRaw(path)) == 0


@pytest.mark.parametrize(("frequency", "speed"), [(math.nan, math.nan), (0.0, 0.0), (-1.0, 9e99)])
def test_what_the_firmware_does_not_know_is_not_made_up(write, frequency, speed):
    (got,) = OculusRaw(write(ping(frequency=frequency, speed=speed)))()
    assert math.isnan(got.frequency_hz)
    assert got.sound_speed_mps == 1500.0


def test_ticks_become_stamps_across_a_wrap(write):
    starts = [2**32 - 1000, 2**32 - 1, 500, 62_500_500]
    path = write(*(ping(start=start) for start in starts))
    assert [p.stamp_ns for p in OculusRaw(path, start_ns=10)()] == [10, 1009, 1510, 62_501_510]
    assert [p.stamp_ns for p in OculusRaw(path, tick_ns=1000.0)()] == [0, 999_000, 1_500_000, 62_501_500_000]


def test_seconds_become_stamps(write):
    path = write(*(ping(version=2, start=start) for start in (1000.25, 1000.5, 1001.0)))
    assert [p.stamp_ns for p in OculusRaw(path)()] == [0, 250_000_000, 750_000_000]


@pytest.mark.parametrize("start", [5.0, 4.0, math.nan, math.inf, 1e300])
def test_stamps_increase_whatever_the_clock_does(write, start, caplog):
    path = write(*(ping(version=2, start=s) for s in (4.5, 5.0, start, 6.0, 7.0)))
    with caplog.at_level(logging.WARNING):
        stamps = [p.stamp_ns for p in OculusRaw(path)()]
    assert stamps[1:3] == [500_000_000, 500_000_001]
    assert (np.diff(stamps) > 0).all()
    assert stamps[4] - stamps[3] == 1_000_000_000
    assert "the sonar's clock went from 5.0" in caplog.text


def test_a_standing_counter_and_a_change_of_version_still_increase():
    clock = PingClock(0, 1.0)
    stamps = [clock.stamp_ns(*at) for at in [(1, 50), (1, 50), (1, 60), (2, 3.0), (2, 4.0), (1, 9), (1, 10)]]
    assert stamps == [0, 1, 11, 12, 1_000_000_012, 1_000_000_013, 1_000_000_014]


def test_fine_ticks_never_give_equal_stamps():
    clock = PingClock(0, 0.1)
    stamps = [clock.stamp_ns(1, start) for start in range(40)]
    assert (np.diff(stamps) > 0).all()


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (b"GARBAGE BEFORE ALL", "at byte 0: no message begins here (0x4147"),
        (ping() + b"\0" * 16, "at byte 330: no message begins here (0x0000"),
        (ping()[:-1], "ends within the message at byte 0 (329 of 330 bytes)"),
        (ping() + ping()[:100], "at byte 330 (100 of 330 bytes); cut it to 330 bytes"),
        (ping() + ping()[:7], "ends within the message at byte 330 (7 of 16 bytes)"),
        (message(b"", 0x80, size=1000), "ends within the message at byte 0 (16 of 1016"),
        (message(b"", size=2**32 - 1), "a message claims 4294967311 bytes"),
        (message(b"", 0x80, size=2**32 - 1), "a message claims 4294967311 bytes"),
        (message(bytes(50)), "66 bytes are too few for a ping of version 1"),
        (message(bytes(110), version=2), "126 bytes are too few for a ping of version 2"),
        (ping(total=331), "the ping counts 331 bytes, its header 330"),
        (ping(code=4), "data size 4 is unknown"),
        (ping(code=1), "30 bytes do not fit 6 x 5 samples of 2 bytes"),
        (ping(ranges=7), "30 bytes do not fit 7 x 5"),
        (ping(ranges=0), "0 ranges x 5 beams"),
        (ping(beams=0), "6 ranges x 0 beams"),
        (ping(beams=6), "do not fit"),
        (ping(beams=65535), "lies outside"),
        (ping(resolution=0.0), "range resolution 0 m"),
        (ping(resolution=math.nan), "range resolution nan m"),
        (ping(resolution=1e9), "range resolution 1e+09 m"),
        (ping(image_bytes=31), "(bytes 300 to 331) lies outside the message's 330"),
        (ping(image=samples(1, (6, 5)), bearings=[0, 1, 2, 2, 3]), "bearings are not monotonic"),
    ],
)  # fmt: skip
def test_faults_are_one_line(write, raw, said):
    assert said in fault(write(raw))


def test_pings_before_a_fault_are_played(write):
    path = write(ping(ping_id=1), ping(ping_id=2, start=9), b"garbage" * 9)
    played = []
    with pytest.raises(InputError, match="at byte 660"):
        played.extend(p.seq for p in OculusRaw(path)())
    stream = OculusRaw(path)()
    assert [next(stream).seq, next(stream).seq] == [1, 2]
    assert len(OculusRaw(path)) == 2


def test_missing_files(tmp_path):
    assert "No such file" in fault(tmp_path / "nope.raw")
    assert "Is a directory" in fault(tmp_path)


def test_memory_is_bounded_by_one_message(write):
    image = np.zeros((200, 500), np.uint32)
    path = write(*(ping(image, start=i, bearings=range(500), offset=2000) for i in range(60)))
    list(OculusRaw(path)())
    tracemalloc.start()
    assert sum(1 for _ in OculusRaw(path)()) == 60
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 6 * len(ping(image, bearings=range(500), offset=2000))
    assert path.stat().st_size > 10 * peak


def test_no_mutation_escapes_as_another_error(tmp_path, caplog):
    caplog.set_level(logging.ERROR)
    whole, dice, path, refused = (
        ping(version=1) + ping(version=2, start=1, gain=[1] * 6),
        random.Random(2),
        tmp_path / "s",
        0,
    )
    for _ in range(2000):
        raw = bytearray(whole)
        for _ in range(dice.choice([1, 1, 3, 9])):
            raw[dice.randrange(len(raw))] = dice.choice([0, 255, 1, dice.randrange(256)])
        if dice.random() < 0.3:
            del raw[dice.randrange(len(raw)) :]
        path.write_bytes(raw)
        try:
            stamps = [p.stamp_ns for p in OculusRaw(path)()]
            assert stamps == sorted(set(stamps))
        except InputError:
            refused += 1
    assert 500 < refused < 2000


def test_bad_parameters_are_named():
    with pytest.raises(ValueError, match=r"not 0\.0"):
        OculusRaw(Path("s.raw"), tick_ns=0.0)


def test_the_limit_lets_real_messages_through():
    assert MAX_MESSAGE_BYTES > 512 * 4 * 4000


@pytest.mark.parametrize(
    ("name", "first", "count"), [("one_ping_8bit", 415323, 1), ("three_pings_8bit", 415323, 3)]
)
def test_the_golden_streams(name, first, count):
    node = OculusRaw(GOLDEN / f"{name}.raw")
    pings = list(node())
    assert [p.seq for p in pings] == list(range(first, first + count))
    assert len(node) == count
    for p in pings:
        assert p.amplitude.shape == (703, 256)
        assert p.amplitude.dtype == np.uint8
        assert_allclose(np.degrees(p.bearing_rad[[0, -1]]), [-30, 30])
        assert_allclose(p.range_m[-1] + p.cell_m / 2, 1.998, atol=1e-3)
        assert_allclose([p.frequency_hz, p.sound_speed_mps], [2.0989e6, 1490.66], rtol=1e-4)
    assert [p.stamp_ns for p in pings] == [0, 62_502_130, 125_004_227][:count]
