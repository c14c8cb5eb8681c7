"""NMEA 0183 sentences: checksum, fields, and what those of navigation say.

Angles come out in radians, speeds in m/s. Unknown sentences and empty fields say nothing.

Source: NMEA 0183 as documented by its users (gpsd, "NMEA Revealed"; maker manuals for PASHR and PRDID).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType

__all__ = ["Report", "Sentence", "checksum", "report", "sentence"]

KNOT_MPS = 1852.0 / 3600.0
LONGEST = 512  # characters; the standard has 82, proprietary sentences have more
Degrees = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Sentence:
    """The address without its talker (`GGA`, `PASHR`), and the fields after it."""

    name: str
    fields: tuple[str, ...]

    def number(self, place: int) -> float | None:
        """The field as a finite number; None if it is empty or none."""
        try:
            value = float(self.fields[place])
        except (IndexError, ValueError):
            return None
        return value if math.isfinite(value) else None

    def text(self, place: int) -> str:
        """The field, empty where the sentence is shorter."""
        return self.fields[place] if place < len(self.fields) else ""


@dataclass(slots=True)
class Report:
    """What one sentence says; None: nothing."""

    time_s: float | None = None  # of the day, UTC
    date: tuple[int, int, int] | None = None  # year, month, day
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    heading_rad: float | None = None
    roll_rad: float | None = None
    pitch_rad: float | None = None
    turn_radps: float | None = None
    course_rad: float | None = None  # over ground
    speed_mps: float | None = None  # over ground
    ahead_mps: float | None = None  # over ground, in the body frame
    starboard_mps: float | None = None
    depth_m: float | None = None  # of the vehicle
    altitude_m: float | None = None  # of the transducer over the bottom


def checksum(body: str) -> int:
    """Exclusive or of the characters between `$` and `*`."""
    total = 0
    for character in body:
        total ^= ord(character)
    return total


def sentence(line: str) -> Sentence:
    """The sentence in a line.

    Raises ValueError when there is none, or its checksum is wrong or missing.
    """
    text = line.strip()
    start = text.rfind("$")
    if start < 0 or len(text) > LONGEST:
        raise ValueError("no sentence")
    body, star, given = text[start + 1 :].partition("*")
    try:
        right = bool(star) and int(given[:2], 16) == checksum(body)
    except ValueError:
        right = False
    if not right:
        raise ValueError(f"checksum {given[:2]!r} is wrong; it must be {checksum(body):02X}")
    address, *fields = body.split(",")
    name = address if address.startswith("P") else address[2:]
    return Sentence(name, tuple(fields))


def report(one: Sentence) -> Report:
    """What a sentence says of the vehicle's motion."""
    reader = _READERS.get(one.name)
    return Report() if reader is None else reader(one)


def _gga(one: Sentence) -> Report:
    fixed = one.number(5)
    place = _place(one, 1) if fixed else (None, None)
    return Report(time_s=_time(one.text(0)), latitude_deg=place[0], longitude_deg=place[1])


def _rmc(one: Sentence) -> Report:
    said = Report(time_s=_time(one.text(0)), date=_short_date(one.text(8)))
    if one.text(1) == "A":
        said.latitude_deg, said.longitude_deg = _place(one, 2)
        said.speed_mps, said.course_rad = _scaled(one.number(6), KNOT_MPS), _angle(one.number(7))
    return said


def _zda(one: Sentence) -> Report:
    day, month, year = (one.number(place) for place in (1, 2, 3))
    if day is None or month is None or year is None:
        return Report(time_s=_time(one.text(0)))
    return Report(time_s=_time(one.text(0)), date=(int(year), int(month), int(day)))


def _hdt(one: Sentence) -> Report:
    return Report(heading_rad=_angle(one.number(0)))


def _vtg(one: Sentence) -> Report:
    return Report(course_rad=_angle(one.number(0)), speed_mps=_scaled(one.number(4), KNOT_MPS))


