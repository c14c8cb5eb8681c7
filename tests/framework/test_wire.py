import enum
import itertools
import math
import mmap
import struct
import tracemalloc
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgpack
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from xxhash import xxh3_64_intdigest

from fls_flow import Detections, Mount, NavState, Ping, Sealed, Tracks, View, array, messages, wire
from fls_flow.errors import WireError

CLASSES = [
    cls
    for cls in (getattr(messages, name) for name in messages.__all__)
    if messages.is_message_type(cls) and cls is not messages.Message
]
PREFIX = 40  # as docs/wire.md says
STEADY = settings(
    derandomize=True, database=None, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)


class Band(enum.IntEnum):
    LOW = 0
    HIGH = 3


class Side(enum.Enum):
    PORT = "port"
    STARBOARD = "starboard"


@dataclass(frozen=True)
class Pulse:
    band: Band = Band.HIGH
    side: Side = Side.PORT
    chirp: npt.NDArray[np.complex64] = field(default_factory=lambda: np.zeros(0, np.complex64))
    gates: tuple[npt.NDArray[np.float64], ...] = ()


@dataclass(frozen=True, eq=False)
class Echogram(Sealed):
    """A message as another distribution might bring it."""

    seq: int
    stamp_ns: int
    power: npt.NDArray[np.float16] = array((np.float16, np.int8, np.complex128), "n", "m")
    level: npt.NDArray[Any] = field(default_factory=lambda: np.zeros(()))
    mask: npt.NDArray[np.bool_] | None = None
    span: tuple[float, int, str, bool] = (0.0, 0, "", False)
    comment: str | None = None
    mode: Literal["wide", "narrow", 7] = "wide"
    pulse: Pulse = field(default_factory=Pulse)
    pulses: tuple[Pulse, ...] = ()
    cells: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "cells", self.power.size)


def values(annotation: Any) -> st.SearchStrategy[Any]:
    """Any value of an annotation that a message may have."""
    origin, args = get_origin(annotation), get_args(annotation)
    if annotation in SCALARS:
        return SCALARS[annotation]
    if origin is Literal:
        return st.sampled_from(args)
    if isinstance(annotation, enum.EnumMeta):
        return st.sampled_from(list(annotation))
    if origin is tuple and args[-1] is Ellipsis:
        return st.lists(values(args[0]), max_size=3).map(tuple)
    if origin is tuple:
        return st.tuples(*map(values, args))
    if annotation is np.ndarray or origin is np.ndarray:
        (kind,) = get_args(args[1]) if args else (Any,)
        dtype = np.float32 if kind is Any else kind
        return hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3))
    if is_dataclass(annotation):
        return message_of(annotation)
    inner = [values(arg) for arg in args if arg is not type(None)]
    return st.one_of(*inner, *[st.none()] * (type(None) in args))


SCALARS: dict[Any, st.SearchStrategy[Any]] = {
    int: st.integers(-(2**63), 2**64 - 1),
    float: st.floats(),
    bool: st.booleans(),
    str: st.text(st.characters(exclude_categories=["Cs"]), max_size=8),
}


# tuples that name a dimension have its length
NAMES: dict[Any, dict[str, str]] = {
    messages.Classes: {"names": "n_classes"},
    messages.Features: {"names": "n_features"},
    messages.Truth: {"class_name": "n"},
}


@st.composite
def message_of(draw: st.DrawFn, cls: Any) -> Any:
    hints, lengths, given_values = get_type_hints(cls), {}, {}
    for spec in fields(cls):
        shape = spec.metadata.get("shape")
        if not spec.init:
            continue
        if shape is None:
            given_values[spec.name] = draw(values(hints[spec.name]))
            continue
        dims = [
            lengths.setdefault(d, draw(st.integers(0, 4))) if isinstance(d, str) else d for d in shape.dims
        ]
        arrays = hnp.arrays(draw(st.sampled_from(shape.dtypes)), tuple(dims))
        optional = type(None) in get_args(hints[spec.name])
        given_values[spec.name] = draw(st.one_of(st.none(), arrays) if optional else arrays)
    for name, counted in NAMES.get(cls, {}).items():
        text = draw(st.lists(values(str), min_size=lengths[counted], max_size=lengths[counted]))
        given_values[name] = tuple(text)
    return cls(**given_values)


