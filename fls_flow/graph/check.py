"""Every check of a graph before anything starts: kinds, parameters, wires, order, clock, loose ends."""

from __future__ import annotations

import dataclasses
import os.path
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fls_flow import parameters
from fls_flow.catalog import Catalog, InPort, Kind, suggest
from fls_flow.document import Value, shown
from fls_flow.errors import FlsFlowError, GraphError, PluginError, Problem
from fls_flow.graph.model import Graph, Input, Mode, Node
from fls_flow.graph.read import Draft, Source, giver
from fls_flow.messages import Message

__all__ = ["checked"]


@dataclass
class _Check:
    """What the checks know of a graph while they go through it."""

    source: Source
    catalog: Catalog
    kinds: dict[str, Kind] = field(default_factory=dict)
    wires: dict[str, list[Input]] = field(default_factory=dict)
    arguments: dict[str, dict[str, Any]] = field(default_factory=dict)
    unwired: list[InPort] = field(default_factory=list)  # whose giver is unknown
    places: dict[tuple[str, str], str] = field(default_factory=dict)  # (node, port) -> where its wire stands

    def problem(self, where: str, what: str) -> None:
        self.source.problems.append(Problem(where, what))

    def note(self, what: str) -> None:
        self.source.notes.append(what)


def checked(source: Source, catalog: Catalog, *, sinkless: bool = False) -> Graph:
    """The graph, ready to run.

    Raises GraphError with every problem, those of `source` included. With `sinkless`, a graph may end in
    outputs that nobody takes.
    """
    check = _Check(source, catalog)
    for draft in source.drafts.values():
        _kind(check, draft)
    for draft in source.drafts.values():
        if draft.name in check.kinds:
            _wires(check, draft, check.kinds[draft.name])
    if not sinkless:
        _loose_ends(check)
    for name, kind in check.kinds.items():
        _parameters(check, source.drafts[name], kind)
        _on_error(check, source.drafts[name], kind)
    clock = _clock(check)
    order = _order(check)
    _same_file(check)
    if not source.drafts and not source.problems:
        check.problem(source.where, "the graph has no nodes")
    if source.problems:
        raise GraphError(sorted(dict.fromkeys(source.problems), key=_place))
    return Graph(
        source.name, tuple(_node(check, name) for name in order), clock, source.path, tuple(source.notes)
    )


def _place(problem: Problem) -> tuple[str, int]:
    file, _, line = problem.where.rpartition(":")
    return (file, int(line)) if file and line.isdigit() else (problem.where, 0)


def _node(check: _Check, name: str) -> Node:
    draft = check.source.drafts[name]
    on_error = "skip" if draft.on_error is not None and draft.on_error.data == "skip" else "stop"
    wires = tuple(check.wires[name])
    return Node(name, check.kinds[name], check.arguments[name], wires, on_error, draft.where)  # type: ignore[arg-type]


def _kind(check: _Check, draft: Draft) -> None:
    if "node" in draft.faulty:
        return
    if draft.use is None:
        check.problem(draft.where, f"node '{draft.name}' has no 'use'; name its kind")
    elif not isinstance(draft.use.data, str):
        check.problem(draft.use.where, f"node '{draft.name}': 'use' is {shown(draft.use)}; it names a kind")
    else:
        try:
            kind = check.catalog.load(draft.use.data)
        except PluginError as error:
            check.problem(draft.use.where, f"node '{draft.name}': {error}")
            return
        decided = _decided(check, draft, kind) if kind.undecided else kind
        if decided is not None:
            check.kinds[draft.name] = decided


def _decided(check: _Check, draft: Draft, kind: Kind) -> Kind | None:
    """The kind with the output that its parameters make, such as of a file; None after a problem."""
    known = {one.name for one in kind.parameters}
    given = {
        name: value for name, value in draft.given.items() if name in known or name not in draft.inherited
    }
    result = parameters.check(kind, given, draft.name, draft.where)
    check.source.problems.extend(result.problems)
    if result.problems or "with" in draft.faulty:
        return None
    try:
        return kind.decided(kind.cls(**result.arguments))
    except FlsFlowError as error:
        check.problem(draft.where, f"node '{draft.name}': {error}")
        return None


# --- wires ---------------------------------------------------------------------------------------


