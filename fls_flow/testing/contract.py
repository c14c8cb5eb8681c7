"""Hold a node to the contract that every plugin keeps."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fls_flow import wire
from fls_flow.catalog import Catalog, Kind, describe
from fls_flow.messages import Message
from fls_flow.parameters import resolve
from fls_flow.runtime.answer import named, same_ping
from fls_flow.testing.samples import sample_firings

__all__ = ["check_node"]


def check_node(node: Any, firings: Sequence[Mapping[str, Any]] | None = None) -> None:
    """Hold a node to the contract; raises AssertionError that names the broken rule.

    `node` is an instance, a class whose parameters all have defaults, or the name of an installed kind.
    `firings` are its inputs ping by ping, as keyword arguments; by default small made-up ones, empty messages
    among them. Checked: every ping is answered with the promised types, seq and stamp; inputs are not
    written; a second instance gives the same bits; neither answers nor state follow the memory of the inputs,
    which is overwritten after each firing, as a shared slot is reused; `snapshot()` gives arrays and plain
    values, and `restore()` carries on with the same bits, as often as it is called. A source is checked on
    its first pings, a live one on its ports alone, since what it gives is not its own; a sink writes into a
    folder that is removed.
    """
    instance, kind = _instance(node)
    with TemporaryDirectory() as folder:
        fresh = _Fresh(instance, Path(folder))
        if kind.source:
            if not getattr(instance, "live", False):
                _check_source(fresh, kind)
            return
        firings = sample_firings(kind) if firings is None else firings
        first = _fired(fresh(), kind, firings)
        second = _fired(fresh(), kind, firings)
        _same(first, second, "a second instance gives other bits: seed what is random, keep no state outside")
        third = _fired(fresh(), kind, firings, overwrite=True)
        _same(first, third, "the bits differ when memory is reused: its state shares memory with an input")
        if kind.restorable and kind.outputs:
            _check_restore(fresh, kind, firings, first)


def _instance(node: Any) -> tuple[Any, Kind]:
    if isinstance(node, str):
        node = Catalog().load(node).cls
    if isinstance(node, type):
        kind = describe(node)
        required = [one.name for one in kind.parameters if one.required]
        assert not required, f"{node.__name__} needs {', '.join(required)}: give check_node an instance"
        return node(), kind
    return node, describe(type(node)).decided(node)


class _Fresh:
    """Makes instances with the same parameters; relative paths lie in a folder that each has for itself."""

    def __init__(self, instance: Any, folder: Path) -> None:
        self._type, self._folder, self._made = type(instance), folder, 0
        names = [one.name for one in dataclasses.fields(instance) if one.init]
        self._parameters = {name: getattr(instance, name) for name in names}

    def __call__(self) -> Any:
        self._made += 1
        folder = self._folder / str(self._made)
        folder.mkdir()
        return self._type(**resolve(self._parameters, folder))


Record = list[dict[str, bytes]]


def _fired(
    instance: Any, kind: Kind, firings: Sequence[Mapping[str, Any]], *, overwrite: bool = False
) -> Record:
    """The encoded answers; with `overwrite`, the memory of the inputs is overwritten after each firing."""
    record: Record = []
    kept: list[dict[str, Message]] = []
    try:
        for inputs in firings:
            copies = {port: _Lent(value) for port, value in inputs.items()}
            answer = instance(**{port: lent.value for port, lent in copies.items()})
            outputs = _checked_answer(kind, answer, inputs)
            kept.append(outputs)
            record.append({port: wire.encode(message) for port, message in outputs.items()})
            for port, lent in copies.items():
                assert lent.unchanged(), f"the node writes into its input '{port}'; copy it first"
                if overwrite:
                    lent.overwrite()
            later = [{port: wire.encode(message) for port, message in outputs.items()} for outputs in kept]
            why = "an answer changed after it was given: it shares memory with an input or with the node"
            _same(record, later, f"{why}; copy what you return")
    finally:
        getattr(instance, "close", lambda: None)()
    return record


def _checked_answer(kind: Kind, answer: Any, inputs: Mapping[str, Any]) -> dict[str, Message]:
    ping = next(value for value in inputs.values() if value is not None and not isinstance(value, tuple))
    try:
        outputs = named(kind, answer)
        same_ping(outputs.values(), ping.seq, ping.stamp_ns)
    except Exception as error:
        raise AssertionError(f"ping seq {ping.seq}: {error}") from error
    for port, message in outputs.items():
        for one in dataclasses.fields(message):  # type: ignore[arg-type]  # messages are dataclasses
            value = getattr(message, one.name)
            writable = isinstance(value, np.ndarray) and value.flags.writeable
            assert not writable, f"'{port}.{one.name}' can be written; messages are read-only"
    return outputs


class _Lent:
    """An input whose arrays lie in memory that can be overwritten, as a shared slot is after its release."""

    def __init__(self, value: Any) -> None:
        one_by_one = value if isinstance(value, tuple) else (value,)
        self._buffers = [bytearray(wire.encode(one)) for one in one_by_one if one is not None]
        self._before = [bytes(buffer) for buffer in self._buffers]
        messages = iter([wire.decode(buffer, type(one)) for buffer, one in self._pairs(one_by_one)])
        if isinstance(value, tuple):
            self.value: Any = tuple(messages)
        else:
            self.value = next(messages, None)

    def _pairs(self, values: tuple[Any, ...]) -> Iterator[tuple[bytearray, Any]]:
        return zip(self._buffers, [one for one in values if one is not None], strict=True)

    def unchanged(self) -> bool:
        """Whether every byte is as it was."""
        return all(bytes(now) == before for now, before in zip(self._buffers, self._before, strict=True))

    def overwrite(self) -> None:
        """Fill the memory with another pattern."""
        for buffer in self._buffers:
            buffer[:] = b"\x7f" * len(buffer)  # as floats: huge, so that no sum or maximum misses it


def _same(first: Record, second: Record, why: str) -> None:
    for number, (one, other) in enumerate(zip(first, second, strict=True)):
        for port in one:
            assert one[port] == other[port], f"firing {number}, output '{port}': {why}"


def _check_restore(fresh: _Fresh, kind: Kind, firings: Sequence[Mapping[str, Any]], whole: Record) -> None:
    half = len(firings) // 2
    before, after = fresh(), fresh()
    for inputs in firings[:half]:
        before(**inputs)
    state = before.snapshot()
    assert isinstance(state, dict), f"snapshot() gives {type(state).__name__}; it gives a dict"
    for inputs in firings[half:]:
        before(**inputs)  # a snapshot must not follow the node that it was taken from
    _check_plain(state, "snapshot()")
    after.restore(state)
    carried = _fired(after, kind, firings[half:])
    _same(carried, whole[half:], "after snapshot() and restore() the bits differ: some state is missing")
    again = fresh()
    again.restore(state)  # a stored snapshot may be needed twice
    repeated = _fired(again, kind, firings[half:])
    _same(carried, repeated, "a second restore() of one snapshot gives other bits: restore() must copy it")


def _check_plain(value: Any, where: str) -> None:
    """A snapshot is stored and carried between processes: arrays and plain values alone."""
    if isinstance(value, dict):
        for key, one in value.items():
            assert isinstance(key, str), f"{where} has the key {key!r}; its keys are text"
            _check_plain(one, f"{where}[{key!r}]")
    elif isinstance(value, list | tuple):
        for number, one in enumerate(value):
            _check_plain(one, f"{where}[{number}]")
    elif isinstance(value, np.ndarray):
        assert not value.dtype.hasobject, f"{where} is an array of objects; give numbers"
    else:
        plain = value is None or isinstance(value, bool | int | float | complex | str | bytes | np.generic)
        assert plain, f"{where} is a {type(value).__name__}; give arrays and plain values"


def _check_source(fresh: _Fresh, kind: Kind, pings: int = 5) -> None:
    runs: list[Record] = []
    for _ in range(2):
        record: Record = []
        iterator = iter(fresh()())
        for _, produced in zip(range(pings), iterator, strict=False):
            outputs = named(kind, produced)
            first = next(iter(outputs.values()))
            same_ping(outputs.values(), first.seq, first.stamp_ns)
            record.append({port: wire.encode(message) for port, message in outputs.items()})
        runs.append(record)
    assert len(runs[0]) == len(runs[1]), "a second iteration gives another number of pings"
    _same(runs[0], runs[1], "a second iteration gives other bits: seed what is random")
