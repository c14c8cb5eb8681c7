"""Values of a graph file checked against the fields of a node class, without silent coercion."""

from __future__ import annotations

import dataclasses
import json
import re
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, PydanticUserError, ValidationError, create_model

from fls_flow.catalog import Kind, Parameter, suggest
from fls_flow.document import Value, plain, shown
from fls_flow.errors import PluginError, Problem

__all__ = ["Checked", "Models", "check", "resolve", "type_name"]

# an int is a float, text is a Path, a list is a tuple: nothing else turns into something else
STRICT = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=False, protected_namespaces=())
# as pydantic calls them: in a model, in a dataclass
UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
MISSING = ("missing", "missing_argument")


Models = dict[type, type[BaseModel]]  # by node class


@dataclasses.dataclass(frozen=True)
class Checked:
    """Arguments for the node class, and what is wrong with those that were given."""

    arguments: dict[str, Any]
    problems: tuple[Problem, ...]


def check(
    kind: Kind, given: Mapping[str, Value], node: str, where: str, models: Models | None = None
) -> Checked:
    """The arguments that `given` makes for `kind`; every mistake names the node and says what fits.

    `models` keeps what is costly to make of a class, for its next node. Raises PluginError when the class has
    a parameter whose annotation no graph file can express.
    """
    models = {} if models is None else models
    if kind.cls not in models:
        models[kind.cls] = _model(kind)
    model = models[kind.cls]
    document = {name: plain(value) for name, value in given.items()}
    try:
        checked = model.model_validate_json(json.dumps(document))
    except ValidationError as error:
        problems = [_problem(kind, given, node, where, one) for one in _causes(error)]
        return Checked({}, tuple(dict.fromkeys(problems)))
    except (Exception, SystemExit) as error:  # a nested dataclass raised something else than ValueError
        return Checked({}, (_refused(error, given, node, where),))
    arguments = {_field(name): getattr(checked, name) for name in checked.model_fields_set}
    if kind.outputs:  # a sink's paths lie under the folder of each run
        arguments = {name: _resolved(value, given[name].folder) for name, value in arguments.items()}
    try:
        kind.cls(**arguments)
    except (Exception, SystemExit) as error:
        return Checked({}, (_refused(error, given, node, where),))
    return Checked(arguments, ())


def _refused(error: BaseException, given: Mapping[str, Value], node: str, where: str) -> Problem:
    """What the class itself says, at the first parameter that it names as a word."""
    text = " ".join(str(error).split()) or type(error).__name__
    text = f"SystemExit: {text}" if isinstance(error, SystemExit) else text
    named = ((re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text), value) for name, value in given.items())
    found = sorted((match.start(), value.where) for match, value in named if match)
    return Problem(found[0][1] if found else where, f"node '{node}': {text}")


def _model(kind: Kind) -> type[BaseModel]:
    fields: dict[str, Any] = {}
    for parameter in kind.parameters:
        default = ... if parameter.required else None
        fields[_alias(parameter.name)] = (parameter.annotation, Field(default, alias=parameter.name))
    try:
        return create_model(f"{kind.cls.__name__}Parameters", __config__=STRICT, **fields)
    except (PydanticUserError, TypeError, NameError) as error:
        reason = str(error).splitlines()[0]
        raise PluginError(
            f"kind '{kind.name}' has a parameter that a graph cannot express: {reason}; use int, "
            "float, bool, str, Path, Literal, tuple, Optional, dataclasses; state is field(init=False)"
        ) from error


def _alias(name: str) -> str:
    return f"parameter_{name}"  # a model's attributes must not meet pydantic's own names


def _field(alias: str) -> str:
    return alias.removeprefix("parameter_")


def _causes(error: ValidationError) -> list[dict[str, Any]]:
    """The errors, without a missing name that is there with another spelling."""
    errors: list[dict[str, Any]] = [dict(one) for one in error.errors(include_url=False)]
    unknown = [one["loc"] for one in errors if one["type"] in UNKNOWN]
    return [
        one
        for one in errors
        if one["type"] not in MISSING
        or not suggest(str(one["loc"][-1]), [str(loc[-1]) for loc in unknown if loc[:-1] == one["loc"][:-1]])
    ]


def _problem(kind: Kind, given: Mapping[str, Value], node: str, where: str, error: dict[str, Any]) -> Problem:
    path = [str(part) for part in error["loc"]]
    parameter = next((one for one in kind.parameters if one.name == path[0]), None)
    place, name, parent = _locate(given, path, where)
    if error["type"] in UNKNOWN:
        known = [one.name for one in kind.parameters] if len(path) == 1 else _nested(parameter, path)
        near = suggest(path[-1], known) or f"; it has {', '.join(known) or 'none'}"
        return Problem(place, f"node '{node}': kind '{kind.name}' has no parameter '{name}'{near}")
    if error["type"] in MISSING and not isinstance(parent, list):
        return Problem(place, f"node '{node}': parameter '{name}' is missing; kind '{kind.name}' needs it")
    if error["type"] in ("value_error", "assertion_error"):  # of a nested dataclass
        return Problem(place, f"node '{node}': parameter '{name}': {error['ctx']['error']}")
    expected = type_name(parameter.annotation) if parameter else "?"
    near = suggest(str(given[path[0]].data), _words(parameter.annotation) if parameter else [])
    text = f"parameter '{path[0]}' is {shown(given[path[0]])}; it takes {expected}{near}"
    return Problem(place, f"node '{node}': {text}")


def _words(annotation: Any) -> list[str]:
    """The words that an annotation allows, in Literals anywhere in it."""
    inside = typing.get_args(annotation)
    if typing.get_origin(annotation) is typing.Literal:
        return [one for one in inside if isinstance(one, str)]
    return [word for one in inside for word in _words(one)]


def _locate(given: Mapping[str, Value], path: list[str], where: str) -> tuple[str, str, Any]:
    """Where the deepest value along `path` stands, its dotted name, and the data that it would stand in."""
    value = given.get(path[0])
    if value is None:
        return where, path[0], None
    known, parent = [path[0]], None
    for part in path[1:]:
        parent = value.data
        child = value.mapping.get(part)
        if child is None and isinstance(value.data, list) and part.isdigit() and int(part) < len(value.data):
            child = value.data[int(part)]
        if child is not None:
            value = child
            known.append(part)
        elif isinstance(parent, dict) and part == path[-1]:
            known.append(part)
    return value.where, ".".join(known), parent


def _nested(parameter: Parameter | None, path: list[str]) -> list[str]:
    """The fields that the dataclasses at `path` inside a parameter have."""
    inside = _dataclasses(parameter.annotation) if parameter is not None else []
    for part in path[1:-1]:
        below = [hints[part] for hints in map(typing.get_type_hints, inside) if part in hints]
        inside = [one for hint in below for one in _dataclasses(hint)] or inside
    return [field.name for one in inside for field in dataclasses.fields(one) if field.init]


def _dataclasses(annotation: Any) -> list[type]:
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        return [annotation]
    return [one for argument in typing.get_args(annotation) for one in _dataclasses(argument)]


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
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        inside = {one.name: getattr(value, one.name) for one in dataclasses.fields(value) if one.init}
        laid = {name: _resolved(one, folder) for name, one in inside.items()}
        return value if laid == inside else dataclasses.replace(value, **laid)
    return value
