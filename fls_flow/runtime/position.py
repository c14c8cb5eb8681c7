"""Which ping each node of a process is at, kept in a file that outlives the process.

Two numbers per node: how many pings it has begun, and how many it is done with. They are written without a
lock, each by its node's own thread alone, and read when the process is dead.
"""

from __future__ import annotations

import logging
import mmap
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Position", "Whereabouts", "kept", "look"]

log = logging.getLogger(__name__)

Position = memoryview | list[int]  # [begun, done]
SIZE = struct.calcsize("qq")


@dataclass(frozen=True, slots=True)
class Whereabouts:
    """How far a node came; `at` is the index of the ping that it was at work on, None between two pings."""

    fired: int
    at: int | None


def kept(path: Path, nodes: Sequence[str]) -> Mapping[str, Position]:
    """The positions of `nodes`, in the new file `path`; in this process alone where none can be made."""
    try:
        with path.open("xb+") as file:
            file.write(bytes(SIZE * len(nodes)))  # takes its place on the disk: a full one shows here
            file.flush()
            whole = memoryview(mmap.mmap(file.fileno(), 0)).cast("q")
    except OSError as error:
        log.info("%s: %s; if this process dies, its ping will not be known", path, error.strerror)
        return {name: [0, 0] for name in nodes}
    return {name: whole[2 * number : 2 * number + 2] for number, name in enumerate(nodes)}


def look(path: Path, nodes: Sequence[str]) -> dict[str, Whereabouts]:
    """What the file `path` says of `nodes`; empty when there is none."""
    try:
        numbers = list(struct.iter_unpack("qq", path.read_bytes()))
    except (OSError, struct.error):
        return {}
    return {
        name: Whereabouts(done, begun - 1 if begun > done else None)
        for name, (begun, done) in zip(nodes, numbers, strict=False)
    }