def assert_same(a: Any, b: Any) -> None:
    """Equal to the bit, in type too."""
    assert type(a) is type(b)
    if is_dataclass(a):
        for spec in fields(a):
            assert_same(getattr(a, spec.name), getattr(b, spec.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif isinstance(a, float):
        assert struct.pack("<d", a) == struct.pack("<d", b)
    else:
        assert a == b


def arrays_in(value: Any) -> list[npt.NDArray[Any]]:
    if isinstance(value, np.ndarray):
        return [value]
    parts = [getattr(value, f.name) for f in fields(value)] if is_dataclass(value) else value
    return [a for part in parts for a in arrays_in(part)] if isinstance(parts, list | tuple) else []


def ping(**changes: Any) -> Ping:
    amplitude = np.arange(12, dtype=np.uint16).reshape(4, 3)
    nav = NavState(1, 2, position_m=(1.0, 2.0, 3.0))
    given_values = {
        "amplitude": amplitude,
        "range_m": np.arange(4.0),
        "bearing_rad": np.arange(3.0),
        "nav": nav,
    }
    return Ping(7, 1_700_000_000_000_000_000, **(given_values | changes))


def tracks(n: int = 2) -> Tracks:
    state = np.arange(4.0 * n).reshape(n, 4)
    covariance = np.tile(np.eye(4), (n, 1, 1))
    return Tracks(3, 4, np.arange(n), np.ones(n), state, covariance, np.ones(n), np.ones(n), "ned")


def echogram() -> Echogram:
    pulse = Pulse(
        Band.LOW, Side.STARBOARD, np.array([1 + 2j], np.complex64), (np.arange(3.0), np.zeros((0, 2)))
    )
    return Echogram(
        1, 2, np.ones((2, 3), np.int8), np.array(5, np.uint32), np.array([True]), (0.5, -1, "é", True), "", 7,
        pulse, (pulse, Pulse()),
    )  # fmt: skip


def parts(buffer: bytes) -> tuple[list[Any], bytes]:
    """The header's items, and all that follows it."""
    (size,) = struct.unpack_from("<I", buffer, 20)
    return msgpack.unpackb(buffer[PREFIX : PREFIX + size]), buffer[PREFIX + size :]


def forged(
    header: bytes, payload: bytes, flags: int = 1, size: int | None = None, payload_sum: int | None = None
) -> bytes:
    """A buffer with right checksums, put together after docs/wire.md alone."""
    size = PREFIX + len(header) + len(payload) if size is None else size
    payload_sum = xxh3_64_intdigest(payload) * (flags & 1) if payload_sum is None else payload_sum
    sizes = struct.pack("<IIQQ", flags, len(header), size, payload_sum)
    return struct.pack("<4sIQ", b"FLSW", 1, xxh3_64_intdigest(sizes + header)) + sizes + header + payload


# ---- identity


def test_every_message_class_is_covered() -> None:
    assert {"Ping", "NavState", "Detections", "Tracks", "Wakes", "Truth"} <= {cls.__name__ for cls in CLASSES}
    assert len(CLASSES) == 12


@pytest.mark.parametrize("cls", [*CLASSES, Echogram])
@given(data=st.data())
@settings(STEADY, max_examples=60)
def test_decode_gives_back_what_was_encoded(cls: type, data: st.DataObject) -> None:
    message = data.draw(message_of(cls))
    buffer = wire.encode(message)
    assert len(buffer) == wire.encoded_size(message)
    decoded = wire.decode(buffer, cls)
    assert_same(decoded, message)
    assert wire.encode(decoded) == buffer
    assert wire.peek(buffer) == (
        f"{cls.__module__.split('.')[0]}.{cls.__name__}",
        message.seq,
        message.stamp_ns,
    )


@pytest.mark.parametrize("cls", [*CLASSES, Echogram])
def test_empty_messages_pass(cls: type) -> None:
    assert_same(wire.decode(wire.encode(cls(1, 2)), cls), cls(1, 2))


@pytest.mark.parametrize(
    "code", ["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "c8", "c16"]
)
@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 0, 3), (2, 3, 4)])
def test_every_dtype_and_shape_passes(code: str, shape: tuple[int, ...]) -> None:
    cells = np.random.default_rng(1).integers(0, 2, shape).astype(code)
    assert_same(wire.decode(wire.encode(Echogram(1, 2, level=cells)), Echogram).level, cells)


