"""What a supervisor knows of each process that it has started."""

from __future__ import annotations

import signal
import sys
from dataclasses import dataclass, field
from typing import Any, BinaryIO

from fls_flow.channel import Channel
from fls_flow.deploy import Group

__all__ = ["Child"]


@dataclass
class Child:
    """A process of the run and its group of nodes; as text, who it is and how far it came."""

    group: Group
    channel: Channel
    output: BinaryIO  # what it prints
    ready: bool = False
    done: bool = False
    report: dict[str, Any] | None = None
    fired: dict[str, int] = field(default_factory=dict)  # pings, by node
    heard: float = 0.0  # when it last said anything, monotonic
    exit_code: int | None = None
    _partial: bytes = field(default=b"", init=False, repr=False)

    def __str__(self) -> str:
        nodes = ", ".join(f"'{name}'" for name in self.group.nodes)
        done = max(self.fired.values(), default=0)
        word = "node" if len(self.group.nodes) == 1 else "nodes"
        return f"process '{self.group.name}' with {word} {nodes}, after about {done} pings,"

    @property
    def cause(self) -> str:
        """How it died, as far as is known."""
        code = self.exit_code
        if code is None:
            return ""
        return f" (signal {-code}: {signal.Signals(-code).name})" if code < 0 else f" (exit code {code})"

    def show_printed(self) -> bool:
        """Pass on the whole lines that it has printed, with its name; False at the end."""
        printed = self.output.read(1 << 16) or b""
        *lines, self._partial = (self._partial + printed).split(b"\n")
        for line in lines:
            sys.stderr.write(f"[{self.group.name}] {line.decode(errors='replace')}\n")
        return bool(printed)
