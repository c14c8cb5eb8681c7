"""A Parquet file of number columns, written whole at the end."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import InputError

__all__ = ["ParquetFile"]


@dataclass
class ParquetFile:
    """Rows under fixed columns, kept in memory until `close`; the file never replaces another.

    Columns are float64 where `dtypes` names no other. Raises InputError where pyarrow is not installed.
    """

    path: Path
    columns: tuple[str, ...]
    dtypes: Mapping[str, npt.DTypeLike] = field(default_factory=dict)
    _rows: list[Sequence[Any]] = field(default_factory=list, init=False, repr=False)
    _begun: bool = field(default=False, init=False, repr=False)
    _closed: bool = field(default=False, init=False, repr=False)

    def write(self, seq: int, stamp_ns: int, entries: Iterable[Sequence[Any]]) -> None:
        """Append one row per entry."""
        self._begin()
        self._rows.extend((seq, stamp_ns, *entry) for entry in entries)

    def close(self) -> None:
        """Write the file; one without rows holds the columns alone."""
        if self._closed:
            return
        self._begin()
        self._closed = True
        import pyarrow
        import pyarrow.parquet

        table = pyarrow.table(dict(zip(self.columns, self._arrays(), strict=True)))
        part = self.path.with_name(f".{self.path.name}-{os.getpid()}.part")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            pyarrow.parquet.write_table(table, part)
            os.link(part, self.path)  # unlike a rename, refuses to replace a file
        except FileExistsError as error:
            raise self._taken() from error
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror or error})") from error
        finally:
            part.unlink(missing_ok=True)

    def snapshot(self) -> dict[str, Any]:
        """All rows so far, a column each."""
        return {"rows": self._arrays()}

    def restore(self, rows: Sequence[npt.NDArray[Any]]) -> None:
        """Go on from the rows of a snapshot."""
        self._rows = list(zip(*(np.asarray(column).tolist() for column in rows), strict=True))

    def _begin(self) -> None:
        """Find out before there are rows to lose whether the file can be written."""
        if self._begun:
            return
        if importlib.util.find_spec("pyarrow") is None:
            raise InputError(
                f"{self.path}: Parquet needs pyarrow; pip install 'fls-flow[train]', or take .csv"
            )
        if self.path.exists():
            raise self._taken()
        self._begun = True

    def _taken(self) -> InputError:
        return InputError(f"{self.path}: exists already; choose another path, or move it away")

    def _arrays(self) -> list[npt.NDArray[Any]]:
        columns = zip(*self._rows, strict=True) if self._rows else [()] * len(self.columns)
        return [
            np.array(values, self.dtypes.get(name, np.float64))
            for name, values in zip(self.columns, columns, strict=True)
        ]
