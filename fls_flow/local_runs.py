"""The runs of this user on this machine: a private folder each, where processes meet and `top` finds them."""

from __future__ import annotations

import json
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from fls_flow.errors import RunError, UserError

__all__ = ["LocalRun", "announce", "find", "listed", "meeting_place"]

SOCKET_PATH_BYTES = 107  # sun_path of Linux, without its final zero
ABOUT = "run.json"
OWNER = "the.pid"  # of its supervisor; no process has a name with a dot
ROOM_BYTES = 64 << 10
TRIES, TRY_S = 5, 0.02


@dataclass(frozen=True)
class LocalRun:
    """A run on this machine, and where its Zenoh session listens."""

    run: str
    graph: str
    host: str
    endpoint: str
    pid: int  # of its supervisor


def _bases() -> list[Path]:
    given = os.environ.get("XDG_RUNTIME_DIR")
    own = Path(tempfile.gettempdir()) / f"fls-flow-{os.getuid()}"
    return [*([Path(given) / "fls-flow"] if given and Path(given).is_absolute() else []), own]


@contextmanager
def meeting_place(run: str, names: Iterable[str]) -> Iterator[Path]:
    """A private folder in which the processes of a run meet, with a socket of each name; removed at the end.

    It lies under `$XDG_RUNTIME_DIR/fls-flow`; without one, where nothing can be made in it, or where the
    names of sockets become too long for the system, under a private folder of this user in the temporary one.
    Raises RunError when that is not private, or when nothing can be made in it either.
    """
    bases = _bases()
    longest = max((len(os.fsencode(name)) for name in names), default=0) + len("/") + len(".lock")
    fitting = [one for one in bases if len(os.fsencode(one / run)) + longest < SOCKET_PATH_BYTES]
    if not fitting:
        raise RunError(f"{bases[-1]}: too long for sockets; set XDG_RUNTIME_DIR to a shorter folder")
    path = _made(fitting, run)
    try:
        yield path
    finally:
        _remove(path)


def _made(folders: Sequence[Path], run: str) -> Path:
    """A new folder for the run in the first of these in which one can be made."""
    reasons = []
    for folder in folders:
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _private(folder)
            _sweep(folder)
            (folder / run).mkdir(mode=0o700)
            _claim(folder / run)
            return folder / run
        except OSError as error:
            reasons.append(f"{folder}: cannot be used: {error.strerror}")
    raise RunError(f"{'; '.join(reasons)}; set XDG_RUNTIME_DIR to a folder of your own")


def _claim(folder: Path) -> None:
    """Note whose it is; raise OSError, and remove it, without room for what a run keeps in it."""
    trial = folder / "the.room"
    try:
        (folder / OWNER).write_text(str(os.getpid()), encoding="utf-8")
        trial.write_bytes(bytes(ROOM_BYTES))
        trial.unlink()
    except OSError:
        _remove(folder)
        raise


def _remove(folder: Path) -> None:
    """Remove a folder from which a closing session may be taking its own files at this moment."""
    for _ in range(TRIES):
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return
        time.sleep(TRY_S)


def _private(folder: Path) -> None:
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise RunError(f"{folder}: is not a private folder of this user; remove it or set XDG_RUNTIME_DIR")


def _sweep(folder: Path) -> None:
    """Remove what runs that were killed whole have left behind."""
    for path in folder.glob(f"*/{OWNER}"):
        try:
            os.kill(int(path.read_text(encoding="utf-8")), 0)
        except ProcessLookupError:
            shutil.rmtree(path.parent, ignore_errors=True)
        except (OSError, ValueError, OverflowError):
            continue  # it has just ended, or is not ours to judge


def announce(place: Path, graph: str, run: str, host: str, endpoint: str) -> None:
    """Let others of this user find the run that meets at `place`."""
    about = LocalRun(run, graph, host, endpoint, os.getpid())
    draft = place / f".{ABOUT}"
    draft.write_text(json.dumps(asdict(about)), encoding="utf-8")
    draft.replace(place / ABOUT)


def listed() -> list[LocalRun]:
    """The runs of this user that are alive, by graph and run."""
    found = []
    for path in [path for base in _bases() for path in base.glob(f"*/{ABOUT}")]:
        try:
            one = LocalRun(**json.loads(path.read_text(encoding="utf-8")))
            os.kill(one.pid, 0)
        except (OSError, ValueError, TypeError):
            continue  # it has just ended, or was killed
        found.append(one)
    return sorted(set(found), key=lambda one: (one.graph, one.run, one.host))


def find(prefix: str | None) -> LocalRun:
    """The run whose id begins with `prefix`; without one, the only run.

    Raises UserError that lists the runs.
    """
    runs = [one for one in listed() if one.run.startswith(prefix or "")]
    if len({one.run for one in runs}) == 1:
        return runs[0]
    known = "; ".join(f"{one.run} ({one.graph})" for one in (runs or listed())) or "none"
    if prefix is not None and not runs:
        raise UserError(f"no run begins with '{prefix}'; runs on this machine: {known}")
    which = "name one of them" if runs else "start one, or name another machine's with --connect"
    raise UserError(f"runs on this machine: {known}; {which}")
