"""The kinds that are installed: listing them imports nothing, loading one imports its module alone.

A kind is a plain dataclass: its fields are the parameters, the annotations of `__call__` are the ports.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import inspect
import re
import types
import typing
from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Union, get_args, get_origin

import pluggy

from fls_flow import hookspecs
from fls_flow.errors import PluginError
from fls_flow.messages import Message, is_message_type

__all__ = ["Catalog", "InPort", "Kind", "Listing", "OutPort", "Parameter", "describe", "suggest"]


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


def suggest(name: str, among: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the name nearest to `name`, or nothing."""
    near = get_close_matches(name, list(among), n=1, cutoff=0.6)
    return f"; did you mean '{near[0]}'?" if near else ""


class Catalog:
    """The installed kinds, and those that a test or a notebook adds as classes."""

    def __init__(self, extra: Mapping[str, type] | None = None) -> None:
        self._extra = dict(extra or {})
        self._loaded: dict[str, Kind] = {}

    def listings(self) -> tuple[Listing, ...]:
        """Every installed kind, sorted by name; a name that two distributions claim stands twice."""
        return tuple(listing for listing, _ in self._entries)

    def names(self) -> list[str]:
        """The names of all kinds."""
        return sorted({one.kind for one in self.listings()} | set(self._extra))

    def load(self, name: str) -> Kind:
        """The kind of that name.

        Raises PluginError when there is none, when two distributions claim it, or when its module breaks the
        contract.
        """
        if name not in self._loaded:
            extra = self._extra.get(name)
            self._loaded[name] = self._installed(name) if extra is None else describe(extra, name)
        return self._loaded[name]

    def _installed(self, name: str) -> Kind:
        entries = [(listing, entry) for listing, entry in self._entries if listing.kind == name]
        if not entries:
            near = suggest(name, self.names())
            raise PluginError(f"unknown kind '{name}'{near or '; fls-flow plugins lists the installed ones'}")
        if len(entries) > 1:
            owners = " and ".join(_owner(listing) for listing, _ in entries)
            raise PluginError(f"kind '{name}' is claimed by {owners}; uninstall one of them")
        listing, entry = entries[0]
        return dataclasses.replace(describe(_hooked(entry, listing), name), listing=listing)

    @functools.cached_property
    def _entries(self) -> list[tuple[Listing, importlib.metadata.EntryPoint]]:
        """What is installed, read from the disk once."""
        found = [(_listing(one), one) for one in importlib.metadata.entry_points(group=hookspecs.PROJECT)]
        return sorted(found, key=lambda one: (one[0].kind, one[0].distribution, one[0].module))


def _listing(entry: importlib.metadata.EntryPoint) -> Listing:
    read = entry.dist.metadata if entry.dist else None  # each look at it reads the file anew
    metadata = {key: read[key] for key in read} if read else {}
    return Listing(
        entry.name, metadata.get("Name", "unknown"), metadata.get("Version", "unknown"), entry.value
    )


def _owner(listing: Listing) -> str:
    return f"{listing.distribution} {listing.version} ({listing.module})"


def _hooked(entry: importlib.metadata.EntryPoint, listing: Listing) -> type:
    """The class that the module's `fls_node` hook returns; each module gets a plugin manager of its own."""
    blame = f"kind '{listing.kind}' of {_owner(listing)}"
    try:
        module = entry.load()
    except (Exception, SystemExit) as error:
        cause = _cause(error)
        raise PluginError(f"{blame} cannot be imported: {cause}; mend or uninstall it") from error
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    try:
        manager.register(module, name=listing.module)
        manager.check_pending()
        found = manager.hook.fls_node()
    except pluggy.PluginValidationError as error:
        reason = " ".join(str(error).split())
        raise PluginError(f"{blame} has a wrong hook: {reason}; the hook is fls_node()") from error
    except Exception as error:
        raise PluginError(f"{blame}: fls_node() raised {_cause(error)}; mend or uninstall it") from error
    if len(found) != 1 or not isinstance(found[0], type):
        raise PluginError(f"{blame} has no `@hookimpl def fls_node()` that returns a class")
    return found[0]


def _cause(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


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
    except Exception as error:
        raise PluginError(f"{blame}: the default of '{field.name}' raised {_cause(error)}") from error


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
