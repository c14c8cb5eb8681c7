"""Large messages between the processes of one host: written once into shared memory, read there by all.

A producing process has an `Arena`: one file of a memory file system, of which it hands out slots. A consuming
process opens a slot's descriptor in its `Window` and gets an array that is no copy. Each reader has a byte in
the slot's entry, which it clears when its last view has died: so a slot is never written while somebody reads
it, and giving it back takes no message. Layout and rules: docs/shared_memory.md.
"""

from __future__ import annotations

import fcntl
import logging
import os
import re
import threading
import time
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.errors import LinkError
from fls_flow.links._blocks import PAGE, Blocks, capacity_of
from fls_flow.links._shared_file import ENTRIES, MAX_READERS, TABLE_BYTES, SharedFile, Table, opened

__all__ = ["MAX_READERS", "SHARED_MEMORY", "Arena", "Descriptor", "Slot", "Window", "domain", "sweep"]

SHARED_MEMORY = Path("/dev/shm")

_log = logging.getLogger(__name__)
_NAME = re.compile(r"fls-[A-Za-z0-9._-]{1,200}")


class Descriptor(NamedTuple):
    """Where a message lies: what a reader is sent in its place."""

    name: str  # of the file
    slot: int
    offset: int  # bytes from the begin of the file, a multiple of 64
    size: int  # bytes
    generation: int  # tells this message from others that had the slot


@dataclass(frozen=True, slots=True)
class Slot:
    """Room for one message, leased to its readers from the beginning."""

    view: memoryview  # writable, as long as the message, aligned to 64 bytes
    descriptor: Descriptor
    _table: Table

    def release(self, reader: int) -> None:
        """Take back the lease of a reader who will not be told of the slot."""
        self._table.release(self.descriptor.slot, reader, self.descriptor.generation)