def test_large_pings_pass() -> None:
    message = ping(
        amplitude=np.random.default_rng(1).random((4000, 39), np.float32),
        range_m=np.arange(4000.0),
        bearing_rad=np.arange(39.0),
    )
    assert_same(wire.decode(wire.encode(message), Ping), message)


@pytest.mark.parametrize("twist", ["fortran", "reversed", "strided", "big-endian"])
def test_any_memory_order_is_written_as_little_endian_c_order(twist: str) -> None:
    plain = np.arange(12, dtype=np.uint16).reshape(4, 3)
    twisted = {
        "fortran": np.asfortranarray(plain),
        "reversed": plain[::-1, ::-1].copy()[::-1, ::-1],
        "strided": np.repeat(np.repeat(plain, 2, 0), 3, 1)[::2, ::3],
        "big-endian": plain.astype(">u2"),
    }[twist]
    message = Echogram(1, 2, level=twisted)
    buffer = wire.encode(message)
    assert buffer == wire.encode(Echogram(1, 2, level=plain))
    room = bytearray(b"\xff" * len(buffer))
    assert wire.encode_into(message, room) == len(buffer)
    assert room == buffer


@pytest.mark.parametrize(
    "message", [ping(), tracks(), tracks(0), echogram(), ping(valid=np.ones((4, 3), bool))]
)
@pytest.mark.parametrize("checksum", [True, False])
def test_writing_in_place_gives_the_same_bytes(message: Any, checksum: bool) -> None:
    buffer = wire.encode(message, checksum=checksum)
    room = bytearray(b"\xaa" * (len(buffer) + 8))
    assert wire.encode_into(message, memoryview(room), checksum=checksum) == len(buffer)
    assert room == buffer + b"\xaa" * 8
    assert_same(wire.decode(memoryview(room)[: len(buffer)], type(message)), message)


def test_equal_values_give_equal_bytes() -> None:
    ours = ping(sound_speed_mps=1500.0, mount=Mount((1.0, 0.0, 0.0)))
    theirs = ping(sound_speed_mps=1500, mount=Mount((np.float64(1.0), 0, np.int32(0))))  # type: ignore[arg-type]
    assert wire.encode(ours) == wire.encode(theirs)
    assert wire.encode(replace(tracks(), seq=np.int32(3))) == wire.encode(tracks())


def test_scalars_come_back_as_plain_python() -> None:
    odd = replace(ping(), seq=np.int64(7), sound_speed_mps=np.float64(1490))
    decoded = wire.decode(wire.encode(odd), Ping)
    assert type(decoded.seq) is int
    assert type(decoded.sound_speed_mps) is float


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -0.0, 5e-324])
def test_special_floats_pass(value: float) -> None:
    assert_same(wire.decode(wire.encode(ping(frequency_hz=value)), Ping).frequency_hz, value)


# ---- memory


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_decoded_arrays_are_read_only_views(kind: Any) -> None:
    buffer = kind(wire.encode(ping()))
    decoded = wire.decode(buffer, Ping)
    whole = np.frombuffer(buffer, np.uint8)
    for found in arrays_in(decoded):
        assert np.shares_memory(found, whole)
        assert not found.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            found[...] = 0
        with pytest.raises(ValueError, match="WRITEABLE"):
            found.flags.writeable = True


