"""The checks of wires: that they name an output which exists, fits and may be taken in that way."""

from __future__ import annotations

from typing import Any

from fls_flow.catalog import InPort, Kind, suggest
from fls_flow.document import Value, shown
from fls_flow.graph.findings import Findings
from fls_flow.graph.model import Input, Mode
from fls_flow.graph.read import Draft, giver
from fls_flow.messages import Message

__all__ = ["check_references", "check_wires", "fits"]


def check_wires(found: Findings, draft: Draft, kind: Kind) -> None:
    """Keep the wires of a node that are right, and say what is wrong with the others."""
    before = len(found.source.problems)
    written = {port: value for port, value in draft.wires.items() if not _fallen(found, draft, kind, port)}
    tried = [_wire(found, draft, kind, port, value) for port, value in written.items()]
    wires = [wire for wire in tried if wire is not None]
    found.wires[draft.name] = wires
    failed = [port for port, wire in zip(written, tried, strict=True) if wire is None]
    found.unwired += [
        port for name in failed if (port := kind.input(name)) and not _meant(found, draft, port)
    ]
    if "in" in draft.faulty:
        return
    misnamed = [port for port in written if kind.input(port) is None]
    missing = [port for port in kind.inputs if not port.optional and port.name not in written]
    for port in missing:
        found.unwired.append(port)
        if not suggest(port.name, misnamed):
            needs = f"input '{port.name}' ({_message_name(port.message)})"
            found.problem(draft.where, f"node '{draft.name}': {needs} is not wired; '{kind.name}' needs it")
    certain = len(wires) == len(written) and len(found.source.problems) == before
    if certain and not kind.source and not any(wire.mode == "now" for wire in wires):
        what = f"node '{draft.name}' has no plain input, so nothing tells it when to fire; wire one without @"
        found.problem(draft.where, what)


def check_references(found: Findings, draft: Draft) -> None:
    """Say which wires of a node without a known kind name a node or an output that is not there."""
    for port, value in draft.wires.items():
        parsed = _reference(found, draft.name, port, value)
        giver_kind = found.kinds.get(parsed[0]) if parsed is not None else None
        if parsed is None or giver_kind is None or not parsed[1]:
            continue
        if giver_kind.output(parsed[1]) is None:
            _no_output(found, f"node '{draft.name}': input '{port}'", value, parsed[0], parsed[1])


def _meant(found: Findings, draft: Draft, port: InPort) -> bool:
    """Whether a wire with a mistake names a node that may be the right one."""
    name = giver(draft.wires[port.name])
    kind = found.kinds.get(name)
    outputs = kind.outputs if kind is not None else ()
    unknown = name in found.source.drafts and kind is None
    return unknown or any(fits(one.message, port.message) for one in outputs)


def _fallen(found: Findings, draft: Draft, kind: Kind, port: str) -> bool:
    """Whether a wire came with another kind and this one has no such input."""
    if port not in draft.inherited_wires or kind.input(port) is not None:
        return False
    found.note(f"node '{draft.name}': input '{port}' falls away; '{kind.name}' has none")
    found.source.cut.add(giver(draft.wires[port]))
    return True


def _wire(found: Findings, draft: Draft, kind: Kind, port_name: str, value: Value) -> Input | None:
    port = kind.input(port_name)
    if port is None:
        known = [one.name for one in kind.inputs]
        hint = suggest(port_name, known) or f"; it has {', '.join(known) or 'none'}"
        what = f"node '{draft.name}': kind '{kind.name}' has no input '{port_name}'{hint}"
        found.problem(value.where, what)
    parsed = _reference(found, draft.name, port_name, value)
    if port is None or parsed is None or parsed[0] not in found.kinds:
        return None
    name, output, mode = parsed
    blame = f"node '{draft.name}': input '{port.name}'"
    wrong = _mode_problem(port, mode, name, found.kinds[name])
    if wrong:
        found.problem(value.where, f"{blame} {wrong}")
    taken = _output(found, f"{blame} takes {_message_name(port.message)}", port, value, name, output)
    if taken is None or wrong:
        return None
    found.places[draft.name, port.name] = value.where
    return Input(port.name, name, taken, mode)


def _reference(found: Findings, node: str, port: str, value: Value) -> tuple[str, str, Mode] | None:
    """Node, output ("" if not named) and mode of a written reference."""
    blame = f"node '{node}': input '{port}'"
    reference, at, suffix = value.data.partition("@") if isinstance(value.data, str) else ("", "", "")
    name, dot, output = reference.strip().partition(".")
    if not name or (dot and not output):
        found.problem(value.where, f"{blame} is {shown(value)}; write NODE or NODE.OUTPUT")
        return None
    if at and suffix not in ("previous", "time"):
        hint = suggest(suffix, ["previous", "time"]) or "; it is @previous or @time"
        found.problem(value.where, f"{blame} has the suffix '@{suffix}'{hint}")
        return None
    if name not in found.source.drafts:
        hint = suggest(name, found.source.drafts) or f"; it has {', '.join(found.source.drafts)}"
        found.problem(value.where, f"{blame}: the graph has no node '{name}'{hint}")
        return None
    return name, output, suffix or "now"  # type: ignore[return-value]  # one of the three by now


def _output(found: Findings, blame: str, port: InPort, value: Value, name: str, output: str) -> str | None:
    """The output of node `name` that the wire takes: the one named, or the only one that fits."""
    outputs = found.kinds[name].outputs
    fitting = [one.name for one in outputs if fits(one.message, port.message)]
    if output in fitting or (not output and len(fitting) == 1):
        return output or fitting[0]
    if not output:
        which = "several outputs that fit, name one" if fitting else "no output that fits"
        found.problem(
            value.where, f"{blame}; node '{name}' has {which}: it gives {_gives(found.kinds[name])}"
        )
    elif (given := found.kinds[name].output(output)) is None:
        _no_output(found, blame, value, name, output)
    else:
        hint = f"; '{name}.{fitting[0]}' fits" if fitting else ""
        found.problem(value.where, f"{blame}, but '{name}.{output}' gives {given.message.__name__}{hint}")
    return None


def _no_output(found: Findings, blame: str, value: Value, name: str, output: str) -> None:
    kind = found.kinds[name]
    near = suggest(output, [one.name for one in kind.outputs]) or f"; it gives {_gives(kind)}"
    found.problem(value.where, f"{blame}; node '{name}' has no output '{output}'{near}")


def _gives(kind: Kind) -> str:
    return ", ".join(f"{one.name} ({one.message.__name__})" for one in kind.outputs) or "nothing"


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


def fits(made: type, taken: Any) -> bool:
    """Whether an input that is annotated `taken` takes messages of the class `made`."""
    return taken is Message or issubclass(made, taken)


def _message_name(message: Any) -> str:
    return "any message" if message is Message else str(message.__name__)
