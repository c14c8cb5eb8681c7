"""From the field annotations of a message class to the codecs that carry its values."""

from __future__ import annotations

import enum
import types
from collections.abc import Callable
from dataclasses import Field, fields, is_dataclass
from functools import cache
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
from xxhash import xxh3_64_intdigest

from fls_flow._array_codec import DTYPES, Array
from fls_flow._codecs import Choice, Codec, Many, Optional, Scalar, Tuple
from fls_flow._records import Laid, Record, Schema
from fls_flow.errors import WireError
from fls_flow.messages import is_message_type

__all__ = ["Carrier", "carrier"]


class Carrier(NamedTuple):
    """What carries the messages of a class."""

    schema: Schema
    write: Callable[[Any], Laid]  # a message's items and arrays
    read: Callable[[Callable[[], Any], memoryview, int], tuple[Any, int]]  # the message; where its arrays end


@cache
def carrier(cls: type) -> Carrier:
    """What carries messages of `cls`; WireError that names the first field which cannot be carried."""
    if not is_message_type(cls):
        raise WireError(f"{cls!r} is no message: a frozen dataclass that begins with seq and stamp_ns")
    record = _record_of(cls, ())
    return Carrier(record.schema, record.writer(), record.reader())


def _record_of(cls: type, outer: tuple[type, ...]) -> Record:
    name = f"{cls.__module__.partition('.')[0]}.{cls.__qualname__}"
    if cls in outer:
        raise WireError(f"{name} contains itself: the wire carries no recursive class")
    try:
        hints = get_type_hints(cls)
    except Exception as error:  # an annotation can fail in any way
        raise WireError(f"{name} has annotations that cannot be resolved at module level: {error}") from error
    parts = tuple(
        (spec.name, _codec(hints[spec.name], f"{name}.{spec.name}", spec, (*outer, cls)))
        for spec in fields(cls)
        if spec.init
    )
    if not parts:
        raise WireError(f"{name} has no fields to carry")
    text = f"{name}({','.join(f'{field}:{part.text}' for field, part in parts)})"
    return Record(cls, Schema(name, xxh3_64_intdigest(text.encode()), text), parts)


def _codec(annotation: Any, where: str, spec: Field[Any], outer: tuple[type, ...]) -> Codec:
    """What carries values of `annotation`; WireError that names the field when nothing does."""
    annotation = getattr(annotation, "__value__", annotation)  # of a `type` statement
    if annotation in (bool, int, float, str):
        return Scalar(where, annotation)
    origin = get_origin(annotation) or annotation
    if origin in (Union, types.UnionType):
        return _union(get_args(annotation), where, spec, outer)
    if origin is np.ndarray:
        return _array((annotation,), where, spec)
    if origin is tuple:
        return _tuple(get_args(annotation), where, spec, outer)
    if origin is Literal:
        return _choice(where, {value: value for value in get_args(annotation)})
    if isinstance(annotation, enum.EnumMeta):
        return _choice(where, {member.value: member for member in list[enum.Enum](annotation)})
    if isinstance(annotation, type) and is_dataclass(annotation):
        return _record_of(annotation, outer)
    raise _unfit(where, annotation)


def _unfit(where: str, annotation: Any) -> WireError:
    carried = "arrays, bool, int, float, str, Literal, enums, None, tuples and dataclasses of those"
    return WireError(f"{where} is annotated {annotation}: the wire carries {carried}")


def _union(args: tuple[Any, ...], where: str, spec: Field[Any], outer: tuple[type, ...]) -> Codec:
    rest = tuple(arg for arg in args if arg is not types.NoneType)
    if all((get_origin(arg) or arg) is np.ndarray for arg in rest):
        inner: Codec = _array(rest, where, spec)
    elif len(rest) == 1:
        inner = _codec(rest[0], where, spec, outer)
    else:
        raise _unfit(where, " | ".join(map(str, args)))
    return inner if len(rest) == len(args) else Optional(inner)


def _tuple(args: tuple[Any, ...], where: str, spec: Field[Any], outer: tuple[type, ...]) -> Codec:
    if not args:
        raise _unfit(where, "tuple without its parts")
    if len(args) == 2 and args[1] is Ellipsis:
        return Many(where, _codec(args[0], where, spec, outer))
    return Tuple(where, tuple(_codec(arg, where, spec, outer) for arg in args))


def _choice(where: str, options: dict[Any, Any]) -> Choice:
    if not options or not all(type(plain) in (int, str) for plain in options):
        raise _unfit(where, f"a choice of {list(options)}")
    return Choice(where, options)


def _array(annotations: tuple[Any, ...], where: str, spec: Field[Any]) -> Array:
    """By what `fls_flow.array` declares; without it by the annotation."""
    shape = spec.metadata.get("shape")
    if shape is None:
        allows = _any_of(annotations)
        dtypes = {code: dtype for code, dtype in DTYPES.items() if allows(dtype)}
        dims = ""
    else:
        dtypes = {code: dtype for code, dtype in DTYPES.items() if dtype in shape.dtypes}
        dims = "(" + ",".join(map(str, shape.dims)) + ")"
    if not dtypes:
        takes = " | ".join(map(str, annotations))
        raise WireError(f"{where} is annotated {takes}: the wire carries {', '.join(DTYPES)}")
    return Array(where, dtypes, dims)


def _any_of(annotations: tuple[Any, ...]) -> Callable[[np.dtype[Any]], bool]:
    scalars = tuple(map(_scalar_of, annotations))
    return lambda dtype: issubclass(dtype.type, scalars)


def _scalar_of(annotation: Any) -> type[np.generic]:
    """The X of np.ndarray[..., np.dtype[X]]; np.generic when the annotation leaves it open."""
    for dtype in get_args(annotation)[1:]:
        for scalar in get_args(dtype):
            if isinstance(scalar, type) and issubclass(scalar, np.generic):
                return scalar
    return np.generic
