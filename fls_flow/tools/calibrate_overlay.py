"""What a calibration found, as a graph file over the one that was calibrated."""

from __future__ import annotations

import os.path
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fls_flow.errors import UserError
from fls_flow.graph import Graph
from fls_flow.tools.calibrate import Calibration

__all__ = ["overlay", "write"]


def overlay(
    graph: Graph, found: Calibration, folder: Path, *, use: Iterable[str] = (), set_: Iterable[str] = ()
) -> str:
    """The text of the graph file, whose `base:` is found from `folder`.

    `use` and `set_` are laid in too, but for those of the clock: it stands for the recording. Raises
    UserError for a parameter within a parameter, which an overlay would replace as a whole.
    """
    nodes: dict[str, dict[str, Any]] = {}
    for text in use:
        name, _, kind = text.partition("=")
        nodes.setdefault(name, {})["use"] = kind
    for text in set_:
        path, _, value = text.partition("=")
        name, parameter, *deeper = path.split(".")
        if deeper and name != graph.clock:
            raise UserError(
                f"--set {text}: write '{name}.{parameter}' as a whole into the graph file instead"
            )
        nodes.setdefault(name, {}).setdefault("with", {})[parameter] = value
    nodes.pop(graph.clock, None)
    given = nodes.setdefault(found.node, {}).setdefault("with", {})
    given["pfa"] = _number(found.point.pfa)
    given["threshold_scale"] = _scale(found)
    lines = [*_comments(found), f"base: {_base(graph, folder)}", "nodes:"]
    for name, node in nodes.items():
        lines.append(f"  {name}:")
        if "use" in node:
            lines.append(f"    use: {node['use']}")
        if "with" in node:
            lines += ["    with:", *(f"      {key}: {value}" for key, value in node["with"].items())]
    return "\n".join(lines) + "\n"


def write(path: Path, text: str) -> None:
    """Write the file; raises UserError when it is there already or cannot be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise UserError(f"{path}: is there already; name another file with --out") from error
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error


def _comments(found: Calibration) -> list[str]:
    point = found.point
    how = "a fitted tail" if found.extrapolated else "counts"
    after = f"{point.after.rate:.3g} ({point.after.low:.2g} to {point.after.high:.2g})"
    return [
        f"# {found.node} ({found.kind}) for a false-alarm rate of {point.pfa:g}, from {how} over "
        f"{found.pings} pings",
        f"# without targets. On the half that the scale was not fitted to: {after},",
        f"# and {point.before.rate:.3g} with threshold_scale 1.",
    ]


def _scale(found: Calibration) -> str:
    scale = found.threshold_scale
    if isinstance(scale, float):
        return _number(scale)
    return "[" + ", ".join(map(_number, scale)) + "]"


def _number(value: float) -> str:
    """So that YAML reads it back as the same float."""
    return repr(float(value)) if "e" not in repr(float(value)) else f"{value:.12g}".replace("e-0", "e-")


def _base(graph: Graph, folder: Path) -> str:
    """The calibrated graph, as found from `folder`; a shipped one by its name."""
    from fls_flow.graph import shipped

    if graph.path is None:
        return graph.name
    if graph.path.resolve().parent == shipped().resolve():
        return graph.path.stem
    return f"'{os.path.relpath(graph.path.resolve(), folder.resolve())}'"