def _wires(check: _Check, draft: Draft, kind: Kind) -> None:
    before = len(check.source.problems)
    written = {port: value for port, value in draft.wires.items() if not _fallen(check, draft, kind, port)}
    tried = [_wire(check, draft, kind, port, value) for port, value in written.items()]
    wires = [wire for wire in tried if wire is not None]
    check.wires[draft.name] = wires
    failed = [port for port, wire in zip(written, tried, strict=True) if wire is None]
    check.unwired += [
        port for name in failed if (port := kind.input(name)) and not _meant(check, draft, port)
    ]
    if "in" in draft.faulty:
        return
    misnamed = [port for port in written if kind.input(port) is None]
    missing = [port for port in kind.inputs if not port.optional and port.name not in written]
    for port in missing:
        check.unwired.append(port)
        if not suggest(port.name, misnamed):
            needs = f"input '{port.name}' ({_message_name(port.message)})"
            check.problem(draft.where, f"node '{draft.name}': {needs} is not wired; '{kind.name}' needs it")
    certain = len(wires) == len(written) and len(check.source.problems) == before
    if certain and not kind.source and not any(wire.mode == "now" for wire in wires):
        what = f"node '{draft.name}' has no plain input, so nothing tells it when to fire; wire one without @"
        check.problem(draft.where, what)


def _meant(check: _Check, draft: Draft, port: InPort) -> bool:
    """Whether a wire with a mistake names a node that may be the right one."""
    name = giver(draft.wires[port.name])
    kind = check.kinds.get(name)
    outputs = kind.outputs if kind is not None else ()
    unknown = name in check.source.drafts and kind is None
    return unknown or any(_fits(one.message, port.message) for one in outputs)


def _fallen(check: _Check, draft: Draft, kind: Kind, port: str) -> bool:
    """Whether a wire came with another kind and this one has no such input."""
    if port not in draft.inherited_wires or kind.input(port) is not None:
        return False
    check.note(f"node '{draft.name}': input '{port}' falls away; '{kind.name}' has none")
    check.source.cut.add(giver(draft.wires[port]))
    return True


def _wire(check: _Check, draft: Draft, kind: Kind, port_name: str, value: Value) -> Input | None:
    port = kind.input(port_name)
    if port is None:
        known = [one.name for one in kind.inputs]
        hint = suggest(port_name, known) or f"; it has {', '.join(known) or 'none'}"
        what = f"node '{draft.name}': kind '{kind.name}' has no input '{port_name}'{hint}"
        check.problem(value.where, what)
    parsed = _reference(check, draft.name, port_name, value)
    if port is None or parsed is None or parsed[0] not in check.kinds:
        return None
    name, output, mode = parsed
    blame = f"node '{draft.name}': input '{port.name}'"
    wrong = _mode_problem(port, mode, name, check.kinds[name])
    if wrong:
        check.problem(value.where, f"{blame} {wrong}")
    found = _output(check, f"{blame} takes {_message_name(port.message)}", port, value, name, output)
    if found is None or wrong:
        return None
    check.places[draft.name, port.name] = value.where
    return Input(port.name, name, found, mode)


def _reference(check: _Check, node: str, port: str, value: Value) -> tuple[str, str, Mode] | None:
    """Node, output ("" if not named) and mode of a written reference."""
    blame = f"node '{node}': input '{port}'"
    reference, at, suffix = value.data.partition("@") if isinstance(value.data, str) else ("", "", "")
    name, dot, output = reference.strip().partition(".")
    if not name or (dot and not output):
        check.problem(value.where, f"{blame} is {shown(value)}; write NODE or NODE.OUTPUT")
        return None
    if at and suffix not in ("previous", "time"):
        hint = suggest(suffix, ["previous", "time"]) or "; it is @previous or @time"
        check.problem(value.where, f"{blame} has the suffix '@{suffix}'{hint}")
        return None
    if name not in check.source.drafts:
        hint = suggest(name, check.source.drafts) or f"; it has {', '.join(check.source.drafts)}"
        check.problem(value.where, f"{blame}: the graph has no node '{name}'{hint}")
        return None
    return name, output, suffix or "now"  # type: ignore[return-value]  # one of the three by now


