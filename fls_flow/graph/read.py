"""Graph files as written: found by name, `base:` merged in, `--use` and `--set` laid over."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import fls_flow
from fls_flow import document
from fls_flow.catalog import suggest
from fls_flow.document import Value
from fls_flow.errors import GraphError, Problem, UserError

__all__ = ["Draft", "Source", "find", "override", "read", "shipped"]

GRAPH_KEYS = ("graph", "base", "nodes")
NODE_KEYS = ("use", "with", "in", "on_error")


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


@dataclass
class Source:
    """A graph as written, with what is wrong so far."""

    name: str
    where: str
    path: Path | None
    drafts: dict[str, Draft] = field(default_factory=dict)
    removed: set[str] = field(default_factory=set)
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
    if path.is_file():
        return path if beside else Path(name)
    words = {str(name), str(name).replace("-", "_"), str(name).replace("_", "-")}
    places = [folder / "graphs", Path.cwd() / "graphs", shipped(), folder]
    for place in places:
        for word in sorted(words):
            if (place / f"{word}.yaml").is_file():
                return place / f"{word}.yaml"
    known = sorted({found.stem for place in places[:3] for found in place.glob("*.yaml")})
    near = suggest(Path(name).stem, known) or f"; known graphs: {', '.join(known) or 'none'}"
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
    nodes = root.mapping.get("nodes")
    if nodes is None and base is None:
        source.problems.append(root.at("'nodes' is missing; name the nodes of the graph there"))
    elif nodes is not None and not isinstance(nodes.data, dict):
        source.problems.append(nodes.at("'nodes' is a mapping of names to nodes"))
    for name, value in (nodes.mapping if nodes is not None else {}).items():
        _merge(source, name, value)
    return source


def _base(source: Source, base: Value, seen: tuple[Path, ...]) -> None:
    if not isinstance(base.data, str):
        source.problems.append(base.at("'base' is the name of a graph file"))
        return
    try:
        path = find(base.data, base.folder)
    except UserError as error:
        source.problems.append(base.at(f"base {error}"))
        return
    if path.resolve() in seen:
        source.problems.append(base.at(f"'{base.data}' is its own base"))
        return
    below = read(path, seen)
    source.drafts, source.removed, source.name = below.drafts, below.removed, below.name
    source.problems.extend(below.problems)


def _graph_name(source: Source, root: Value) -> None:
    name = root.mapping.get("graph")
    if name is None:
        if "base" not in root.mapping:
            source.problems.append(root.at(f"'graph' is missing; name it, for example graph: {source.name}"))
    elif not (isinstance(name.data, str) and is_name(name.data)):
        source.problems.append(name.at(f"graph is {name.data!r}; its name is of letters, digits, - and _"))
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


def _merge(source: Source, name: str, value: Value) -> None:
    if value.data is None and name in source.drafts:
        del source.drafts[name]
        source.removed.add(name)
        return
    if not isinstance(value.data, dict):
        source.problems.append(value.at(f"node '{name}' is a mapping, for example {{use: KIND}}"))
        return
    if not is_name(name):
        source.problems.append(value.at(f"node name {name!r}: use letters, digits, - and _"))
    _unknown_keys(value, NODE_KEYS, f"node '{name}'", source.problems)
    below = source.drafts.get(name)
    source.removed.discard(name)
    draft = Draft(name, value.where) if below is None else _swapped(below, value.mapping.get("use"))
    wires = _mapping(source, value, "in", name)
    source.drafts[name] = replace(
        draft,
        given={**draft.given, **_mapping(source, value, "with", name)},
        wires={k: v for k, v in {**draft.wires, **wires}.items() if v.data is not None},
        on_error=value.mapping.get("on_error", draft.on_error),
        use=value.mapping.get("use", draft.use),
        inherited=draft.inherited - set(_mapping(source, value, "with", name)),
        inherited_wires=draft.inherited_wires - set(wires),
    )


def _swapped(draft: Draft, use: Value | None) -> Draft:
    """The draft for another kind: what it holds so far is inherited."""
    if use is None or (draft.use is not None and use.data == draft.use.data):
        return draft
    return replace(draft, use=use, inherited=frozenset(draft.given), inherited_wires=frozenset(draft.wires))


def _mapping(source: Source, value: Value, key: str, name: str) -> dict[str, Value]:
    child = value.mapping.get(key)
    if child is None or child.data is None:
        return {}
    if not isinstance(child.data, dict):
        what = f"node '{name}': '{key}' is a mapping of names to values"
        if child.at(what) not in source.problems:
            source.problems.append(child.at(what))
    return child.mapping


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
