"""How a message class stands in a buffer: its codecs, field by field, and the functions that they make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt

from fls_flow._codecs import Codec, Writer, unfit
from fls_flow._generated import Code
from fls_flow.errors import WireError

__all__ = ["Laid", "Record", "Schema"]

Laid = tuple[list[Any], list[tuple[npt.NDArray[Any], np.dtype[Any]]]]  # items; arrays, dtypes on the wire


class Schema(NamedTuple):
    """How a message class is carried: two classes with equal schemas read each other's buffers."""

    name: str  # top-level package and class
    fingerprint: int  # of `text`
    text: str


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

    def write(self, value: str, code: Writer) -> None:
        with code.block(f"if type({value}) is not {code.uses(self.cls)}"):
            code.line(f"{code.uses(self.refuse)}({value})")
        for field, part in self.parts:
            entry = code.name()
            code.line(f"{entry} = {value}.{field}")
            part.write(entry, code)

    def read(self, code: Code) -> str:
        value = code.name()
        fields = ", ".join(f"{field}={part.read(code)}" for field, part in self.parts)
        with code.block("try"):
            code.line(f"{value} = {code.uses(self.cls)}({fields})")
        with code.block("except Exception as error"):  # whatever a plugin's class raises at what it refuses
            code.line(f"{code.uses(self.refused)}(error)")
        return value

    def refuse(self, value: Any) -> NoReturn:
        """Say what it takes instead."""
        unfit(self.name, value, "exactly this class")

    def refused(self, error: Exception) -> NoReturn:
        """Say why the class does not take what the buffer holds."""
        reason = " ".join(str(error).split())
        raise WireError(f"{self.name} refuses what the buffer holds: {reason}") from error

    def writer(self) -> Callable[[Any], Laid]:
        """The function that gives the items and arrays of a message."""
        code = Writer()
        code.line(f"items, arrays = [{self.name!r}, {self.schema.fingerprint}], []")
        self.write("message", code)
        code.flush()
        code.line("return items, arrays")
        return code.function("write", "message")

    def reader(self) -> Callable[[Callable[[], Any], memoryview, int], tuple[Any, int]]:
        """The function that gives the message whose items `take` gives, and where its arrays end."""
        code = Code()
        code.line(f"return {self.read(code)}, end")
        return code.function("read", "take, view, end")