def test_arrays_of_a_plain_dataclass_are_read_only_too() -> None:
    decoded = wire.decode(wire.encode(echogram()), Echogram)
    assert len(arrays_in(decoded)) == 10
    assert not any(a.flags.writeable for a in arrays_in(decoded))


def test_views_keep_the_buffer_alive() -> None:
    room = bytearray(wire.encode(tracks()))
    state = wire.decode(room, Tracks).state
    with pytest.raises(BufferError):
        room.clear()
    with pytest.raises(ValueError, match="WRITEABLE"):
        state.flags.writeable = True
    del state
    room.clear()


def test_shared_memory_cannot_be_closed_under_a_view() -> None:
    room = mmap.mmap(-1, 4096)
    n = wire.encode_into(tracks(), memoryview(room))
    decoded = wire.decode(memoryview(room)[:n], Tracks)
    with pytest.raises(BufferError):
        room.close()
    assert_same(decoded, tracks())
    del decoded
    room.close()


def test_segments_are_aligned_with_the_buffer() -> None:
    room = np.zeros(4096 + 64, np.uint8)
    start = -room.ctypes.data % 64
    view = memoryview(room)[start:]  # type: ignore[arg-type]
    n = wire.encode_into(tracks(), view)
    assert all(a.ctypes.data % 64 == 0 for a in arrays_in(wire.decode(view[:n], Tracks)))
    odd = memoryview(b"x" + bytes(view[:n]))[1:]
    assert_same(wire.decode(odd, Tracks), tracks())


# ---- what cannot be carried


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"seq": 2**64}, r"seq is 18446744073709551616 \(int\); it takes integers of 64 bits"),
        ({"stamp_ns": -(2**63) - 1}, "stamp_ns is -9223372036854775809"),
        ({"seq": True}, r"seq is True \(bool\); it takes int"),
        ({"seq": 1.0}, r"seq is 1.0 \(float\)"),
        ({"seq": None}, "seq is None"),
        ({"comment": "a\ud800"}, "comment is .*UTF-8"),
        ({"span": (np.float32(1), 0, "", False)}, r"span is .*\(float32\); it takes float"),
        ({"span": (10**400, 0, "", False)}, "span is 10+.*too large"),
        ({"span": (0.0, 0, "")}, r"span is .*takes a tuple \(float,int,str,bool\)"),
        ({"span": [0.0, 0, "", False]}, "span is .*takes a tuple"),
        ({"pulses": [Pulse()]}, r"pulses is .*takes a tuple"),
        ({"mode": "wider"}, "mode is wider .*'wide'.'narrow'.7"),
        ({"mode": []}, r"mode is \[\] "),
        ({"pulse": None}, "Pulse is None .*exactly this class"),
        ({"pulse": Pulse(band=1)}, r"Pulse.band is 1 .*0.3"),
        ({"level": np.zeros(2, object)}, "level has dtype object"),
        ({"level": np.zeros(2, "V4")}, r"level has dtype \|V4"),
        ({"level": np.zeros(2, "M8[s]")}, "level has dtype datetime64"),
        ({"level": np.zeros(2, np.longdouble)}, "level has dtype (float128|longdouble)"),
        ({"level": np.array(["a"])}, "level has dtype <U1"),
        ({"level": "abc"}, "level has dtype <U3"),
        ({"mask": np.zeros(2, np.uint8)}, "mask has dtype uint8 .* it takes b1"),
        (
            {"mask": np.array([0, 255], np.uint8).view(bool)},
            r"mask holds bytes other than 0 and 1: use `!= 0`",
        ),
    ],
)
def test_values_that_do_not_fit_are_named(change: dict[str, Any], text: str) -> None:
    with pytest.raises(WireError, match=text):
        wire.encode(replace(echogram(), **change))


