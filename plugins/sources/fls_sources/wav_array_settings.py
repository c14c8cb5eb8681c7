"""What lies beside a recording of a hydrophone array: a YAML file of positions, pulse and times."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from fls_flow import InputError
from fls_sources.array_geometry import effective_speed_mps, positions_from_distances
from fls_sources.array_waveform import Chirp

__all__ = ["ArraySettings", "read_settings"]

FloatArray = npt.NDArray[np.float64]
KEYS = (
    "positions_m",
    "distances_m",
    "first_bearing_deg",
    "clockwise",
    "pulse",
    "sound_speed_mps",
    "layers",
    "array_depth_m",
    "target_depth_m",
    "first_ping_s",
    "period_s",
    "ping_times_s",
    "listen_s",
    "start_ns",
)
PULSE_KEYS = ("start_hz", "stop_hz", "duration_s", "taper", "file")


@dataclass(frozen=True, eq=False)
class ArraySettings:
    """Geometry, water, pulse and ping times of a recording."""

    position_m: FloatArray  # (n_channels, 3)
    sound_speed_mps: float
    pulse: Chirp | Path  # or the file of its samples
    first_ping_s: float  # start of transmission, in the recording
    period_s: float | None  # None: one ping
    ping_times_s: tuple[float, ...]  # instead of an even period
    listen_s: float | None  # None: to the next ping
    start_ns: int  # stamp of the recording's first sample


def read_settings(path: Path) -> ArraySettings:
    """The settings in a YAML file (docs/active_array.md); InputError names file, key and what it takes."""
    document = _document(path)
    fault = _fault(path)
    _known_keys(document, KEYS, "", fault)
    pulse_given = document.get("pulse")
    if not isinstance(pulse_given, Mapping):
        raise fault("'pulse' is missing; give start_hz, stop_hz and duration_s, or file")
    times = _numbers(document.get("ping_times_s", []), "ping_times_s", fault)
    if times.size and (times.ndim != 1 or times[0] < 0.0 or (np.diff(times) <= 0.0).any()):
        raise fault("'ping_times_s' must be a list of increasing seconds from 0")
    period_s = _optional(document, "period_s", fault)
    if times.size and ("period_s" in document or "first_ping_s" in document):
        raise fault("has 'ping_times_s' and an even period; leave out 'period_s' and 'first_ping_s'")
    first_ping_s = _number(document, "first_ping_s", 0.0, fault)
    if first_ping_s < 0.0:
        raise fault(f"'first_ping_s' is {first_ping_s}; it must be 0 or more")
    start_ns = document.get("start_ns", 0)
    if type(start_ns) is not int or not 0 <= start_ns < 2**63:
        raise fault(f"'start_ns' is {start_ns!r}; it takes nanoseconds UTC, an integer")
    return ArraySettings(
        _positions(document, fault),
        _sound_speed(document, fault),
        _pulse(pulse_given, path, fault),
        first_ping_s,
        period_s,
        tuple(times.tolist()),
        _optional(document, "listen_s", fault),
        start_ns,
    )


Fault = Callable[[str], InputError]


def _fault(path: Path) -> Fault:
    return lambda text: InputError(f"{path}: {text}")


def _document(path: Path) -> dict[str, Any]:
    try:
        document = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: {error.strerror}; a recording needs a YAML file with positions_m and pulse beside it"
        ) from error
    except (YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(document, dict):
        raise InputError(f"{path}: holds no mapping; give positions_m and pulse")
    return document


def _known_keys(given: Mapping[Any, Any], known: tuple[str, ...], prefix: str, fault: Fault) -> None:
    for key in given:
        if key not in known:
            raise fault(f"unknown key '{prefix}{key}'; it has {', '.join(known)}")


def _numbers(given: Any, key: str, fault: Fault) -> FloatArray:
    try:
        numbers = np.array(given, float)
    except (TypeError, ValueError):
        raise fault(f"'{key}' must be numbers, in rows of one length") from None
    if not np.isfinite(numbers).all():
        raise fault(f"'{key}' has entries that are not finite")
    return numbers


def _number(document: Mapping[str, Any], key: str, default: float | None, fault: Fault) -> float:
    value = document.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise fault(f"'{key}' is {value!r}; it takes a number" if key in document else f"'{key}' is missing")
    return float(value)


def _optional(document: Mapping[str, Any], key: str, fault: Fault) -> float | None:
    if document.get(key) is None:
        return None
    value = _number(document, key, None, fault)
    if value <= 0.0:
        raise fault(f"'{key}' is {value}; it must be positive")
    return value


def _positions(document: Mapping[str, Any], fault: Fault) -> FloatArray:
    if ("positions_m" in document) == ("distances_m" in document):
        raise fault(
            "give either 'positions_m', a row [x, y, z] per channel, or 'distances_m', a square table"
        )
    if "positions_m" in document:
        placed = _numbers(document["positions_m"], "positions_m", fault)
        if placed.ndim != 2 or placed.shape[1] not in (2, 3) or not len(placed):
            raise fault(
                f"'positions_m' has shape {placed.shape}; it takes a row [x, y] or [x, y, z] per channel"
            )
        return np.pad(placed, ((0, 0), (0, 3 - placed.shape[1])))
    clockwise = document.get("clockwise", True)
    if type(clockwise) is not bool:
        raise fault(f"'clockwise' is {clockwise!r}; it takes true or false")
    bearing_rad = np.deg2rad(_number(document, "first_bearing_deg", 0.0, fault))
    table = _numbers(document["distances_m"], "distances_m", fault)
    try:
        return positions_from_distances(table, bearing_rad, clockwise=clockwise)
    except ValueError as error:
        raise fault(str(error)) from error


def _sound_speed(document: Mapping[str, Any], fault: Fault) -> float:
    if "layers" not in document:
        speed = _number(document, "sound_speed_mps", None, fault)
        if speed <= 0.0:
            raise fault(f"'sound_speed_mps' is {speed}; it must be positive")
        return speed
    if "sound_speed_mps" in document:
        raise fault("has 'layers' and 'sound_speed_mps'; leave one out")
    array_depth_m = _number(document, "array_depth_m", None, fault)
    target_depth_m = _number(document, "target_depth_m", array_depth_m, fault)
    try:
        layers = _numbers(document["layers"], "layers", fault)
        return effective_speed_mps(layers, array_depth_m, target_depth_m)
    except ValueError as error:
        raise fault(str(error)) from error


def _pulse(given: Mapping[str, Any], path: Path, fault: Fault) -> Chirp | Path:
    _known_keys(given, PULSE_KEYS, "pulse.", fault)
    if "file" in given:
        if len(given) > 1 or not isinstance(given["file"], str):
            raise fault("'pulse.file' takes the path of a WAV file, and no other key beside it")
        return path.parent / given["file"]
    numbers = {key: _number(given, key, None, fault) for key in PULSE_KEYS[:3]}
    try:
        return Chirp(**numbers, taper=_number(given, "taper", 0.0, fault))
    except ValueError as error:
        raise fault(f"pulse: {error}") from error
