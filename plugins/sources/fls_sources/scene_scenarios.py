"""The named sequences of the simulated sonar: what is there, how it moves, how long it lasts.

Source: Karoui, Quidu & Legris 2015, Sec. V (facts of sequences I to IV; places and speeds are ours).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fls_sources.scene_motion import OwnShip, TimedPath, coasting
from fls_sources.scene_objects import SceneObject
from fls_sources.scene_wake import WakeLaw

__all__ = ["Scenario", "Sector", "SequenceName", "random_things", "scenario"]

SequenceName = Literal[
    "buoys-and-blocks", "inflatable-and-buoy", "inflatable-and-sailboat", "passenger-boat", "random", "empty"
]
FIRST_PILLAR_ID = 101


@dataclass(frozen=True, slots=True)
class Sector:
    """The sector that a random scene is to fill."""

    range_min_m: float
    range_max_m: float
    half_width_rad: float


@dataclass(frozen=True, slots=True)
class Scenario:
    """A sequence: its size, the own ship and the things around it."""

    pings: int
    n_ranges: int
    own: OwnShip
    things: tuple[SceneObject, ...] = ()


def scenario(name: SequenceName) -> Scenario:
    """The named sequence; of `random` only size and own ship: its things come from `random_things`."""
    return _SCENARIOS[name]()


def buoys_and_blocks() -> Scenario:
    """Sequence I: the survey boat approaches five still things; a pier lies along the port edge."""
    still = TimedPath.still
    things = (
        SceneObject(1, "large-buoy", still(170.0, 8.0), 6.0, 6.0, 18.0),
        SceneObject(2, "small-buoy", still(214.0, 22.0), 3.0, 3.0, 18.0),
        SceneObject(3, "small-buoy", still(222.0, -6.0), 3.0, 3.0, 18.0),
        SceneObject(4, "concrete-block", still(262.0, -66.0), 2.0, 2.0, 18.0),
        SceneObject(5, "concrete-block", still(272.0, -48.0), 2.0, 2.0, 18.0),
    )
    pillars = tuple(
        SceneObject(FIRST_PILLAR_ID + i, "pier-pillar", still(190.0 + 12.0 * i, -82.0), 0.8, 0.8, 18.0)
        for i in range(10)
    )
    return Scenario(600, 4000, OwnShip(0.4, np.deg2rad(3.0), 15.0), things + pillars)


def inflatable_and_buoy() -> Scenario:
    """Sequence II: an inflatable boat coasts behind a buoy, changing its heading all the time."""
    way = [
        (33.0, 13.5),
        (37.0, 10.7),
        (40.0, 6.5),
        (41.5, 1.5),
        (41.5, -3.5),
        (39.8, -8.2),
        (36.8, -12.0),
        (33.5, -14.0),
    ]
    boat = coasting(way, 0.0, 0.45, 105.0)
    things = (
        SceneObject(1, "buoy", TimedPath.still(37.6, -1.5), 1.0, 1.0, 23.0),
        SceneObject(2, "inflatable-boat", boat, 2.0, 1.0, 28.0, wake=WakeLaw(life_s=140.0)),
    )
    return Scenario(280, 1000, OwnShip(0.03, np.deg2rad(1.5), 16.0), things)


def inflatable_and_sailboat() -> Scenario:
    """Sequence III: the boat coasts past a buoy and meets a sail-boat that comes in from starboard."""
    way = [(37.0, -17.0), (36.5, -9.0), (36.0, 0.0), (35.8, 8.0), (35.5, 16.0)]
    boat = coasting(way, -50.0, 0.18, 300.0)
    sail_way = np.array([(46.0, 22.0), (39.2, 14.5), (40.5, 8.0), (43.0, 2.0)])
    sailing = TimedPath(np.array([155.0, 190.0, 215.0, 240.0]), sail_way)
    things = (
        SceneObject(1, "buoy", TimedPath.still(22.0, 6.0), 1.0, 1.0, 23.0),
        SceneObject(2, "inflatable-boat", boat, 2.0, 1.0, 28.0, wake=WakeLaw(life_s=200.0, start_s=-50.0)),
        SceneObject(3, "sail-boat", sailing, 2.0, 1.0, 18.0),
    )
    return Scenario(480, 1000, OwnShip(0.02, np.deg2rad(1.5), 17.0), things)


def passenger_boat() -> Scenario:
    """Sequence IV: a passenger boat crosses from port to starboard; its propeller cavitates."""
    crossing = TimedPath.straight(0.0, (46.0, -15.0), (0.2, 3.6))
    wake = WakeLaw(24.0, 0.6, 0.03, 25.0, 30.0, -30.0)
    boat = SceneObject(1, "passenger-boat", crossing, 5.0, 2.0, 28.0, wake=wake, noise_db=22.0)
    return Scenario(20, 6000, OwnShip(0.1, np.deg2rad(1.0), 15.0), (boat,))


def random_scene() -> Scenario:
    """Still things and boats with wakes at places that the seed chooses."""
    return Scenario(200, 1000, OwnShip(0.05, np.deg2rad(1.5), 15.0))


def random_things(
    sector: Sector, n_objects: int, n_boats: int, duration_s: float, rng: np.random.Generator
) -> tuple[SceneObject, ...]:
    """Still things and boats, evenly over the inner 80 % of the sector at mid-sequence.

    Boats keep a velocity of 0.2 to 0.6 m/s in any direction and lay a wake from the start.
    """
    n = n_objects + n_boats
    near = sector.range_min_m + 0.2 * (sector.range_max_m - sector.range_min_m)
    distance = np.sqrt(rng.uniform(near**2, (0.9 * sector.range_max_m) ** 2, n))
    bearing = rng.uniform(-0.8, 0.8, n) * sector.half_width_rad
    place = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)
    size, snr = rng.uniform(0.5, 3.0, n), rng.uniform(20.0, 26.0, n)
    course, speed = rng.uniform(-np.pi, np.pi, n), rng.uniform(0.2, 0.6, n)
    things = []
    for k in range(n):
        if k < n_objects:
            path = TimedPath.still(*place[k].tolist())
            things.append(SceneObject(k + 1, "object", path, size[k], size[k], snr[k]))
            continue
        v = (speed[k] * np.cos(course[k]), speed[k] * np.sin(course[k]))
        path = TimedPath.straight(duration_s / 2.0, (place[k, 0], place[k, 1]), v)
        things.append(SceneObject(k + 1, "boat", path, 2.0, 1.0, snr[k], wake=WakeLaw(life_s=120.0)))
    return tuple(things)


def empty() -> Scenario:
    """Clutter only."""
    return Scenario(200, 1000, OwnShip())


_SCENARIOS: dict[SequenceName, Callable[[], Scenario]] = {
    "buoys-and-blocks": buoys_and_blocks,
    "inflatable-and-buoy": inflatable_and_buoy,
    "inflatable-and-sailboat": inflatable_and_sailboat,
    "passenger-boat": passenger_boat,
    "random": random_scene,
    "empty": empty,
}
