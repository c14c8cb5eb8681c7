"""Play detections from a CSV file."""

from __future__ import annotations

import csv
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn, TextIO

import numpy as np

from fls_flow import Detections, InputError, Mount, View, hookimpl

__all__ = ["COLUMNS", "DetectionsCsv"]

COLUMNS = ("seq", "stamp_ns", "range_m", "bearing_rad", "amplitude")
MAX_LINE_CHARACTERS = 2**16
INT64_MAX = 2**63 - 1
_LOG = logging.getLogger(__name__)

Entry = tuple[float, float, float]  # range, bearing, amplitude


@dataclass
class DetectionsCsv:
    """A message per ping of `seq,stamp_ns,range_m,bearing_rad,amplitude`, read row by row.

    The file does not say what the sonar saw or how well it measured: the parameters do. Raises InputError
    that names file and line.
    """

    path: Path
    range_min_m: float = 0.0
    range_max_m: float = 50.0
    sector_deg: float = 60.0  # from the outer edge of the first beam to that of the last
    n_beams: int = 39
    range_sd_m: float = 0.05
    bearing_sd_deg: float = 1.5
    sound_speed_mps: float = 1500.0
    mount: Mount = field(default_factory=Mount)

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if not 0.0 <= self.range_min_m < self.range_max_m < math.inf:
            raise ValueError(
                "range_min_m must be 0 or more and lie below range_max_m, "
                f"not {self.range_min_m} and {self.range_max_m}"
            )
        if not 0.0 < self.sector_deg <= 360.0:
            raise ValueError(f"sector_deg must lie between 0 and 360, not {self.sector_deg}")
        if self.n_beams < 1:
            raise ValueError(f"n_beams must be 1 or more, not {self.n_beams}")
        for name in ("range_sd_m", "bearing_sd_deg", "sound_speed_mps"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive, not {getattr(self, name)}")

    def __call__(self) -> Iterator[Detections]:
        """Read ping by ping."""
        try:
            with self.path.open(encoding="utf-8-sig", newline="") as file:
                reader = _Reader(self.path, file)
                warned = False
                for (seq, stamp_ns), entries in reader.pings():
                    if not warned and any(entry[0] > self.range_max_m for entry in entries):
                        _LOG.warning("%s: ping %d has echoes beyond range_max_m; set it", self.path, seq)
                        warned = True
                    yield self._detections(seq, stamp_ns, entries)
        except OSError as err:
            raise InputError(f"{self.path}: {err.strerror or err}; check the path") from err
        except UnicodeDecodeError as err:
            raise InputError(f"{self.path}: is no UTF-8 text ({err.reason}); save it as UTF-8") from err

    def _detections(self, seq: int, stamp_ns: int, entries: Sequence[Entry]) -> Detections:
        table = np.array(entries, float).reshape(-1, 3)
        n = len(table)
        variance = np.diag([self.range_sd_m**2, math.radians(self.bearing_sd_deg) ** 2])
        return Detections(
            seq,
            stamp_ns,
            table[:, 0],
            table[:, 1],
            table[:, 2],
            np.zeros((n, 2)),
            np.tile(variance, (n, 1, 1)),
            np.zeros(n, np.uint8),
            self._view(),
        )

    def _view(self) -> View:
        width = math.radians(self.sector_deg) / self.n_beams
        bearing = (np.arange(self.n_beams) - (self.n_beams - 1) / 2) * width
        return View(
            self.range_min_m,
            self.range_max_m,
            self.range_sd_m,
            bearing.astype(np.float64),
            width,
            self.sound_speed_mps,
            self.mount,
        )


@dataclass
class _Reader:
    """Rows of a file grouped to pings; every fault names the line."""

    path: Path
    file: TextIO
    _line: int = field(default=0, init=False)

    def pings(self) -> Iterator[tuple[tuple[int, int], list[Entry]]]:
        """(seq, stamp_ns) and entries of each ping."""
        ping: tuple[int, int] | None = None
        entries: list[Entry] = []
        for row in self._rows():
            key = self._whole("seq", row[0]), self._whole("stamp_ns", row[1])
            if key != ping:
                if ping is not None:
                    if key[1] <= ping[1]:
                        self._fault(f"stamp_ns {key[1]} does not increase; sort the file by ping")
                    yield ping, entries
                ping, entries = key, []
            if any(row[2:]):
                entries.append(self._entry(row))
        if ping is not None:
            yield ping, entries

    def _rows(self) -> Iterator[list[str]]:
        """The contract's columns of each row, in its order."""
        rows = csv.reader(self._lines())
        try:
            header = [name.strip() for name in next(rows, [])]
            missing = [name for name in COLUMNS if name not in header]
            if missing:
                self._fault(f"the header lacks {', '.join(missing)}; it takes {','.join(COLUMNS)}")
            places = [header.index(name) for name in COLUMNS]
            for row in rows:
                if len(row) > len(header):
                    self._fault(f"has {len(row)} fields, the header {len(header)}")
                if row:
                    row += [""] * (len(header) - len(row))
                    yield [row[place].strip() for place in places]
        except csv.Error as err:
            self._fault(f"is no CSV ({err})")

    def _lines(self) -> Iterator[str]:
        while line := self.file.readline(MAX_LINE_CHARACTERS):
            self._line += 1
            if len(line) == MAX_LINE_CHARACTERS:
                self._fault(f"is longer than {MAX_LINE_CHARACTERS} characters; is this a CSV file?")
            yield line

    def _whole(self, name: str, text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            self._fault(f"{name} is '{text[:40]}'; it takes a whole number")
        if abs(value) > INT64_MAX:
            self._fault(f"{name} is {value}; it takes 64 bits")
        return value

    def _entry(self, row: Sequence[str]) -> Entry:
        distance, bearing = self._real("range_m", row[2]), self._real("bearing_rad", row[3])
        if not 0.0 <= distance < math.inf:
            self._fault(f"range_m is {distance}; it takes metres from 0")
        if not abs(bearing) <= math.pi:
            self._fault(f"bearing_rad is {bearing}; it takes radians from -pi to pi (are these degrees?)")
        return distance, bearing, self._real("amplitude", row[4] or "nan")

    def _real(self, name: str, text: str) -> float:
        try:
            return float(text)
        except ValueError:
            self._fault(f"{name} is '{text[:40]}'; it takes a number")

    def _fault(self, what: str) -> NoReturn:
        raise InputError(f"{self.path}:{max(self._line, 1)}: {what}")


@hookimpl
def fls_node() -> type[DetectionsCsv]:
    """Return the node of kind `detections-csv`."""
    return DetectionsCsv