def test_a_subclass_that_lies_about_itself_is_written_as_what_it_is() -> None:
    class Loud(str):
        __slots__ = ()

        def __str__(self) -> str:
            return "LOUD"

    decoded = wire.decode(wire.encode(replace(echogram(), comment=Loud("low"))), Echogram)
    assert decoded.comment == "low"


@dataclass(frozen=True)
class WithDict:
    seq: int
    stamp_ns: int
    extra: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class WithMixedUnion:
    seq: int
    stamp_ns: int
    either: int | str = 0


@dataclass(frozen=True)
class WithLongDouble:
    seq: int
    stamp_ns: int
    wide: npt.NDArray[np.longdouble] | None = None


@dataclass(frozen=True)
class Nested:
    seq: int
    stamp_ns: int
    inner: "Nested | None" = None


@dataclass(frozen=True)
class Unresolved:
    seq: int
    stamp_ns: int
    what: "NoSuchName" = 0  # type: ignore[name-defined]  # noqa: F821  # the mistake under test


@dataclass(frozen=True)
class Nothing:
    pass


@dataclass(frozen=True)
class WithNothing:
    seq: int
    stamp_ns: int
    nothing: tuple[Nothing, ...] = ()


@dataclass(frozen=True)
class WithBareTuple:
    seq: int
    stamp_ns: int
    entries: tuple = ()  # type: ignore[type-arg]  # the mistake under test


@pytest.mark.parametrize(
    ("cls", "text"),
    [
        (WithDict, "WithDict.extra is annotated dict"),
        (WithMixedUnion, "WithMixedUnion.either is annotated"),
        (WithLongDouble, "WithLongDouble.wide is annotated .*longdouble.*: the wire carries b1"),
        (Nested, "Nested contains itself"),
        (Unresolved, "Unresolved has annotations that cannot be resolved.*NoSuchName"),
        (WithNothing, "Nothing has no fields"),
        (WithBareTuple, "WithBareTuple.entries is annotated tuple without its parts"),
        (Mount, "Mount.*is no message"),
        (View, "View.*is no message"),
        (int, "int.*is no message"),
    ],
)
def test_classes_that_cannot_be_carried_are_named(cls: Any, text: str) -> None:
    with pytest.raises(WireError, match=text):
        wire.schema(cls)
    message = cls(1, 2) if cls is not int else 1
    with pytest.raises(WireError, match=text):
        wire.encode(message)


@pytest.mark.parametrize("room", [bytearray(10), bytes(4096), memoryview(bytearray(8192))[::2]])
def test_room_that_is_too_small_read_only_or_strided_is_refused(room: Any) -> None:
    with pytest.raises(WireError, match=r"writable bytes|contiguous"):
        wire.encode_into(tracks(), room)


# ---- what is no message


def test_another_type_is_named() -> None:
    with pytest.raises(WireError, match=r"holds fls_flow\.Tracks, not the expected fls_flow\.Ping"):
        wire.decode(wire.encode(tracks()), Ping)


def test_another_schema_is_named() -> None:
    @dataclass(frozen=True)
    class Local:
        seq: int
        stamp_ns: int
        gain: float = 0.0

    older = Local
    newer = dataclass(frozen=True)(type("Local", (), {
        "__annotations__": {"seq": int, "stamp_ns": int, "gain_db": float}, "gain_db": 0.0,
        "__module__": Local.__module__, "__qualname__": Local.__qualname__,
    }))  # fmt: skip
    ours, theirs = wire.schema(newer), wire.schema(older)
    assert ours.name == theirs.name
    with pytest.raises(
        WireError, match=f"{theirs.fingerprint:016x}.*{ours.fingerprint:016x}.*different versions"
    ):
        wire.decode(wire.encode(older(1, 2)), newer)


def test_another_version_is_named() -> None:
    buffer = bytearray(wire.encode(tracks()))
    struct.pack_into("<I", buffer, 4, 2)
    for read in (lambda: wire.decode(buffer, Tracks), lambda: wire.peek(buffer)):
        with pytest.raises(WireError, match="wire version 2, this is 1"):
            read()


