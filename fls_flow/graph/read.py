"""Graph files as written: found by name, `base:` merged in, `--use` and `--set` laid over."""

from __future__ import annotations

import os.path
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import fls_flow
from fls_flow import document
from fls_flow.catalog import suggest
from fls_flow.document import Value, shown
from fls_flow.errors import GraphError, Problem, UserError

__all__ = ["Draft", "Source", "find", "override", "read", "shipped"]

GRAPH_KEYS = ("graph", "base", "nodes")
NODE_KEYS = ("use", "with", "in", "on_error")
MAX_BASES = 32
NAME = "letters, digits, - and _, beginning with a letter"


@dataclass(frozen=True)
class Draft:
    """One node as written."""

    name: str
    where: str
    use: Value | None = None
    given: dict[str, Value] = field(default_factory=dict)
    wires: dict[str, Value] = field(default_factory=dict)
    on_error: Value | None = None
    # names that came with another kind: kept where the new kind has them, else they fall away
    inherited: frozenset[str] = frozenset()
    inherited_wires: frozenset[str] = frozenset()
    # what cannot be read, and was reported: the node itself, its `in` or its `with`
    faulty: frozenset[str] = frozenset()


@dataclass
class Source:
    """A graph as written, with what is wrong so far."""

    name: str
    where: str
    path: Path | None
    drafts: dict[str, Draft] = field(default_factory=dict)
    cut: set[str] = field(default_factory=set)  # nodes that lost a consumer to an override
    notes: list[str] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


def shipped() -> Path:
    """The folder of the graphs that come with fls_flow: in the wheel, or in the checkout."""
    package = Path(fls_flow.__file__).parent
    carried = package / "_shipped" / "graphs"
    return carried if carried.is_dir() else package.parent / "graphs"


def find(name: str | Path, beside: Path | None = None) -> Path:
    """The graph file called `name`: a path, or a name in `graphs/` or among the shipped graphs.

    Raises UserError that lists the graphs there are.
    """
    folder = beside or Path.cwd()
    path = folder / name
    if os.path.isfile(path):  # Path.is_file raises for names that are too long
        return path if beside else Path(name)
    words = {str(name), str(name).replace("-", "_"), str(name).replace("_", "-")}
    places = [folder / "graphs", Path.cwd() / "graphs", shipped(), folder]
    for place in places:
        for word in sorted(words):
            if os.path.isfile(place / f"{word}.yaml"):
                return place / f"{word}.yaml"
    if str(name) and os.path.isdir(path):
        raise UserError(f"{name}: is a folder; name a graph file in it")
    known = sorted({found.stem for place in places[:3] for found in place.glob("*.yaml")})
    beside_it = [found.stem for found in folder.glob("*.yaml")]
    near = suggest(Path(name).stem, [*known, *beside_it]) or f"; known graphs: {', '.join(known) or 'none'}"
    raise UserError(f"{name}: no such graph file{near}")


def read(path: Path, seen: tuple[Path, ...] = ()) -> Source:
    """The graph in the file `path`, over its `base:` if it has one.

    Raises GraphError when there is nothing to go on with.
    """
    problems: list[Problem] = []
    root = document.read(path, problems)
    source = Source(path.stem, root.where, path, problems=problems)
    if not isinstance(root.data, dict):
        raise GraphError([*problems, root.at("a graph file is a mapping with the keys graph and nodes")])
    _unknown_keys(root, GRAPH_KEYS, "a graph", source.problems)
    base = root.mapping.get("base")
    if base is not None:
        _base(source, base, (*seen, path.resolve()))
    _graph_name(source, root)
    _nodes(source, root, root.mapping.get("nodes"))
    return source


