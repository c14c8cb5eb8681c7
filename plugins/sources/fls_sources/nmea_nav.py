"""Navigation from NMEA 0183 sentences: a UDP stream, or a file of them."""

from __future__ import annotations

import datetime
import logging
import math
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from fls_flow import InputError, NavState, hookimpl
from fls_sources.nmea_sentences import LONGEST, Report, report

__all__ = ["Epoch", "NmeaNav"]

EARTH_M, FLATTENING = 6_378_137.0, 1.0 / 298.257223563  # WGS 84
DAY_S = 86_400
POLL_S = 0.2  # how often a waiting socket looks whether it is to end
MAX_DATAGRAM = 65_535
MOST_COMPLAINTS = 5
NAN = float("nan")
_LOG = logging.getLogger(__name__)


@dataclass
class NmeaNav:
    """Navigation samples: from the file `path`, or live from UDP datagrams at `host`, `port`.

    Read are GGA, RMC, ZDA, HDT, THS, VTG, VBW, ROT, DBT, DPT, XDR (PTCH, ROLL, DEPTH), PASHR and PRDID, of
    any talker; others are passed over, and so are lines with a wrong or no checksum: the log says so. A
    sample holds what was said since the one before, and nan otherwise: `nav-fusion` joins them quantity by
    quantity. Live, each datagram makes a sample, stamped when it arrived. In a file, a new time of day in
    GGA, RMC, ZDA or PASHR begins a sample; the date comes from RMC or ZDA, else from `date` (YYYY-MM-DD).

    Position is north and east of `origin_deg` (latitude, longitude), by default of the first fix. Course and
    speed over ground become velocity ahead and to starboard once a heading is known; VBW says it without.

    `host` is this machine's own address to listen at: with the default nobody else can send.
    Raises InputError for a file that cannot be read, holds no sentence or has no date, and for an address
    that cannot be bound.
    """

    path: Path | None = None
    host: str = "127.0.0.1"
    port: int = 10110
    date: str = ""
    origin_deg: tuple[float, float] | None = None
    _closing: threading.Event = field(default_factory=threading.Event, init=False, repr=False)

    def __post_init__(self) -> None:
        if not 1 <= self.port <= 65_535:
            raise ValueError(f"port is {self.port}; it must lie between 1 and 65535")
        if self.date:
            _day(self.date)
        if self.origin_deg is not None:
            latitude, longitude = self.origin_deg
            if not (abs(latitude) < 90.0 and abs(longitude) <= 180.0):
                raise ValueError(f"origin_deg is {self.origin_deg}; it must be latitude and longitude")

    @property
    def live(self) -> bool:
        """Whether samples come from outside, in their own time."""
        return self.path is None

    def __call__(self) -> Iterator[NavState]:
        """Every sample, in the order of the sentences."""
        return self._received() if self.path is None else self._read(self.path)

    def close(self) -> None:
        """End a live iterator, from any thread."""
        self._closing.set()

    def _read(self, path: Path) -> Iterator[NavState]:
        epoch = Epoch(self.origin_deg, None if not self.date else _day(self.date))
        seq = 0
        try:
            with path.open("rb") as file:
                for said in _reports(_lines(iter(lambda: file.readline(LONGEST), b"")), str(path)):
                    if epoch.begins(said) and not epoch.empty:
                        yield epoch.sample(seq, self._file_stamp(epoch, path))
                        seq += 1
                    epoch.add(said)
        except OSError as err:
            raise InputError(f"{path}: {err.strerror or err}; check the path") from err
        if not epoch.empty:
            yield epoch.sample(seq, self._file_stamp(epoch, path))
            seq += 1
        if not seq:
            raise InputError(f"{path}: no NMEA 0183 sentence of navigation with a right checksum")

    def _file_stamp(self, epoch: Epoch, path: Path) -> int:
        stamp = epoch.stamp_ns
        if stamp is None:
            raise InputError(f"{path}: sentences without date or time of day; set date: YYYY-MM-DD, add ZDA")
        return stamp

    def _received(self) -> Iterator[NavState]:
        where = f"udp://{self.host}:{self.port}"
        epoch = Epoch(self.origin_deg, None)
        with self._bound(where) as endpoint:
            seq, last_ns = 0, 0
            while not self._closing.is_set():
                try:
                    datagram = endpoint.recv(MAX_DATAGRAM)
                except TimeoutError:
                    continue
                last_ns = max(time.time_ns(), last_ns + 1)
                for said in _reports(_lines(datagram.splitlines()), where):
                    epoch.add(said)
                if not epoch.empty:
                    yield epoch.sample(seq, last_ns)
                    seq += 1

    def _bound(self, where: str) -> socket.socket:
        endpoint: socket.socket | None = None
        try:
            found = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_DGRAM)[0]
            endpoint = socket.socket(found[0], socket.SOCK_DGRAM)
            endpoint.bind(found[4])
            endpoint.settimeout(POLL_S)
        except OSError as err:
            if endpoint is not None:
                endpoint.close()
            reason = err.strerror or err
            raise InputError(f"{where}: {reason}; check host and port, or who else listens there") from err
        return endpoint


