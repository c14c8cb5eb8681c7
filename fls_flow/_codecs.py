"""How values stand in a buffer: scalars as items of its flat header, arrays as segments behind it.

Each codec carries the values of one annotation. Reading checks every item, so that nothing comes out but what
the annotation allows.
"""

from __future__ import annotations

import enum
import math
import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
import numpy.typing as npt

from fls_flow.errors import WireError

__all__ = [
    "DTYPES",
    "Array",
    "Choice",
    "Codec",
    "Many",
    "Optional",
    "Record",
    "Scalar",
    "Schema",
    "Sink",
    "Source",
    "Tuple",
    "aligned",
    "short",
]

ALIGNMENT = 64  # a cache line, and more than any SIMD load asks for
_MAX_NDIM = 32
DTYPES = {
    code: np.dtype("<" + code)
    for code in ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "c8", "c16")
}


class Schema(NamedTuple):
    """How a message class is carried: two classes with equal schemas read each other's buffers."""

    name: str  # top-level package and class
    fingerprint: int  # of `text`
    text: str


@dataclass(frozen=True, slots=True)
class Sink:
    """What writing fills: the header's items and the arrays in order."""

    items: list[Any]
    arrays: list[tuple[npt.NDArray[Any], np.dtype[Any]]]


class Source:
    """What reading draws from: the header's items in order, and the arrays behind it."""

    def __init__(self, view: memoryview, items: list[Any], end_of_header: int) -> None:
        self._view = view.toreadonly()
        self._items: Iterator[Any] = iter(items)
        self._end = end_of_header
        # the header's next item; StopIteration when it has too few (so never take in a generator)
        self.take: Callable[[], Any] = self._items.__next__

    def array(self, where: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> npt.NDArray[Any]:
        """The next segment, as a read-only view."""
        count = math.prod(shape)
        start = aligned(self._end)
        if count == 0:
            return _empty(where, dtype, shape)
        if start + count * dtype.itemsize > len(self._view):
            raise WireError(f"{where} has shape {short(shape)} of {dtype}: more than the buffer holds")
        self._end = start + count * dtype.itemsize
        # Not ndarray(buffer=...), which would let the buffer be resized or closed under the array.
        found: npt.NDArray[Any] = np.frombuffer(self._view, dtype, count, start).reshape(shape)
        _check_bools(where, found)
        return found

    def finish(self) -> None:
        """Raise unless all was read."""
        if any(True for _ in self._items):
            raise WireError("the header has too many items")
        if self._end != len(self._view):
            raise WireError(f"the arrays end at byte {self._end} of {len(self._view)}")


def _empty(where: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> npt.NDArray[Any]:
    try:
        empty = np.empty(shape, dtype)
    except (ValueError, OverflowError, MemoryError) as error:  # a length beyond numpy's beside a zero
        raise WireError(f"{where} has shape {short(shape)}: {error}") from error
    empty.flags.writeable = False
    return empty


def _check_bools(where: str, array: npt.NDArray[Any]) -> None:
    """Raise at bytes that are neither 0 nor 1: numpy takes them for bools and then counts them wrongly."""
    if array.dtype.kind == "b" and array.size and array.view(np.uint8).max() > 1:
        raise WireError(f"{where} holds bytes other than 0 and 1: use `!= 0`, not `.view(bool)`")


class Codec(Protocol):
    """What carries the values of one annotation."""

    @property
    def text(self) -> str:
        """The annotation's part of the schema."""

    def write(self, value: Any, sink: Sink) -> None:
        """Append the items and arrays of `value`; WireError that names the field when it does not fit."""

    def read(self, source: Source) -> Any:
        """The value that the next items give; WireError when they do not fit."""


def _refuse(where: str, value: Any, wanted: str) -> NoReturn:
    raise WireError(f"{where} is {short(value)} ({type(value).__name__}); it takes {wanted}")


@dataclass(frozen=True, slots=True)
class Scalar:
    """A bool, int, float or str, as the header's item."""

    where: str
    kind: type

    @property
    def text(self) -> str:
        return self.kind.__name__

    def write(self, value: Any, sink: Sink) -> None:
        if type(value) is not self.kind:
            # float32 is no float here: in one process it would go on computing in single precision.
            taken, exactly = _TAKEN[self.kind]
            if not isinstance(value, taken) or type(value) is bool:
                _refuse(self.where, value, self.text)
            try:
                value = exactly(value)
            except OverflowError as error:
                raise WireError(f"{self.where} is {short(value)}: {error}") from error
        if self.kind is int and not -(2**63) <= value < 2**64:
            _refuse(self.where, value, "integers of 64 bits")
        if self.kind is str and not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value):
            _refuse(self.where, value, "text that UTF-8 can hold")
        sink.items.append(value)

    def read(self, source: Source) -> Any:
        value = source.take()
        return value if type(value) is self.kind else _refuse(self.where, value, self.text)


# For each kind: what is taken for it, and how it becomes exactly it (a subclass may lie about itself).
_TAKEN: dict[type, tuple[tuple[type, ...], Callable[[Any], Any]]] = {
    bool: ((np.bool_,), bool),
    int: ((int, np.integer), operator.index),
    float: ((float, int, np.integer), float),
    str: ((str,), str.__str__),
}


@dataclass(frozen=True, slots=True)
class Choice:
    """One of a Literal's values or of an enum's members, which stand as their values."""

    where: str
    options: dict[int | str, Any]

    @property
    def text(self) -> str:
        return "|".join(map(repr, self.options))

    def write(self, value: Any, sink: Sink) -> None:
        plain = value.value if isinstance(value, enum.Enum) else value
        self._option(plain)
        sink.items.append(operator.index(plain) if isinstance(plain, int) else str.__str__(plain))

    def read(self, source: Source) -> Any:
        return self._option(source.take())

    def _option(self, plain: Any) -> Any:
        if not isinstance(plain, int | str) or plain not in self.options:
            _refuse(self.where, plain, self.text)
        return self.options[plain]


@dataclass(frozen=True, slots=True)
class Optional:
    """A bool that says whether the value is there, then the value."""

    inner: Codec

    @property
    def text(self) -> str:
        return f"{self.inner.text}?"

    def write(self, value: Any, sink: Sink) -> None:
        sink.items.append(value is not None)
        if value is not None:
            self.inner.write(value, sink)

    def read(self, source: Source) -> Any:
        there = source.take()
        if type(there) is not bool:
            raise WireError(f"the header has {short(there)} where it says whether a {self.text} is there")
        return self.inner.read(source) if there else None


@dataclass(frozen=True, slots=True)
class Tuple:
    """A tuple of fixed length, its entries one after the other."""

    where: str
    parts: tuple[Codec, ...]

    @property
    def text(self) -> str:
        return "(" + ",".join(part.text for part in self.parts) + ")"

    def write(self, value: Any, sink: Sink) -> None:
        if not isinstance(value, tuple) or len(value) != len(self.parts):
            _refuse(self.where, value, f"a tuple {self.text}")
        for part, entry in zip(self.parts, value, strict=True):
            part.write(entry, sink)

    def read(self, source: Source) -> Any:
        return tuple([part.read(source) for part in self.parts])


@dataclass(frozen=True, slots=True)
class Many:
    """A tuple of any length: the length, then its entries."""

    where: str
    part: Codec

    @property
    def text(self) -> str:
        return f"{self.part.text}*"

    def write(self, value: Any, sink: Sink) -> None:
        if not isinstance(value, tuple):
            _refuse(self.where, value, f"a tuple {self.text}")
        sink.items.append(len(value))
        for entry in value:
            self.part.write(entry, sink)

    def read(self, source: Source) -> Any:
        length = source.take()
        if type(length) is not int or length < 0:
            _refuse(self.where, length, "a number of entries")
        # Every entry takes an item at least: a length that lies ends with the header.
        return tuple([self.part.read(source) for _ in range(length)])


@dataclass(frozen=True, slots=True)
class Array:
    """dtype, number of dimensions and their lengths in the header; the cells in a segment of their own."""

    where: str
    dtypes: dict[str, np.dtype[Any]]  # those allowed
    dims: str  # as the class declares them

    @property
    def text(self) -> str:
        return f"[{' '.join(self.dtypes)}]{self.dims}"

    def write(self, value: Any, sink: Sink) -> None:
        array = np.asarray(value)
        code = array.dtype.str[1:]
        if code not in self.dtypes or array.ndim > _MAX_NDIM:
            what = f"{self.where} has dtype {array.dtype} and {array.ndim} dimensions"
            raise WireError(f"{what}; it takes {', '.join(self.dtypes)} and at most {_MAX_NDIM}")
        _check_bools(self.where, array)
        sink.items.extend((code, array.ndim, *array.shape))
        if array.size:
            sink.arrays.append((array, self.dtypes[code]))

    def read(self, source: Source) -> Any:
        code, ndim = source.take(), source.take()
        if type(code) is not str or code not in self.dtypes:
            _refuse(self.where, code, f"dtype {', '.join(self.dtypes)}")
        if type(ndim) is not int or not 0 <= ndim <= _MAX_NDIM:
            _refuse(self.where, ndim, f"0 to {_MAX_NDIM} dimensions")
        shape = tuple([source.take() for _ in range(ndim)])
        for length in shape:
            if type(length) is not int or length < 0:
                _refuse(self.where, shape, "lengths as its shape")
        return source.array(self.where, self.dtypes[code], shape)


@dataclass(frozen=True, slots=True)
class Record:
    """A dataclass: its fields in their order."""

    cls: type
    schema: Schema
    parts: tuple[tuple[str, Codec], ...]

    @property
    def name(self) -> str:
        return self.schema.name

    @property
    def text(self) -> str:
        return self.schema.text

    def write(self, value: Any, sink: Sink) -> None:
        if type(value) is not self.cls:
            _refuse(self.name, value, "exactly this class")
        for name, part in self.parts:
            part.write(getattr(value, name), sink)

    def read(self, source: Source) -> Any:
        values = {name: part.read(source) for name, part in self.parts}
        try:
            return self.cls(**values)
        except Exception as error:  # whatever a plugin's class raises at what it refuses
            reason = " ".join(str(error).split())
            raise WireError(f"{self.name} refuses what the buffer holds: {reason}") from error


def aligned(offset: int) -> int:
    """Where a segment begins that follows byte `offset`."""
    return -(-offset // ALIGNMENT) * ALIGNMENT


def short(value: Any) -> str:
    """The value in an error's one line, whatever it is."""
    text = value if type(value) is str and value.isprintable() else ascii(value)
    return text if len(text) <= 60 else text[:57] + "..."
