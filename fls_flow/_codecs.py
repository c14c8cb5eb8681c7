"""How values stand in a buffer: scalars as items of its flat header (arrays: `_array_codec`).

Each codec carries the values of one annotation: it adds to the functions that write and read a message class.
Reading checks every item, so that nothing comes out but what the annotation allows.
"""

from __future__ import annotations

import enum
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn, Protocol

import numpy as np

from fls_flow._generated import Code
from fls_flow.errors import WireError

__all__ = [
    "Choice",
    "Codec",
    "Many",
    "Optional",
    "Scalar",
    "Tuple",
    "Writer",
    "short",
    "unfit",
]


class Codec(Protocol):
    """What carries the values of one annotation."""

    @property
    def text(self) -> str:
        """The annotation's part of the schema."""

    def write(self, value: str, code: Writer) -> None:
        """Add lines that append the items and arrays of the variable `value`.

        They raise WireError, which names the field, when it does not fit.
        """

    def read(self, code: Code) -> str:
        """Add lines that take the next items and arrays; the variable with their value.

        They use `take()` for the header's next item (StopIteration when it has too few), `view` and `end`,
        where the last array ends. They raise WireError when the items do not fit.
        """


class Writer(Code):
    """Code that fills `items` and `arrays`."""

    def __init__(self) -> None:
        super().__init__()
        self._pending: list[str] = []

    def item(self, *expressions: str) -> None:
        """Add items of the header; those that follow each other are appended at once."""
        self._pending += expressions

    def flush(self) -> None:
        """Append what is pending."""
        if self._pending:
            self.line(f"items += ({', '.join(self._pending)},)")
            self._pending.clear()


def unfit(where: str, value: Any, wanted: str) -> NoReturn:
    """Raise WireError: what the field `where` holds, and what it takes instead."""
    raise WireError(f"{where} is {short(value)} ({type(value).__name__}); it takes {wanted}")


@dataclass(frozen=True, slots=True)
class Scalar:
    """A bool, int, float or str, as the header's item."""

    where: str
    kind: type

    @property
    def text(self) -> str:
        return self.kind.__name__

    def write(self, value: str, code: Writer) -> None:
        beyond = {int: f" or not {-(2**63)} <= {value} < {2**64}", str: f" or not {value}.isascii()"}
        with code.block(f"if type({value}) is not {self.text}{beyond.get(self.kind, '')}"):
            code.line(f"{value} = {code.uses(self.exactly)}({value})")
        code.item(value)

    def read(self, code: Code) -> str:
        value = code.name()
        code.line(f"{value} = take()")
        with code.block(f"if type({value}) is not {self.text}"):
            code.line(f"{code.uses(self.refuse)}({value})")
        return value

    def refuse(self, value: Any) -> NoReturn:
        """Say what it takes instead."""
        unfit(self.where, value, self.text)

    def exactly(self, value: Any) -> Any:
        """The value as exactly this kind; WireError for what cannot be one."""
        if type(value) is not self.kind:
            # float32 is no float here: in one process it would go on computing in single precision.
            taken, exactly = _TAKEN[self.kind]
            if not isinstance(value, taken) or type(value) is bool:
                self.refuse(value)
            try:
                value = exactly(value)
            except OverflowError as error:
                raise WireError(f"{self.where} is {short(value)}: {error}") from error
        if self.kind is int and not -(2**63) <= value < 2**64:
            unfit(self.where, value, "integers of 64 bits")
        if self.kind is str and any("\ud800" <= c <= "\udfff" for c in value):
            unfit(self.where, value, "text that UTF-8 can hold")
        return value


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

    def write(self, value: str, code: Writer) -> None:
        code.line(f"{value} = {code.uses(self.plain)}({value})")
        code.item(value)

    def read(self, code: Code) -> str:
        value = code.name()
        code.line(f"{value} = {code.uses(self.option)}(take())")
        return value

    def plain(self, value: Any) -> int | str:
        """What stands for the value."""
        plain = value.value if isinstance(value, enum.Enum) else value
        self.option(plain)
        return operator.index(plain) if isinstance(plain, int) else str.__str__(plain)

    def option(self, plain: Any) -> Any:
        """The value that `plain` stands for."""
        if not isinstance(plain, int | str) or plain not in self.options:
            unfit(self.where, plain, self.text)
        return self.options[plain]


