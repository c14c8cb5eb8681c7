"""What a node class says of itself: its fields are parameters, the annotations of `__call__` are ports."""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Union, get_args, get_origin

from fls_flow.errors import PluginError
from fls_flow.messages import Message, is_message_type

__all__ = ["InPort", "Kind", "Listing", "OutPort", "Parameter", "cause_of", "describe"]


@dataclass(frozen=True, slots=True)
class Listing:
    """One installed kind, as its distribution announces it."""

    kind: str
    distribution: str
    version: str
    module: str


@dataclass(frozen=True, slots=True)
class Parameter:
    """A field of the dataclass that a graph may set."""

    name: str
    annotation: Any
    required: bool
    default: Any = None


@dataclass(frozen=True, slots=True)
class InPort:
    """An argument of `__call__`."""

    name: str
    message: Any  # a message class, or Message for any
    optional: bool = False  # has a default, so that it may be left unwired
    nullable: bool = False  # `X | None`: takes `@previous`
    stream: bool = False  # `tuple[X, ...]`: takes `@time`


@dataclass(frozen=True, slots=True)
class OutPort:
    """What `__call__` returns, or one field of it."""

    name: str
    message: type


@dataclass(frozen=True)
class Kind:
    """A node class and what its signature says."""

    name: str
    cls: type
    parameters: tuple[Parameter, ...]
    inputs: tuple[InPort, ...]
    outputs: tuple[OutPort, ...]
    takes_any: Any = None  # the message type of `**ports`
    bundle: type | None = None  # the NamedTuple of several outputs
    source: bool = False
    listing: Listing | None = None

    @property
    def role(self) -> str:
        """Source, sink, or what it makes."""
        if self.source:
            return "source"
        if not self.outputs:
            return "sink"
        made = {port.message.__name__ for port in self.outputs}
        roles = {
            "Tracks": "tracker",
            "Detections": "detector",
            "Classes": "classifier",
            "Features": "features",
        }
        return next((role for name, role in roles.items() if name in made), "filter")

    @property
    def undecided(self) -> bool:
        """Whether an instance says of which class its messages are (`output_type`)."""
        return any(port.message is Message for port in self.outputs)

    def decided(self, instance: Any) -> Kind:
        """The kind with the output that an instance of it has; raises what its `output_type` raises."""
        if not self.undecided:
            return self
        message = instance.output_type()
        if not is_message_type(message):
            raise PluginError(f"kind '{self.name}': output_type() gives {_name(message)}, no message class")
        return dataclasses.replace(self, outputs=(OutPort(_snake(message.__name__), message),))

    @property
    def stateful(self) -> bool:
        """Whether instances keep something from ping to ping."""
        return any(not field.init for field in dataclasses.fields(self.cls))

    @property
    def restorable(self) -> bool:
        """Whether the state can be taken and put back."""
        return hasattr(self.cls, "snapshot") and hasattr(self.cls, "restore")

    def input(self, name: str) -> InPort | None:
        """The input of that name, `**ports` included."""
        named = next((port for port in self.inputs if port.name == name), None)
        return InPort(name, self.takes_any) if named is None and self.takes_any is not None else named

    def output(self, name: str) -> OutPort | None:
        """The output of that name."""
        return next((port for port in self.outputs if port.name == name), None)


def describe(cls: type, name: str | None = None) -> Kind:
    """Parameters, ports and role of a node class, from its fields and its `__call__`.

    Raises PluginError that says what the class lacks.
    """
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        raise PluginError(f"kind '{name or cls}' is not a dataclass; put @dataclass over its class")
    blame = f"kind '{name}' ({cls.__module__}.{cls.__qualname__})" if name else cls.__qualname__
    if not any("__call__" in base.__dict__ for base in cls.__mro__[:-1]):
        raise PluginError(f"{blame} has no __call__")
    fields, hints = _hints(cls, blame), _hints(cls.__call__, blame)
    inputs, takes_any = _inputs(cls, hints, blame)
    if "return" not in hints:
        raise PluginError(f"{blame}: annotate what __call__ returns (None for a sink)")
    source = not inputs and takes_any is None
    returned = _yielded(hints["return"], blame) if source else hints["return"]
    undecided = source and returned is Message and hasattr(cls, "output_type")
    outputs, bundle = ((OutPort("message", Message),), None) if undecided else _outputs(returned, blame)
    if source and not outputs:
        raise PluginError(f"{blame} has neither inputs nor outputs")
    return Kind(
        name or _snake(cls.__name__).replace("_", "-"),
        cls,
        tuple(
            _parameter(field, fields[field.name], blame) for field in dataclasses.fields(cls) if field.init
        ),
        inputs,
        outputs,
        takes_any,
        bundle,
        source,
    )


