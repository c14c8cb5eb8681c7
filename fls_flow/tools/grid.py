"""The cells of a sweep: every combination of the values that `--set` lists.

`a,b,c` lists values, `start:stop[:step]` counts from start up to, not including, stop. A comma or a colon
inside quotes, [] or {} is the value's own: the pieces are YAML, as in `fls-flow run --set`.
"""

from __future__ import annotations

import glob
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property
from pathlib import Path

from fls_flow import document
from fls_flow.errors import GraphError, Problem, UserError

__all__ = ["MAX_CELLS", "Axis", "Grid", "axes_of", "split"]

MAX_CELLS = 1_000_000
NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
RANGE = re.compile(rf"({NUMBER}):({NUMBER})(?::({NUMBER}))?")
NOTHING = ("", "~", "null")
CLOSING = {"[": "]", "{": "}"}


@dataclass(frozen=True)
class Axis:
    """One parameter and its values, as `--set` takes them."""

    name: str
    values: tuple[str, ...]

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The values as a table shows them: without quotes, of paths the names if these tell them apart."""
        plain = tuple(json.loads(value) if value.startswith('"') else value for value in self.values)
        names = tuple(Path(value).name for value in plain)
        return names if all(map(Path.is_absolute, map(Path, plain))) and _distinct(names) else plain

    @property
    def is_repeat(self) -> bool:
        """Whether its values are draws of chance: a parameter called `seed`."""
        return self.name.rpartition(".")[2] == "seed"


@dataclass(frozen=True, slots=True)
class Grid:
    """All combinations of the axes' values, the last axis running fastest."""

    axes: tuple[Axis, ...]

    def __len__(self) -> int:
        return math.prod(len(axis.values) for axis in self.axes)

    def places(self, index: int) -> tuple[int, ...]:
        """Which value of each axis cell `index` has."""
        found = []
        for axis in reversed(self.axes):
            index, place = divmod(index, len(axis.values))
            found.append(place)
        return tuple(reversed(found))

    def settings(self, index: int) -> tuple[str, ...]:
        """The `--set` options of cell `index`."""
        return tuple(
            f"{axis.name}={axis.values[place]}"
            for axis, place in zip(self.axes, self.places(index), strict=True)
        )

    def labels(self, index: int) -> dict[str, str]:
        """The values of cell `index` by the name of the axis."""
        places = zip(self.axes, self.places(index), strict=True)
        return {axis.name: axis.labels[place] for axis, place in places}

    def crosses(self) -> Iterator[int]:
        """Cells that together show every value of every axis once, the first value of the others."""
        stride = len(self)
        yield 0
        for axis in self.axes:
            stride //= len(axis.values)
            yield from range(stride, stride * len(axis.values), stride)


def axes_of(set_: Iterable[str], is_path: Callable[[str], bool] = lambda name: False) -> Grid:
    """The grid that `--set` options span; `is_path` tells the parameters whose values are files to read.

    Paths become absolute; a folder names the files in it, `*` and `?` all that match. Raises UserError with
    every mistake.
    """
    problems: list[Problem] = []
    axes: list[Axis] = []
    for text in set_:
        where = f"--set {text}"
        name, equals, written = text.partition("=")
        if not (equals and "." in name):
            problems.append(Problem(where, "write it as --set NODE.PARAMETER=VALUES"))
        elif any(axis.name == name for axis in axes):
            problems.append(Problem(where, f"{name} is set twice; list its values in one --set"))
        else:
            try:
                axes.append(Axis(name, _values(written, paths=is_path(name))))
            except ValueError as error:
                problems.append(Problem(where, str(error)))
    if problems:
        raise GraphError(problems)
    grid = Grid(tuple(axes))
    if len(grid) > MAX_CELLS:
        raise UserError(f"the grid has {len(grid):,} cells; at most {MAX_CELLS:,} can be kept account of")
    return grid


def _values(written: str, *, paths: bool) -> tuple[str, ...]:
    values: list[str] = []
    for piece in split(written):
        matched = RANGE.fullmatch(piece)
        if paths:
            values += _files(piece)
        elif matched:
            values += _counted(*matched.groups())
        elif not piece and "," in written:
            raise ValueError("a value between commas is empty; write '' for empty text")
        else:
            values.append(piece)
    if not _distinct(tuple(values)):
        raise ValueError("a value is listed twice")
    return tuple(values)


def split(written: str) -> list[str]:
    """The pieces between commas that stand outside quotes and brackets, stripped."""
    pieces, begin, awaited = [], 0, ""
    quote = ""
    for place, letter in enumerate(written):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"" and not written[begin:place].strip(" [{,:"):
            quote = letter
        elif letter in CLOSING:
            awaited += CLOSING[letter]
        elif awaited and letter == awaited[-1]:
            awaited = awaited[:-1]
        elif letter in "'\"" and awaited:
            quote = letter
        elif letter == "," and not awaited:
            pieces.append(written[begin:place].strip())
            begin = place + 1
    return [*pieces, written[begin:].strip()]


def _counted(first: str, stop: str, step: str | None) -> list[str]:
    """The numbers of a range; in decimals, so that 0.1:0.5:0.1 ends where it should."""
    low, high, by = Decimal(first), Decimal(stop), Decimal(step or "1")
    count = math.ceil((high - low) / by) if by else 0
    if count < 1:
        raise ValueError(f"the range {first}:{stop}{f':{step}' if step else ''} has no values")
    if count > MAX_CELLS:
        raise ValueError(f"the range {first}:{stop} has {count:,} values; at most {MAX_CELLS:,} are possible")
    return [str(low + by * i) for i in range(count)]


def _files(piece: str) -> list[str]:
    """The files that a path, a folder or a pattern names, as absolute paths in quotes."""
    if piece in NOTHING or piece[0] in CLOSING:
        return [piece]
    # Only what is quoted is read as YAML: there a leading * is an alias.
    text = str(document.plain(document.parse(piece, "", [], lines=False))) if piece[0] in "'\"" else piece
    if any(letter in text for letter in "*?"):
        found, missing = glob.glob(text, recursive=True), f"no file matches {text}"
    elif Path(text).is_dir():
        inside = Path(text).iterdir()
        found = [str(path) for path in inside if path.is_file() and not path.name.startswith(".")]
        missing = f"the folder {text} holds no file"
    else:
        found, missing = [text], ""
    if not found:
        raise ValueError(missing)
    return [json.dumps(path) for path in sorted(str(Path(path).absolute()) for path in found)]


def _distinct(values: tuple[str, ...]) -> bool:
    return len(set(values)) == len(values)