@dataclass(frozen=True, slots=True)
class Optional:
    """A bool that says whether the value is there, then the value."""

    inner: Codec

    @property
    def text(self) -> str:
        return f"{self.inner.text}?"

    def write(self, value: str, code: Writer) -> None:
        code.item(f"{value} is not None")
        code.flush()
        with code.block(f"if {value} is not None"):
            self.inner.write(value, code)
            code.flush()

    def read(self, code: Code) -> str:
        there, value = code.name(), code.name()
        code.line(f"{there} = take()")
        code.line(f"{value} = None")
        with code.block(f"if {there} is True"):
            code.line(f"{value} = {self.inner.read(code)}")
        with code.block(f"elif {there} is not False"):
            code.line(f"{code.uses(self.refuse)}({there})")
        return value

    def refuse(self, there: Any) -> NoReturn:
        """Say what it takes instead."""
        raise WireError(f"the header has {short(there)} where it says whether a {self.text} is there")


@dataclass(frozen=True, slots=True)
class Tuple:
    """A tuple of fixed length, its entries one after the other."""

    where: str
    parts: tuple[Codec, ...]

    @property
    def text(self) -> str:
        return "(" + ",".join(part.text for part in self.parts) + ")"

    def write(self, value: str, code: Writer) -> None:
        with code.block(f"if not isinstance({value}, tuple) or len({value}) != {len(self.parts)}"):
            code.line(f"{code.uses(self.refuse)}({value})")
        entries = [code.name() for _ in self.parts]
        code.line(f"{', '.join(entries)}, = {value}" if entries else "pass")
        for part, entry in zip(self.parts, entries, strict=True):
            part.write(entry, code)

    def read(self, code: Code) -> str:
        entries = [part.read(code) for part in self.parts]
        return f"({', '.join(entries)},)" if entries else "()"

    def refuse(self, value: Any) -> NoReturn:
        """Say what it takes instead."""
        unfit(self.where, value, f"a tuple {self.text}")


@dataclass(frozen=True, slots=True)
class Many:
    """A tuple of any length: the length, then its entries."""

    where: str
    part: Codec

    @property
    def text(self) -> str:
        return f"{self.part.text}*"

    def write(self, value: str, code: Writer) -> None:
        with code.block(f"if not isinstance({value}, tuple)"):
            code.line(f"{code.uses(self.refuse)}({value})")
        code.item(f"len({value})")
        code.flush()
        entry = code.name()
        with code.block(f"for {entry} in {value}"):
            self.part.write(entry, code)
            code.flush()

    def read(self, code: Code) -> str:
        length, entries = code.name(), code.name()
        code.line(f"{length} = take()")
        with code.block(f"if type({length}) is not int or {length} < 0"):
            code.line(f"{code.uses(self.refuse_length)}({length})")
        code.line(f"{entries} = []")
        # Every entry takes an item at least: a length that lies ends with the header.
        with code.block(f"for _ in range({length})"):
            code.line(f"{entries}.append({self.part.read(code)})")
        return f"tuple({entries})"

    def refuse(self, value: Any) -> NoReturn:
        """Say what it takes instead."""
        unfit(self.where, value, f"a tuple {self.text}")

    def refuse_length(self, length: Any) -> NoReturn:
        """Say what it takes instead."""
        unfit(self.where, length, "a number of entries")


def short(value: Any) -> str:
    """The value in an error's one line, whatever it is."""
    text = value if type(value) is str and value.isprintable() else ascii(value)
    return text if len(text) <= 60 else text[:57] + "..."
