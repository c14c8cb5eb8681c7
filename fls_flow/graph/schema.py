"""A JSON Schema of graph files, made of the installed kinds: with it an editor completes and checks them."""

from __future__ import annotations

import dataclasses
import inspect
import math
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from fls_flow.catalog import InPort, Kind, Parameter
from fls_flow.parameters import type_name

__all__ = ["schema"]

Schema = dict[str, Any]

NAME = r"[A-Za-z_-][A-Za-z0-9_-]*"
WIRE: Schema = {"type": "string", "pattern": rf"^\s*{NAME}(\.{NAME})?\s*(@(previous|time))?$"}
MAPPING: Schema = {"type": ["object", "null"]}
PLAIN: Mapping[Any, Schema] = {
    int: {"type": "integer"},
    float: {"type": "number"},
    bool: {"type": "boolean"},
    str: {"type": "string"},
    Path: {"type": "string"},
    type(None): {"type": "null"},
}


def schema(kinds: Iterable[Kind]) -> Schema:
    """What a graph file of these kinds may hold, as a JSON Schema (draft 2020-12).

    A file that `check` finds sound fits it. It sees kinds, ports, parameters and their types, but not what
    needs more than one node or the class itself: whether a wire leads somewhere, whether a value is in range.
    """
    known = sorted(kinds, key=lambda kind: kind.name)
    node: dict[str, Schema] = {
        "use": _uses(known),
        "with": MAPPING,
        "in": MAPPING,
        "on_error": {"enum": ["stop", "skip"]},
    }
    graph: dict[str, Schema] = {
        "graph": {"type": "string", "pattern": f"^{NAME}$"},
        "base": {"type": "string"},
        "nodes": {"type": "object", "propertyNames": {"pattern": f"^{NAME}$"}},
    }
    over_a_base = {"anyOf": [{"type": "null"}, {"$ref": "#/$defs/node"}]}
    whole = {"$ref": "#/$defs/node", "required": ["use"], "properties": {"in": _each(WIRE)}}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "A graph of fls_flow",
        **_object(graph),
        "if": {"required": ["base"]},
        "then": {"properties": {"nodes": _each(over_a_base)}},
        "else": {"required": ["graph", "nodes"], "properties": {"nodes": _each({"$ref": "#/$defs/whole"})}},
        "$defs": {
            "node": {**_object(node), "allOf": _by_kind(known, _possible)},
            "whole": {**whole, "allOf": _by_kind(known, _needed)},
        },
    }


def _uses(kinds: Iterable[Kind]) -> Schema:
    docs = {kind.name: _doc(kind.cls).partition("\n\n")[0] for kind in kinds}
    return {"enum": list(docs), "enumDescriptions": list(docs.values())}  # no keyword, but editors show it


def _by_kind(kinds: Iterable[Kind], of: Callable[[Kind], Schema]) -> list[Schema]:
    """What holds for a node of each kind."""
    is_kind = [{"properties": {"use": {"const": kind.name}}, "required": ["use"]} for kind in kinds]
    return [{"if": one, "then": of(kind)} for one, kind in zip(is_kind, kinds, strict=True)]


def _possible(kind: Kind) -> Schema:
    parameters = {one.name: _parameter(one) for one in kind.parameters}
    wires: Schema = {"properties": {one.name: _wire(one) for one in kind.inputs}}
    if kind.takes_any is None:
        wires["additionalProperties"] = False
    given = {"description": _doc(kind.cls), "properties": parameters, "additionalProperties": False}
    return {"properties": {"with": given, "in": wires}}


def _needed(kind: Kind) -> Schema:
    parameters = [one.name for one in kind.parameters if one.required]
    wires = [one.name for one in kind.inputs if not one.optional]
    named = {key: names for key, names in (("with", parameters), ("in", wires)) if names}
    inside = {key: {"type": "object", "required": names} for key, names in named.items()}
    return {"required": list(named), "properties": inside}


def _wire(port: InPort) -> Schema:
    """A wire as far as its own text shows; `null` takes away one of a base."""
    suffix = "@time" if port.stream else "(@previous)?" if port.nullable else ""
    takes = f"{port.message.__name__}: NODE or NODE.OUTPUT"
    takes += ", with @time" if port.stream else ", @previous or not" if port.nullable else ""
    return {"anyOf": [{"type": "null"}, WIRE], "pattern": f"^[^@]*{suffix}$", "description": takes}


def _parameter(one: Parameter) -> Schema:
    made = {**_of(one.annotation), "description": type_name(one.annotation)}
    default = None if one.required else _plain(one.default)
    return (
        made
        if one.required or (default is None and one.default is not None)
        else {**made, "default": default}
    )


def _of(annotation: Any, above: tuple[type, ...] = ()) -> Schema:
    """What fits an annotation; anything where that cannot be said."""
    origin, inside = get_origin(annotation), get_args(annotation)
    if annotation in PLAIN:
        return dict(PLAIN[annotation])
    if origin is Literal:
        return {"enum": list(inside)}
    if origin in (Union, types.UnionType):
        return {"anyOf": [_of(one, above) for one in inside]}
    if origin is list or (origin is tuple and inside[1:] == (Ellipsis,)):
        return {"type": "array", "items": _of(inside[0], above)}
    if origin is tuple:
        items = [_of(one, above) for one in inside]
        return {"type": "array", "prefixItems": items, "minItems": len(items), "maxItems": len(items)}
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation) and annotation not in above:
        return _dataclass(annotation, (*above, annotation))
    return {}


def _dataclass(cls: type, above: tuple[type, ...]) -> Schema:
    hints = typing.get_type_hints(cls)
    fields = [one for one in dataclasses.fields(cls) if one.init]
    none = dataclasses.MISSING
    needed = [one.name for one in fields if one.default is none and one.default_factory is none]
    inside = {one.name: _of(hints[one.name], above) for one in fields}
    return {**_object(inside), "required": needed, "description": _doc(cls)}


def _object(properties: Mapping[str, Schema]) -> Schema:
    return {"type": "object", "properties": dict(properties), "additionalProperties": False}


def _each(of: Schema) -> Schema:
    return {"additionalProperties": of}


def _doc(cls: type) -> str:
    return inspect.getdoc(cls) or ""


def _plain(value: Any) -> Any:
    """A default as JSON has it; None where it has no such thing."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {one.name: _plain(getattr(value, one.name)) for one in dataclasses.fields(value) if one.init}
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    if isinstance(value, Path):
        return str(value)
    fits = math.isfinite(value) if isinstance(value, float) else isinstance(value, bool | int | str)
    return value if fits else None
