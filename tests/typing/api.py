"""What users write against fls_flow, for the type checker alone: mypy --strict must find nothing to say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import (
    BeamMask,
    DetectionKind,
    Detections,
    Message,
    NavState,
    Ping,
    Sealed,
    Tracks,
    array,
    hookimpl,
)
from fls_flow.catalog import Catalog, Kind
from fls_flow.errors import FlsFlowError, GraphError, InputError, Problem
from fls_flow.graph import Graph, load


@dataclass(frozen=True, eq=False)
class Spectrum(Sealed):
    """A message of a plugin's own."""

    seq: int
    stamp_ns: int
    power_db: npt.NDArray[np.float64] = array(float, "n")
    frequency_hz: npt.NDArray[np.float64] = array(float, "n")
    window: Literal["hann", "rectangular"] = "hann"


@dataclass
class Peaks:
    """A plugin with one output."""

    margin_db: float = 12.0

    def __post_init__(self) -> None:
        if self.margin_db <= 0.0:
            raise ValueError(f"margin_db is {self.margin_db}; it is positive")

    def __call__(self, ping: Ping, mask: BeamMask | None = None) -> Detections:
        bright = ping.amplitude > np.median(ping.amplitude) * 10 ** (self.margin_db / 20.0)
        if mask is not None:
            bright = bright & ~mask.noisy
        rows, columns = np.nonzero(bright)
        return Detections.of(
            ping,
            range_m=ping.range_m[rows],
            bearing_rad=ping.bearing_rad[columns],
            amplitude=ping.amplitude[rows, columns],
            kind=DetectionKind.ECHO,
        )


class Both(NamedTuple):
    """Several outputs: each field a port."""

    spectrum: Spectrum
    mask: BeamMask


@dataclass
class Noise:
    """A plugin with state, several outputs, feedback and a stream."""

    seed: int = 0
    _mean_db: float = field(default=0.0, init=False, repr=False)

    def __call__(self, ping: Ping, tracks: Tracks | None, nav: tuple[NavState, ...] = ()) -> Both:
        power = np.full(len(nav), self._mean_db + (0 if tracks is None else len(tracks)))
        noisy = np.zeros(ping.bearing_rad.size, bool)
        return Both(
            Spectrum(ping.seq, ping.stamp_ns, power, power),
            BeamMask(ping.seq, ping.stamp_ns, noisy, ping.bearing_rad.copy()),
        )

    def snapshot(self) -> dict[str, Any]:
        return {"mean_db": self._mean_db}

    def restore(self, state: dict[str, Any]) -> None:
        self._mean_db = state["mean_db"]


@dataclass
class Player:
    """A source that knows its length."""

    path: Path
    live: bool = False

    def __call__(self) -> Iterator[Ping]:
        if not self.path.is_file():
            raise InputError(f"{self.path}: is not there; name a recording")
        for seq in range(len(self)):
            yield Ping(seq, 0, np.zeros((3, 2), np.uint8), np.arange(3.0), np.arange(2.0))

    def __len__(self) -> int:
        return 3


@dataclass
class Recorder:
    """A sink that takes any ports."""

    path: Path = Path("all.txt")
    _lines: list[str] = field(default_factory=list, init=False, repr=False)

    def __call__(self, **ports: Message) -> None:
        self._lines += [f"{name} {message.seq} {message.stamp_ns}" for name, message in ports.items()]

    def close(self) -> None:
        self.path.write_text("\n".join(self._lines))


@hookimpl
def fls_node() -> type[Peaks]:
    return Peaks


def in_a_notebook(ping: Ping) -> int:
    found: Detections = Peaks(margin_db=6.0)(ping)
    strong = found.select(found.amplitude > 3.0)
    spectrum: Spectrum = Noise()(ping, None).spectrum
    return len(strong) + int(spectrum.power_db.size)


def kinds() -> list[Kind]:
    catalog = Catalog({"peaks": Peaks, "noise": Noise, "player": Player, "recorder": Recorder})
    return [catalog.load(name) for name in catalog.names()]


def checked(path: Path) -> Graph | list[Problem]:
    try:
        return load(path, use=["cfar=peaks"], set_=["cfar.margin_db=3"])
    except GraphError as error:
        return list(error.problems)
    except FlsFlowError:
        return []


def wrong(ping: Ping) -> None:
    """The checker sees these mistakes: each ignore would be reported as unused if it did not."""
    Peaks(margin="12")  # type: ignore[call-arg]
    Peaks()(ping.amplitude)  # type: ignore[arg-type]
    ping.seq = 3  # type: ignore[misc]
    Noise()(ping)  # type: ignore[call-arg]
    Recorder()(count=3)  # type: ignore[arg-type]
