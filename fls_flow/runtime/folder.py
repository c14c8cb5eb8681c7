"""A run's folder: where its sinks write, `run.json` with what ran, `run.log` with what was said."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import importlib.metadata
import json
import logging
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fls_flow.errors import RunError, UserError
from fls_flow.graph import Graph

__all__ = ["RunFolder"]


class RunFolder:
    """The folder of one run; a run never overwrites another's files. `shown` is its path as it was given."""

    def __init__(self, path: Path) -> None:
        self.shown, self.path = path, path.absolute()  # a node may change the working directory

    @classmethod
    def create(cls, graph: Graph, path: Path | None = None) -> RunFolder:
        """The folder `path`, by default `runs/<graph>/<UTC time>/`.

        Raises UserError when it belongs to another run or cannot be made.
        """
        try:
            if path is None:
                return cls(_unused(Path("runs") / graph.name))
            path.mkdir(parents=True, exist_ok=True)
            (path / "run.json").open("x").close()
        except FileExistsError as error:
            if path is None:
                raise UserError(f"{error.filename}: is a file where a folder is needed") from error
            if not path.is_dir():
                raise UserError(f"--out {path}: is a file; name a folder") from error
            raise UserError(f"--out {path}: holds another run; name a new folder") from error
        except OSError as error:
            what = f"--out {path}" if path is not None else error.filename
            raise UserError(f"{what}: cannot be made: {error.strerror}") from error
        return cls(path)

    def occupied(self, graph: Graph) -> list[Path]:
        """Files of the graph's sinks that stand here already."""
        paths = [
            self.path / value
            for node in graph.nodes
            if node.is_sink
            for value in node.parameters().values()
            if isinstance(value, Path)
        ]
        return [path for path in paths if path.is_file()]

    def record(self, document: dict[str, Any]) -> None:
        """Write `run.json`: whole, or not at all. Raises RunError."""
        draft = self.path / ".run.json.part"
        try:
            draft.write_text(json.dumps(document, indent=2, default=_plain) + "\n", encoding="utf-8")
            os.replace(draft, self.path / "run.json")
        except OSError as error:
            draft.unlink(missing_ok=True)
            raise RunError(f"{self.path / 'run.json'}: cannot be written: {error.strerror}") from error

    @contextmanager
    def logging(self) -> Iterator[None]:
        """Write the log of the run to `run.log`."""
        handler = _QuietFile(self.path / "run.log", encoding="utf-8", delay=True)
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        handler.setLevel(logging.INFO)
        root = logging.getLogger()
        root.addHandler(handler)
        try:
            yield
        finally:
            root.removeHandler(handler)
            handler.close()


class _QuietFile(logging.FileHandler):
    """A log file that does not drown the errors of a full disk in tracebacks."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record; where the file cannot even be opened, nothing: who logs is not to blame."""
        with contextlib.suppress(OSError):
            super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 -- logging's name
        """Say nothing: what was to be logged is shown on the terminal too."""

    def close(self) -> None:
        """Close the file; what of it finds no room is let go."""
        with contextlib.suppress(OSError):
            super().close()


def _unused(folder: Path) -> Path:
    """A new folder named by the time, with an empty `run.json`; runs that begin at once get one each."""
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    folder.mkdir(parents=True, exist_ok=True)
    path, n = folder / now, 1
    while True:
        try:
            path.mkdir()
        except FileExistsError:
            n += 1
            path = folder / f"{now}-{n}"
        else:
            (path / "run.json").open("x").close()
            return path


def _plain(value: Any) -> Any:
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else str(value)  # type: ignore[arg-type]


def describe(graph: Graph) -> dict[str, Any]:
    """What `run.json` says of a graph: its nodes, kinds, parameters, wires and the versions behind them."""
    names = {node.kind.listing.distribution for node in graph.nodes if node.kind.listing is not None}
    versions = {name: importlib.metadata.version(name) for name in sorted(names | {"fls-flow", "numpy"})}
    nodes = {
        node.name: {
            "use": node.kind.name,
            "with": node.parameters(),
            "in": {wire.port: str(wire) for wire in node.inputs},
            "on_error": node.on_error,
        }
        for node in graph.nodes
    }
    versions = {"python": platform.python_version(), **versions}
    file = str(graph.path) if graph.path else None
    return {"graph": graph.name, "file": file, "digest": graph.digest, "versions": versions, "nodes": nodes}
