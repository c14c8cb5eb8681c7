"""The named scenes over the sea floor: what lies there and how the vehicle comes by.

Places are north and east of the vehicle's start, m; the vehicle's depth at the start is 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
import numpy.typing as npt

from fls_sources.ground_vehicle import Swing, Vehicle

__all__ = ["Floor", "GroundObject", "GroundScenario", "GroundSequence", "ground_scenario"]

FloatArray = npt.NDArray[np.float64]
GroundSequence = Literal["two-targets", "objects", "wreck", "mid-water", "empty"]


@dataclass(frozen=True, slots=True)
class Floor:
    """A plane floor: `depth_m` below the start, deeper by `slope` m per m (north, east)."""

    depth_m: float
    slope: tuple[float, float] = (0.0, 0.0)

    def depth_at(self, north_m: npt.ArrayLike, east_m: npt.ArrayLike) -> FloatArray:
        """Depth below the start, m."""
        depth: FloatArray = (
            self.depth_m
            + self.slope[0] * np.asarray(north_m, float)
            + self.slope[1] * np.asarray(east_m, float)
        )
        return depth

    @property
    def normal(self) -> FloatArray:
        """(3,) unit, NED, into the floor."""
        raw = np.array([-self.slope[0], -self.slope[1], 1.0])
        return raw / float(np.sqrt((raw * raw).sum()))


@dataclass(frozen=True, slots=True)
class GroundObject:
    """A box that stands on the floor, or hangs in the water when `above_m` is not 0."""

    target_id: int
    class_name: str
    north_m: float
    east_m: float
    length_m: float = 0.0  # along its heading
    width_m: float = 0.0
    height_m: float = 0.0
    heading_rad: float = 0.0
    snr_db: float = 20.0  # mean power of a cell that it fills, against the floor on the beam's axis
    above_m: float = 0.0  # of its foot, over the floor


@dataclass(frozen=True, slots=True)
class GroundScenario:
    """A sequence: its length, the vehicle and the things on the floor."""

    pings: int
    altitude_m: float
    vehicle: Vehicle
    things: tuple[GroundObject, ...] = ()


MANOEUVRE = Vehicle(
    1.6,
    surge=Swing(0.8, 9.0),
    sway=Swing(0.35, 14.0, 0.6),
    heave=Swing(0.3, 11.0),
    crab=Swing(np.deg2rad(3.0), 8.0, 1.0),
    pitch=Swing(np.deg2rad(3.0), 6.0, 0.4),
    roll=Swing(np.deg2rad(4.0), 5.0, 2.0),
)
CALM = Vehicle(
    1.5,
    sway=Swing(0.5, 20.0),
    heave=Swing(0.15, 13.0),
    pitch=Swing(np.deg2rad(1.0), 7.0),
    roll=Swing(np.deg2rad(1.5), 6.0, 1.0),
)


def ground_scenario(name: GroundSequence) -> GroundScenario:
    """The named sequence."""
    return _SCENARIOS[name]()


def two_targets() -> GroundScenario:
    """Two small objects, passed while the vehicle changes speed, heading, pitch, roll and depth."""
    things = (
        GroundObject(1, "target", 44.0, 7.5, snr_db=26.0),
        GroundObject(2, "target", 48.0, -8.0, snr_db=26.0),
    )
    return GroundScenario(65, 6.0, MANOEUVRE, things)


def objects() -> GroundScenario:
    """Blocks and a cylinder with their shadows."""
    things = (
        GroundObject(1, "block", 34.0, 6.0, 1.2, 1.2, 0.8, 0.4, 18.0),
        GroundObject(2, "cylinder", 43.0, -6.0, 2.2, 0.6, 0.6, 1.2, 18.0),
        GroundObject(3, "block", 54.0, 2.0, 1.5, 1.5, 1.0, 0.0, 18.0),
    )
    return GroundScenario(100, 6.0, CALM, things)


def wreck() -> GroundScenario:
    """A shipwreck across the bow: a large echo, then a large shadow."""
    things = (GroundObject(1, "wreck", 48.0, 1.0, 11.0, 3.5, 2.5, 1.2, 20.0),)
    return GroundScenario(90, 8.0, CALM, things)


def mid_water() -> GroundScenario:
    """A buoy on its rope before the vehicle, 9 m over the floor, and a block on the floor."""
    things = (
        GroundObject(1, "buoy", 22.0, 0.5, snr_db=26.0, above_m=9.0),
        GroundObject(2, "block", 46.0, -6.0, snr_db=26.0),
    )
    return GroundScenario(45, 12.0, CALM, things)


def empty() -> GroundScenario:
    """The bare floor."""
    return GroundScenario(30, 6.0, CALM)


_SCENARIOS: MappingProxyType[str, Callable[[], GroundScenario]] = MappingProxyType(
    {
        "two-targets": two_targets,
        "objects": objects,
        "wreck": wreck,
        "mid-water": mid_water,
        "empty": empty,
    }
)
