"""Write what a simulator knows of its targets to a CSV file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fls_flow import Truth, hookimpl
from fls_sinks.csv_file import Cell, CsvFile

__all__ = ["COLUMNS", "TruthCsv", "rows"]

COLUMNS = ("seq", "stamp_ns", "target_id", "x_m", "y_m", "vx_mps", "vy_mps", "class", "frame")


@dataclass
class TruthCsv:
    """A row per target and ping."""

    path: Path = Path("truth.csv")
    _file: CsvFile = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._file = CsvFile(Path(self.path), COLUMNS)

    def __call__(self, truth: Truth) -> None:
        """Append the targets of one ping; they are on disk afterwards."""
        self._file.write(truth.seq, truth.stamp_ns, rows(truth))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def snapshot(self) -> dict[str, Any]:
        """The length of the file."""
        return self._file.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on where the snapshot was taken; later rows are cut off."""
        self._file.restore(snapshot["offset"])


def rows(truth: Truth) -> Iterator[tuple[Cell, ...]]:
    """One tuple per target: `COLUMNS` from `target_id` on."""
    targets = zip(truth.target_id.tolist(), truth.state.tolist(), truth.class_name, strict=True)
    for target, state, name in targets:
        yield (target, *state, name, truth.frame)


@hookimpl
def fls_node() -> type[TruthCsv]:
    """Return the node of kind `truth-csv`."""
    return TruthCsv
