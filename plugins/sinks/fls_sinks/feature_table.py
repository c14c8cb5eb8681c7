"""Write features to a table, a row per track and ping: what `fls-flow train` learns from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fls_flow import Features, InputError, hookimpl
from fls_sinks.csv_file import CsvFile
from fls_sinks.parquet_file import ParquetFile

__all__ = ["KEYS", "FeatureTable"]

KEYS = ("seq", "stamp_ns", "track_id")
FORMATS = (".csv", ".parquet")


@dataclass
class FeatureTable:
    """`seq,stamp_ns,track_id`, then a column per feature; a ping without features has no row.

    A `.csv` file grows ping by ping, with floats that read back exactly; `.parquet` (needs the extra
    `train`) is written whole when the run ends.

    Raises InputError when the names of the features change: a table has one set of columns.
    """

    path: Path = Path("features.csv")
    _names: tuple[str, ...] = field(default=(), init=False, repr=False)
    _file: CsvFile | ParquetFile = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if self.path.suffix.lower() not in FORMATS:
            raise ValueError(f"path must end in {' or '.join(FORMATS)}, not {self.path}")
        self._file = self._made(())

    def __call__(self, features: Features) -> None:
        """Append the features of one ping."""
        if features.names and features.names != self._names:
            if self._names:
                raise InputError(f"{self.path}: features change from {self._names} to {features.names}")
            self._names = features.names
            self._file = self._made(features.names)
        if len(features):
            rows = zip(features.track_id.tolist(), features.values.tolist(), strict=True)
            entries = [(track_id, *values) for track_id, values in rows]
            self._file.write(features.seq, features.stamp_ns, entries)

    def close(self) -> None:
        """Close the file; one without features holds the header."""
        self._file.close()

    def snapshot(self) -> dict[str, Any]:
        """Columns, and the length of the file or its rows."""
        return {"names": list(self._names), **self._file.snapshot()}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on where the snapshot was taken."""
        self._names = tuple(snapshot["names"])
        self._file = self._made(self._names)
        self._file.restore(**{name: value for name, value in snapshot.items() if name != "names"})

    def _made(self, names: tuple[str, ...]) -> CsvFile | ParquetFile:
        if self.path.suffix.lower() == ".csv":
            return CsvFile(self.path, (*KEYS, *names))
        return ParquetFile(self.path, (*KEYS, *names), dict.fromkeys(KEYS, np.int64))


@hookimpl
def fls_node() -> type[FeatureTable]:
    """Return the node of kind `feature-table`."""
    return FeatureTable
