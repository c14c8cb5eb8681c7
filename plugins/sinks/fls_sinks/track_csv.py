"""Write tracks to a CSV file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fls_flow import Classes, Tracks, TrackStatus, hookimpl
from fls_sinks.csv_file import Cell, CsvFile

__all__ = ["COLUMNS", "TrackCsv", "rows"]

COLUMNS = (
    "seq",
    "stamp_ns",
    "track_id",
    "status",
    "x_m",
    "y_m",
    "vx_mps",
    "vy_mps",
    "var_x",
    "cov_xy",
    "var_y",
    "label",
    "probability",
    "frame",
)
_WORD = {int(status): status.name.lower() for status in TrackStatus}


@dataclass
class TrackCsv:
    """A row per track and ping; label and probability are those of `classes`, empty without it."""

    path: Path = Path("tracks.csv")
    _file: CsvFile = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._file = CsvFile(Path(self.path), COLUMNS)

    def __call__(self, tracks: Tracks, classes: Classes | None = None) -> None:
        """Append the tracks of one ping; they are on disk afterwards."""
        self._file.write(tracks.seq, tracks.stamp_ns, rows(tracks, classes))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def snapshot(self) -> dict[str, Any]:
        """The length of the file."""
        return self._file.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on where the snapshot was taken; later rows are cut off."""
        self._file.restore(snapshot["offset"])


def rows(tracks: Tracks, classes: Classes | None) -> Iterator[tuple[Cell, ...]]:
    """One tuple per track: `COLUMNS` from `track_id` on."""
    described = {} if classes is None else _described(classes)
    kinematic = np.column_stack(
        [tracks.state, tracks.covariance[:, 0, 0], tracks.covariance[:, 0, 1], tracks.covariance[:, 1, 1]]
    ).tolist()
    for track_id, status, numbers in zip(tracks.id.tolist(), tracks.status.tolist(), kinematic, strict=True):
        yield (track_id, _WORD[status], *numbers, *described.get(track_id, ("", "")), tracks.frame)


def _described(classes: Classes) -> dict[int, tuple[str, float]]:
    return {
        track_id: (classes.names[label], posterior[label])
        for track_id, label, posterior in zip(
            classes.track_id.tolist(), classes.label.tolist(), classes.posterior.tolist(), strict=True
        )
        if 0 <= label < len(classes.names)
    }


@hookimpl
def fls_node() -> type[TrackCsv]:
    """Return the node of kind `track-csv`."""
    return TrackCsv