def _hints(annotated: Any, blame: str) -> dict[str, Any]:
    try:
        return typing.get_type_hints(annotated)
    except Exception as error:
        raise PluginError(f"{blame} has an annotation that cannot be resolved: {error}") from error


def _parameter(field: dataclasses.Field[Any], annotation: Any, blame: str) -> Parameter:
    if field.default is not dataclasses.MISSING:
        return Parameter(field.name, annotation, False, field.default)
    if field.default_factory is dataclasses.MISSING:
        return Parameter(field.name, annotation, True)
    try:
        return Parameter(field.name, annotation, False, field.default_factory())
    except (Exception, SystemExit) as error:
        raise PluginError(f"{blame}: the default of '{field.name}' raised {cause_of(error)}") from error


def _inputs(cls: type, hints: dict[str, Any], blame: str) -> tuple[tuple[InPort, ...], Any]:
    ports: list[InPort] = []
    takes_any = None
    signature = inspect.signature(cls.__call__)
    for parameter in list(signature.parameters.values())[1:]:
        if parameter.name not in hints:
            raise PluginError(f"{blame}: annotate the input '{parameter.name}' with its message class")
        if parameter.kind is inspect.Parameter.VAR_POSITIONAL:
            raise PluginError(
                f"{blame}: inputs have names; '*{parameter.name}' has none, use '**{parameter.name}'"
            )
        if parameter.kind is inspect.Parameter.POSITIONAL_ONLY:
            raise PluginError(f"{blame}: '{parameter.name}' is positional-only; remove the '/' after it")
        port = _in_port(parameter, hints[parameter.name], blame)
        if parameter.kind is inspect.Parameter.VAR_KEYWORD:
            if port.nullable or port.stream:
                raise PluginError(f"{blame}: annotate '**{parameter.name}' with a message class or Message")
            takes_any = port.message
        else:
            ports.append(port)
    return tuple(ports), takes_any


def _in_port(parameter: inspect.Parameter, hint: Any, blame: str) -> InPort:
    arguments = [one for one in get_args(hint) if one is not type(None)]
    nullable = get_origin(hint) in (Union, types.UnionType) and len(arguments) < len(get_args(hint))
    stream = get_origin(hint) is tuple and len(arguments) == 2 and arguments[1] is Ellipsis
    message = arguments[0] if stream or (nullable and len(arguments) == 1) else hint
    if message is not Message and not is_message_type(message):
        raise PluginError(
            f"{blame}: the input '{parameter.name}' is annotated {_name(hint)}; it takes a message class X, "
            "X | None, or tuple[X, ...] for @time"
        )
    optional = parameter.default is not inspect.Parameter.empty
    return InPort(parameter.name, message, optional, nullable, stream)


def _yielded(hint: Any, blame: str) -> Any:
    if get_origin(hint) in (Iterator, Iterable, Generator) and get_args(hint):
        return get_args(hint)[0]
    raise PluginError(f"{blame} has no inputs, so it is a source: let __call__ return Iterator[...]")


def _outputs(hint: Any, blame: str) -> tuple[tuple[OutPort, ...], type | None]:
    if hint is type(None) or hint is None:
        return (), None
    if is_message_type(hint):
        return (OutPort(_snake(hint.__name__), hint),), None
    if isinstance(hint, type) and issubclass(hint, tuple) and hasattr(hint, "_fields"):
        hints = _hints(hint, blame)
        ports = tuple(OutPort(name, hints.get(name, object)) for name in hint._fields)
        wrong = [port.name for port in ports if not is_message_type(port.message)]
        if ports and not wrong:
            return ports, hint
        if not ports:
            raise PluginError(f"{blame} returns {_name(hint)}, which has no fields; None makes a sink")
        raise PluginError(f"{blame}: the output '{wrong[0]}' is not annotated with a message class")
    raise PluginError(
        f"{blame} returns {_name(hint)}; it returns a message, a NamedTuple of messages or None"
    )


def _snake(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def _name(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) else str(hint)


def cause_of(error: BaseException) -> str:
    """An exception on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
