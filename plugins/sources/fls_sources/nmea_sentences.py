"""What NMEA 0183 sentences of navigation say; pynmeagps reads them.

Angles come out in radians, speeds in m/s. Unknown sentences and empty fields say nothing.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType

from pynmeagps import (
    NMEAMessage,
    NMEAMessageError,
    NMEAParseError,
    NMEAReader,
    NMEATypeError,
    calc_checksum,
)

__all__ = ["LONGEST", "Report", "report"]

KNOT_MPS = 1852.0 / 3600.0
LONGEST = 512  # characters; the standard has 82, proprietary sentences have more
# of Teledyne RD Instruments, which the library does not know: pitch, roll, heading in degrees
PRDID = {"RDID": {"pitch": "DE", "roll": "DE", "heading": "DE"}}


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


def report(line: str) -> Report:
    """What the sentence in a line says of the vehicle's motion.

    It begins at the last `$`, so that a sentence cut off before it does no harm. Raises ValueError when there
    is none, its checksum is wrong or missing, or a field is not what the standard says.
    """
    text = line.strip()
    start = text.rfind("$")
    if start < 0 or len(text) > LONGEST:
        raise ValueError("no sentence")
    body, _, given = text[start + 1 :].partition("*")
    right = calc_checksum(body)
    if given[:2].upper() != right:  # the library passes over a line without a checksum in silence
        raise ValueError(f"checksum {given[:2]!r} is wrong; it must be {right}")
    try:
        message = NMEAReader.parse(f"${body}*{right}", userdefined=PRDID)
    except (NMEAMessageError, NMEAParseError, NMEATypeError, LookupError) as err:
        raise ValueError(f"no sentence of the standard: {err}") from err
    reader = None if message is None else _READERS.get(message.msgID)
    return Report() if message is None or reader is None else reader(message)


def _gga(said: NMEAMessage) -> Report:
    place = _place(said) if _number(said, "quality") else (None, None)
    return Report(time_s=_time(said), latitude_deg=place[0], longitude_deg=place[1])


def _rmc(said: NMEAMessage) -> Report:
    date = getattr(said, "date", None)
    day = (date.year, date.month, date.day) if isinstance(date, datetime.date) else None
    out = Report(time_s=_time(said), date=day)
    if _text(said, "status") == "A":
        out.latitude_deg, out.longitude_deg = _place(said)
        out.speed_mps, out.course_rad = _number(said, "spd", KNOT_MPS), _angle(said, "cog")
    return out


def _zda(said: NMEAMessage) -> Report:
    day, month, year = (_number(said, name) for name in ("day", "month", "year"))
    if day is None or month is None or year is None:
        return Report(time_s=_time(said))
    return Report(time_s=_time(said), date=(int(year), int(month), int(day)))


def _vtg(said: NMEAMessage) -> Report:
    return Report(course_rad=_angle(said, "cogt"), speed_mps=_number(said, "sogn", KNOT_MPS))


def _vbw(said: NMEAMessage) -> Report:
    if _text(said, "groundspdstatus") != "A":  # over ground; over water is no help
        return Report()
    return Report(
        ahead_mps=_number(said, "longgroundspd", KNOT_MPS),
        starboard_mps=_number(said, "transgroundspd", KNOT_MPS),
    )


def _rot(said: NMEAMessage) -> Report:
    rate = _number(said, "rot", math.pi / 180.0 / 60.0)
    return Report(turn_radps=rate if _text(said, "valid") == "A" else None)


def _pashr(said: NMEAMessage) -> Report:
    return Report(
        time_s=_time(said, "utctime"),
        heading_rad=_angle(said, "trueHdg") if _text(said, "trueHdgInd") == "T" else None,
        roll_rad=_angle(said, "roll") if hasattr(said, "trueHdg") else None,
        pitch_rad=_angle(said, "pitch") if hasattr(said, "trueHdg") else None,
    )


def _prdid(said: NMEAMessage) -> Report:
    return Report(
        pitch_rad=_angle(said, "pitch"), roll_rad=_angle(said, "roll"), heading_rad=_angle(said, "heading")
    )


def _xdr(said: NMEAMessage) -> Report:
    """Groups of type, value, unit and name."""
    out, group = Report(), 1
    while hasattr(said, f"tdrid_{group:02d}"):
        kind, unit, name = (_text(said, f"{what}_{group:02d}") for what in ("tdrtype", "dataunit", "tdrid"))
        value, name = f"data_{group:02d}", name.upper()
        if kind == "A" and unit == "D" and name.startswith(("PTCH", "PITCH")):
            out.pitch_rad = _angle(said, value)
        elif kind == "A" and unit == "D" and name.startswith("ROLL"):
            out.roll_rad = _angle(said, value)
        elif kind == "D" and unit == "M" and name.startswith("DEPTH"):
            out.depth_m = _number(said, value)
        group += 1
    return out


_READERS: MappingProxyType[str, Callable[[NMEAMessage], Report]] = MappingProxyType(
    {
        "GGA": _gga,
        "RMC": _rmc,
        "ZDA": _zda,
        "HDT": lambda said: Report(heading_rad=_angle(said, "headingT")),
        "THS": lambda said: Report(heading_rad=_angle(said, "headt")),
        "VTG": _vtg,
        "VBW": _vbw,
        "ROT": _rot,
        "ASHR": _pashr,
        "RDID": _prdid,
        "XDR": _xdr,
        "DBT": lambda said: Report(altitude_m=_number(said, "depthm")),
        "DPT": lambda said: Report(altitude_m=_number(said, "depth")),
    }
)


def _text(said: NMEAMessage, name: str) -> str:
    """The field, empty where the sentence is shorter."""
    return str(getattr(said, name, ""))


def _number(said: NMEAMessage, name: str, scale: float = 1.0) -> float | None:
    """The field as a finite number; None if it is empty."""
    value = getattr(said, name, None)
    return scale * value if isinstance(value, int | float) and math.isfinite(value) else None


def _angle(said: NMEAMessage, name: str) -> float | None:
    return _number(said, name, math.pi / 180.0)


def _time(said: NMEAMessage, name: str = "time") -> float | None:
    """Seconds of the day."""
    at = getattr(said, name, None)
    if not isinstance(at, datetime.time):
        return None
    return 3600.0 * at.hour + 60.0 * at.minute + at.second + 1e-6 * at.microsecond


def _place(said: NMEAMessage) -> tuple[float | None, float | None]:
    """Latitude and longitude, degrees; the library does not bound them."""
    latitude, longitude = _number(said, "lat"), _number(said, "lon")
    sides = _text(said, "NS") in ("N", "S") and _text(said, "EW") in ("E", "W")
    if latitude is None or longitude is None or not sides or abs(latitude) > 90.0 or abs(longitude) > 180.0:
        return None, None
    return latitude, longitude
