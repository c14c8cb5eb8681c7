"""The checks of a graph as a whole: one clock, an order without cycles, no loose ends."""

from __future__ import annotations

from collections.abc import Iterator

from fls_flow.graph.check_wires import fits
from fls_flow.graph.findings import Findings
from fls_flow.graph.read import giver

__all__ = ["check_ends", "find_clock", "find_order"]


def find_clock(found: Findings) -> str:
    """The one source whose outputs are taken plainly."""
    plain: dict[str, None] = {}
    streamed: set[str] = set()
    for wire in (wire for wires in found.wires.values() for wire in wires):
        if found.kinds[wire.node].source and wire.mode == "time":
            streamed.add(wire.node)
        elif found.kinds[wire.node].source:
            plain[wire.node] = None
    clocks = list(plain)
    if len(clocks) > 1:
        first, *others = clocks
        for other in others:
            what = f"two clocks: '{first}' and '{other}'; take one of them by @time"
            found.problem(found.source.drafts[other].where, what)
    elif not clocks and found.kinds and not found.source.problems:
        found.problem(found.source.where, "no clock: wire the source of the pings to a node")
    for name in sorted(streamed & set(clocks)):
        what = f"node '{name}' gives the pings and is taken by @time as well; it can be only one of them"
        found.problem(found.source.drafts[name].where, what)
    return clocks[0] if clocks else ""


def find_order(found: Findings) -> list[str]:
    """Names so that each comes after those that it waits for; what is left is a cycle."""
    waits = {
        name: {wire.node for wire in found.wires.get(name, []) if wire.mode == "now"} for name in found.kinds
    }
    order: dict[str, None] = {}
    while ready := [name for name in waits if name not in order and waits[name] <= order.keys()]:
        order.update(dict.fromkeys(ready))
    places = list(found.source.drafts)
    for cycle in _cycles({name: needed for name, needed in waits.items() if name not in order}):
        first = cycle.index(min(cycle, key=places.index))
        way = [*cycle[first:], *cycle[:first], cycle[first]]
        what = f"a cycle without @previous: {' -> '.join(way)}; mark one of its wires @previous"
        found.problem(found.source.drafts[way[0]].where, what)
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


def check_ends(found: Findings) -> None:
    """Nodes whose results reach no sink: a mistake, unless a swap took their consumer away."""
    givers = {name: {wire.node for wire in wires} for name, wires in found.wires.items()}
    sinks = [name for name, kind in found.kinds.items() if not kind.outputs]
    if not sinks and found.kinds and len(found.kinds) == len(found.source.drafts):
        found.problem(found.source.where, "the graph has no sink; add one, for example {use: track-csv, ...}")
        return
    fallen = _reach(list(found.source.cut), givers)
    used = _reach([*sinks, *_uncertain(found)], givers)
    for name in [one for one in found.kinds if one not in used]:
        if name in fallen:
            found.note(f"node '{name}' falls away; nothing takes its outputs any more")
            del found.kinds[name], found.wires[name]
        else:
            what = f"node '{name}' is unused: its outputs reach no sink; wire them or remove it"
            found.problem(found.source.drafts[name].where, what)


def _uncertain(found: Findings) -> set[str]:
    """Nodes whose use cannot be judged, since a wire from them or their own kind has a problem."""
    if any(draft.faulty - {"with"} for draft in found.source.drafts.values()):
        return set(found.source.drafts)
    broken = {name for name in found.source.drafts if name not in found.kinds}
    for draft in found.source.drafts.values():
        kind = found.kinds.get(draft.name)
        for port, value in draft.wires.items():
            fallen = port in draft.inherited_wires and kind is not None and kind.input(port) is None
            if (draft.name, port) not in found.places and not fallen:
                broken.add(giver(value))
    meant = {port.message for port in found.unwired}  # any giver that fits
    for name, kind in found.kinds.items():
        if any(fits(output.message, message) for output in kind.outputs for message in meant):
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
