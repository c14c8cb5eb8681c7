"""Play a recording of polar images from an npz file (layout: docs/recordings.md)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import Mount, Ping, hookimpl
from fls_sources.npz_stream import Member, NpzArchive

__all__ = ["PolarNpz"]

Array = npt.NDArray[Any]
AMPLITUDES = tuple(np.dtype(d) for d in (np.uint8, np.uint16, np.float32))


@dataclass
class PolarNpz:
    """The pings of a recording, in order; memory is bounded by one ping.

    Raises InputError for a file that is missing, damaged or lacks geometry.
    """

    path: Path
    range_max_m: float | None = None  # of the last range row, for files with relative ranges
    start_ns: int | None = None  # stamp of the file's first ping; None: as in the file, 0 if it has none
    first: int = 0  # index of the first ping to play
    pings: int | None = None  # how many to play; None: to the end
    mount: Mount = field(default_factory=Mount)

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if self.range_max_m is not None and not 0 < self.range_max_m < math.inf:
            raise ValueError(f"range_max_m must be positive, not {self.range_max_m}")
        if self.first < 0:
            raise ValueError(f"first must be 0 or more, not {self.first}")
        if self.pings is not None and self.pings < 1:
            raise ValueError(f"pings must be 1 or more, not {self.pings}")

    def __len__(self) -> int:
        with NpzArchive(self.path) as archive:
            first, stop = self._selection(archive, _image(archive).shape[0])
        return stop - first

    def __call__(self) -> Iterator[Ping]:
        """Read and check all tables at once, then give ping by ping."""
        with NpzArchive(self.path) as archive:
            n_pings, n_ranges, n_beams = _image(archive).shape
            first, stop = self._selection(archive, n_pings)
            tables = _Tables(
                _range_m(archive, n_ranges, self.range_max_m),
                _bearing_rad(archive, n_beams),
                _seq(archive, n_pings),
                _stamp_ns(archive, n_pings, self.start_ns),
                *(_scalar(archive, name, default) for name, default in _SCALARS.items()),
            )
        return self._play(tables, first, stop)

    def _selection(self, archive: NpzArchive, n_pings: int) -> tuple[int, int]:
        if self.first >= n_pings:
            raise archive.fault(f"has {n_pings} pings; parameter first = {self.first} lies beyond")
        wanted = n_pings if self.pings is None else self.first + self.pings
        return self.first, min(wanted, n_pings)

    def _play(self, tables: _Tables, first: int, stop: int) -> Iterator[Ping]:
        with NpzArchive(self.path) as archive:
            masks = _masks(archive, _image(archive), first, stop)
            for index, amplitude in enumerate(archive.pieces("image", first, stop), first):
                yield Ping(
                    int(tables.seq[index]),
                    int(tables.stamp_ns[index]),
                    amplitude,
                    tables.range_m.copy(),
                    tables.bearing_rad.copy(),
                    next(masks),
                    tables.beamwidth_rad,
                    tables.sound_speed_mps,
                    tables.frequency_hz,
                    self.mount,
                )


_SCALARS = {"beamwidth_rad": math.nan, "sound_speed_mps": 1500.0, "frequency_hz": math.nan}


@dataclass(frozen=True, slots=True)
class _Tables:
    range_m: Array
    bearing_rad: Array
    seq: Array
    stamp_ns: Array
    beamwidth_rad: float
    sound_speed_mps: float
    frequency_hz: float


def _image(archive: NpzArchive) -> Member:
    image = archive.member("image")
    if len(image.shape) != 3 or 0 in image.shape:
        raise archive.fault(f"'image' has shape {image.shape}; it takes (n_pings, n_ranges, n_beams)")
    if image.dtype.newbyteorder("=") not in AMPLITUDES:
        raise archive.fault(f"'image' has dtype {image.dtype}; save it as uint8, uint16 or float32")
    return image


def _table(archive: NpzArchive, key: str, length: int, axis: str) -> Array:
    shape = archive.member(key).shape
    if shape != (length,):
        raise archive.fault(f"'{key}' has shape {shape}, but 'image' has {axis} = {length}")
    return archive.table(key)


def _numbers(archive: NpzArchive, key: str, length: int, axis: str) -> Array:
    table = _table(archive, key, length, axis)
    if table.dtype.kind not in "iuf" or not np.isfinite(table).all():
        raise archive.fault(f"'{key}' ({table.dtype}) has entries that are no finite numbers")
    return table.astype(float)


def _range_m(archive: NpzArchive, n_ranges: int, range_max_m: float | None) -> Array:
    key = "range_m" if "range_m" in archive else "range_rel"
    if key not in archive:
        raise archive.fault("has neither 'range_m' nor 'range_rel'; add the range of each image row")
    ranges = _numbers(archive, key, n_ranges, "n_ranges")
    if ranges[0] < 0 or (np.diff(ranges) <= 0).any():
        raise archive.fault(f"'{key}' must start at 0 or more and increase; sort the rows of 'image'")
    if key == "range_m":
        if range_max_m is not None:
            raise archive.fault("has 'range_m' in metres already; leave out the parameter range_max_m")
        return ranges
    if range_max_m is None:
        raise archive.fault("has relative ranges ('range_rel'); give the parameter range_max_m")
    if abs(ranges[-1] - 1.0) > 1e-6:
        raise archive.fault(f"'range_rel' ends with {ranges[-1]}; its last entry must be 1")
    return ranges * range_max_m


def _bearing_rad(archive: NpzArchive, n_beams: int) -> Array:
    if "bearing_rad" not in archive:
        raise archive.fault("has no 'bearing_rad'; add the bearing of each image column, rad to starboard")
    bearing = _numbers(archive, "bearing_rad", n_beams, "n_beams")
    if np.abs(bearing).max() > np.pi:
        raise archive.fault(f"'bearing_rad' reaches {np.abs(bearing).max():g}; are these degrees?")
    step = np.diff(bearing)
    if not ((step > 0).all() or (step < 0).all()):
        raise archive.fault("'bearing_rad' is not monotonic; sort the columns of 'image'")
    return bearing


def _seq(archive: NpzArchive, n_pings: int) -> Array:
    if "seq" not in archive:
        return np.arange(n_pings)
    return _integers(archive, "seq", n_pings)


def _stamp_ns(archive: NpzArchive, n_pings: int, start_ns: int | None) -> Array:
    if "stamp_ns" in archive:
        stamps = _integers(archive, "stamp_ns", n_pings)
        if (stamps[1:] <= stamps[:-1]).any():
            index = int(np.argmax(stamps[1:] <= stamps[:-1])) + 1
            raise archive.fault(f"'stamp_ns' does not increase at ping {index}; sort the recording")
        return stamps if start_ns is None else stamps - stamps[0] + start_ns
    if "fps" not in archive:
        raise archive.fault("has neither 'stamp_ns' nor 'fps'; add when the pings were sent")
    period_ns = 1e9 / _scalar(archive, "fps", math.nan)
    if not period_ns >= 1:
        raise archive.fault(f"'fps' gives a ping each {period_ns} ns; it counts pings per second")
    since_first: Array = np.floor(np.arange(n_pings) * period_ns + 0.5).astype(np.int64)
    return since_first + (start_ns or 0)


def _integers(archive: NpzArchive, key: str, n_pings: int) -> Array:
    table = _table(archive, key, n_pings, "n_pings")
    if table.dtype.kind not in "iu" or (table.size and int(table.max()) > np.iinfo(np.int64).max):
        raise archive.fault(f"'{key}' has dtype {table.dtype}; save it as int64")
    return table.astype(np.int64)


def _scalar(archive: NpzArchive, key: str, default: float) -> float:
    if key not in archive:
        return default
    member = archive.member(key)
    if member.shape not in ((), (1,)) or member.dtype.kind not in "iuf":
        raise archive.fault(f"'{key}' has shape {member.shape} and dtype {member.dtype}; it takes one number")
    value = float(archive.table(key).reshape(()))
    if not 0 < value < math.inf:
        raise archive.fault(f"'{key}' is {value}; it must be positive")
    return value


def _masks(archive: NpzArchive, image: Member, first: int, stop: int) -> Iterator[Array | None]:
    if "valid" not in archive:
        return iter([None] * (stop - first))
    valid = archive.member("valid")
    if valid.shape not in (image.shape, image.shape[1:]) or valid.dtype != np.dtype(bool):
        raise archive.fault(
            f"'valid' is {valid.dtype} {valid.shape}; it takes bool {image.shape} or {image.shape[1:]}"
        )
    if len(valid.shape) == 3:
        return archive.pieces("valid", first, stop)
    mask = archive.table("valid")
    return (mask.copy() for _ in range(first, stop))


@hookimpl
def fls_node() -> type[PolarNpz]:
    """Return the node of kind `polar-npz`."""
    return PolarNpz