def _vbw(one: Sentence) -> Report:
    if one.text(5) != "A":  # over ground; over water is no help
        return Report()
    return Report(ahead_mps=_scaled(one.number(3), KNOT_MPS), starboard_mps=_scaled(one.number(4), KNOT_MPS))


def _rot(one: Sentence) -> Report:
    rate = one.number(0) if one.text(1) == "A" else None
    return Report(turn_radps=_scaled(rate, math.pi / 180.0 / 60.0))


def _pashr(one: Sentence) -> Report:
    heading = one.number(1) if one.text(2) == "T" else None
    return Report(
        time_s=_time(one.text(0)),
        heading_rad=_angle(heading),
        roll_rad=_angle(one.number(3)),
        pitch_rad=_angle(one.number(4)),
    )


def _prdid(one: Sentence) -> Report:
    pitch, roll, heading = (_angle(one.number(place)) for place in range(3))
    return Report(pitch_rad=pitch, roll_rad=roll, heading_rad=heading)


def _xdr(one: Sentence) -> Report:
    """Groups of type, value, unit and name."""
    said = Report()
    for start in range(0, len(one.fields) - 3, 4):
        kind, unit, name = one.text(start), one.text(start + 2), one.text(start + 3).upper()
        value = one.number(start + 1)
        if kind == "A" and unit == "D" and name.startswith(("PTCH", "PITCH")):
            said.pitch_rad = _angle(value)
        elif kind == "A" and unit == "D" and name.startswith("ROLL"):
            said.roll_rad = _angle(value)
        elif kind == "D" and unit == "M" and name.startswith("DEPTH"):
            said.depth_m = value
    return said


def _dbt(one: Sentence) -> Report:
    return Report(altitude_m=one.number(2))


def _dpt(one: Sentence) -> Report:
    return Report(altitude_m=one.number(0))


_READERS: MappingProxyType[str, Callable[[Sentence], Report]] = MappingProxyType(
    {
        "GGA": _gga,
        "RMC": _rmc,
        "ZDA": _zda,
        "HDT": _hdt,
        "THS": _hdt,
        "VTG": _vtg,
        "VBW": _vbw,
        "ROT": _rot,
        "PASHR": _pashr,
        "PRDID": _prdid,
        "XDR": _xdr,
        "DBT": _dbt,
        "DPT": _dpt,
    }
)


def _angle(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)


def _scaled(value: float | None, by: float) -> float | None:
    return None if value is None else value * by


def _time(text: str) -> float | None:
    """Seconds of the day of hhmmss.ss."""
    try:
        hours, minutes, seconds = int(text[:2]), int(text[2:4]), float(text[4:])
    except ValueError:
        return None
    sound = 0 <= hours < 24 and 0 <= minutes < 60 and 0.0 <= seconds < 61.0
    return 3600.0 * hours + 60.0 * minutes + seconds if sound else None


def _short_date(text: str) -> tuple[int, int, int] | None:
    """Of ddmmyy; years from 1980 to 2079."""
    if len(text) != 6 or not text.isdigit():
        return None
    day, month, year = int(text[:2]), int(text[2:4]), int(text[4:])
    return (year + (1900 if year >= 80 else 2000), month, day)


def _place(one: Sentence, place: int) -> tuple[float | None, float | None]:
    """Latitude and longitude, degrees, of four fields from `place` on."""
    latitude = _dm(one.number(place), one.text(place + 1), "N", "S", 90.0)
    longitude = _dm(one.number(place + 2), one.text(place + 3), "E", "W", 180.0)
    return (latitude, longitude) if latitude is not None and longitude is not None else (None, None)


def _dm(value: float | None, side: str, plus: str, minus: str, most: float) -> float | None:
    """Degrees of (d)ddmm.mm."""
    if value is None or value < 0.0 or side not in (plus, minus):
        return None
    degrees = math.floor(value / 100.0)
    angle = degrees + (value - 100.0 * degrees) / 60.0
    if angle > most:
        return None
    return angle if side == plus else -angle