@pytest.mark.parametrize(
    ("buffer", "text"),
    [
        (b"", "0 bytes are no message"),
        (b"FLSW" * 9, "36 bytes are no message"),
        (b"PK\x03\x04" + bytes(60), "begins with b'PK"),
        (memoryview(bytearray(100))[::2], "no contiguous buffer"),
        (12, "int is no contiguous buffer"),
        (forged(msgpack.packb(["fls_flow.Tracks"]), b""), "does not hold the 1 items"),
        (forged(b"", b""), "cannot be unpacked"),
        (forged(msgpack.packb(parts(wire.encode(tracks(0)))[0]), b"", flags=2), "flags 0x2 are not known"),
        (forged(b"\x90", b"", size=2**63), "41 bytes, its prefix says"),
        (forged(msgpack.packb(parts(wire.encode(tracks(0)))[0]), b"", flags=0, payload_sum=5), "flags 0x0"),
    ],
)
def test_what_is_wrong_is_said(buffer: Any, text: str) -> None:
    with pytest.raises(WireError, match=text):
        wire.decode(buffer, Tracks)


def test_the_class_itself_may_refuse() -> None:
    items, payload = parts(wire.encode(tracks(1)))
    assert items[4:7] == ["i8", 1, 1]
    items[6] = 0  # no id, but a state
    with pytest.raises(WireError, match="Tracks"):
        wire.decode(forged(msgpack.packb(items), payload), Tracks)


def test_payload_without_checksum_is_flagged_and_its_length_still_checked() -> None:
    buffer = bytearray(wire.encode(tracks(), checksum=False))
    assert struct.unpack_from("<I", buffer, 16) == (0,)
    assert_same(wire.decode(buffer, Tracks), tracks())
    for other in (buffer[:-1], buffer + b"\0", buffer + buffer):
        for read in (lambda b: wire.decode(b, Tracks), wire.peek):
            with pytest.raises(WireError, match="cut or joined"):
                read(other)
    struct.pack_into("<I", buffer, 16, 1)
    with pytest.raises(WireError, match="header's checksum"):
        wire.decode(buffer, Tracks)


# ---- mutations


def mutations(buffer: bytes) -> Any:
    """Every bit flipped, every truncation, and at every byte: inserted, doubled, dropped, replaced."""
    for at, bit in itertools.product(range(len(buffer)), range(8)):
        yield buffer[:at] + bytes([buffer[at] ^ (1 << bit)]) + buffer[at + 1 :]
    for at in range(len(buffer)):
        yield buffer[:at]
        yield buffer[:at] + b"\x00" + buffer[at:]
        yield buffer[: at + 1] + buffer[at:]
        yield buffer[:at] + buffer[at + 1 :]
        yield buffer[:at] + bytes([(buffer[at] + 101) % 256]) + buffer[at + 1 :]
    yield buffer + b"\x00"
    yield buffer + buffer


@pytest.mark.parametrize("message", [tracks(1), ping(), echogram(), Detections(1, 2)])
def test_every_single_mutation_is_found(message: Any) -> None:
    buffer, kind = wire.encode(message), type(message)
    changed = [mutation for mutation in mutations(buffer) if mutation != buffer]
    assert len(changed) > 12 * len(buffer)
    for mutation in changed:
        with pytest.raises(WireError):
            wire.decode(mutation, kind)
        try:
            wire.peek(mutation)  # reads less, so it may not notice
        except WireError:
            continue


def test_the_mutations_are_ten_thousand() -> None:
    sizes = [wire.encoded_size(m) for m in (tracks(1), ping(), echogram(), Detections(1, 2))]
    assert 12 * sum(sizes) > 10_000


