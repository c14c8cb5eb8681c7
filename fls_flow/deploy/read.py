"""Deployment files as written, and every check of them against their graph."""

from __future__ import annotations

import math
import os.path
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from fls_flow import document
from fls_flow.catalog import suggest
from fls_flow.deploy import edges, safety, settings
from fls_flow.deploy.draft import Draft
from fls_flow.deploy.model import LOCAL, Deployment, Group
from fls_flow.document import Value, shown
from fls_flow.errors import GraphError, Problem, UserError
from fls_flow.graph import Graph
from fls_flow.graph import shipped as shipped_graphs
from fls_flow.graph.read import is_name

__all__ = ["find", "load", "shipped"]

KEYS = (
    "deployment",
    "window",
    "hosts",
    "processes",
    "qos",
    "threads",
    "deadline_s",
    "lost_after_s",
    "connect_timeout_s",
    "control",
    "zenoh",
)
SECONDS = ("deadline_s", "lost_after_s", "connect_timeout_s")
MAX_WINDOW, MAX_THREADS, MAX_SECONDS = 1000, 256, 86400.0
NAME = "letters, digits, - and _, beginning with a letter"


def shipped() -> Path:
    """The folder of the deployments that come with fls_flow: in the wheel, or in the checkout."""
    return shipped_graphs().parent / "deployments"


def find(name: str | Path) -> Path:
    """The deployment file called `name`: a path, or a name in `deployments/` or among the shipped ones.

    Raises UserError that lists the deployments there are.
    """
    if os.path.isfile(name):  # Path.is_file raises for names that are too long
        return Path(name)
    words = sorted({str(name), str(name).replace("-", "_"), str(name).replace("_", "-")})
    places = [Path.cwd() / "deployments", shipped()]
    for path in (place / f"{word}.yaml" for place in places for word in words):
        if os.path.isfile(path):
            return path
    known = sorted({found.stem for place in places for found in place.glob("*.yaml")})
    near = suggest(Path(name).stem, known) or f"; known deployments: {', '.join(known) or 'none'}"
    raise UserError(f"{name}: no such deployment file{near}")


def load(name: str | Path, graph: Graph, *, host: str | None = None) -> Deployment:
    """The deployment of `graph` in a file, or of that name.

    With `host` (or when there is only one) the files that this host needs are looked at too: certificates,
    key, passwords. Raises GraphError with every problem in it, UserError when there is no such file or host.
    """
    path = find(name)
    problems: list[Problem] = []
    root = document.read(path, problems)
    if not isinstance(root.data, dict):
        raise GraphError([*problems, root.at("a deployment file is a mapping that begins with deployment:")])
    draft = Draft(graph, root, problems)
    deployment = _checked(draft, path, host)
    if problems:
        raise GraphError(sorted(dict.fromkeys(problems), key=_place))
    if host is not None and host not in draft.hosts:
        near = suggest(host, draft.hosts) or f"; it has {', '.join(draft.hosts)}"
        raise UserError(f"{path}: the deployment has no host '{host}'{near}")
    return deployment


def _place(problem: Problem) -> tuple[str, int]:
    file, _, line = problem.where.rpartition(":")
    return (file, int(line)) if file and line.isdigit() else (problem.where, 0)


def _checked(draft: Draft, path: Path, host: str | None) -> Deployment:
    _unknown(draft, draft.root.mapping, KEYS, "a deployment")
    name = _name(draft)
    window = _number(draft, "window", _is_window, f"a whole number from 1 to {MAX_WINDOW}")
    limits = f"a number of seconds above 0, at most {MAX_SECONDS:.0f}"
    seconds = {key: _number(draft, key, _is_seconds, limits) for key in SECONDS}
    control = _number(draft, "control", lambda data: isinstance(data, bool), "true or false")
    _hosts(draft)
    _processes(draft)
    _threads(draft)
    latest = edges.latest(draft)
    edges.feedback(draft)
    looked_at = draft.hosts[0] if host is None and len(draft.hosts) == 1 else host
    given = draft.get("zenoh")
    zenoh, parts = settings.read(given, draft.root, draft.hosts)
    safety.check(zenoh, parts, given or draft.root, looked_at)
    draft.problems += zenoh.problems
    return Deployment(
        name,
        draft.host_of.get(draft.graph.clock, LOCAL),
        {one: _groups(draft, one) for one in draft.hosts},
        window,
        latest,
        control=bool(control),
        zenoh=zenoh.settings,
        path=path,
        notes=(*draft.notes, *zenoh.notes),
        **{key: float(value) for key, value in seconds.items() if value is not None},
    )


def _unknown(draft: Draft, given: Mapping[str, Value], known: Iterable[str], of: str) -> None:
    for key, value in given.items():
        if key not in known:
            hint = suggest(key, known) or f"; it has {', '.join(known)}"
            draft.problems.append(value.at(f"{of} has no key '{key}'{hint}"))


