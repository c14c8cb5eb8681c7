"""The checks of single nodes: kinds, parameters, what happens on an error, the files of sinks."""

from __future__ import annotations

import dataclasses
import os.path
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fls_flow import parameters
from fls_flow.catalog import Kind
from fls_flow.document import shown
from fls_flow.errors import FlsFlowError, PluginError
from fls_flow.graph.findings import Findings
from fls_flow.graph.read import Draft

__all__ = ["check_files", "check_kind", "check_on_error", "check_parameters"]

OWN_FILES = ("run.json", "run.log")  # of every run's folder


def check_kind(found: Findings, draft: Draft) -> None:
    """Find the kind of a node."""
    if "node" in draft.faulty:
        return
    if draft.use is None:
        found.problem(draft.where, f"node '{draft.name}' has no 'use'; name its kind")
    elif not isinstance(draft.use.data, str):
        found.problem(draft.use.where, f"node '{draft.name}': 'use' is {shown(draft.use)}; it names a kind")
    else:
        try:
            kind = found.catalog.load(draft.use.data)
        except PluginError as error:
            found.problem(draft.use.where, f"node '{draft.name}': {error}")
            meant = found.catalog.meant(draft.use.data)
            if meant is None:
                return
            kind = meant  # its other mistakes can be told at once
        decided = _decided(found, draft, kind) if kind.undecided else kind
        if decided is not None:
            found.kinds[draft.name] = decided


def _decided(found: Findings, draft: Draft, kind: Kind) -> Kind | None:
    """The kind with the output that its parameters make, such as of a file; None after a problem."""
    known = {one.name for one in kind.parameters}
    given = {
        name: value for name, value in draft.given.items() if name in known or name not in draft.inherited
    }
    result = parameters.check(kind, given, draft.name, draft.where, found.models)
    found.source.problems.extend(result.problems)
    if result.problems or "with" in draft.faulty:
        return None
    try:
        return kind.decided(kind.cls(**result.arguments))
    except FlsFlowError as error:
        found.problem(draft.where, f"node '{draft.name}': {error}")
    except (Exception, SystemExit) as error:
        cause = " ".join(f"{type(error).__name__}: {error}".split())
        found.problem(draft.where, f"node '{draft.name}': output_type() raised {cause}")
    return None


def check_parameters(found: Findings, draft: Draft, kind: Kind) -> None:
    """Find the arguments of a node."""
    if "with" in draft.faulty:
        return
    known = {one.name for one in kind.parameters}
    given = dict(draft.given)
    for name in [one for one in given if one in draft.inherited and one not in known]:
        found.note(f"node '{draft.name}': parameter '{name}' falls away; '{kind.name}' has none")
        del given[name]
    try:
        result = parameters.check(kind, given, draft.name, draft.where, found.models)
    except PluginError as error:
        found.problem(draft.where, f"node '{draft.name}': {error}")
        return
    found.source.problems.extend(result.problems)
    found.arguments[draft.name] = result.arguments


def check_on_error(found: Findings, draft: Draft, kind: Kind) -> None:
    """Say what keeps a node from being skipped."""
    if draft.on_error is None:
        return
    if draft.on_error.data not in ("stop", "skip"):
        what = f"node '{draft.name}': on_error is {shown(draft.on_error)}; it is stop or skip"
        found.problem(draft.on_error.where, what)
    elif draft.on_error.data == "skip":
        for reason in _unskippable(kind):
            found.problem(draft.on_error.where, f"node '{draft.name}': on_error: skip {reason}")


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


def check_files(found: Findings) -> None:
    """Two sinks must not write one file: a run never overwrites."""
    seen: dict[Path, str] = {}
    for name, kind in found.kinds.items():
        if kind.outputs or name not in found.arguments:
            continue
        defaults = {one.name: one.default for one in kind.parameters}
        for value in {**defaults, **found.arguments[name]}.values():
            if not isinstance(value, Path):
                continue
            value = Path(os.path.normpath(value))
            reason = _unwritable(value, seen)
            if reason is not None:
                found.problem(found.source.drafts[name].where, f"node '{name}' writes '{value}', {reason}")
            seen.setdefault(value, name)


def _unwritable(path: Path, seen: Mapping[Path, str]) -> str | None:
    """What keeps a sink from writing `path`, given who writes which path already."""
    if path.parts[:1] == ("..",):
        return "which lies outside the run's folder; leave out '..'"
    if str(path) in OWN_FILES:
        return f"which is the run's own; give it another path than {' and '.join(OWN_FILES)}"
    if path in seen:
        return f"and so does node '{seen[path]}'; give one another path"
    for other, name in seen.items():
        folder = min(path, other, key=lambda one: len(one.parts))
        if folder.suffix and folder in (*path.parents, *other.parents):  # without a suffix it may be a folder
            return f"and node '{name}' writes '{other}'; '{folder}' cannot be a file and a folder"
    return None