@given(data=st.data())
@settings(STEADY, max_examples=500)
def test_several_changes_at_once_are_found(data: st.DataObject) -> None:
    buffer = wire.encode(ping())
    mutation = bytearray(buffer)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(mutation)))
        to = data.draw(st.integers(at, min(len(mutation), at + 70)))
        mutation[at:to] = data.draw(st.binary(max_size=70))
    if mutation != buffer:
        with pytest.raises(WireError):
            wire.decode(mutation, Ping)


def test_more_than_the_message_is_refused() -> None:
    items, payload = parts(wire.encode(tracks(1)))
    header = msgpack.packb(items)
    assert_same(wire.decode(forged(header, payload), Tracks), tracks(1))
    for end in (b"\x00", b"\xcd", b"\xcd\x01"):  # an item beyond the count, and halves of items
        with pytest.raises(WireError, match=r"cannot be unpacked.*trailing"):
            wire.decode(forged(header + end, payload), Tracks)
    with pytest.raises(WireError, match="too many items"):
        wire.decode(forged(msgpack.packb([*items, 0]), payload), Tracks)
    with pytest.raises(WireError, match="too few items"):
        wire.decode(forged(msgpack.packb(parts(wire.encode(tracks(0)))[0][:-1]), b""), Tracks)
    with pytest.raises(WireError, match="the arrays end at byte"):
        wire.decode(forged(header, payload + bytes(64)), Tracks)
    with pytest.raises(WireError, match="more than the buffer holds"):
        wire.decode(forged(header, payload[:-1]), Tracks)


ODD: list[Any] = [
    *(
        -1,
        0,
        1,
        2,
        3,
        2**31,
        2**63,
        2**64 - 1,
        0.0,
        1.0,
        math.nan,
        True,
        False,
        None,
        "",
        "O",
        "V8",
        "|O",
        "<f8",
        ">f8",
    ),
    *("f8", "f4", "b1", "u1", "i8", "M8[s]", "f16", "U4", "sensor", "ned", b"", b"x", [], [[]], {}, {1: 2}),
    msgpack.ExtType(4, b"x"),
    msgpack.ExtType(4, b""),
    msgpack.Timestamp(1),
]


@pytest.mark.parametrize("message", [tracks(1), ping(), echogram(), messages.Classes(1, 2, names=("a", "b"))])
def test_every_item_replaced_by_every_oddity(message: Any) -> None:
    items, payload = parts(wire.encode(message))
    for at, odd in itertools.product(range(len(items)), ODD):
        assert_message_or_wire_error(
            forged(msgpack.packb([*items[:at], odd, *items[at + 1 :]]), payload), type(message)
        )


JUNK = st.one_of(
    st.sampled_from(ODD),
    st.integers(-(2**63), 2**64 - 1),
    st.integers(-2, 5),
    st.floats(),
    st.booleans(),
    st.none(),
    st.binary(max_size=3),
    st.text(max_size=3),
    st.recursive(st.just([]), lambda inner: st.lists(inner, max_size=2), max_leaves=4),
    st.dictionaries(st.integers(0, 9), st.integers(0, 9), max_size=2),
)


def assert_message_or_wire_error(buffer: bytes, kind: type) -> bool:
    for read in (wire.peek, lambda b: wire.decode(b, kind)):
        try:
            result = read(buffer)
        except WireError:
            return False
    assert type(result) is kind
    wire.encode(result)
    return True


@pytest.mark.parametrize("message", [tracks(2), ping(), echogram()])
@given(data=st.data())
@settings(STEADY, max_examples=400)
def test_forged_headers_give_a_wire_error_or_a_message(message: Any, data: st.DataObject) -> None:
    items, payload = parts(wire.encode(message))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(items) - 1))
        change = data.draw(st.sampled_from(["junk", "swap", "drop", "double"]))
        if change == "junk":
            items[at] = data.draw(JUNK)
        elif change == "swap":
            other = data.draw(st.integers(0, len(items) - 1))
            items[at], items[other] = items[other], items[at]
        elif change == "double" or len(items) == 1:
            items.insert(at, items[at])
        else:
            del items[at]
    assert_message_or_wire_error(
        forged(msgpack.packb(items), payload, data.draw(st.integers(0, 3))), type(message)
    )


