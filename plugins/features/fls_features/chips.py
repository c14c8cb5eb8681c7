"""Cut the piece of the ping around each track that was just updated."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_features.chip_messages import Chips
from fls_features.cutting import chip_size, cut, nearest_cells, windows
from fls_flow import Ping, Tracks, TrackStatus, hookimpl
from fls_flow.geometry import sensor_pose, to_polar, wrap

__all__ = ["CutChips"]

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]

CONFIRMED = int(TrackStatus.CONFIRMED)
LOST = int(TrackStatus.LOST)


def _none() -> IntArray:
    return np.zeros(0, np.int64)


@dataclass
class CutChips:
    """A chip of +-`half_range_m` x +-`half_bearing_deg` around each track that this ping has updated.

    A track is updated when its `hits` are more than in the ping before. Only confirmed tracks get chips, and
    tentative ones on demand. At the image's borders a chip is shifted and keeps its size; an image smaller
    than a chip bounds it. A track whose chip would lie outside the image, or whose place in the sensor's
    frame is not known (`frame: ned` in a ping without navigation), gets none.

    Source: Brinkmann 2010, 4.3.1, with the sizes of the text (its listing takes beams for degrees).
    """

    half_range_m: float = 10.0
    half_bearing_deg: float = 5.0
    tentative: bool = False
    _id: IntArray = field(default_factory=_none, init=False, repr=False)  # of the last ping, increasing
    _hits: IntArray = field(default_factory=_none, init=False, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.half_range_m < math.inf:
            raise ValueError(f"half_range_m is {self.half_range_m}; it must be positive")
        if not 0.0 < self.half_bearing_deg <= 180.0:
            raise ValueError(f"half_bearing_deg is {self.half_bearing_deg}; it lies between 0 and 180")

    def __call__(self, ping: Ping, tracks: Tracks) -> Chips:
        """The chips of one ping."""
        wanted = self._updated(tracks) & (tracks.status != LOST)
        if not self.tentative:
            wanted &= tracks.status == CONFIRMED
        if not (wanted.any() and ping.amplitude.size):
            return Chips(ping.seq, ping.stamp_ns)
        found = _in_sensor_frame(tracks, ping)
        if found is None:
            return Chips(ping.seq, ping.stamp_ns)
        place, course = found
        sure = tracks.status == CONFIRMED
        sought = tracks.id[wanted], place[wanted], course[wanted]
        return self._chips(ping, *sought, tracks.id[sure], place[sure])

    def _updated(self, tracks: Tracks) -> BoolArray:
        """Which tracks have more hits than in the ping before; keeps their hits for the next."""
        before = np.zeros(len(tracks), np.int64)
        if self._id.size:
            at = np.minimum(np.searchsorted(self._id, tracks.id), self._id.size - 1)
            before = np.where(self._id[at] == tracks.id, self._hits[at], 0)
        order = np.argsort(tracks.id, kind="stable")
        self._id, self._hits = tracks.id[order], tracks.hits[order]
        return np.asarray(tracks.hits > before)

    def _chips(
        self,
        ping: Ping,
        track_id: IntArray,
        place: FloatArray,
        course: FloatArray,
        sure_id: IntArray,
        sure_place: FloatArray,
    ) -> Chips:
        distance, bearing = to_polar(place)
        spacing = abs(ping.beam_spacing_rad)
        half_bearing = math.radians(self.half_bearing_deg)
        cell = nearest_cells(ping.range_m, ping.bearing_rad, distance, bearing)
        off_range = np.abs(ping.range_m[cell[:, 0]] - distance)
        off_bearing = np.abs(ping.bearing_rad[cell[:, 1]] - bearing) % (2.0 * np.pi)
        off_bearing = np.minimum(off_bearing, 2.0 * np.pi - off_bearing)
        near = (off_range <= self.half_range_m) & (off_bearing <= half_bearing)
        if not near.any():
            return Chips(ping.seq, ping.stamp_ns)
        size = chip_size(self.half_range_m, half_bearing, ping.cell_m, spacing)
        where = windows(cell[near], size, (ping.range_m.size, ping.bearing_rad.size))
        amplitude = cut(ping.amplitude, where)
        if ping.valid is not None:
            amplitude[~cut(ping.valid, where)] = 0
        if amplitude.dtype.kind == "f":
            amplitude[~np.isfinite(amplitude)] = 0
        return Chips(
            ping.seq,
            ping.stamp_ns,
            track_id[near],
            amplitude,
            where.origin,
            where.centre,
            ping.range_m[where.origin[:, :1] + np.arange(where.size[0])],
            ping.bearing_rad[where.origin[:, 1:] + np.arange(where.size[1])],
            ping.cell_m,
            spacing,
            *self._near(track_id[near], distance[near], bearing[near], sure_id, sure_place),
            course[near],
        )

    def _near(
        self,
        track_id: IntArray,
        distance: FloatArray,
        bearing: FloatArray,
        sure_id: IntArray,
        sure_place: FloatArray,
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Pairs of a chip and another confirmed track that may lie in it, wherever the chip was shifted."""
        r, b = to_polar(sure_place)
        close = np.abs(r - distance[:, None]) <= 2.0 * self.half_range_m
        close &= np.abs(wrap(b - bearing[:, None])) <= 2.0 * math.radians(self.half_bearing_deg)
        chip, other = np.nonzero(close & (sure_id != track_id[:, None]))
        return chip.astype(np.int64), sure_id[other], np.stack([r[other], b[other]], axis=1)

    def snapshot(self) -> dict[str, Any]:
        """The hits of the tracks in the last ping."""
        return {"id": self._id.copy(), "hits": self._hits.copy()}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._id, self._hits = np.array(snapshot["id"]), np.array(snapshot["hits"])


def _in_sensor_frame(tracks: Tracks, ping: Ping) -> tuple[FloatArray, FloatArray] | None:
    """Positions (n, 2) and courses (n,) in the sensor's frame; None where its own place is not known."""
    place, velocity = tracks.state[:, :2], tracks.state[:, 2:]
    if tracks.frame == "sensor":
        return place, np.arctan2(velocity[:, 1], velocity[:, 0])
    nav = ping.nav
    if nav is None or not np.isfinite([*nav.position_m[:2], nav.attitude_rad[2]]).all():
        return None
    pose = sensor_pose(nav, ping.mount)
    at = pose.to_sensor(place)
    ahead = pose.to_sensor(place + velocity) - at
    return at, np.arctan2(ahead[:, 1], ahead[:, 0])


@hookimpl
def fls_node() -> type[CutChips]:
    """Return the node of kind `chips`."""
    return CutChips
