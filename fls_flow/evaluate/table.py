"""The four CSV files that programs exchange, as tables in order of time."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fls_flow.evaluate.columns import FRAMES, Layout, Reader

__all__ = ["MARKS", "Kind", "Table", "kind_of", "read"]

IntArray = npt.NDArray[np.int64]
Kind = Literal["tracks", "truth", "estimates", "detections"]

_VELOCITY = ("vx_mps", "vy_mps")
_LAYOUTS: dict[Kind, Layout] = {
    "tracks": Layout(
        "track_id",
        ("track_id", "x_m", "y_m"),
        ("status", *_VELOCITY, "var_x", "cov_xy", "var_y", "label", "probability", "frame"),
        whole=("track_id",),
        text=("status", "label", "frame"),
        unique=True,
    ),
    "truth": Layout(
        "target_id",
        ("target_id", "x_m", "y_m"),
        (*_VELOCITY, "class", "frame"),
        whole=("target_id",),
        text=("class", "frame"),
        unique=True,
    ),
    "estimates": Layout(
        "x_m", ("expected_targets", "x_m", "y_m"), (*_VELOCITY, "weight", "frame"), text=("frame",)
    ),
    "detections": Layout("range_m", ("range_m", "bearing_rad"), ("amplitude",)),
}
# the column that no other kind of file has
MARKS: dict[Kind, str] = {
    "tracks": "track_id",
    "detections": "range_m",
    "estimates": "expected_targets",
    "truth": "target_id",
}


SEPARATORS = (";", "\t", "|")  # of programs that mean something else by CSV


@dataclass(frozen=True, eq=False)
class Table:
    """One file: its pings in order of time, and its entries in order of ping."""

    path: Path
    kind: Kind
    seq: IntArray  # (n_pings,)
    stamp_ns: IntArray  # (n_pings,), increasing
    ping: IntArray  # (n,) the ping of each entry, not decreasing
    line: IntArray  # (n,) where each entry stands in the file
    columns: dict[str, npt.NDArray[Any]]  # (n,) each: int64, float64 (nan: unknown) or str
    frame: str
    expected_targets: npt.NDArray[np.float64] | None = None  # (n_pings,), of estimates


def kind_of(path: Path) -> Kind | None:
    """What one column of its header says a file is; None for none of the four kinds.

    Raises UserError when it cannot be read.
    """
    reader = Reader(path)
    with reader.opened() as file:
        names = next(csv.reader(file), [])
    for separator in SEPARATORS if len(names) == 1 else ():
        if set(names[0].split(separator)) & set(MARKS.values()):
            reader.fault(1, f"its columns are separated by {separator!r}; save it with commas")
    header = {name.strip() for name in names}
    if "track_id" in header and not header & {"x_m", "y_m", "status"}:
        return None  # what else is known of tracks, as a table of features
    return next((kind for kind, mark in MARKS.items() if mark in header), None)


def read(path: Path, kind: Kind) -> Table:
    """The file as columns; columns and rows may stand in any order.

    Further columns are ignored; what a missing optional one would say is unknown.
    Raises UserError with file and line of the first fault.
    """
    reader = Reader(path)
    chunks = list(reader.chunks(_LAYOUTS[kind]))
    columns = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
    return _ordered(reader, kind, columns)


def _ordered(reader: Reader, kind: Kind, columns: dict[str, npt.NDArray[Any]]) -> Table:
    layout = _LAYOUTS[kind]
    order = np.argsort(columns["stamp_ns"], kind="stable")
    columns = {name: column[order] for name, column in columns.items()}
    stamp_ns, first, ping = np.unique(columns["stamp_ns"], return_index=True, return_inverse=True)
    line, seq = columns.pop("line"), columns["seq"]
    other = np.flatnonzero(seq != seq[first][ping])
    if other.size:
        row = int(other[0])
        reader.fault(line[row], f"stamp_ns {stamp_ns[ping[row]]} is that of seq {seq[first][ping[row]]} too")
    expected = columns["expected_targets"][first] if kind == "estimates" else None
    entry = columns.pop("entry")
    columns = {name: column[entry] for name, column in columns.items()}
    if layout.unique:
        _refuse_repeated(reader, layout.key, columns, ping[entry], line[entry])
    frame = _frame(reader, columns, line[entry])
    return Table(reader.path, kind, seq[first], stamp_ns, ping[entry], line[entry], columns, frame, expected)


def _refuse_repeated(
    reader: Reader, key: str, columns: dict[str, npt.NDArray[Any]], ping: IntArray, line: IntArray
) -> None:
    order = np.lexsort((columns[key], ping))
    same = (np.diff(ping[order]) == 0) & (np.diff(columns[key][order]) == 0)
    if same.any():
        row = order[1:][same][0]
        seq, name = columns["seq"][row], columns[key][row]
        reader.fault(line[row], f"{key} {name} stands twice in ping seq {seq}; it takes one row per ping")


def _frame(reader: Reader, columns: dict[str, npt.NDArray[Any]], line: IntArray) -> str:
    if "frame" not in columns or not line.size:
        return "sensor"
    frames = np.where(columns["frame"] == "", "sensor", columns["frame"])
    reader.one_of("frame", frames, FRAMES, line)
    other = np.flatnonzero(frames != frames[0])
    if other.size:
        row = int(other[np.argmin(line[other])])
        reader.fault(line[row], f"frame is '{frames[row]}' after '{frames[0]}'; it takes one frame per file")
    return str(frames[0])
