"""The file behind an arena: a head, a table of leases, and the slots' bytes, mapped into memory.

Layout: docs/shared_memory.md.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import cast

from fls_flow.links._blocks import PAGE

__all__ = ["ENTRIES", "MAX_READERS", "TABLE_BYTES", "SharedFile", "Table", "opened"]

ENTRIES = 1024
MAX_READERS = 56  # what is left of a cache line beside the generation
TABLE_BYTES = (
    PAGE + 64 * ENTRIES
)  # an entry is a cache line: readers of different slots do not disturb each other

_MAGIC = int.from_bytes(b"FLSRING1", "little")
_ALLOCATED = 1  # the head's word that says up to where the file has memory behind it
_POPULATE_WRITE = 23  # MADV_POPULATE_WRITE, which mmap does not name
_LEASED, _OPEN = b"\1", b"\2"
_RELEASED = bytes(MAX_READERS)


class Table:
    """The leases: for each slot the generation of its message, and a byte per reader (0 is released).

    A byte is set by the producer while the slot is free, then written only by its reader. Words and bytes are
    stored whole, so neither side ever sees half of one.
    """

    def __init__(self, content: memoryview) -> None:
        self._flags = content[:TABLE_BYTES]
        self._words = self._flags.cast("Q")

    @property
    def is_valid(self) -> bool:
        """Whether this is the table of an arena."""
        return self._words[0] == _MAGIC

    @property
    def allocated(self) -> int:
        """Bytes of the file, from its begin, that have memory behind them."""
        return self._words[_ALLOCATED]

    @allocated.setter
    def allocated(self, size: int) -> None:
        self._words[_ALLOCATED] = size
        self._words[0] = _MAGIC

    def lease(self, slot: int, readers: int, generation: int) -> None:
        """Lease a free slot to the readers whose bits are set."""
        # The generation first: whoever comes with an older descriptor finds it refused, never a lease.
        self._words[_entry(slot) // 8] = generation
        begin = _flag(slot, 0)
        self._flags[begin : begin + MAX_READERS] = _flags_of(readers)

    def is_leased(self, slot: int, reader: int, generation: int) -> bool:
        """Whether the message is leased to this reader, who has not opened it yet."""
        flag = _flag(slot, reader)
        return self._words[_entry(slot) // 8] == generation and self._flags[flag] == _LEASED[0]

    def take(self, slot: int, reader: int) -> None:
        """Note that the reader has opened the slot."""
        self._flags[_flag(slot, reader)] = _OPEN[0]

    def release(self, slot: int, reader: int, generation: int) -> None:
        """End a reader's lease, unless the slot is another message's by now."""
        if self._words[_entry(slot) // 8] == generation:
            self._flags[_flag(slot, reader)] = 0

    def drop(self, slots: Iterable[int], reader: int) -> None:
        """End the leases of a reader that is gone."""
        for slot in slots:
            self._flags[_flag(slot, reader)] = 0

    def is_free(self, slot: int) -> bool:
        """Whether every reader has released the slot."""
        begin = _flag(slot, 0)
        return self._flags[begin : begin + MAX_READERS] == _RELEASED


@dataclass(frozen=True, slots=True, eq=False)
class SharedFile:
    """A mapped file; it is unmapped when nothing refers to its memory any more.

    As long as it is mapped it holds a shared lock, by which others see that it is in use.
    """

    content: memoryview  # of the whole file; read-only in a reader's
    table: Table
    fd: int = -1  # the producer's, to grow the file; to be closed by who made it

    @classmethod
    def create(cls, path: Path, size: int) -> SharedFile:
        """A new file that can grow to `size`; OSError when it exists, or there is no room for its table."""
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(fd, fcntl.LOCK_SH)  # the mapping keeps a duplicate of fd, and so the lock
            if os.fstat(fd).st_nlink == 0:
                raise OSError(errno.ESTALE, "was swept away")
            os.ftruncate(fd, size)
            os.posix_fallocate(fd, 0, TABLE_BYTES)
            content = memoryview(mmap.mmap(fd, size))
        except OSError:
            path.unlink(missing_ok=True)
            os.close(fd)
            raise
        table = Table(content)
        table.allocated = TABLE_BYTES
        return cls(content, table, fd)

    @classmethod
    def open(cls, path: Path) -> SharedFile:
        """A file that another process of this user has made; OSError when it is none."""
        fd = opened(path)
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
            if os.fstat(fd).st_size <= TABLE_BYTES:
                raise OSError(errno.EINVAL, "is no arena", str(path))
            table = Table(memoryview(mmap.mmap(fd, TABLE_BYTES)))
            content = memoryview(mmap.mmap(fd, 0, access=mmap.ACCESS_READ))
        finally:
            os.close(fd)
        if not table.is_valid:
            raise OSError(errno.EINVAL, "is no arena", str(path))
        return cls(content, table)

    def secure(self, size: int) -> None:
        """Put memory behind the first `size` bytes; OSError when there is not enough."""
        if size > self.table.allocated:
            begin, grown = self.table.allocated, size - self.table.allocated
            os.posix_fallocate(self.fd, begin, grown)
            with suppress(OSError):  # before Linux 5.14, or with larger pages: then page by page at first use
                cast(mmap.mmap, self.content.obj).madvise(_POPULATE_WRITE, begin, grown)
            self.table.allocated = size


def opened(path: Path) -> int:
    """A descriptor of this user's regular file; OSError when it is another's, or a link."""
    fd = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    found = os.fstat(fd)
    if stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid():
        return fd
    os.close(fd)
    raise OSError(errno.EPERM, "is not a file of this user", str(path))


def _entry(slot: int) -> int:
    return PAGE + 64 * slot


def _flag(slot: int, reader: int) -> int:
    return PAGE + 64 * slot + 8 + reader


@lru_cache(maxsize=256)
def _flags_of(readers: int) -> bytes:
    return bytes(readers >> reader & 1 for reader in range(MAX_READERS))
