"""The processes that a supervisor has started: what it hears of each, how far they came, how they end."""

from __future__ import annotations

import logging
import select
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from fls_flow.channel import Channel
from fls_flow.deploy import Group
from fls_flow.graph import Graph
from fls_flow.nursery import Nursery
from fls_flow.observe import NodeCounts
from fls_flow.runtime import position
from fls_flow.runtime.position import Whereabouts
from fls_flow.runtime.worker import Assignment

__all__ = ["Child", "Children"]

log = logging.getLogger(__name__)

EXIT_S = 0.5  # from the end of its channel until a process has ended
PART_S = 1.0  # how long processes may take to exit after the end


@dataclass
class Child:
    """A process of the run and its group of nodes; as text, who it is and how far it came."""

    group: Group
    channel: Channel
    output: BinaryIO  # what it prints
    positions: Path  # the file in which it keeps how far its nodes are
    ready: bool = False
    done: bool = False
    report: dict[str, Any] | None = None
    reached: dict[str, Whereabouts] = field(default_factory=dict)  # by node, once it was looked for
    heard: float = 0.0  # when it last said anything, monotonic
    born: float | None = None  # when it began, monotonic
    exit_code: int | None = None
    _partial: bytes = field(default=b"", init=False, repr=False)

    def __str__(self) -> str:
        nodes = ", ".join(f"'{name}'" for name in self.group.nodes)
        word = "node" if len(self.group.nodes) == 1 else "nodes"
        return f"process '{self.group.name}' with {word} {nodes}, {self._where()},"

    def _where(self) -> str:
        at = [(name, where.at) for name, where in self.reached.items() if where.at is not None]
        if not at:
            return f"after {max((where.fired for where in self.reached.values()), default=0)} pings"
        if len(self.group.nodes) == 1:
            return f"at ping index {at[0][1]}"
        return " and ".join(f"node '{name}' at ping index {index}" for name, index in at)

    def look(self) -> None:
        """Find out how far its nodes are, without its help."""
        self.reached = position.look(self.positions, self.group.nodes)

    @property
    def cause(self) -> str:
        """How it died, as far as is known."""
        code = self.exit_code
        if code is None:
            return ""
        if code >= 0:
            return f" (exit code {code})"
        named = -code in set(signal.Signals)  # real-time signals have no names but the first and the last
        return f" (signal {-code}: {signal.Signals(-code).name})" if named else f" (signal {-code})"

    def show_printed(self) -> bool:
        """Pass on the whole lines that it has printed, with its name; False at the end."""
        printed = self.output.read(1 << 16)
        *lines, self._partial = (self._partial + (printed or b"")).split(b"\n")
        self._show(lines)
        return printed != b""

    def show_rest(self) -> None:
        """Pass on what is left, whole lines or not."""
        while printed := self.output.read(1 << 16):
            self._partial += printed
        self._show(self._partial.splitlines())

    def _show(self, lines: Iterable[bytes]) -> None:
        for line in lines:
            sys.stderr.write(f"[{self.group.name}] {line.decode(errors='replace')}\n")