def _output(check: _Check, blame: str, port: InPort, value: Value, name: str, output: str) -> str | None:
    """The output of node `name` that the wire takes: the one named, or the only one that fits."""
    outputs = check.kinds[name].outputs
    fitting = [one.name for one in outputs if _fits(one.message, port.message)]
    if output in fitting or (not output and len(fitting) == 1):
        return output or fitting[0]
    gives = ", ".join(f"{one.name} ({one.message.__name__})" for one in outputs) or "nothing"
    if not output:
        which = "several outputs that fit, name one" if fitting else "no output that fits"
        check.problem(value.where, f"{blame}; node '{name}' has {which}: it gives {gives}")
    elif (found := check.kinds[name].output(output)) is None:
        near = suggest(output, [one.name for one in outputs]) or f"; it gives {gives}"
        check.problem(value.where, f"{blame}; node '{name}' has no output '{output}'{near}")
    else:
        fits = f"; '{name}.{fitting[0]}' fits" if fitting else ""
        check.problem(value.where, f"{blame}, but '{name}.{output}' gives {found.message.__name__}{fits}")
    return None


def _mode_problem(port: InPort, mode: Mode, name: str, giver: Kind) -> str | None:
    takes = _message_name(port.message)
    if mode == "previous" and not port.nullable:
        return f"takes no @previous: it is annotated {takes}, not {takes} | None (there is none at the start)"
    if mode == "time" and not port.stream:
        return f"takes no @time: it is annotated {takes}, not tuple[{takes}, ...]"
    if mode != "time" and port.stream:
        return f"takes a stream: write {name}@time"
    if mode == "time" and not giver.source:
        return f"takes @time from a source alone; '{name}' is no source"
    return None


def _fits(made: type, taken: Any) -> bool:
    return taken is Message or issubclass(made, taken)


def _message_name(message: Any) -> str:
    return "any message" if message is Message else str(message.__name__)


# --- parameters ----------------------------------------------------------------------------------


def _parameters(check: _Check, draft: Draft, kind: Kind) -> None:
    if "with" in draft.faulty:
        return
    known = {one.name for one in kind.parameters}
    given = dict(draft.given)
    for name in [one for one in given if one in draft.inherited and one not in known]:
        check.note(f"node '{draft.name}': parameter '{name}' falls away; '{kind.name}' has none")
        del given[name]
    try:
        result = parameters.check(kind, given, draft.name, draft.where)
    except PluginError as error:
        check.problem(draft.where, f"node '{draft.name}': {error}")
        return
    check.source.problems.extend(result.problems)
    check.arguments[draft.name] = result.arguments


def _on_error(check: _Check, draft: Draft, kind: Kind) -> None:
    if draft.on_error is None:
        return
    if draft.on_error.data not in ("stop", "skip"):
        what = f"node '{draft.name}': on_error is {shown(draft.on_error)}; it is stop or skip"
        check.problem(draft.on_error.where, what)
    elif draft.on_error.data == "skip":
        for reason in _unskippable(kind):
            check.problem(draft.on_error.where, f"node '{draft.name}': on_error: skip {reason}")


def _unskippable(kind: Kind) -> list[str]:
    reasons = []
    if kind.source:
        reasons.append("is not for a source: it has no ping to answer")
    if kind.outputs and kind.stateful and not kind.restorable:
        reasons.append(f"needs snapshot() and restore() in kind '{kind.name}', which keeps state")
    for port in kind.outputs:
        needed = [one.name for one in dataclasses.fields(port.message)[2:] if _required(one)]
        if needed:
            reasons.append(f"needs an empty {port.message.__name__}; give its {', '.join(needed)} a default")
    return reasons


def _required(one: dataclasses.Field[Any]) -> bool:
    return one.default is dataclasses.MISSING and one.default_factory is dataclasses.MISSING


def _same_file(check: _Check) -> None:
    """Two sinks must not write one file: a run never overwrites."""
    seen: dict[Path, str] = {}
    for name, kind in check.kinds.items():
        if kind.outputs or name not in check.arguments:
            continue
        defaults = {one.name: one.default for one in kind.parameters}
        for value in {**defaults, **check.arguments[name]}.values():
            if not isinstance(value, Path):
                continue
            value = Path(os.path.normpath(value))
            if value.parts[:1] == ("..",):
                what = f"node '{name}' writes '{value}', which lies outside the run's folder; leave out '..'"
                check.problem(check.source.drafts[name].where, what)
            if value in seen:
                what = (
                    f"node '{name}' writes '{value}', and so does node '{seen[value]}'; give one another path"
                )
                check.problem(check.source.drafts[name].where, what)
            seen.setdefault(value, name)


# --- order, clock, loose ends --------------------------------------------------------------------


