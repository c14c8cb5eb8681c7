"""The array fields of messages: declared once, checked and read-only from construction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from fls_flow._generated import Code

__all__ = ["Sealed", "Shape", "array"]


@dataclass(frozen=True, slots=True)
class Shape:
    """What an array field takes."""

    dtypes: tuple[np.dtype[Any], ...]
    dims: tuple[int | str, ...]


def array(dtype: npt.DTypeLike | tuple[npt.DTypeLike, ...], *dims: int | str, optional: bool = False) -> Any:
    """A message's array field: its dtype (or the dtypes allowed) and shape; by default it is empty.

    A named dimension (`"n"`) is equal in all arrays of one message; a number is that length. An `optional`
    one may be None, and is by default.
    """
    allowed = tuple(np.dtype(d) for d in (dtype if isinstance(dtype, tuple) else (dtype,)))
    empty = tuple(0 if isinstance(d, str) else d for d in dims)
    shape = Shape(allowed, dims)
    if optional:
        return field(default=None, metadata={"shape": shape})
    return field(default_factory=lambda: np.zeros(empty, allowed[0]), metadata={"shape": shape})


class Sealed:
    """Base of dataclasses with `array` fields: checks shapes and makes the arrays read-only.

    Raises ValueError that names the field, when an array has another shape than the class declares.
    """

    def __post_init__(self) -> None:
        _sealer(cast(Any, type(self)))(self)


@cache
def _shapes(cls: Any) -> dict[str, Shape]:
    """The array fields of a class."""
    return {one.name: one.metadata["shape"] for one in fields(cls) if "shape" in one.metadata}


@cache
def _sealer(cls: Any) -> Callable[[Any], None]:
    """What checks and seals the arrays of a message: each goes through it, on both sides of a link."""
    code, shapes = Code(), _shapes(cls)
    named = dict.fromkeys(dim for shape in shapes.values() for dim in shape.dims if isinstance(dim, str))
    variables: dict[int | str, str] = {dim: code.name() for dim in named}
    for variable in variables.values():
        code.line(f"{variable} = -1")  # until an array says how long it is
    for name, shape in shapes.items():
        code.line(f"value = self.{name}")
        with code.block("if value is not None"):
            _seal(code, name, shape, variables)
    code.line("return")
    return code.function("seal", "self")


def _seal(code: Code, name: str, shape: Shape, variables: dict[int | str, str]) -> None:
    """Add the lines for one array, whose named dimensions have `variables`."""
    others = " and ".join(f"value.dtype is not {code.uses(dtype)}" for dtype in shape.dtypes)
    with code.block(f"if type(value) is not {code.uses(np.ndarray)} or {others}"):
        code.line(f"value = {code.uses(_converted)}(self, {name!r}, value, {code.uses(shape)})")
    code.line("shape = value.shape")
    misfit = [f"len(shape) != {len(shape.dims)}"]
    for axis, dim in enumerate(shape.dims):
        length = f"shape[{axis}]"
        known = variables.get(dim)
        expected = f"({known} if {known} >= 0 else ({known} := {length}))" if known else str(dim)
        misfit.append(f"{length} != {expected}")
    with code.block(f"if {' or '.join(misfit)}"):
        code.line(f"raise {code.uses(_misfit)}(self, {name!r}, shape, {shape.dims!r})")
    code.line("value = value.view()")
    code.line("value.setflags(write=False)")
    code.line(f"{code.uses(object.__setattr__)}(self, {name!r}, value)")


def _converted(owner: object, name: str, value: Any, shape: Shape) -> npt.NDArray[Any]:
    """The value as a plain array of a dtype that the field takes."""
    given = np.asarray(value)
    if given.dtype in shape.dtypes:
        return given
    if len(shape.dtypes) > 1:
        allowed = ", ".join(map(str, shape.dtypes))
        raise ValueError(f"{type(owner).__name__}.{name} has dtype {given.dtype}; it takes {allowed}")
    return given.astype(shape.dtypes[0])


def _misfit(owner: object, name: str, given: tuple[int, ...], dims: tuple[int | str, ...]) -> ValueError:
    """What to say of an array that has not the shape of its field, or not that of an earlier field."""
    takes = "(" + ", ".join(map(str, dims)) + ("," if len(dims) == 1 else "") + ")"
    text = f"{type(owner).__name__}.{name} has shape {given}; it takes {takes}"
    if len(given) == len(dims):
        first = _first_lengths(owner)
        for length, dim in zip(given, dims, strict=True):
            by, expected = first.get(dim, (name, length))
            if expected != length and by != name:
                return ValueError(f"{text}: '{by}' has {dim} = {expected}")
    return ValueError(text)


def _first_lengths(owner: object) -> dict[int | str, tuple[str, int]]:
    """Of each named dimension, the first field that has it, and its length there."""
    first: dict[int | str, tuple[str, int]] = {}
    for name, shape in _shapes(cast(Any, type(owner))).items():
        value = getattr(owner, name)
        if value is not None:
            for length, dim in zip(np.shape(value), shape.dims, strict=False):
                if isinstance(dim, str):
                    first.setdefault(dim, (name, length))
    return first
