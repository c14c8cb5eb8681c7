"""Which feature tables are learned from, and what they hold: named files, or those in the folders of runs."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.evaluate.columns import Layout, Reader

__all__ = ["FeatureTable", "Run", "find_runs", "read_labels", "read_table", "run_record", "tables_under"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

KEYS = ("seq", "stamp_ns", "track_id")
CLASS = "class"


@dataclass(frozen=True, slots=True)
class Run:
    """The feature tables of one run, and what says which of its tracks is what."""

    tables: tuple[Path, ...]
    tracks: Path | None = None
    truth: Path | None = None
    labels: Path | None = None  # what somebody says the tracks are
    record: Path | None = None  # run.json


@dataclass(frozen=True, eq=False)
class FeatureTable:
    """One table: a row per track and ping that describes it."""

    path: Path
    stamp_ns: IntArray  # (n,)
    track_id: IntArray  # (n,)
    names: tuple[str, ...]
    values: FloatArray  # (n, p); nan: unknown
    word: npt.NDArray[np.str_] | None  # (n,) the column `class`, if there is one
    digest: str  # of the file's bytes


def find_runs(
    paths: Sequence[Path], truth: Path | None = None, labels: Path | None = None
) -> tuple[Run, ...]:
    """The runs in files and folders; a folder without tables gives those of the folders in it.

    Tracks, truth and labels lie beside a table; `truth` and `labels` take the place of theirs. Raises
    UserError for a path without a feature table.
    """
    found: dict[Path, list[Path]] = {}
    for path in paths:
        files = [path] if not path.is_dir() else tables_under(path)
        if not files:
            raise UserError(f"{path}: holds no feature table; let a graph write one with feature-table")
        for file in files:
            if file not in found.setdefault(file.parent, []):
                found[file.parent].append(file)
    return tuple(_run(folder, files, truth, labels) for folder, files in found.items())


def tables_under(folder: Path) -> list[Path]:
    """The feature tables in a folder; in one without any, those in all folders below."""
    own = [path for path in _files(folder.iterdir()) if _is_table(path)]
    return own or [path for path in _files(folder.rglob("*")) if _is_table(path)]


def _files(paths: Iterable[Path]) -> list[Path]:
    return sorted(path for path in paths if path.suffix.lower() in (".csv", ".parquet") and path.is_file())


def _is_table(path: Path) -> bool:
    header = _header(path)
    return set(KEYS) <= set(header) and "x_m" not in header


def _run(folder: Path, files: list[Path], truth: Path | None, labels: Path | None) -> Run:
    beside = [path for path in _files(folder.iterdir()) if path.suffix.lower() == ".csv"]
    headers = {path: _header(path) for path in beside}
    tracks = [path for path, header in headers.items() if {"track_id", "x_m"} <= set(header)]
    known = [truth] if truth else [path for path, header in headers.items() if "target_id" in header]
    said = [path for path, header in headers.items() if set(header) == {"track_id", CLASS}]
    said = [labels] if labels else said
    for what, several in (("tracks", tracks), ("truth", known), ("labels", said)):
        if len(several) > 1:
            raise UserError(f"{several[0]} and {several[1]}: both hold {what}; leave one in the folder")
    record = folder / "run.json"
    return Run(
        tuple(files),
        tracks[0] if tracks else None,
        known[0] if known else None,
        said[0] if said else None,
        record if record.is_file() else None,
    )


def _header(path: Path) -> list[str]:
    if path.suffix.lower() == ".parquet":
        return list(_parquet(path, schema=True).names)
    with Reader(path).opened() as file:
        return [name.strip() for name in next(csv.reader(file), [])]


def read_table(path: Path) -> FeatureTable:
    """The table in a CSV or Parquet file; raises UserError that names the file and what is wrong."""
    header = _header(path)
    missing = [name for name in KEYS if name not in header]
    if missing:
        raise UserError(f"{path}: lacks the columns {', '.join(missing)}; feature-table writes such a table")
    names = tuple(name for name in header if name not in (*KEYS, CLASS))
    if not names:
        raise UserError(f"{path}: holds no features; did the run describe any track?")
    if path.suffix.lower() == ".parquet":
        columns = _parquet_columns(path, header)
    else:
        layout = Layout("track_id", ("track_id",), (*names, CLASS), whole=("track_id",), text=(CLASS,))
        chunks = list(Reader(path).chunks(layout))
        columns = {name: np.concatenate([one[name] for one in chunks]) for name in (*header, "entry")}
        columns = {name: column[columns["entry"]] for name, column in columns.items()}
    values = np.stack([np.asarray(columns[name], float) for name in names], axis=1)
    word = columns.get(CLASS)
    return FeatureTable(
        path,
        np.asarray(columns["stamp_ns"], np.int64),
        np.asarray(columns["track_id"], np.int64),
        names,
        values,
        None if word is None else np.asarray(word, np.str_),
        sha256(path.read_bytes()).hexdigest(),
    )


def _parquet_columns(path: Path, header: list[str]) -> dict[str, npt.NDArray[Any]]:
    table = _parquet(path, schema=False)
    columns: dict[str, npt.NDArray[Any]] = {}
    for name in header:
        column = np.asarray(table.column(name).to_numpy())
        if name == CLASS:
            columns[name] = np.array(["" if one is None else str(one) for one in column], np.str_)
        elif column.dtype.kind in "iufb":
            columns[name] = column
        else:
            raise UserError(f"{path}: column '{name}' holds {column.dtype}; a feature is a number")
    return columns


def _parquet(path: Path, *, schema: bool) -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise UserError(f"{path}: Parquet needs pyarrow; pip install 'fls-flow[train]'") from error
    try:
        return pyarrow.parquet.read_schema(path) if schema else pyarrow.parquet.read_table(path)
    except pyarrow.ArrowException as error:
        raise UserError(f"{path}: is no Parquet file ({' '.join(str(error).split())})") from error
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}; check the path") from error


def read_labels(path: Path) -> dict[int, str]:
    """Track id to class, of a CSV file with the columns track_id and class.

    Raises UserError with file and line for what is no id, and for a track that stands twice.
    """
    found: dict[int, str] = {}
    reader = Reader(path)
    with reader.opened() as file:
        for row in (rows := csv.DictReader(file)):
            named = {str(name).strip(): str(value).strip() for name, value in row.items()}
            try:
                track = int(named["track_id"])
            except ValueError:
                text = named["track_id"][:40]
                reader.fault(rows.line_num, f"track_id is '{text}'; it takes a whole number")
            if track in found:
                reader.fault(rows.line_num, f"track_id {track} stands twice")
            found[track] = named[CLASS]
    return found


def run_record(run: Run) -> dict[str, Any] | None:
    """Graph, digest and seeds of the run that wrote the tables, as its `run.json` has them."""
    if run.record is None:
        return None
    try:
        document = json.loads(run.record.read_text(encoding="utf-8"))
        seeds = {
            f"{node}.{name}": value
            for node, one in document["nodes"].items()
            for name, value in one["with"].items()
            if name == "seed"
        }
        return {"graph": document["graph"], "digest": document["digest"], "seeds": seeds}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run.record}: is no record of a run ({type(error).__name__}: {error})") from error
