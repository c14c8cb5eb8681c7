"""What flows between nodes: frozen dataclasses of arrays, scalars, strings and tuples of those.

Every message begins with `seq` (the sensor's own ping number: it may gap or repeat) and `stamp_ns` (UTC).
All later fields have defaults, so `Detections(seq, stamp_ns)` is the empty answer to a ping. Arrays are
checked against their declared shape and are read-only from construction.

Frames: sensor x forward, y starboard, z down; world local NED. Metres, radians, seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import IntEnum
from typing import Any, Literal, Protocol, Self

import numpy as np
import numpy.typing as npt

from fls_flow._sealed import Sealed, array

__all__ = [
    "AltimeterBeams",
    "BeamMask",
    "Classes",
    "DetectionKind",
    "Detections",
    "Features",
    "Frame",
    "HydrophoneBlock",
    "Intensity",
    "Message",
    "Mount",
    "NavState",
    "Ping",
    "Sealed",
    "TrackStatus",
    "Tracks",
    "Truth",
    "View",
    "Wakes",
    "array",
    "is_message_type",
]

Frame = Literal["sensor", "ned"]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
SampleArray = npt.NDArray[np.float32] | npt.NDArray[np.float64] | npt.NDArray[np.int16]
AmplitudeArray = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]
Vector = tuple[float, float, float]

ZERO: Vector = (0.0, 0.0, 0.0)
UNKNOWN: Vector = (float("nan"), float("nan"), float("nan"))


class Message(Protocol):
    """What every message has; annotate a port with it to take any message."""

    @property
    def seq(self) -> int:
        """The sensor's ping number."""

    @property
    def stamp_ns(self) -> int:
        """When the ping was sent, nanoseconds UTC."""


def is_message_type(cls: object) -> bool:
    """Whether `cls` is a frozen dataclass that begins with `seq` and `stamp_ns`."""
    if not (isinstance(cls, type) and is_dataclass(cls) and cls.__dataclass_params__.frozen):  # type: ignore[attr-defined]
        return False
    return [f.name for f in fields(cls)][:2] == ["seq", "stamp_ns"]


@dataclass(frozen=True, slots=True)
class Mount:
    """The sensor's place on the vehicle; by default at its origin, looking forward."""

    position_m: Vector = ZERO  # in the body frame: x forward, y starboard, z down
    attitude_rad: Vector = ZERO  # roll, pitch, yaw of the sensor against the body


@dataclass(frozen=True, eq=False)
class NavState:
    """Where the vehicle is and how it moves; what is not known is nan."""

    seq: int
    stamp_ns: int
    position_m: Vector = UNKNOWN  # NED
    attitude_rad: Vector = UNKNOWN  # roll, pitch, yaw
    attitude_rate_radps: Vector = UNKNOWN  # their time derivatives
    velocity_mps: Vector = UNKNOWN  # over ground, in the body frame (DVL)
    altitude_m: float = float("nan")  # height above the bottom


@dataclass(frozen=True, eq=False)
class AltimeterBeams(Sealed):
    """Slant ranges to the bottom along beams, as a DVL or several altimeters measure them."""

    seq: int
    stamp_ns: int
    direction: FloatArray = array(float, "n", 3)  # unit, in the body frame, from the vehicle's origin
    range_m: FloatArray = array(float, "n")  # nan where a beam has not found the bottom

    def __len__(self) -> int:
        return self.range_m.size


@dataclass(frozen=True, eq=False)
class Ping(Sealed):
    """One polar sonar image."""

    seq: int
    stamp_ns: int
    amplitude: AmplitudeArray = array((np.float32, np.uint8, np.uint16), "n_ranges", "n_beams")
    range_m: FloatArray = array(float, "n_ranges")  # of each row's centre, increasing
    bearing_rad: FloatArray = array(float, "n_beams")  # of each column, from x to starboard; not always even
    valid: BoolArray | None = array(bool, "n_ranges", "n_beams", optional=True)  # cells with data; None: all
    beamwidth_rad: float = float("nan")  # -3 dB, of one beam
    sound_speed_mps: float = 1500.0
    frequency_hz: float = float("nan")
    mount: Mount = Mount()
    nav: NavState | None = None

    @property
    def cell_m(self) -> float:
        """Spacing of the range cells, m; nan with fewer than two."""
        return _spacing(self.range_m)

    @property
    def beam_spacing_rad(self) -> float:
        """Median spacing of the beams, rad; the beamwidth with fewer than two."""
        return _spacing(self.bearing_rad) if self.bearing_rad.size > 1 else self.beamwidth_rad


def _named(owner: str, what: str, names: tuple[str, ...], expected: int) -> None:
    if len(names) != expected:
        raise ValueError(f"{owner}.{what} names {len(names)}; there are {expected}")