def _clock(check: _Check) -> str:
    """The one source whose outputs are taken plainly."""
    plain: dict[str, None] = {}
    streamed: set[str] = set()
    for wire in (wire for wires in check.wires.values() for wire in wires):
        if check.kinds[wire.node].source and wire.mode == "time":
            streamed.add(wire.node)
        elif check.kinds[wire.node].source:
            plain[wire.node] = None
    clocks = list(plain)
    if len(clocks) > 1:
        first, *others = clocks
        for other in others:
            what = f"two clocks: '{first}' and '{other}'; take one of them by @time"
            check.problem(check.source.drafts[other].where, what)
    elif not clocks and check.kinds and not check.source.problems:
        check.problem(check.source.where, "no clock: wire the source of the pings to a node")
    for name in sorted(streamed & set(clocks)):
        what = f"node '{name}' gives the pings and is taken by @time as well; it can be only one of them"
        check.problem(check.source.drafts[name].where, what)
    return clocks[0] if clocks else ""


def _order(check: _Check) -> list[str]:
    """Names so that each comes after those that it waits for; what is left is a cycle."""
    waits = {
        name: {wire.node for wire in check.wires.get(name, []) if wire.mode == "now"} for name in check.kinds
    }
    order: dict[str, None] = {}
    while ready := [name for name in waits if name not in order and waits[name] <= order.keys()]:
        order.update(dict.fromkeys(ready))
    places = list(check.source.drafts)
    for cycle in _cycles({name: needed for name, needed in waits.items() if name not in order}):
        first = cycle.index(min(cycle, key=places.index))
        way = [*cycle[first:], *cycle[:first], cycle[first]]
        what = f"a cycle without @previous: {' -> '.join(way)}; mark one of its wires @previous"
        check.problem(check.source.drafts[way[0]].where, what)
    return list(order)


def _cycles(waits: dict[str, set[str]]) -> Iterator[list[str]]:
    """Cycles without a common node among nodes that wait for each other, in the direction of the data."""
    while True:
        while free := [name for name, needed in waits.items() if not needed & waits.keys()]:
            for name in free:
                del waits[name]
        if not waits:
            return
        name, way = next(iter(waits)), list[str]()
        while name not in way:
            way.append(name)
            name = min(waits[name] & waits.keys())
        cycle = way[way.index(name) :][::-1]
        yield cycle
        for name in cycle:
            del waits[name]


def _loose_ends(check: _Check) -> None:
    """Nodes whose results reach no sink: a mistake, unless a swap took their consumer away."""
    givers = {name: {wire.node for wire in wires} for name, wires in check.wires.items()}
    sinks = [name for name, kind in check.kinds.items() if not kind.outputs]
    if not sinks and check.kinds and len(check.kinds) == len(check.source.drafts):
        check.problem(check.source.where, "the graph has no sink; add one, for example {use: track-csv, ...}")
        return
    fallen = _reach(list(check.source.cut), givers)
    used = _reach([*sinks, *_uncertain(check)], givers)
    for name in [one for one in check.kinds if one not in used]:
        if name in fallen:
            check.note(f"node '{name}' falls away; nothing takes its outputs any more")
            del check.kinds[name], check.wires[name]
        else:
            what = f"node '{name}' is unused: its outputs reach no sink; wire them or remove it"
            check.problem(check.source.drafts[name].where, what)


def _uncertain(check: _Check) -> set[str]:
    """Nodes whose use cannot be judged, since a wire from them or their own kind has a problem."""
    if any(draft.faulty - {"with"} for draft in check.source.drafts.values()):
        return set(check.source.drafts)
    broken = {name for name in check.source.drafts if name not in check.kinds}
    for draft in check.source.drafts.values():
        kind = check.kinds.get(draft.name)
        for port, value in draft.wires.items():
            fallen = port in draft.inherited_wires and kind is not None and kind.input(port) is None
            if (draft.name, port) not in check.places and not fallen:
                broken.add(giver(value))
    meant = {port.message for port in check.unwired}  # any giver that fits
    for name, kind in check.kinds.items():
        if any(_fits(output.message, message) for output in kind.outputs for message in meant):
            broken.add(name)
    return broken


def _reach(start: list[str], givers: dict[str, set[str]]) -> set[str]:
    """`start` and all that they take from, directly or not."""
    seen: set[str] = set()
    waiting = list(start)
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            waiting.extend(givers.get(name, ()))
    return seen
