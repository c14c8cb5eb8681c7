"""Every check of a graph before anything starts: kinds, parameters, wires, order, clock, loose ends."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fls_flow import parameters
from fls_flow.catalog import Catalog, InPort, Kind, suggest
from fls_flow.document import Value
from fls_flow.errors import GraphError, PluginError, Problem
from fls_flow.graph.model import Graph, Input, Mode, Node
from fls_flow.graph.read import Draft, Source
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
    notes: list[str] = field(default_factory=list)
    cut: set[str] = field(default_factory=set)  # nodes that lost a consumer with a swap
    places: dict[tuple[str, str], str] = field(default_factory=dict)  # (node, port) -> where its wire stands

    def problem(self, where: str, what: str) -> None:
        self.source.problems.append(Problem(where, what))


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
        source.name, tuple(_node(check, name) for name in order), clock, source.path, tuple(check.notes)
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
    if draft.use is None:
        check.problem(draft.where, f"node '{draft.name}' has no 'use'; name its kind")
    elif not isinstance(draft.use.data, str):
        check.problem(draft.use.where, f"node '{draft.name}': 'use' is {draft.use.data!r}; it names a kind")
    else:
        try:
            check.kinds[draft.name] = check.catalog.load(draft.use.data)
        except PluginError as error:
            check.problem(draft.use.where, f"node '{draft.name}': {error}")


# --- wires ---------------------------------------------------------------------------------------


def _wires(check: _Check, draft: Draft, kind: Kind) -> None:
    wires: list[Input] = []
    for port_name, value in draft.wires.items():
        wire = _wire(check, draft, kind, port_name, value)
        if wire is not None:
            wires.append(wire)
    check.wires[draft.name] = wires
    wired = {wire.port for wire in wires} | (set(draft.wires) - draft.inherited_wires)
    for port in kind.inputs:
        if not port.optional and port.name not in wired:
            needs = f"input '{port.name}' ({_message_name(port.message)})"
            check.problem(draft.where, f"node '{draft.name}': {needs} is not wired; '{kind.name}' needs it")


def _wire(check: _Check, draft: Draft, kind: Kind, port_name: str, value: Value) -> Input | None:
    port = kind.input(port_name)
    parsed = _reference(check, draft.name, port_name, value)
    if port is None:
        if port_name in draft.inherited_wires:
            check.notes.append(f"node '{draft.name}': input '{port_name}' falls away; '{kind.name}' has none")
            check.cut.update([parsed[0]] if parsed else [])
            return None
        known = [one.name for one in kind.inputs]
        hint = suggest(port_name, known) or f"; it has {', '.join(known) or 'none'}"
        check.problem(
            value.where, f"node '{draft.name}': kind '{kind.name}' has no input '{port_name}'{hint}"
        )
        return None
    if parsed is None or parsed[0] not in check.kinds:
        return None
    name, output, mode = parsed
    return _typed(check, draft, port, value, name, output, mode)


def _reference(check: _Check, node: str, port: str, value: Value) -> tuple[str, str, Mode] | None:
    """Node, output ("" if not named) and mode of a written reference."""
    text = value.data
    if not isinstance(text, str):
        check.problem(value.where, f"node '{node}': input '{port}' is {text!r}; write NODE or NODE.OUTPUT")
        return None
    reference, at, suffix = text.partition("@")
    if at and suffix not in ("previous", "time"):
        hint = suggest(suffix, ["previous", "time"]) or "; it is @previous or @time"
        check.problem(value.where, f"node '{node}': input '{port}' has the suffix '@{suffix}'{hint}")
        return None
    name, _, output = reference.strip().partition(".")
    if name not in check.source.drafts:
        if name in check.source.removed and port in check.source.drafts[node].wires:
            check.notes.append(f"node '{node}': input '{port}' falls away with node '{name}'")
            return None
        hint = suggest(name, check.source.drafts) or f"; it has {', '.join(check.source.drafts)}"
        check.problem(value.where, f"node '{node}': input '{port}': the graph has no node '{name}'{hint}")
        return None
    return name, output, suffix or "now"  # type: ignore[return-value]  # one of the three by now


def _typed(
    check: _Check, draft: Draft, port: InPort, value: Value, name: str, output: str, mode: Mode
) -> Input | None:
    blame = f"node '{draft.name}': input '{port.name}'"
    wrong = _mode_problem(port, mode, name, check.kinds[name])
    if wrong:
        check.problem(value.where, f"{blame} {wrong}")
    kind = check.kinds[name]
    fitting = [one for one in kind.outputs if _fits(one.message, port.message)]
    takes = _message_name(port.message)
    if output:
        found = kind.output(output)
        if found is None:
            known = [one.name for one in kind.outputs]
            hint = suggest(output, known) or f"; it has {', '.join(known) or 'none'}"
            check.problem(value.where, f"{blame}: node '{name}' has no output '{output}'{hint}")
            return None
        if found not in fitting:
            made = found.message.__name__
            check.problem(value.where, f"{blame} takes {takes}, but '{name}.{output}' gives {made}")
            return None
    elif len(fitting) != 1:
        gives = ", ".join(f"{one.name} ({one.message.__name__})" for one in kind.outputs) or "nothing"
        which = "several outputs that fit, name one" if fitting else "no output that fits"
        check.problem(value.where, f"{blame} takes {takes}; node '{name}' has {which}: it gives {gives}")
        return None
    else:
        found = fitting[0]
    check.places[draft.name, port.name] = value.where
    return Input(port.name, name, found.name, mode)


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
    known = {one.name for one in kind.parameters}
    given = dict(draft.given)
    for name in [one for one in given if one in draft.inherited and one not in known]:
        check.notes.append(f"node '{draft.name}': parameter '{name}' falls away; '{kind.name}' has none")
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
        what = f"node '{draft.name}': on_error is {draft.on_error.data!r}; it is stop or skip"
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
    for name, wires in check.wires.items():
        for wire in wires:
            if check.kinds[wire.node].source:
                plain.update({wire.node: None} if wire.mode != "time" else {})
                streamed.update({wire.node} if wire.mode == "time" else set())
        if not check.kinds[name].source and wires and not any(wire.mode == "now" for wire in wires):
            what = f"node '{name}' has no plain input, so nothing tells it when to fire; wire one without @"
            check.problem(check.source.drafts[name].where, what)
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
    order: list[str] = []
    while ready := [name for name in waits if name not in order and waits[name] <= set(order)]:
        order.extend(ready)
    stuck = {name: needed - set(order) for name, needed in waits.items() if name not in order}
    cycle = _cycle(stuck)
    if cycle:
        way = " -> ".join([*cycle, cycle[0]])
        place = check.source.drafts[cycle[0]].where
        check.problem(place, f"a cycle without @previous: {way}; mark one of its wires @previous")
    return order


def _cycle(stuck: dict[str, set[str]]) -> list[str]:
    """One cycle among nodes that wait for each other, in the direction of the data."""
    name = next((one for one, needed in stuck.items() if needed & set(stuck)), None)
    way: list[str] = []
    while name is not None and name not in way:
        way.append(name)
        name = next(iter(sorted(stuck[name] & set(stuck))), None)
    return way[way.index(name) :][::-1] if name is not None else []


def _loose_ends(check: _Check) -> None:
    """Nodes whose results reach no sink: a mistake, unless a swap took their consumer away."""
    givers = {name: {wire.node for wire in wires} for name, wires in check.wires.items()}
    sinks = [name for name, kind in check.kinds.items() if not kind.outputs]
    if not sinks and check.kinds and len(check.kinds) == len(check.source.drafts):
        check.problem(check.source.where, "the graph has no sink; add one, for example {use: track-csv, ...}")
        return
    fallen = _reach(list(check.cut), givers)
    used = _reach([*sinks, *_uncertain(check)], givers)
    for name in [one for one in check.kinds if one not in used]:
        if name in fallen:
            check.notes.append(f"node '{name}' falls away; nothing takes its outputs any more")
            del check.kinds[name], check.wires[name]
        else:
            what = f"node '{name}' is unused: its outputs reach no sink; wire them or remove it"
            check.problem(check.source.drafts[name].where, what)


def _uncertain(check: _Check) -> set[str]:
    """Nodes whose use cannot be judged, since a wire from them or their own kind has a problem."""
    broken = {name for name in check.source.drafts if name not in check.kinds}
    for draft in check.source.drafts.values():
        for port, value in draft.wires.items():
            if (draft.name, port) not in check.places and isinstance(value.data, str):
                inherited = port in draft.inherited_wires and draft.name in check.kinds
                broken |= set() if inherited else {value.data.partition("@")[0].partition(".")[0].strip()}
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
