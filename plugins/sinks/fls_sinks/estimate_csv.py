"""Write the estimates of a PHD filter to a CSV file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fls_flow import Intensity, hookimpl
from fls_sinks.csv_file import Cell, CsvFile

__all__ = ["COLUMNS", "EstimateCsv", "rows"]

COLUMNS = ("seq", "stamp_ns", "expected_targets", "x_m", "y_m", "vx_mps", "vy_mps", "weight", "frame")


@dataclass
class EstimateCsv:
    """A row per estimate and ping; a ping without estimates is one row with the expected number alone."""

    path: Path = Path("estimates.csv")
    _file: CsvFile = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._file = CsvFile(Path(self.path), COLUMNS)

    def __call__(self, intensity: Intensity) -> None:
        """Append the estimates of one ping; they are on disk afterwards."""
        self._file.write(intensity.seq, intensity.stamp_ns, rows(intensity))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def snapshot(self) -> dict[str, Any]:
        """The length of the file."""
        return self._file.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on where the snapshot was taken; later rows are cut off."""
        self._file.restore(snapshot["offset"])


def rows(intensity: Intensity) -> Iterator[tuple[Cell, ...]]:
    """One tuple per estimate: `COLUMNS` from `expected_targets` on."""
    expected = float(intensity.expected_targets)
    if not len(intensity):
        yield (expected, *[""] * (len(COLUMNS) - 3))
    for state, weight in zip(intensity.state.tolist(), intensity.weight.tolist(), strict=True):
        yield (expected, *state, weight, intensity.frame)


@hookimpl
def fls_node() -> type[EstimateCsv]:
    """Return the node of kind `estimate-csv`."""
    return EstimateCsv
