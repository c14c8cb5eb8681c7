"""A sweep's folder: which grid it holds, and a row for each cell that is done.

`sweep.json` says what is swept. `cells.jsonl` grows by one whole line per cell, each on disk before the next,
so a sweep that was stopped goes on where it was. A line cut short by a crash is dropped.
"""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from fls_flow.errors import UserError
from fls_flow.tools.cell import Row

__all__ = ["Records"]


class Records:
    """The rows of one sweep; one process at a time may hold them, as a context."""

    def __init__(self, folder: Path, about: dict[str, Any]) -> None:
        """Hold `folder`, new or of the same sweep.

        Raises UserError when it holds another sweep, is in use, or cannot be written.
        """
        self.path = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(folder / "cells.jsonl", os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        except OSError as error:
            raise UserError(f"--out {folder}: cannot be written: {error.strerror}") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._same(about)
            self.rows = self._read()
        except BlockingIOError as error:
            os.close(self._file)
            raise UserError(
                f"--out {folder}: another sweep is writing there; wait for it, or name a new folder"
            ) from error
        except BaseException:
            os.close(self._file)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    def append(self, row: Row) -> None:
        """Add a cell's row: whole, and on disk."""
        line = json.dumps(dataclasses.asdict(row), separators=(",", ":")) + "\n"
        os.write(self._file, line.encode())
        self.rows[row.index] = row  # at once: a signal while the disk is slow finds it done
        os.fsync(self._file)

    def write(self, name: str, text: str) -> None:
        """Write a file of the folder: whole, or not at all."""
        draft = self.path / f".{name}.part"
        draft.write_text(text, encoding="utf-8")
        os.replace(draft, self.path / name)

    def _same(self, about: dict[str, Any]) -> None:
        path = self.path / "sweep.json"
        about = json.loads(json.dumps(about))  # as it will be read back
        if not path.exists():
            if os.fstat(self._file).st_size:
                raise UserError(f"--out {self.path}: holds cells but no sweep.json; name a new folder")
            self.write("sweep.json", json.dumps(about, indent=2) + "\n")
            return
        try:
            held = json.loads(path.read_text(encoding="utf-8"))
            differing = sorted(key for key in {*held, *about} if held.get(key) != about.get(key))
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise UserError(f"{path}: is no sweep's; name a new --out folder") from error
        if differing:
            raise UserError(
                f"--out {self.path}: holds another sweep ({', '.join(differing)} differ); name a new folder"
            )

    def _read(self) -> dict[int, Row]:
        """The last row of each cell; a torn end is cut off."""
        text = (self.path / "cells.jsonl").read_bytes()
        whole = text.rfind(b"\n") + 1
        if whole < len(text):
            os.ftruncate(self._file, whole)
        rows: dict[int, Row] = {}
        for number, line in enumerate(text[:whole].splitlines(), 1):
            try:
                row = Row(**json.loads(line))
            except (ValueError, TypeError) as error:
                raise UserError(
                    f"{self.path / 'cells.jsonl'}:{number}: is no row of a sweep; remove it"
                ) from error
            rows[row.index] = row
        return rows
