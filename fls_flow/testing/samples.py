"""Small made-up messages, to try a node on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fls_flow.catalog import InPort, Kind, describe
from fls_flow.messages import (
    AltimeterBeams,
    BeamMask,
    Classes,
    Detections,
    Features,
    HydrophoneBlock,
    Intensity,
    Message,
    NavState,
    Ping,
    Tracks,
    Truth,
    Wakes,
)

__all__ = ["sample_firings"]

BEAMS, RANGES = 9, 120
STATES = np.array([[16.0, 0.0, 0.2, 0.0], [20.0, 4.0, 0.0, 0.0]])
SPREAD = np.broadcast_to(0.04 * np.eye(4), (2, 4, 4))
IDS = np.array([1, 2])


def sample_firings(kind: Kind | type, pings: int = 6, seed: int = 0) -> list[dict[str, Any]]:
    """Made-up inputs for a node, ping by ping; those of the third ping are empty."""
    found = kind if isinstance(kind, Kind) else describe(kind)
    rng = np.random.default_rng(seed)
    free = () if found.takes_any is None else (InPort("anything", found.takes_any),)
    return [
        {port.name: _input(port, number, rng, blank=number == 2) for port in (*found.inputs, *free)}
        for number in range(pings)
    ]


def _input(port: InPort, number: int, rng: np.random.Generator, *, blank: bool) -> Any:
    seq, stamp_ns = 10 + number, 1_000_000_000 + number * 500_000_000
    message = Ping if port.message is Message else port.message
    if port.stream:
        return tuple(_sample(message, seq, stamp_ns + n, rng) for n in range(0 if blank else 2))
    if port.nullable and number == 0:
        return None
    return message(seq, stamp_ns) if blank else _sample(message, seq, stamp_ns, rng)


Maker = Callable[[int, int, np.random.Generator], Any]


def _sample(message: Any, seq: int, stamp_ns: int, rng: np.random.Generator) -> Any:
    """A message with something in it; a class that is not known here is made empty."""
    makers: dict[type, Maker] = {
        AltimeterBeams: _altimeter_beams,
        BeamMask: _beam_mask,
        Classes: _classes,
        Detections: _detections,
        Features: _features,
        HydrophoneBlock: _hydrophones,
        Intensity: _intensity,
        NavState: _nav,
        Ping: _ping,
        Tracks: _tracks,
        Truth: _truth,
        Wakes: _wakes,
    }
    maker = makers.get(message)
    return message(seq, stamp_ns) if maker is None else maker(seq, stamp_ns, rng)


def _ping(seq: int, stamp_ns: int, rng: np.random.Generator) -> Ping:
    amplitude = rng.rayleigh(1.0, (RANGES, BEAMS)).astype(np.float32)
    amplitude[60:63, 4] = 30.0
    range_m = np.linspace(1.0, 30.75, RANGES)
    bearing_rad = np.linspace(-0.5, 0.5, BEAMS)
    nav = _nav(seq, stamp_ns, rng)
    return Ping(seq, stamp_ns, amplitude, range_m, bearing_rad, beamwidth_rad=0.125, nav=nav)


def _nav(seq: int, stamp_ns: int, rng: np.random.Generator) -> NavState:
    return NavState(
        seq,
        stamp_ns,
        position_m=(0.1 * seq, 0.0, 2.0),
        attitude_rad=(0.0, 0.0, 0.02 * seq),
        attitude_rate_radps=(0.0, 0.0, 0.04),
        velocity_mps=(1.0, 0.0, 0.0),
        altitude_m=20.0,
    )


def _altimeter_beams(seq: int, stamp_ns: int, rng: np.random.Generator) -> AltimeterBeams:
    direction = np.array([[0.3, 0.4, 0.0], [0.3, -0.4, 0.0], [-0.3, 0.4, 0.0], [-0.3, -0.4, 0.0]])
    direction[:, 2] = np.sqrt(0.75)
    return AltimeterBeams(seq, stamp_ns, direction, 23.0 + rng.normal(0.0, 0.1, 4))


def _detections(seq: int, stamp_ns: int, rng: np.random.Generator) -> Detections:
    return Detections.of(
        _ping(seq, stamp_ns, rng),
        range_m=[5.0, 16.0 + 0.1 * (seq - 10), 25.0],
        bearing_rad=rng.normal([-0.3, 0.0, 0.2], 0.01),
        amplitude=[10.0, 30.0, 12.0],
    )


def _beam_mask(seq: int, stamp_ns: int, rng: np.random.Generator) -> BeamMask:
    return BeamMask(seq, stamp_ns, np.arange(BEAMS) == 4, np.linspace(-0.5, 0.5, BEAMS))


def _wakes(seq: int, stamp_ns: int, rng: np.random.Generator) -> Wakes:
    apex = np.array([[8.0, 1.0]])
    one = np.ones(1)
    return Wakes(seq, stamp_ns, apex, 0.3 * one, 5.0 * one, 0.17 * one, np.zeros(1, np.int64), one > 0)


def _tracks(seq: int, stamp_ns: int, rng: np.random.Generator) -> Tracks:
    status = np.array([1, 0], np.uint8)
    return Tracks(seq, stamp_ns, IDS, status, STATES, SPREAD, np.array([5, 2]), np.array([6, 2]))


def _intensity(seq: int, stamp_ns: int, rng: np.random.Generator) -> Intensity:
    return Intensity(seq, stamp_ns, 1.7, STATES, np.array([0.9, 0.8]), SPREAD)


def _features(seq: int, stamp_ns: int, rng: np.random.Generator) -> Features:
    return Features(seq, stamp_ns, IDS, ("area", "mean"), rng.random((2, 2)))


def _classes(seq: int, stamp_ns: int, rng: np.random.Generator) -> Classes:
    posterior = np.array([[0.9, 0.1], [0.3, 0.7]])
    return Classes(seq, stamp_ns, IDS, ("diver", "fish"), np.array([0, 1]), posterior)


def _truth(seq: int, stamp_ns: int, rng: np.random.Generator) -> Truth:
    return Truth(seq, stamp_ns, IDS, STATES, ("buoy", "boat"))


def _hydrophones(seq: int, stamp_ns: int, rng: np.random.Generator) -> HydrophoneBlock:
    samples = rng.standard_normal((4, 256)).astype(np.float32)
    return HydrophoneBlock(seq, stamp_ns, samples, 96_000.0, np.eye(4, 3), np.ones(16))