@dataclass
class Epoch:
    """Gathers reports into one sample; the last word on each quantity counts."""

    origin_deg: tuple[float, float] | None
    day: int | None  # since 1970
    _said: Report = field(default_factory=Report)
    _time_s: float | None = None
    _heading_rad: float | None = None  # the last one ever
    _empty: bool = True

    @property
    def empty(self) -> bool:
        """Whether nothing was said since the last sample."""
        return self._empty

    @property
    def stamp_ns(self) -> int | None:
        """The epoch's time; None without date or time of day."""
        if self.day is None or self._time_s is None:
            return None
        return self.day * DAY_S * 1_000_000_000 + round(self._time_s * 1e9)

    def begins(self, said: Report) -> bool:
        """Whether the report belongs to a later time than those gathered."""
        return said.time_s is not None and self._time_s is not None and said.time_s != self._time_s

    def add(self, said: Report) -> None:
        """Take a report."""
        if said.time_s is not None:
            past_midnight = self._time_s is not None and said.time_s < self._time_s - DAY_S / 2
            if past_midnight and self.day is not None and said.date is None:
                self.day += 1
            self._time_s = said.time_s
        if said.date is not None:
            self.day = _days(*said.date, otherwise=self.day)
        if said.heading_rad is not None:
            self._heading_rad = said.heading_rad
        news = {name: value for name in _QUANTITIES if (value := getattr(said, name)) is not None}
        self._said = replace(self._said, **news)
        self._empty &= not news

    def sample(self, seq: int, stamp_ns: int) -> NavState:
        """The sample of what was gathered; then a new epoch begins."""
        said, self._said, self._empty = self._said, Report(), True
        north, east = self._place(said)
        heading = NAN if said.heading_rad is None else math.remainder(said.heading_rad, math.tau)
        ahead, starboard = self._velocity(said)
        return NavState(
            seq,
            stamp_ns,
            (north, east, _or_nan(said.depth_m)),
            (_or_nan(said.roll_rad), _or_nan(said.pitch_rad), heading),
            (NAN, NAN, _or_nan(said.turn_radps)),
            (ahead, starboard, NAN),
            _or_nan(said.altitude_m),
        )

    def _place(self, said: Report) -> tuple[float, float]:
        """North and east of the origin, on the ellipsoid's radii there."""
        if said.latitude_deg is None or said.longitude_deg is None:
            return NAN, NAN
        if self.origin_deg is None:
            self.origin_deg = (said.latitude_deg, said.longitude_deg)
        latitude = math.radians(self.origin_deg[0])
        squash = FLATTENING * (2.0 - FLATTENING)
        bend = 1.0 - squash * math.sin(latitude) ** 2
        prime = EARTH_M / math.sqrt(bend)
        meridian = prime * (1.0 - squash) / bend
        east_deg = math.remainder(said.longitude_deg - self.origin_deg[1], 360.0)
        north = meridian * math.radians(said.latitude_deg - self.origin_deg[0])
        return north, prime * math.cos(latitude) * math.radians(east_deg)

    def _velocity(self, said: Report) -> tuple[float, float]:
        if said.ahead_mps is not None and said.starboard_mps is not None:
            return said.ahead_mps, said.starboard_mps
        if said.speed_mps is None or said.course_rad is None or self._heading_rad is None:
            return NAN, NAN
        drift = said.course_rad - self._heading_rad
        return said.speed_mps * math.cos(drift), said.speed_mps * math.sin(drift)


_QUANTITIES = (
    "latitude_deg",
    "longitude_deg",
    "heading_rad",
    "roll_rad",
    "pitch_rad",
    "turn_radps",
    "course_rad",
    "speed_mps",
    "ahead_mps",
    "starboard_mps",
    "depth_m",
    "altitude_m",
)


def _lines(raw: Iterable[bytes]) -> Iterator[str]:
    return (line.decode("ascii", "replace") for line in raw)


def _reports(lines: Iterable[str], where: str) -> Iterator[Report]:
    """What the sentences say; lines that are none are counted in the log."""
    bad = 0
    for line in lines:
        if not line.strip():
            continue
        try:
            said = report(line)
        except ValueError as err:
            bad += 1
            if bad <= MOST_COMPLAINTS:
                more = "; no more is said of such lines" if bad == MOST_COMPLAINTS else ""
                _LOG.warning("%s: passed over %r: %s%s", where, line.strip()[:80], err, more)
            continue
        yield said


def _or_nan(value: float | None) -> float:
    return NAN if value is None else value


def _day(text: str) -> int:
    """Days since 1970 of YYYY-MM-DD; raises ValueError."""
    try:
        return datetime.date.fromisoformat(text).toordinal() - datetime.date(1970, 1, 1).toordinal()
    except ValueError as err:
        raise ValueError(f"date is {text!r}; it must be YYYY-MM-DD") from err


def _days(year: int, month: int, day: int, *, otherwise: int | None) -> int | None:
    """Days since 1970; `otherwise` for a date that does not exist."""
    try:
        return datetime.date(year, month, day).toordinal() - datetime.date(1970, 1, 1).toordinal()
    except ValueError:
        return otherwise


@hookimpl
def fls_node() -> type[NmeaNav]:
    """The kind `nmea-nav`."""
    return NmeaNav
