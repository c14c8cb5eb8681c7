"""Values of a graph file checked against the fields of a node class, without silent coercion."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, PydanticSchemaGenerationError, ValidationError, create_model

from fls_flow.catalog import Kind, Parameter, suggest
from fls_flow.document import Value, plain
from fls_flow.errors import PluginError, Problem

__all__ = ["Checked", "check", "resolve", "type_name"]

# an int is a float, text is a Path, a list is a tuple: nothing else turns into something else
STRICT = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=False, protected_namespaces=())


@dataclasses.dataclass(frozen=True)
class Checked:
    """Arguments for the node class, and what is wrong with those that were given."""

    arguments: dict[str, Any]
    problems: tuple[Problem, ...]


def check(kind: Kind, given: Mapping[str, Value], node: str, where: str) -> Checked:
    """The arguments that `given` makes for `kind`; every mistake names the node and says what fits.

    Raises PluginError when the class has a parameter whose annotation no graph file can express.
    """
    model = _model(kind)
    document = {name: plain(value) for name, value in given.items()}
    try:
        checked = model.model_validate_json(json.dumps(document))
    except ValidationError as error:
        problems = [_problem(kind, given, node, where, dict(one)) for one in error.errors(include_url=False)]
        return Checked({}, tuple(dict.fromkeys(problems)))
    arguments = {_field(name): getattr(checked, name) for name in checked.model_fields_set}
    if kind.outputs:  # a sink's paths lie under the folder of each run
        arguments = {name: _resolved(value, given[name].folder) for name, value in arguments.items()}
    return _constructed(kind, arguments, given, node, where)


def _constructed(
    kind: Kind, arguments: dict[str, Any], given: Mapping[str, Value], node: str, where: str
) -> Checked:
    try:
        kind.cls(**arguments)
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        named = [value.where for name, value in given.items() if name in text]
        return Checked({}, (Problem(named[0] if named else where, f"node '{node}': {text}"),))
    return Checked(arguments, ())


def _model(kind: Kind) -> type[BaseModel]:
    fields: dict[str, Any] = {}
    for parameter in kind.parameters:
        default = ... if parameter.required else None
        fields[_alias(parameter.name)] = (parameter.annotation, default)
    config = ConfigDict(**STRICT, alias_generator=_field, populate_by_name=False)
    try:
        return create_model(f"{kind.cls.__name__}Parameters", __config__=config, **fields)
    except PydanticSchemaGenerationError as error:
        reason = str(error).splitlines()[0]
        raise PluginError(
            f"kind '{kind.name}' has a parameter that a graph cannot express: {reason}; use int, "
            "float, bool, str, Path, Literal, tuple, Optional, dataclasses; state is field(init=False)"
        ) from error


def _alias(name: str) -> str:
    return f"parameter_{name}"  # a model's attributes must not meet pydantic's own names


def _field(alias: str) -> str:
    return alias.removeprefix("parameter_")


def _problem(kind: Kind, given: Mapping[str, Value], node: str, where: str, error: dict[str, Any]) -> Problem:
    path = [str(part) for part in error["loc"]]
    parameter = next((one for one in kind.parameters if one.name == path[0]), None)
    place, name = _locate(given, path, where)
    if error["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        known = [one.name for one in kind.parameters] if len(path) == 1 else _nested(parameter)
        near = suggest(path[-1], known) or f"; it has {', '.join(known) or 'none'}"
        return Problem(place, f"node '{node}': kind '{kind.name}' has no parameter '{name}'{near}")
    if error["type"] in ("missing", "missing_argument"):
        return Problem(place, f"node '{node}': parameter '{name}' is missing; kind '{kind.name}' needs it")
    expected = type_name(parameter.annotation) if parameter else "?"
    shown = json.dumps(_shown(given, path))
    return Problem(place, f"node '{node}': parameter '{name}' is {shown}; it takes {expected}")


def _locate(given: Mapping[str, Value], path: list[str], where: str) -> tuple[str, str]:
    """Where the deepest value along `path` stands, and its dotted name."""
    value = given.get(path[0])
    if value is None:
        return where, path[0]
    known = [path[0]]
    for part in path[1:]:
        child = value.mapping.get(part)
        if child is None and isinstance(value.data, list) and part.isdigit() and int(part) < len(value.data):
            child = value.data[int(part)]
        if child is not None:
            value = child
            known.append(part)
    if path[-1] != known[-1] and isinstance(value.data, dict):
        known.append(path[-1])
    return value.where, ".".join(known)


def _shown(given: Mapping[str, Value], path: list[str]) -> Any:
    shown = plain(given[path[0]])
    text = json.dumps(shown)
    return shown if len(text) <= 80 else text[:77] + "..."


def _nested(parameter: Parameter | None) -> list[str]:
    if parameter is None or not dataclasses.is_dataclass(parameter.annotation):
        return []
    return [field.name for field in dataclasses.fields(parameter.annotation)]


def type_name(annotation: Any) -> str:
    """An annotation as its author wrote it."""
    if isinstance(annotation, type) and not hasattr(annotation, "__args__"):
        return annotation.__name__
    return str(annotation).replace("typing.", "").replace("NoneType", "None").replace("pathlib.", "")


def resolve(arguments: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The arguments with relative paths laid under `folder`."""
    return {name: _resolved(value, folder) for name, value in arguments.items()}


def _resolved(value: Any, folder: Path | None) -> Any:
    if isinstance(value, Path):
        return value if value.is_absolute() else (folder or Path.cwd()) / value
    if isinstance(value, tuple):
        return tuple(_resolved(one, folder) for one in value)
    return value
