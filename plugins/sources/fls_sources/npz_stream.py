"""Read arrays of an npz archive in pieces, so that memory stays bounded whatever the archive claims."""

from __future__ import annotations

import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from fls_flow.errors import InputError

__all__ = ["Member", "NpzArchive"]

MAX_PIECE_BYTES = 2**28  # the largest piece held in memory; no sonar's ping or table comes near
_DAMAGE = (
    EOFError,
    MemoryError,  # of the parser, in nested headers
    OSError,
    OverflowError,
    RuntimeError,  # an encrypted member; also NotImplementedError
    SyntaxError,  # of a dtype's text; numpy lets it through
    TypeError,
    ValueError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


@dataclass(frozen=True, slots=True)
class Member:
    """What the header of one array says, checked against the member's size."""

    key: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def piece_bytes(self) -> int:
        """Bytes of one entry along the first axis."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize


class NpzArchive:
    """The arrays of an npz file: tables as a whole, long arrays entry by entry along their first axis.

    Every fault raises InputError in one line that begins with the path.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip = _opened(path)

    def __enter__(self) -> NpzArchive:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._zip.close()

    def __contains__(self, key: str) -> bool:
        return f"{key}.npy" in self._zip.NameToInfo

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the arrays, sorted."""
        return tuple(sorted(name.removesuffix(".npy") for name in self._zip.namelist()))

    def fault(self, what: str) -> InputError:
        """The error that says `what` about this file."""
        return InputError(f"{self.path}: {what}")

    def member(self, key: str) -> Member:
        """Shape and dtype of an array, without loading it."""
        with self._stream(key) as (member, _):
            return member

    def table(self, key: str) -> npt.NDArray[Any]:
        """A whole array."""
        with self._stream(key) as (member, stream):
            size = math.prod(member.shape) * member.dtype.itemsize
            if size > MAX_PIECE_BYTES:
                raise self.fault(f"'{key}' claims {size} bytes; a table takes at most {MAX_PIECE_BYTES}")
            return self._piece(member, stream, size).reshape(member.shape)

    def pieces(self, key: str, first: int, stop: int) -> Iterator[npt.NDArray[Any]]:
        """Entries `first` to `stop` along the first axis, each with memory of its own."""
        with self._stream(key) as (member, stream):
            size = member.piece_bytes
            if size > MAX_PIECE_BYTES:
                raise self.fault(f"one ping of '{key}' claims {size} bytes; at most {MAX_PIECE_BYTES}")
            for index in range(stop):
                piece = self._piece(member, stream, size)
                if index >= first:
                    yield piece.reshape(member.shape[1:])

    def _piece(self, member: Member, stream: IO[bytes], size: int) -> npt.NDArray[Any]:
        with self._faults(member.key):
            raw = stream.read(size)
        if len(raw) != size:
            raise self.fault(f"'{member.key}' ends early; copy or convert the recording again")
        piece = np.frombuffer(raw, member.dtype)
        return piece.astype(member.dtype.newbyteorder("="), copy=False)

    @contextmanager
    def _stream(self, key: str) -> Iterator[tuple[Member, IO[bytes]]]:
        if key not in self:
            raise self.fault(
                f"has no '{key}' but {', '.join(self.keys) or 'nothing'}; see docs/recordings.md"
            )
        entry = self._zip.NameToInfo[f"{key}.npy"]
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise self.fault(f"'{key}' is not deflated; write it with numpy.savez_compressed")
        with self._faults(key):
            stream = self._zip.open(entry)
        with stream:
            yield self._header(key, entry.file_size, stream), stream

    def _header(self, key: str, size: int, stream: IO[bytes]) -> Member:
        with self._faults(key):
            version = np.lib.format.read_magic(stream)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"npy version {version}")
            read = (
                np.lib.format.read_array_header_1_0
                if version == (1, 0)
                else np.lib.format.read_array_header_2_0
            )
            shape, fortran, dtype = read(stream)
            claimed = stream.tell() + math.prod(shape) * dtype.itemsize
        if dtype.kind not in "biufcSU" or not dtype.itemsize:
            raise self.fault(f"'{key}' holds {dtype}, not numbers; save it as a plain array")
        if fortran and sum(n > 1 for n in shape) > 1:
            raise self.fault(f"'{key}' is in Fortran order; save numpy.ascontiguousarray({key})")
        if claimed != size or any(n < 0 for n in shape):
            raise self.fault(f"'{key}' claims shape {shape} in {size} bytes; convert the recording again")
        return Member(key, shape, dtype)

    @contextmanager
    def _faults(self, key: str) -> Iterator[None]:
        try:
            yield
        except _DAMAGE as err:
            cause = " ".join(str(err).split())[:200] or type(err).__name__
            raise self.fault(f"'{key}' is damaged ({cause}); copy or convert the recording again") from err


def _opened(path: Path) -> zipfile.ZipFile:
    try:
        with path.open("rb") as file:
            magic = file.read(6)
        return zipfile.ZipFile(path)
    except (zipfile.BadZipFile, NotImplementedError, struct.error, ValueError) as err:
        if magic.startswith(b"PK"):
            raise InputError(f"{path}: is a truncated or damaged npz; copy it again") from err
        if magic == b"\x93NUMPY":
            raise InputError(f"{path}: is one npy array; write it by numpy.savez with its geometry") from err
        raise InputError(f"{path}: is not an npz file; see docs/recordings.md for the layout") from err
    except OSError as err:
        raise InputError(f"{path}: {err.strerror or err}; check the path") from err
