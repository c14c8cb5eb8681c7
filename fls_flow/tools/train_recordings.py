"""Features of recordings: a graph that describes tracks is run over each, and its files are learned from."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fls_flow.catalog import Catalog, Kind
from fls_flow.errors import PluginError, UserError
from fls_flow.graph import Graph, find
from fls_flow.graph.check import checked
from fls_flow.graph.read import Draft, Source, giver, override, read
from fls_flow.messages import Ping, Truth
from fls_flow.recording import Recording
from fls_flow.runtime import Run, RunFolder, describe
from fls_flow.tools.train_tables import tables_under

__all__ = ["Describing", "described", "prepared"]

READERS = {".mcap": "mcap-replay", ".npz": "polar-npz", ".oculus": "oculus-raw"}
BESIDE = ("truth.csv", "labels.csv")  # what says what the tracks are; also as STEM.truth.csv, STEM.labels.csv
Told = Callable[[int, int | None], None]  # pings that are done, and all of them


@dataclass(frozen=True)
class Describing:
    """How the tracks of recordings are described, and where the runs of that go."""

    graph: str
    runs: Path
    use: tuple[str, ...] = ()
    set_: tuple[str, ...] = ()


def prepared(
    paths: Sequence[Path], how: Describing, told: Callable[[Path], Told] = lambda recording: _untold
) -> tuple[list[Path], list[Path]]:
    """What to learn from: paths with tables as they are, and the runs over the recordings that others name.

    Gives these paths, and those of the runs in which nothing says what the tracks are. `told` hears of each
    recording, and what it gives of the pings.
    """
    found = [_recordings(path) for path in paths]
    stems = [one.stem for some in found for one in some]
    taken: list[Path] = []
    unknown: list[Path] = []
    for path, recordings in zip(paths, found, strict=True):
        for one in recordings:
            name = one.stem if stems.count(one.stem) == 1 else f"{one.parent.name}-{one.stem}"
            run = described(one, how, name, told(one))
            taken.append(run)
            unknown += [] if any((run / said).exists() for said in BESIDE) else [run]
        taken += [] if recordings else [path]
    return taken, unknown


def _untold(done: int, total: int | None) -> None:
    """Nobody listens."""


def _recordings(path: Path) -> list[Path]:
    """The recordings that a path names: itself, or those in a folder without tables."""
    if not path.is_dir():
        return [] if path.suffix.lower() in (".csv", ".parquet") else [path]
    if tables_under(path):
        return []
    return sorted(one for one in path.rglob("*") if one.suffix.lower() in READERS and one.is_file())


def described(recording: Path, how: Describing, name: str, told: Told = _untold) -> Path:
    """The folder `name` of the run of the graph over a recording, with what beside that says of its tracks.

    A run of the same graph with the same parameters over the same file is not repeated. Raises UserError
    where another run has its folder, GraphError for a graph that cannot read the recording, and what ended
    the run.
    """
    graph = _graph_over(recording, how)
    out = how.runs / name
    about = {**describe(graph), "recording_bytes": recording.stat().st_size}
    if not _is_done(out, about):
        _run(graph, out, about, told)
    for kind, file in _said_of(recording):
        if not (out / kind).exists():
            shutil.copyfile(file, out / kind)
    if recording.suffix.lower() == ".mcap" and not any((out / kind).exists() for kind in BESIDE):
        _truth_within(recording, out / "truth.csv")
    return out


def _graph_over(recording: Path, how: Describing) -> Graph:
    """The graph with the recording in place of its pings; nothing in it asks for the truth any more."""
    catalog, source = Catalog(), read(find(how.graph))
    name = _source_of_pings(source, catalog)
    use, given = list(how.use), {one.partition("=")[0] for one in how.set_}
    if not any(one.startswith(f"{name}=") for one in use) and recording.suffix.lower() in READERS:
        use.append(f"{name}={READERS[recording.suffix.lower()]}")
    settings = [f"{name}.path={json.dumps(str(recording.resolve()))}", *how.set_]
    if f"{name}=mcap-replay" in use and f"{name}.topic" not in given:
        settings.append(f"{name}.topic={json.dumps(Recording(recording).one_topic(Ping))}")
    written = source.drafts[name].use
    if written is not None and use and f"{name}={written.data}" not in use:
        source.drafts[name] = replace(source.drafts[name], given={})  # a scene's count of pings, say
    override(source, use, settings)
    for draft in list(source.drafts.values()):
        _without_truth(source, draft, name, catalog)
    return checked(source, catalog)


def _source_of_pings(source: Source, catalog: Catalog) -> str:
    """The only source of pings of a graph."""
    found = []
    for name, draft in source.drafts.items():
        kind = _kind(draft, catalog)
        if kind is not None and kind.source and (kind.undecided or _gives(kind, Ping)):
            found.append(name)
    if len(found) != 1:
        named = f"has {len(found)} sources of pings; "
        raise UserError(f"--graph {source.name}: {named}a recording takes the place of exactly one")
    return found[0]


def _kind(draft: Draft, catalog: Catalog) -> Kind | None:
    """The kind of a node; None where the check of the graph will say what is wrong with it."""
    with suppress(PluginError):
        if draft.use is not None and isinstance(draft.use.data, str):
            return catalog.load(draft.use.data)
    return None


def _gives(kind: Kind, message: type) -> bool:
    return any(port.message is message for port in kind.outputs)


def _without_truth(source: Source, draft: Draft, giving: str, catalog: Catalog) -> None:
    """Unwire what a node takes of the truth; one that cannot do without goes."""
    kind = _kind(draft, catalog)
    if kind is None:
        return
    ports = [port for port in kind.inputs if port.message is Truth and port.name in draft.wires]
    lost = [port for port in ports if giver(draft.wires[port.name]) == giving]
    if any(not port.optional for port in lost):
        del source.drafts[draft.name]
    elif lost:
        gone = {port.name for port in lost}
        wires = {port: wire for port, wire in draft.wires.items() if port not in gone}
        source.drafts[draft.name] = replace(draft, wires=wires)


def _is_done(out: Path, about: dict[str, Any]) -> bool:
    """Whether the run stands in its folder already; a folder without any is free."""
    if not (out / "run.json").is_file():
        return False
    with suppress(OSError, ValueError):
        found = json.loads((out / "run.json").read_text(encoding="utf-8"))
        alike = all(found.get(key) == about[key] for key in ("digest", "versions", "recording_bytes"))
        if alike and found.get("status") == "finished":
            return True
    raise UserError(
        f"--runs {out.parent}: {out.name} in it is another run, or one that failed; name another folder"
    )


def _run(graph: Graph, out: Path, about: dict[str, Any], told: Told) -> None:
    folder = RunFolder.create(graph, out)
    folder.record({"status": "running", **about})
    run = Run(graph, out=out, on_finished=lambda pings: told(pings, run.total))
    with folder.logging():
        report = run.start()
    folder.record({**about, **report.summary()})
    if report.error is not None:
        raise report.error


def _said_of(recording: Path) -> Iterable[tuple[str, Path]]:
    """Files beside a recording that say what its tracks are, by the names that they get in its run."""
    alone = sum(one.suffix.lower() in READERS for one in recording.parent.iterdir()) == 1
    for name in BESIDE:
        own, shared = recording.with_name(f"{recording.stem}.{name}"), recording.with_name(name)
        if own.is_file():
            yield name, own
        elif alone and shared.is_file():
            yield name, shared


def _truth_within(recording: Path, path: Path) -> None:
    """Write the truth that was recorded with the pings, if it was."""
    found = Recording(recording)
    topics = [topic for topic in found.topics() if found.message_type(topic) is Truth]
    if len(topics) != 1:
        return
    sink = Catalog().load("truth-csv").cls(path=path)
    for message in found.messages(topics[0]):
        sink(message)
    sink.close()