def test_forged_header_bytes_give_a_wire_error_or_a_message() -> None:
    rng = np.random.default_rng(5)
    survived = 0
    for message in (tracks(2), ping(), echogram()):
        buffer = wire.encode(message)
        (size,) = struct.unpack_from("<I", buffer, 20)
        for _ in range(1500):
            header = bytearray(buffer[PREFIX : PREFIX + size])
            for at in rng.integers(0, size, rng.integers(1, 4)):
                header[at] = rng.integers(0, 256)
            survived += assert_message_or_wire_error(
                forged(bytes(header), buffer[PREFIX + size :]), type(message)
            )
    assert survived > 0  # another seq is another message


LENGTHS = [-1, 2**31, 2**40, 2**62, 2**63, 2**64 - 1, 1.0, True, None, "3"]


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("at", range(4, 12))
def test_lengths_that_lie_are_refused(length: Any, at: int) -> None:
    items, payload = parts(wire.encode(tracks(1)))
    assert items[4:12] == ["i8", 1, 1, "u1", 1, 1, "f8", 2]
    items[at] = length
    with pytest.raises(WireError):
        wire.decode(forged(msgpack.packb(items), payload), Tracks)


@pytest.mark.parametrize(
    "shape", [(0, 2**62), (2**62, 0), (0, 2**63), (2**64 - 1, 0), (0,) * 33, (2**32, 2**32)]
)
def test_shapes_beyond_numpy_are_refused(shape: tuple[int, ...]) -> None:
    items, payload = parts(wire.encode(Echogram(1, 2)))
    assert items[4:8] == ["f2", 2, 0, 0]
    items[5:8] = [len(shape), *shape]
    with pytest.raises(WireError):
        wire.decode(forged(msgpack.packb(items), payload), Echogram)


def test_claims_of_a_forged_header_cost_no_memory() -> None:
    huge = b"\xdd\xff\xff\xff\xff"  # an array of 2^32 - 1
    ends = [
        huge * 500,
        b"\xdf\xff\xff\xff\xff" * 500,
        b"\x91" * 2000,
        b"\xc6\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
    ]
    ends += [b"\xc9\xff\xff\xff\xff\x01", b"\xdd\x00\x00\x08\xff" * 500, b"\xcf" + b"\xff" * 8]
    name = msgpack.packb("fls_flow.Truth") + msgpack.packb(wire.schema(messages.Truth).fingerprint)
    opening = name + msgpack.packb(1) + msgpack.packb(2) + b"\xa2i8\x01\x00\xa2f8\x02\x00\x04"
    tracemalloc.start()
    try:
        for end, start in itertools.product(ends, (b"\x95", huge, b"\xdd\x00\x00\x00\x0d")):
            for header in (start + end, start + opening + end):
                with pytest.raises(WireError):
                    wire.decode(forged(header, b""), messages.Truth)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_bools_of_other_bytes_are_refused() -> None:
    items, payload = parts(wire.encode(Echogram(1, 2, mask=np.ones(3, bool))))
    assert payload.endswith(b"\x01\x01\x01")
    with pytest.raises(WireError, match="other than 0 and 1"):
        wire.decode(forged(msgpack.packb(items), payload[:-1] + b"\x02"), Echogram)


# ---- the page that others read


def test_the_page_shows_the_bytes() -> None:
    page = (Path(__file__).parents[2] / "docs" / "wire.md").read_text()
    lines = [line.split("  ")[1] for line in page.splitlines() if line[:4].isalnum() and line[4:6] == "  "]
    shown = bytes.fromhex(" ".join(lines))
    mask = messages.BeamMask(7, 1_700_000_000_000_000_000, np.array([False, True]), np.array([-0.5, 0.5]))
    assert shown == wire.encode(mask)
    assert wire.schema(messages.BeamMask).text in page
