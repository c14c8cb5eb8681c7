"""Everything that fls_flow raises on purpose.

::

    FlsFlowError
    ├── UserError          what the user wrote is wrong           exit code 2
    │   ├── GraphError     a graph file, with every problem in it
    │   └── PluginError    an installed plugin that cannot be used
    ├── RunError           a run failed                           exit code 1
    │   ├── NodeError      a node raised or broke the contract
    │   └── LinkError      messages could not be carried
    ├── InputError         a file or a device gives what it should not
    └── WireError          bytes that are no message
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

__all__ = [
    "FlsFlowError",
    "GraphError",
    "InputError",
    "LinkError",
    "NodeError",
    "PluginError",
    "Problem",
    "RunError",
    "UserError",
    "WireError",
]


class FlsFlowError(Exception):
    """Base of all errors here; its text is one line: what, where, how to mend."""

    exit_code = 1


class UserError(FlsFlowError):
    """What the user wrote is wrong; nothing has started."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class Problem:
    """One mistake: where it stands (`file:line` or the option), what it is and how to mend it."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


class GraphError(UserError):
    """A graph cannot be run; `problems` holds every mistake that was found, in the order of the file."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(map(str, self.problems)))


class PluginError(UserError):
    """An installed plugin breaks the contract; the text names its distribution and module."""


class RunError(FlsFlowError):
    """A run ended before its end."""


class NodeError(RunError):
    """A node raised, or its answer breaks the contract; the text names node, ping and cause."""

    def __init__(self, node: str, index: int | None, seq: int | None, cause: str) -> None:
        self.node, self.index, self.seq, self.cause = node, index, seq, cause
        ping = f"index {index}" if seq is None else f"ping seq {seq} (index {index})"
        at = "" if index is None else f" at {ping}"
        super().__init__(f"node '{node}' failed{at}: {cause}")


class LinkError(RunError):
    """Messages could not be carried from node to node."""


class InputError(FlsFlowError):
    """A recording or a device gives what it should not: truncated, wrong format, missing geometry."""


class WireError(FlsFlowError):
    """A buffer is no whole, unaltered message of the expected type, or a message cannot be carried."""
