"""Which files of a run are scored: named one by one, or found in its folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fls_flow.errors import UserError
from fls_flow.evaluate.recording import topics_of
from fls_flow.evaluate.table import MARKS, Kind, kind_of

__all__ = ["Files", "find"]


@dataclass(frozen=True, slots=True)
class Files:
    """What is scored against what."""

    truth: Path
    tracks: Path | None = None
    detections: Path | None = None
    estimates: Path | None = None


def find(paths: Sequence[Path], truth: Path | None = None) -> Files:
    """The files among `paths`, each known by its header.

    A folder gives all of its CSV files, a recording its topics; `run.mcap#topic` is one of them.

    Raises UserError when two are of one kind, one is of none, or there is no truth or nothing to score.
    """
    if truth is not None and truth.suffix == ".mcap":
        truth = _truth_in(truth)
    found: dict[Kind, Path] = {}
    for path in paths:
        for file in _within(path):
            kind = kind_of(file)
            if kind is None and path.is_dir():
                continue  # a folder may hold other tables
            if kind is None:
                raise UserError(
                    f"{file}:1: has none of the columns {', '.join(MARKS.values())}; is it of a run?"
                )
            if kind == "truth" and truth is not None:
                continue
            if kind in found and found[kind] != file:
                raise UserError(f"{found[kind]} and {file}: both hold {kind}; name one of them")
            found[kind] = file
    known = truth or found.pop("truth", None)
    where = ", ".join(map(str, paths))
    if known is None:
        raise UserError(f"{where}: no truth in there; name its file with --truth")
    if not found:
        wanted = [mark for kind, mark in MARKS.items() if kind != "truth"]
        raise UserError(f"{where}: nothing to score; it takes a file with {' or '.join(wanted)}")
    return Files(known, found.get("tracks"), found.get("detections"), found.get("estimates"))


def _within(path: Path) -> list[Path]:
    """The files of a folder, the topics of a recording."""
    if path.is_dir():
        return sorted(path.glob("*.csv"))
    return topics_of(path) if path.suffix == ".mcap" else [path]


def _truth_in(path: Path) -> Path:
    found = [topic for topic in topics_of(path) if kind_of(topic) == "truth"]
    if not found:
        raise UserError(f"--truth {path}: has no topic of truth")
    return found[0]