class Children:
    """All processes of a run on one host, and the nursery that bears them."""

    def __init__(self, nursery: Nursery, groups: Sequence[Group]) -> None:
        self.nursery, self._groups = nursery, tuple(groups)
        self._by_name: dict[str, Child] = {}

    def __iter__(self) -> Iterator[Child]:
        return iter(self._by_name.values())

    def __len__(self) -> int:
        return len(self._by_name)

    @property
    def ready(self) -> bool:
        """Whether each sees those with whom it exchanges messages."""
        return all(child.ready for child in self)

    @property
    def done(self) -> bool:
        """Whether each has said its last, or died."""
        return all(child.done for child in self)

    def bear(self, graph: Graph, assignment: Assignment) -> None:
        """Start them."""
        born = self.nursery.bear(graph, assignment, self._groups)
        for group in self._groups:
            channel, output = born[group.name]
            now = time.monotonic()
            self._by_name[group.name] = Child(
                group, channel, output, assignment.positions(group.name), heard=now
            )

    def go(self, last: str) -> None:
        """Let them begin, the process `last` after the others."""
        for child in sorted(self, key=lambda child: child.group.name == last):
            child.heard = time.monotonic()
            child.channel.send("go")

    def tell(self, word: str) -> None:
        """Say `word` to each."""
        for child in self:
            child.channel.send(word)

    def late(self, patience_s: float) -> Iterator[Child]:
        """Those that are not ready so long after they began; each is given up."""
        now = time.monotonic()
        for child in self:
            if not (child.ready or child.done or child.born is None) and now - child.born > patience_s:
                child.done = True
                yield child

    def silent(self, patience_s: float) -> Iterator[tuple[Child, float]]:
        """Those that have said nothing for so long, and for how long; each is given up."""
        for child in self:
            silent_s = time.monotonic() - child.heard
            if not child.done and silent_s > patience_s:
                child.done = True
                child.look()
                yield child, silent_s

    def ended(self) -> list[Child]:
        """Those of which it is known that they have exited, but not that they were done."""
        return [child for child in self if child.exit_code is not None and not child.done]

    def kill(self) -> None:
        """End those that are not done at once."""
        late = [child for child in self if not child.done]
        log.error("did not stop in time and were killed: %s", ", ".join(child.group.name for child in late))
        self.nursery.kill()
        for child in late:
            child.done = True
            child.look()

    def hear_nursery(self) -> tuple[bool, str | None]:
        """Take what the nursery says of exits; whether it is there, and what is wrong with it."""
        documents, there = self.nursery.channel.drain()
        wrong = [text for said in documents if (text := self._heard(said)) is not None]
        if not (wrong or there or self.done):
            wrong = ["the process that starts the others died"]
        return there, wrong[0] if wrong else None

    def wait_for_exit(self, child: Child) -> None:
        """The nursery says how a child ended a moment after its channel closed; unless it has not ended."""
        deadline, there = time.monotonic() + EXIT_S, True
        while child.exit_code is None and there and (left_s := deadline - time.monotonic()) > 0.0:
            if select.select([self.nursery.channel], [], [], left_s)[0]:
                documents, there = self.nursery.channel.drain()
                for said in documents:
                    self._heard(said)

    def _heard(self, said: dict[str, Any]) -> str | None:
        if said["word"] == "failed":
            return f"the process that starts the others failed: {said['text']}"
        if said["word"] == "born":
            self._by_name[said["process"]].born = time.monotonic()
        else:
            self._by_name[said["process"]].exit_code = said["code"]
        return None

    def part(self) -> None:
        """Let them go when the run is over; those that have reported close what they hold."""
        self.tell("bye")
        deadline = time.monotonic() + PART_S
        for child in self:
            if child.report is not None:
                child.channel.wait_closed(deadline - time.monotonic())

    def close(self) -> None:
        """Wait for the nursery's end, and show what they have still printed."""
        self.nursery.end()
        for child in self:
            child.show_rest()
            child.channel.close()
            child.output.close()

    def counts(self) -> dict[str, NodeCounts]:
        """What the nodes have done: as each process reported, or as far as one came that died."""
        found: dict[str, NodeCounts] = {}
        for child in self:
            if child.report is not None:
                found |= {name: NodeCounts.of_summary(one) for name, one in child.report["counts"].items()}
            else:
                found |= {name: NodeCounts(fired=where.fired) for name, where in child.reached.items()}
        return found

    def samples_taken(self) -> dict[str, dict[str, list[int]]]:
        """How many samples of streams the pings of a live run got, by node and port."""
        found: dict[str, dict[str, list[int]]] = {}
        for child in self:
            found |= child.report["samples_taken"] if child.report is not None else {}
        return found