def _name(draft: Draft) -> str:
    value = draft.root.mapping.get("deployment")
    if value is None:
        draft.problems.append(draft.root.at("'deployment' is missing; name it, for example deployment: pier"))
    elif not (isinstance(value.data, str) and is_name(value.data)):
        draft.problems.append(value.at(f"deployment is {shown(value)}; its name is of {NAME}"))
    else:
        return value.data
    return ""


def _number(draft: Draft, key: str, fits: Callable[[Any], bool], takes: str) -> Any:
    value = draft.get(key)
    if value is not None and not fits(value.data):
        draft.problems.append(value.at(f"{key} is {shown(value)}; it takes {takes}"))
        return None
    return None if value is None else value.data


def _is_window(data: Any) -> bool:
    return type(data) is int and 1 <= data <= MAX_WINDOW


def _is_seconds(data: Any) -> bool:
    return type(data) in (int, float) and math.isfinite(data) and 0.0 < data <= MAX_SECONDS


# --- places --------------------------------------------------------------------------------------


def _hosts(draft: Draft) -> None:
    """Each node on exactly one host; without `hosts`, all on one."""
    if draft.get("hosts") is None:
        draft.host_of = dict.fromkeys(draft.nodes, LOCAL)
        return
    given = draft.mapping("hosts", "names of hosts to lists of nodes")
    draft.hosts = tuple(given)
    for host, value in given.items():
        if not is_name(host) or host in settings.KEYS:
            reason = f"it is of {NAME}" if not is_name(host) else "that is a key of zenoh:; take another"
            draft.problems.append(value.at(f"host name '{host}': {reason}"))
    found = _shared_out(draft, given, "host")
    draft.host_of = {node: found[node] for node in draft.nodes if node in found}
    missing = [node for node in draft.nodes if node not in found]
    if missing and isinstance(draft.root.mapping["hosts"].data, dict):
        what = f"on no host: {', '.join(missing)}; each node of graph '{draft.graph.name}' runs on one"
        draft.problems.append(draft.root.mapping["hosts"].at(what))


def _shared_out(draft: Draft, given: Mapping[str, Value], of: str) -> dict[str, str]:
    """Node -> the host or process under which it is listed."""
    found: dict[str, str] = {}
    for name, value in given.items():
        nodes = [] if value.data is None else value.data
        if not isinstance(nodes, list):
            draft.problems.append(value.at(f"{of} '{name}' is {shown(value)}; it is a list of nodes"))
            continue
        for one in nodes:
            if not isinstance(one.data, str) or one.data not in draft.nodes:
                near = suggest(str(one.data), draft.nodes) or f"; it has {', '.join(draft.nodes)}"
                what = f"{of} '{name}': graph '{draft.graph.name}' has no node {shown(one)}{near}"
                draft.problems.append(one.at(what))
            elif one.data in found:
                what = f"{of} '{name}': node '{one.data}' is already in {of} '{found[one.data]}'"
                draft.problems.append(one.at(what))
            else:
                found[one.data] = name
    return found


def _processes(draft: Draft) -> None:
    """The process of each node: the one that lists it, else one of its own, named after it."""
    given = draft.mapping("processes", "names of processes to lists of nodes")
    found = _shared_out(draft, given, "process")
    for name, value in given.items():
        nodes = [node for node, process in found.items() if process == name]
        hosts = {draft.host_of[node]: node for node in reversed(nodes) if node in draft.host_of}
        if not is_name(name):
            draft.problems.append(value.at(f"process name '{name}': it is of {NAME}"))
        if name in draft.nodes and found.get(name) != name:
            what = f"process '{name}' has the name of a node that it does not hold; take another name"
            draft.problems.append(value.at(what))
        if not nodes and value.data in (None, []):
            draft.problems.append(value.at(f"process '{name}' is empty; list its nodes, or remove it"))
        if len(hosts) > 1:
            places = ", ".join(f"'{node}' on {host}" for host, node in sorted(hosts.items()))
            draft.problems.append(value.at(f"process '{name}' has nodes of several hosts: {places}"))
    draft.process_of = {node: found.get(node, node) for node in draft.nodes}


def _threads(draft: Draft) -> None:
    known = dict.fromkeys(draft.process_of.values())
    for name, value in draft.mapping("threads", "names of processes to numbers of threads").items():
        if name not in known:
            near = suggest(name, known) or f"; the processes are {', '.join(known)}"
            draft.problems.append(value.at(f"threads: there is no process '{name}'{near}"))
        elif not (type(value.data) is int and 1 <= value.data <= MAX_THREADS):
            what = f"threads of '{name}' is {shown(value)}; it takes a whole number from 1 to {MAX_THREADS}"
            draft.problems.append(value.at(what))
        else:
            draft.threads[name] = value.data


def _groups(draft: Draft, host: str) -> tuple[Group, ...]:
    """The processes of a host, in the order of their first nodes in the graph."""
    members: dict[str, list[str]] = {}
    for node, process in draft.process_of.items():
        if draft.host_of.get(node) == host:
            members.setdefault(process, []).append(node)
    return tuple(Group(name, tuple(nodes), draft.threads.get(name, 1)) for name, nodes in members.items())
