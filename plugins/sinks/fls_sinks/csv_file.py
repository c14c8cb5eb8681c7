"""A CSV file that grows ping by ping, with whole rows on disk after each."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path

from fls_flow.errors import InputError

__all__ = ["Cell", "CsvFile"]

Cell = str | int | float  # floats are written by repr, so they read back exactly


@dataclass
class CsvFile:
    """Rows under fixed columns; the file is made at the first write and never replaces another."""

    path: Path
    columns: tuple[str, ...]
    _file: FileIO | None = field(default=None, init=False, repr=False)
    _offset: int = field(default=0, init=False, repr=False)  # bytes on disk
    _resumed: bool = field(default=False, init=False, repr=False)
    _closed: bool = field(default=False, init=False, repr=False)

    def write(self, seq: int, stamp_ns: int, entries: Iterable[Sequence[Cell]]) -> None:
        """Append one row per entry, or one row of `seq` and `stamp_ns` alone when there is none."""
        rows = [(seq, stamp_ns, *entry) for entry in entries]
        if not rows:
            rows = [(seq, stamp_ns, *[""] * (len(self.columns) - 2))]
        self._append(rows)

    def close(self) -> None:
        """Close the file; one without pings holds the header."""
        if self._closed:
            return
        self._append([])
        self._closed = True
        if self._file is not None:
            self._file.close()

    def snapshot(self) -> dict[str, int]:
        """The length of the file so far, bytes."""
        return {"offset": self._offset}

    def restore(self, offset: int) -> None:
        """Cut the file to `offset` at the next write, and go on from there."""
        self._offset, self._resumed = int(offset), True

    def _append(self, rows: Iterable[Sequence[Cell]]) -> None:
        with self._faults():
            if self._file is None:
                self._file = self._opened()
            if self._offset == 0:
                rows = [self.columns, *rows]
            text = io.StringIO(newline="")
            csv.writer(text, lineterminator="\n").writerows(rows)
            self._put(self._file, text.getvalue().encode())

    def _put(self, file: FileIO, text: bytes) -> None:
        """Write the whole text; where it does not fit, cut off what was, so that the last row is whole."""
        end, rest = self._offset + len(text), text
        try:
            while rest:
                rest = rest[file.write(rest) :]
        except OSError:
            file.truncate(self._offset)
            file.seek(self._offset)
            raise
        self._offset = end

    def _opened(self) -> FileIO:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self._resumed or (self._offset == 0 and not self.path.exists()):
            return self.path.open("xb", buffering=0)
        file = self.path.open("r+b", buffering=0)
        length = file.seek(0, io.SEEK_END)
        if length < self._offset:
            file.close()
            raise InputError(f"{self.path}: has {length} of {self._offset} bytes; start the run anew")
        file.truncate(self._offset)
        file.seek(self._offset)
        return file

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except OSError as err:
            if isinstance(err, FileExistsError) and err.filename == str(self.path):
                raise InputError(
                    f"{self.path}: exists already; choose another path, or move it away"
                ) from err
            raise InputError(f"{self.path}: cannot be written ({err.strerror or err})") from err
