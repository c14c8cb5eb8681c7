"""The text of a CSV file turned into columns, chunk by chunk; every fault names file and line."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.evaluate.recording import csv_lines, is_topic

__all__ = ["FRAMES", "Layout", "Reader"]

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

CHUNK_ROWS = 2_000  # text of this many rows is in memory at a time; more is slower
INT64_MAX = 2**63 - 1
FRAMES = ("sensor", "ned")
FAR = 1e9  # m, m/s: further than any sonar, near enough for squares
LIMITS = {
    "stamp_ns": (0, INT64_MAX),
    **dict.fromkeys(("x_m", "y_m", "vx_mps", "vy_mps", "expected_targets"), (-FAR, FAR)),
    **dict.fromkeys(("var_x", "cov_xy", "var_y"), (-(FAR**2), FAR**2)),
    "probability": (0.0, 1.0),
    "range_m": (0.0, FAR),
    "bearing_rad": (-math.pi, math.pi),
}
STATUSES = ("tentative", "confirmed", "lost")


@dataclass(frozen=True, slots=True)
class Layout:
    """Columns of one kind of file; an entry is a row whose `key` is not empty."""

    key: str
    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    whole: tuple[str, ...] = ()  # the others are real numbers, but for `text`
    text: tuple[str, ...] = ()
    unique: bool = False  # a key stands once per ping


@dataclass(frozen=True, slots=True)
class Reader:
    """Reads one file."""

    path: Path

    def fault(self, line: int | np.int64, what: str) -> NoReturn:
        """Raise UserError for a line of the file."""
        raise UserError(f"{self.path}:{line}: {what}")

    @contextmanager
    def opened(self) -> Iterator[Iterator[str]]:
        """The file as text; raises UserError for what no CSV file does."""
        if is_topic(self.path):
            with closing(csv_lines(self.path)) as lines:
                yield lines
            return
        try:
            with self.path.open(encoding="utf-8-sig", newline="") as file:
                yield file
        except UnicodeDecodeError as error:
            raise UserError(f"{self.path}: is no UTF-8 text ({error.reason}); save it as UTF-8") from error
        except csv.Error as error:
            raise UserError(f"{self.path}: is no CSV ({error})") from error
        except OSError as error:
            raise UserError(f"{self.path}: {error.strerror or error}; check the path") from error

    def chunks(self, layout: Layout) -> Iterator[dict[str, npt.NDArray[Any]]]:
        """Columns of `CHUNK_ROWS` rows at a time; at least one chunk."""
        with self.opened() as file:
            rows = csv.reader(file)
            header = [name.strip() for name in next(rows, [])]
            places = self._places(header, layout)
            full = True
            while full:
                line = rows.line_num
                block = list(islice(rows, CHUNK_ROWS))
                if rows.line_num - line != len(block):
                    self.fault(line + 1, "a quoted field spans lines from here on; write it on one line")
                yield self._chunk(block, line + 1, len(header), places, layout)
                full = len(block) == CHUNK_ROWS

    def _places(self, header: list[str], layout: Layout) -> dict[str, int]:
        wanted = ("seq", "stamp_ns", *layout.required)
        missing = [name for name in wanted if name not in header]
        if missing:
            hint = " (separated by ';': save it with commas)" if len(header) == 1 and ";" in header[0] else ""
            self.fault(1, f"the header lacks {', '.join(missing)}{hint}; it takes {','.join(wanted)}")
        twice = [name for name in (*wanted, *layout.optional) if header.count(name) > 1]
        if twice:
            self.fault(1, f"the header has {', '.join(twice)} twice")
        return {name: header.index(name) for name in (*wanted, *layout.optional) if name in header}

    def _chunk(
        self, block: list[list[str]], line: int, width: int, places: dict[str, int], layout: Layout
    ) -> dict[str, npt.NDArray[Any]]:
        lines = np.arange(line, line + len(block), dtype=np.int64)
        if any(len(row) != width for row in block):
            block, lines = self._squared(block, lines, width)
        fields = list(zip(*block, strict=True)) if block else [()] * width
        text = {name: fields[place] for name, place in places.items()}
        empty = np.fromiter((not one.strip() for one in text[layout.key]), bool, len(block))
        columns: dict[str, npt.NDArray[Any]] = {"line": lines, "entry": ~empty}
        if empty.any():
            self._refuse_halves(text, empty, lines, layout)
        for name, cells in text.items():
            if name in ("seq", "stamp_ns"):
                columns[name] = self._whole(name, cells, lines)
            elif name in layout.text:
                columns[name] = _words(cells)
            elif name in layout.whole:
                columns[name] = self._whole(name, cells, lines, empty)
            else:
                needed = name in layout.required and name != "expected_targets"
                columns[name] = self._real(name, cells, lines, empty, needed=needed)
        self._check_limits(columns, lines, ~empty)
        return columns

    def _squared(
        self, block: list[list[str]], lines: IntArray, width: int
    ) -> tuple[list[list[str]], IntArray]:
        """Rows of equal width: blank lines fall away, short rows are filled up."""
        for row, line in zip(block, lines, strict=True):
            if len(row) > width:
                self.fault(line, f"has {len(row)} fields, the header {width}")
        kept = np.fromiter((bool(row) for row in block), bool, len(block))
        return [row + [""] * (width - len(row)) for row in block if row], lines[kept]

    def _refuse_halves(
        self,
        text: Mapping[str, Sequence[str]],
        empty: BoolArray,
        lines: IntArray,
        layout: Layout,
    ) -> None:
        names = [
            name for name in text if name not in ("seq", "stamp_ns", "expected_targets", "frame", layout.key)
        ]
        for row in np.flatnonzero(empty).tolist():
            for name in names:
                if text[name][row].strip():
                    self.fault(lines[row], f"has {name} but no {layout.key}; fill both or neither")

    def _whole(
        self, name: str, cells: Sequence[str], lines: IntArray, empty: BoolArray | None = None
    ) -> IntArray:
        try:
            return np.array(list(map(int, cells)), np.int64)
        except (ValueError, OverflowError):
            skip = np.zeros(len(cells), bool) if empty is None else empty
            found = [
                0 if gap else self._whole_cell(name, cell, line)
                for cell, line, gap in zip(cells, lines, skip, strict=True)
            ]
            return np.array(found, np.int64)

    def _whole_cell(self, name: str, cell: str, line: np.int64) -> int:
        try:
            value = Decimal(cell.strip())  # other programs write 12 as 12.0 or 1.2e1
            if not value.is_finite() or value != value.to_integral_value():
                raise InvalidOperation
        except InvalidOperation:
            self.fault(line, f"{name} is '{cell[:40]}'; it takes a whole number")
        if value.adjusted() > 18 or abs(value) > INT64_MAX:
            self.fault(line, f"{name} is {cell[:40]}; it takes 64 bits")
        return int(value)

    def _real(
        self, name: str, cells: Sequence[str], lines: IntArray, empty: BoolArray, *, needed: bool
    ) -> npt.NDArray[np.float64]:
        if not any(cells):
            values = np.full(len(cells), np.nan)
        else:
            try:
                values = np.array(list(map(float, cells)), np.float64)
            except ValueError:
                pairs = zip(cells, lines, strict=True)
                values = np.array([self._real_cell(name, cell, line) for cell, line in pairs], np.float64)
        wrong = np.isinf(values)
        if needed:
            wrong |= ~empty & np.isnan(values)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            self.fault(lines[row], f"{name} is '{cells[row][:40]}'; it takes a finite number")
        return values

    def _real_cell(self, name: str, cell: str, line: np.int64) -> float:
        if not cell.strip():
            return math.nan
        try:
            return float(cell)
        except ValueError:
            self.fault(line, f"{name} is '{cell[:40]}'; it takes a number")

    def _check_limits(self, columns: dict[str, npt.NDArray[Any]], lines: IntArray, entry: BoolArray) -> None:
        if "status" in columns:
            self.one_of("status", columns["status"][entry], STATUSES, lines[entry])
        for name, (least, most) in LIMITS.items():
            if name not in columns:
                continue
            value = columns[name]
            wrong = np.flatnonzero((value < least) | (value > most))
            if wrong.size:
                found = value[wrong[0]]
                self.fault(lines[wrong[0]], f"{name} is {found}; it lies between {least:g} and {most:.6g}")

    def one_of(self, name: str, values: npt.NDArray[Any], words: tuple[str, ...], lines: IntArray) -> None:
        """Raise for the first value that is none of the words."""
        wrong = np.flatnonzero(~np.isin(values, words))
        if wrong.size:
            row = int(wrong[0])
            self.fault(lines[row], f"{name} is '{values[row]}'; it takes {', '.join(words)}")


def _words(cells: Sequence[str]) -> npt.NDArray[np.str_]:
    """The cells without blanks around them; a column has few different ones."""
    stripped = {one: one.strip() for one in set(cells)}
    return np.array([stripped[one] for one in cells], dtype=np.str_)
