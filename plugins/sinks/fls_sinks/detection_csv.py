"""Write detections to a CSV file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fls_flow import Detections, hookimpl
from fls_sinks.csv_file import CsvFile

__all__ = ["COLUMNS", "DetectionCsv"]

COLUMNS = ("seq", "stamp_ns", "range_m", "bearing_rad", "amplitude")


@dataclass
class DetectionCsv:
    """A row per detection, in the order of the message."""

    path: Path = Path("detections.csv")
    _file: CsvFile = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._file = CsvFile(Path(self.path), COLUMNS)

    def __call__(self, detections: Detections) -> None:
        """Append the detections of one ping; they are on disk afterwards."""
        table = np.column_stack([detections.range_m, detections.bearing_rad, detections.amplitude])
        self._file.write(detections.seq, detections.stamp_ns, table.tolist())

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def snapshot(self) -> dict[str, Any]:
        """The length of the file."""
        return self._file.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on where the snapshot was taken; later rows are cut off."""
        self._file.restore(snapshot["offset"])


@hookimpl
def fls_node() -> type[DetectionCsv]:
    """Return the node of kind `detection-csv`."""
    return DetectionCsv
