"""A sink that writes the bytes of everything it gets."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from fls_flow import Message, hookimpl, wire


@dataclass
class Recorder:
    """The messages of each ping one after the other, by the names of their ports."""

    path: Path = Path("messages.bin")
    _file: BinaryIO | None = field(default=None, init=False, repr=False)

    def __call__(self, **ports: Message) -> None:
        if self._file is None:
            self._file = self.path.open("xb")
        for name in sorted(ports):
            self._file.write(wire.encode(ports[name]))

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


@hookimpl
def fls_node() -> type[Recorder]:
    return Recorder