def _nodes(source: Source, root: Value, nodes: Value | None) -> None:
    if nodes is None:
        if "base" not in root.mapping:
            source.problems.append(root.at("'nodes' is missing; name the nodes of the graph there"))
        return
    if not isinstance(nodes.data, dict):
        source.problems.append(nodes.at("'nodes' is a mapping of names to nodes"))
    below = dict(source.drafts)
    gone = {name: value for name, value in nodes.mapping.items() if value.data is None and name in below}
    for name in gone:
        source.cut |= set(map(giver, source.drafts.pop(name).wires.values()))
    for name, value in nodes.mapping.items():
        if name not in gone:
            _merge(source, name, value, based="base" in root.mapping)
    for name in [name for name in source.drafts if name in below] if gone else []:
        _fall_away(source, below[name], gone)


def _fall_away(source: Source, below: Draft, gone: dict[str, Value]) -> None:
    """Drop the wires that a node has from its base and whose giver is gone."""
    draft = source.drafts[below.name]
    kept = dict(draft.wires)
    for port, value in draft.wires.items():
        if value is below.wires.get(port) and giver(value) in gone:
            del kept[port]
            note = f"node '{draft.name}': input '{port}' falls away with node '{giver(value)}'"
            source.notes.append(note)
            draft = replace(draft, where=gone[giver(value)].where, wires=kept)
    source.drafts[below.name] = draft


def giver(wire: Value) -> str:
    """The node that a written reference takes from; "" if it is none."""
    return wire.data.partition("@")[0].strip().partition(".")[0] if isinstance(wire.data, str) else ""


def _base(source: Source, base: Value, seen: tuple[Path, ...]) -> None:
    """Begin with the graph that `base` names; without it nothing else can be judged, so problems end here."""
    if not isinstance(base.data, str):
        raise GraphError([*source.problems, base.at(f"'base' is {shown(base)}; it names a graph file")])
    try:
        path = find(base.data, base.folder)
    except UserError as error:
        raise GraphError([*source.problems, base.at(f"base {error}")]) from error
    if path.resolve() in seen:
        raise GraphError([*source.problems, base.at(f"'{base.data}' is its own base")])
    if len(seen) > MAX_BASES:
        raise GraphError([*source.problems, base.at(f"more than {MAX_BASES} bases, one over the other")])
    try:
        below = read(path, seen)
    except GraphError as error:
        raise GraphError([*source.problems, *error.problems]) from error
    source.drafts, source.cut, source.notes, source.name = below.drafts, below.cut, below.notes, below.name
    source.problems.extend(below.problems)


def _graph_name(source: Source, root: Value) -> None:
    name = root.mapping.get("graph")
    if name is None:
        if "base" not in root.mapping:
            source.problems.append(root.at(f"'graph' is missing; name it, for example graph: {source.name}"))
    elif not (isinstance(name.data, str) and is_name(name.data)):
        source.problems.append(name.at(f"graph is {shown(name)}; its name is of {NAME}"))
    else:
        source.name = name.data


def is_name(text: str) -> bool:
    """Whether `text` can name a graph or a node: it becomes part of keys, files and options."""
    return text.isascii() and text.replace("-", "_").isidentifier()


def _unknown_keys(value: Value, known: Iterable[str], of: str, problems: list[Problem]) -> None:
    for key, child in value.mapping.items():
        if key not in known:
            hint = suggest(key, known) or f"; it has {', '.join(known)}"
            problems.append(child.at(f"{of} has no key '{key}'{hint}"))