class Arena:
    """Slots in the file `name` of `folder`, which has at most `max_bytes`; threads may share it.

    The file is made at the first `place`. When it cannot be made or cannot grow, that is logged once and
    `place` has no slot to give. Raises ValueError for a name that does not begin with "fls-" or is no plain
    file name, and for a `max_bytes` without room for a slot.
    """

    def __init__(self, name: str, *, folder: Path = SHARED_MEMORY, max_bytes: int = 256 << 20) -> None:
        if max_bytes < TABLE_BYTES + PAGE:
            raise ValueError(f"max_bytes is {max_bytes}; an arena takes at least {TABLE_BYTES + PAGE}")
        self.name = _checked(name)
        self._path = folder / name
        self._lock = threading.Lock()
        self._blocks = Blocks(TABLE_BYTES, max_bytes // PAGE * PAGE)
        self._leased: dict[int, list[tuple[int, int]]] = {}  # slot and offset, by the capacity of the block
        self._unused = [*reversed(range(ENTRIES))]
        self._generation = time.time_ns()  # so that arenas of one name share no generation
        self._file: SharedFile | None = None
        self._usable, self._warned = True, False
        self._too_much = self._blocks.end  # what there was no memory for

    @property
    def allocated(self) -> int:
        """Bytes of memory that the file takes."""
        return 0 if self._file is None else self._file.table.allocated

    def place(self, size: int, readers: int) -> Slot | None:
        """A slot for `size` bytes, leased to each reader whose bit is set; None: send the bytes instead.

        Raises ValueError when nothing is to be placed, or for nobody.
        """
        if size < 1 or not 0 < readers < 1 << MAX_READERS:
            raise ValueError(
                f"a slot has {size} bytes for readers {readers:#x}; it takes 1 of {MAX_READERS} at least"
            )
        capacity = capacity_of(size)
        with self._lock:
            file = self._file or self._create()
            offset = self._find(file, capacity) if file else None
            if file is None or offset is None:
                return None
            slot = self._unused.pop()
            self._leased.setdefault(capacity, []).append((slot, offset))
            self._generation += 1
            file.table.lease(slot, readers, self._generation)
            descriptor = Descriptor(self.name, slot, offset, size, self._generation)
            return Slot(file.content[offset : offset + size], descriptor, file.table)

    def leased(self) -> int:
        """How many slots are with their readers."""
        with self._lock:
            self._collect()
            return sum(map(len, self._leased.values()))

    def drop(self, reader: int) -> None:
        """End all leases of a reader whose process has ended; its number may then be given to another."""
        with self._lock:
            slots = [slot for leases in self._leased.values() for slot, _ in leases]
            if self._file is not None:
                self._file.table.drop(slots, reader)

    def close(self) -> None:
        """Remove the file; what readers have open stays valid for them."""
        with self._lock:
            if self._file is not None:
                self._path.unlink(missing_ok=True)
                os.close(self._file.fd)
            self._file, self._usable = None, False
            self._leased.clear()

    def _find(self, file: SharedFile, capacity: int) -> int | None:
        """Offset of a free block: the warmest that fits, else a new one, else one joined from others."""
        if not self._unused:
            self._collect()
        if not self._unused:
            return None
        offset = self._blocks.reuse(capacity)
        if offset is None:
            self._collect(capacity)
            offset = self._blocks.reuse(capacity)
        if offset is None:
            offset = self._grow(file, capacity)
        if offset is None:
            self._collect()
            self._blocks.join()
            offset = self._blocks.fit(capacity)
        return self._grow(file, capacity) if offset is None else offset

    def _grow(self, file: SharedFile, capacity: int) -> int | None:
        """Offset of a new block, its memory secured: writing to it cannot end in SIGBUS."""
        needed = self._blocks.tail + capacity
        grown = needed - file.table.allocated
        if needed > self._blocks.end or grown >= self._too_much:
            return None
        try:
            file.secure(needed)
        except OSError as error:
            self._too_much = grown
            self._warn(f"cannot grow to {needed} bytes", error)
            return None
        return self._blocks.carve(capacity)

    def _collect(self, capacity: int | None = None) -> None:
        """Take back the blocks, all or those of one capacity, that every reader has released."""
        if self._file is None:
            return
        for found in list(self._leased) if capacity is None else [capacity]:
            kept = []
            for slot, offset in self._leased.pop(found, ()):
                if self._file.table.is_free(slot):
                    self._blocks.give(offset, found)
                    self._unused.append(slot)
                else:
                    kept.append((slot, offset))
            if kept:
                self._leased[found] = kept

    def _create(self) -> SharedFile | None:
        if self._usable:
            try:
                self._file = SharedFile.create(self._path, self._blocks.end)
            except OSError as error:
                self._usable = False
                self._warn("cannot be made", error)
        return self._file

    def _warn(self, what: str, error: OSError) -> None:
        slower = "messages without a slot are sent as bytes, which is slower"
        if not self._warned:
            _log.warning("shared memory %s %s (%s): %s", self._path, what, error.strerror, slower)
        self._warned = True


class Window:
    """Opens what arenas in `folder` hold; threads may share it.

    A file stays mapped until `forget` or `close`, and beyond that as long as a view of it lives.
    """

    def __init__(self, *, folder: Path = SHARED_MEMORY) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._files: dict[str, SharedFile] = {}

    def open(self, descriptor: Descriptor, reader: int) -> npt.NDArray[np.uint8]:
        """The message's bytes, read-only and in place; the lease of `reader` ends when the last view dies.

        Raises LinkError when the file is gone or foreign, and when the reader has no lease, or has used it.
        """
        file = self._file_of(descriptor, reader)
        _, slot, offset, size, generation = descriptor
        file.table.take(slot, reader)
        array = np.frombuffer(file.content, np.uint8, size, offset)
        # Whatever is made from the array refers to it, as numpy goes no further down than to the last array.
        weakref.finalize(array, file.table.release, slot, reader, generation).atexit = False
        return array

    def release(self, descriptor: Descriptor, reader: int) -> None:
        """End the lease of `reader` without opening the message. Raises LinkError as `open` does."""
        file = self._file_of(descriptor, reader)
        file.table.release(descriptor.slot, reader, descriptor.generation)

    def forget(self, name: str) -> None:
        """Unmap the file of a process that has ended, once its last view has died."""
        with self._lock:
            self._files.pop(name, None)

    def close(self) -> None:
        """Unmap all files, each once its last view has died."""
        with self._lock:
            self._files.clear()

    def _file_of(self, descriptor: Descriptor, reader: int) -> SharedFile:
        """The file, after a check that the reader may open the message in it."""
        name, slot, offset, size, generation = descriptor
        file = self._files.get(name) or self._map(name)
        if not 0 <= slot < ENTRIES or not 0 <= reader < MAX_READERS:
            raise LinkError(f"shared memory {name} has no slot {slot} for a reader {reader}")
        if offset < TABLE_BYTES or size < 1 or offset + size > file.table.allocated:
            raise LinkError(f"shared memory {name} has no {size} bytes at {offset}")
        if not file.table.is_leased(slot, reader, generation):
            raise LinkError(f"shared memory {name}: slot {slot} is not leased to reader {reader} (any more)")
        return file

    def _map(self, name: str) -> SharedFile:
        try:
            path = self._folder / _checked(name)
            with self._lock:
                return self._files.setdefault(name, SharedFile.open(path))
        except (OSError, ValueError) as error:
            raise LinkError(f"shared memory {name!r} cannot be opened: {error}") from error


def domain(folder: Path = SHARED_MEMORY) -> str:
    """A text that is equal for processes that can open each other's arenas, and for no others.

    Containers of one machine may each have their own memory file system, and users cannot open each other's
    files. Empty where there is no `folder`.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8").strip()
        return f"{boot}/{folder.stat().st_dev}/{os.geteuid()}"
    except OSError:
        return ""


def sweep(prefix: str, *, folder: Path = SHARED_MEMORY, abandoned: bool = False) -> list[str]:
    """Remove this user's arenas whose names begin with `prefix`, and give their names.

    With `abandoned`, only those that no living process has mapped, which leaves other runs alone. Raises
    ValueError for a prefix that does not begin with "fls-".
    """
    if not prefix.startswith("fls-"):
        raise ValueError(f"prefix is {prefix!r}; the names of arenas begin with 'fls-'")
    names = sorted(path.name for path in folder.glob("fls-*") if path.name.startswith(prefix))
    return [name for name in names if _NAME.fullmatch(name) and _remove(folder / name, abandoned)]


def _remove(path: Path, abandoned: bool) -> bool:
    try:
        fd = opened(path)
    except OSError:  # gone meanwhile, a link, or somebody else's
        return False
    try:
        if abandoned:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
    except OSError:  # in use, or gone meanwhile
        return False
    finally:
        os.close(fd)
    return True


def _checked(name: str) -> str:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"name is {name!r}; it takes 'fls-' and then letters, digits and ._-")
    return name
