"""Functions that are written as source: one flat body in place of a call per field.

What runs for every message is compiled once per class, as `dataclasses` does with `__init__`: between two
pings the processor forgets its caches, and then each call that is spared counts twenty times. Source is made
from the fields of classes alone, never from data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["Code"]


class Code:
    """The body of a function that grows line by line, and the objects that it names."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._depth = 1
        self._names: dict[str, Any] = {}
        self._count = 0

    def line(self, text: str) -> None:
        """Add a statement."""
        self._lines.append("    " * self._depth + text)

    @contextmanager
    def block(self, head: str) -> Iterator[None]:
        """What is added meanwhile stands below `head`, such as "if there"."""
        self.line(f"{head}:")
        self._depth += 1
        yield
        self._depth -= 1

    def name(self) -> str:
        """A variable that nothing else uses."""
        self._count += 1
        return f"v{self._count}"

    def uses(self, value: Any) -> str:
        """The name of an object from outside."""
        name = f"k{len(self._names)}"
        self._names[name] = value
        return name

    def function(self, name: str, parameters: str) -> Callable[..., Any]:
        """The function of these lines."""
        source = "\n".join([f"def {name}({parameters}):", *self._lines])
        exec(compile(source, f"<{name}>", "exec"), self._names)
        made: Callable[..., Any] = self._names[name]
        return made
