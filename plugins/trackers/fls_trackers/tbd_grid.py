"""Where the cells of a ping lie, and how the sonar and its targets move between pings."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fls_flow import Ping
from fls_flow.geometry import Pose, wrap

__all__ = ["Grid", "Motion", "Place", "grid_from", "grid_of", "own_motion", "place_from"]


Place = tuple[float, float, float]  # north, east, heading


class Grid(NamedTuple):
    """Where the cells of a ping lie; ranges and bearings are even."""

    first_m: float
    cell_m: float
    n_ranges: int
    first_rad: float
    beam_rad: float  # signed spacing
    n_beams: int
    closed: bool
    resolution_m: float
    beamwidth_rad: float

    @property
    def last_m(self) -> float:
        """The range of the last row."""
        return self.first_m + (self.n_ranges - 1) * self.cell_m

    @property
    def resolution_cells(self) -> float:
        """How many targets could be told apart, at least 1."""
        around = self.n_beams * min(abs(self.beam_rad) / self.beamwidth_rad, 1.0)
        along = self.n_ranges * min(self.cell_m / self.resolution_m, 1.0)
        return max(around * along, 1.0)


class Motion(NamedTuple):
    """How targets may move."""

    dt_s: float
    v_max_mps: float
    sigma_v_mps2: float
    cross_mps: float  # spread of speeds across the line of sight
    own_x_m: float  # the sonar's own way since the last ping, in its axes of then
    own_y_m: float
    own_turn_rad: float  # and its turn


def grid_of(ping: Ping, resolution_m: float, beamwidth_rad: float) -> Grid | None:
    """The grid of a ping; None for one without cells. Raises ValueError where it is not even."""
    if ping.range_m.size < 3 or ping.bearing_rad.size < 3:
        return None
    cell_m, beam_rad = float(np.mean(np.diff(ping.range_m))), float(np.mean(np.diff(ping.bearing_rad)))
    for name, table, step in (("range_m", ping.range_m, cell_m), ("bearing_rad", ping.bearing_rad, beam_rad)):
        if not np.allclose(np.diff(table), step, rtol=0.0, atol=0.05 * abs(step)):
            raise ValueError(f"ping seq {ping.seq}: {name} is not evenly spaced, as integration needs it")
    gap = 2.0 * math.pi - abs(float(ping.bearing_rad[-1] - ping.bearing_rad[0]))
    return Grid(
        float(ping.range_m[0]),
        cell_m,
        ping.range_m.size,
        float(ping.bearing_rad[0]),
        beam_rad,
        ping.bearing_rad.size,
        abs(gap - abs(beam_rad)) < 0.5 * abs(beam_rad),
        resolution_m,
        beamwidth_rad,
    )


def grid_from(values: Any) -> Grid:
    """The grid whose numbers a snapshot holds."""
    first_m, cell_m, n_ranges, first_rad, beam_rad, n_beams, closed, resolution_m, beamwidth_rad = values
    return Grid(
        float(first_m),
        float(cell_m),
        int(n_ranges),
        float(first_rad),
        float(beam_rad),
        int(n_beams),
        bool(closed),
        float(resolution_m),
        float(beamwidth_rad),
    )


def own_motion(old: Pose, new: Pose) -> tuple[float, float, float]:
    """The sonar's way from one pose to another, ahead and to starboard as it looked then, m, and its turn."""
    way = old.to_sensor(new.origin_m)
    return float(way[0]), float(way[1]), float(wrap(new.heading_rad - old.heading_rad))


def place_from(values: Any) -> Place:
    """The pose whose numbers a snapshot holds."""
    north, east, heading = (float(one) for one in values)
    return north, east, heading