def _chosen(which: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """An index array as numpy takes it: an empty list has become one of floats."""
    return which if np.size(which) else np.asarray(which, bool if np.asarray(which).dtype == bool else int)


def _spacing(table: FloatArray) -> float:
    return float(np.median(np.abs(np.diff(table)))) if table.size > 1 else float("nan")


@dataclass(frozen=True, eq=False)
class HydrophoneBlock(Sealed):
    """The samples of one emission, as the array received them; sample 0 is the start of transmission."""

    seq: int
    stamp_ns: int
    samples: SampleArray = array((np.float32, np.float64, np.int16), "n_channels", "n_samples")
    sample_rate_hz: float = float("nan")
    position_m: FloatArray = array(float, "n_channels", 3)  # of the hydrophones, sensor frame
    waveform: FloatArray = array(float, "n_pulse")  # transmitted, at sample_rate_hz
    sound_speed_mps: float = 1500.0
    mount: Mount = Mount()
    nav: NavState | None = None


@dataclass(frozen=True, eq=False)
class View(Sealed):
    """What a tracker must know of the ping that detections come from."""

    range_min_m: float = 0.0
    range_max_m: float = 0.0
    cell_m: float = float("nan")
    bearing_rad: FloatArray = array(float, "n_beams")
    beamwidth_rad: float = float("nan")
    sound_speed_mps: float = 1500.0
    mount: Mount = Mount()
    nav: NavState | None = None

    @classmethod
    def of(cls, ping: Ping) -> Self:
        """The view of `ping`; holds none of its memory."""
        near, far = (float(ping.range_m[0]), float(ping.range_m[-1])) if ping.range_m.size else (0.0, 0.0)
        return cls(
            near,
            far,
            ping.cell_m,
            ping.bearing_rad.copy(),
            ping.beamwidth_rad,
            ping.sound_speed_mps,
            ping.mount,
            ping.nav,
        )

    @property
    def beam_spacing_rad(self) -> float:
        """Median spacing of the beams, rad; the beamwidth with fewer than two."""
        return _spacing(self.bearing_rad) if self.bearing_rad.size > 1 else self.beamwidth_rad

    @property
    def area_m2(self) -> float:
        """Area of the sector that the sonar sees, m^2."""
        if not self.bearing_rad.size:
            return 0.0
        span = float(np.ptp(self.bearing_rad))
        if span > np.pi:  # or bearings jump by a turn within the sector
            span = float(np.ptp(np.unwrap(self.bearing_rad)))
        width = span + abs(self.beam_spacing_rad)
        return 0.5 * width * (self.range_max_m**2 - self.range_min_m**2)


class DetectionKind(IntEnum):
    """Where a detection comes from."""

    ECHO = 0
    SELF_NOISE = 1
    WAKE_END = 2


@dataclass(frozen=True, eq=False)
class Detections(Sealed):
    """Points that stand out of one ping, in polar coordinates of the sensor."""

    seq: int
    stamp_ns: int
    range_m: FloatArray = array(float, "n")
    bearing_rad: FloatArray = array(float, "n")
    amplitude: FloatArray = array(float, "n")
    extent: FloatArray = array(float, "n", 2)  # size in range (m) and bearing (rad); 0 for one cell
    covariance: FloatArray = array(float, "n", 2, 2)  # of (range, bearing): m^2, m rad, rad^2
    kind: npt.NDArray[np.uint8] = array(np.uint8, "n")  # DetectionKind
    view: View = field(default_factory=View)

    @classmethod
    def of(
        cls,
        ping: Ping,
        *,
        range_m: npt.ArrayLike,
        bearing_rad: npt.ArrayLike,
        amplitude: npt.ArrayLike,
        extent: npt.ArrayLike | None = None,
        covariance: npt.ArrayLike | None = None,
        kind: DetectionKind | npt.ArrayLike = DetectionKind.ECHO,
    ) -> Self:
        """Detections in `ping`; by default single cells, with one cell and one beam as standard deviation."""
        view = View.of(ping)
        n = np.size(range_m)
        if covariance is None:
            covariance = np.broadcast_to(np.diag([view.cell_m**2, view.beam_spacing_rad**2]), (n, 2, 2))
        return cls(
            ping.seq,
            ping.stamp_ns,
            np.asarray(range_m, float),
            np.asarray(bearing_rad, float),
            np.asarray(amplitude, float),
            np.zeros((n, 2)) if extent is None else np.asarray(extent, float),
            np.asarray(covariance, float),
            np.broadcast_to(np.asarray(kind, np.uint8), (n,)),
            view,
        )

    def __len__(self) -> int:
        return self.range_m.size

    @property
    def position_m(self) -> FloatArray:
        """(n, 2) raw Cartesian positions [x, y] in the sensor frame; not debiased."""
        return np.stack(
            [self.range_m * np.cos(self.bearing_rad), self.range_m * np.sin(self.bearing_rad)], axis=1
        )

    def select(self, which: npt.NDArray[Any]) -> Self:
        """Those that a mask or an index array selects, in its order."""
        which = _chosen(which)
        return replace(
            self,
            range_m=self.range_m[which],
            bearing_rad=self.bearing_rad[which],
            amplitude=self.amplitude[which],
            extent=self.extent[which],
            covariance=self.covariance[which],
            kind=self.kind[which],
        )


@dataclass(frozen=True, eq=False)
class Wakes(Sealed):
    """Wedges of wake, each seen from its apex; several make one wake."""

    seq: int
    stamp_ns: int
    apex_m: FloatArray = array(float, "n", 2)  # sensor frame
    orientation_rad: FloatArray = array(float, "n")  # the way the wake lies from the apex
    length_m: FloatArray = array(float, "n")
    half_angle_rad: FloatArray = array(float, "n")
    wake: IntArray = array(np.int64, "n")  # which wake it belongs to, from 0
    is_end: BoolArray = array(bool, "n")  # whether the apex is an end of that wake

    def __len__(self) -> int:
        return self.orientation_rad.size


@dataclass(frozen=True, eq=False)
class BeamMask(Sealed):
    """Beams that a ship's own noise fills."""

    seq: int
    stamp_ns: int
    noisy: BoolArray = array(bool, "n_beams")
    bearing_rad: FloatArray = array(float, "n_beams")

    def __len__(self) -> int:
        return int(np.count_nonzero(self.noisy))


class TrackStatus(IntEnum):
    """Where a track stands in its life; `LOST` is reported once."""

    TENTATIVE = 0
    CONFIRMED = 1
    LOST = 2


@dataclass(frozen=True, eq=False)
class Tracks(Sealed):
    """Tracked objects at the stamp of the message, after the update."""

    seq: int
    stamp_ns: int
    id: IntArray = array(np.int64, "n")
    status: npt.NDArray[np.uint8] = array(np.uint8, "n")  # TrackStatus
    state: FloatArray = array(float, "n", 4)  # x, y (m), vx, vy (m/s) in `frame`
    covariance: FloatArray = array(float, "n", 4, 4)
    hits: IntArray = array(np.int64, "n")  # pings with an update
    age: IntArray = array(np.int64, "n")  # pings since it began
    frame: Frame = "sensor"

    def __len__(self) -> int:
        return self.id.size

    def select(self, which: npt.NDArray[Any]) -> Self:
        """Those that a mask or an index array selects, in its order."""
        which = _chosen(which)
        return replace(
            self,
            id=self.id[which],
            status=self.status[which],
            state=self.state[which],
            covariance=self.covariance[which],
            hits=self.hits[which],
            age=self.age[which],
        )


@dataclass(frozen=True, eq=False)
class Intensity(Sealed):
    """What a PHD filter estimates: the expected number of targets and where they are."""

    seq: int
    stamp_ns: int
    expected_targets: float = 0.0
    state: FloatArray = array(float, "n", 4)  # x, y (m), vx, vy (m/s) in `frame`
    weight: FloatArray = array(float, "n")
    covariance: FloatArray = array(float, "n", 4, 4)
    frame: Frame = "sensor"

    def __len__(self) -> int:
        return self.weight.size


@dataclass(frozen=True, eq=False)
class Features(Sealed):
    """Numbers that describe tracks: one row per track, one column per name."""

    seq: int
    stamp_ns: int
    track_id: IntArray = array(np.int64, "n")
    names: tuple[str, ...] = ()
    values: FloatArray = array(float, "n", "n_features")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self):
            _named("Features", "names", self.names, self.values.shape[1])

    def __len__(self) -> int:
        return self.track_id.size


@dataclass(frozen=True, eq=False)
class Classes(Sealed):
    """What tracks are taken for: a label and the posterior of each class, per track."""

    seq: int
    stamp_ns: int
    track_id: IntArray = array(np.int64, "n")
    names: tuple[str, ...] = ()
    label: IntArray = array(np.int64, "n")  # index into names
    posterior: FloatArray = array(float, "n", "n_classes")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self):
            _named("Classes", "names", self.names, self.posterior.shape[1])

    def __len__(self) -> int:
        return self.track_id.size


@dataclass(frozen=True, eq=False)
class Truth(Sealed):
    """What a simulator knows of its targets at the stamp of the message."""

    seq: int
    stamp_ns: int
    target_id: IntArray = array(np.int64, "n")
    state: FloatArray = array(float, "n", 4)  # x, y (m), vx, vy (m/s) in `frame`
    class_name: tuple[str, ...] = ()  # one per target
    frame: Frame = "sensor"

    def __post_init__(self) -> None:
        super().__post_init__()
        _named("Truth", "class_name", self.class_name, self.target_id.size)

    def __len__(self) -> int:
        return self.target_id.size