def _merge(source: Source, name: str, value: Value, *, based: bool) -> None:
    if not isinstance(value.data, dict):
        hint = value.data if isinstance(value.data, str) else "KIND"
        what = f"node '{name}' is {shown(value)}; it is a mapping, for example {{use: {hint}}}"
        if value.data is None and based:
            near = suggest(name, source.drafts)
            what = f"the base has no node '{name}' to remove{near}"
        source.problems.append(value.at(what))
        source.drafts[name] = Draft(name, value.where, faulty=frozenset(["node"]))
        return
    if not is_name(name):
        source.problems.append(value.at(f"node name '{name}': it is of {NAME}"))
    _unknown_keys(value, NODE_KEYS, f"node '{name}'", source.problems)
    below = source.drafts.get(name, Draft(name, value.where))
    draft = _swapped(below, value.mapping.get("use"))
    faulty = {key for key in ("in", "with") if not _is_mapping(source, value, key, name)} | _misspelt(value)
    wires, given = (_mapping(value, key) for key in ("in", "with"))
    source.cut |= {giver(below.wires[port]) for port in wires if port in below.wires}
    source.drafts[name] = replace(
        draft,
        given={**draft.given, **given},
        # null unwires what the base wires
        wires={
            k: v for k, v in {**draft.wires, **wires}.items() if v.data is not None or k not in below.wires
        },
        on_error=value.mapping.get("on_error", draft.on_error),
        use=value.mapping.get("use", draft.use),
        inherited=draft.inherited - set(given),
        inherited_wires=draft.inherited_wires - set(wires),
        faulty=draft.faulty | faulty,
    )


def _misspelt(value: Value) -> set[str]:
    """What of a node stands under a key that was reported as unknown; nothing more can be said about it."""
    unknown = [key for key in value.mapping if key not in NODE_KEYS]
    parts = {"use": "node", "in": "in", "with": "with"}
    return {part for key, part in parts.items() if key not in value.mapping and suggest(key, unknown)}


def _swapped(draft: Draft, use: Value | None) -> Draft:
    """The draft for another kind: what it holds so far is inherited."""
    if use is None or (draft.use is not None and use.data == draft.use.data):
        return draft
    inherited, wires = frozenset(draft.given), frozenset(draft.wires)
    where = draft.where if draft.use is None else use.where
    return replace(draft, use=use, where=where, inherited=inherited, inherited_wires=wires)


def _is_mapping(source: Source, value: Value, key: str, name: str) -> bool:
    child = value.mapping.get(key)
    if child is None or child.data is None or isinstance(child.data, dict):
        return True
    source.problems.append(child.at(f"node '{name}': '{key}' is {shown(child)}; it maps names to values"))
    return False


def _mapping(value: Value, key: str) -> dict[str, Value]:
    child = value.mapping.get(key)
    return {} if child is None else child.mapping


def override(source: Source, use: Iterable[str] = (), set_: Iterable[str] = ()) -> None:
    """Lay `--use node=kind` and `--set node.param=value` over the graph; mistakes become problems."""
    for text in use:
        name, equals, kind = text.partition("=")
        where = f"--use {text}"
        if not (equals and name and kind):
            source.problems.append(Problem(where, "write it as --use NODE=KIND"))
        elif _known_node(source, name, where):
            source.drafts[name] = _swapped(source.drafts[name], Value(where, kind))
    for text in set_:
        _set(source, text)


def _known_node(source: Source, name: str, where: str) -> bool:
    if name in source.drafts:
        return True
    near = suggest(name, source.drafts) or f"; it has {', '.join(source.drafts)}"
    source.problems.append(Problem(where, f"the graph has no node '{name}'{near}"))
    return False


def _set(source: Source, text: str) -> None:
    where = f"--set {text}"
    path, equals, written = text.partition("=")
    name, *names = path.split(".")
    if not (equals and names and all(names)):
        source.problems.append(Problem(where, "write it as --set NODE.PARAMETER=VALUE"))
        return
    if not _known_node(source, name, where):
        return
    try:
        value = document.parse(written, where, source.problems, lines=False)
    except GraphError as error:
        source.problems.extend(error.problems)
        return
    draft = source.drafts[name]
    given = _laid(draft.given, names, value)
    source.drafts[name] = replace(draft, given=given, inherited=draft.inherited - {names[0]})


def _laid(given: dict[str, Value], names: list[str], value: Value) -> dict[str, Value]:
    head, *rest = names
    if not rest:
        return {**given, head: value}
    below = given.get(head)
    inner = _laid(below.mapping if below else {}, rest, value)
    return {**given, head: Value(value.where, inner, below.folder if below else None)}
