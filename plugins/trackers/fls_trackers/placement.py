"""Where and when detections are: elapsed time, grain of the view, pose of the sensor, each checked."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fls_flow import Detections, View
from fls_flow.geometry import Pose, sensor_pose
from fls_flow.messages import Frame
from fls_trackers.settings import Grain, Settings, grain_of

__all__ = ["Placement", "check_finite"]

log = logging.getLogger("fls_trackers")

ORIGIN = Pose()


@dataclass
class Placement:
    """The last ping's stamp, and what follows from a ping's stamp and view for tracks in `frame`."""

    settings: Settings
    frame: Frame
    stamp_ns: int | None = field(default=None, init=False)
    _grain: tuple[Any, Grain] | None = field(default=None, init=False, repr=False)
    _said: set[str] = field(default_factory=set, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.frame not in ("sensor", "ned"):
            raise ValueError(f"frame = {self.frame!r}: must be sensor or ned")

    def elapsed_s(self, detections: Detections) -> float:
        """Seconds since the last ping, 0 for the first.

        Raises ValueError when the stamp does not increase.
        """
        if self.stamp_ns is None:
            return 0.0
        elapsed = detections.stamp_ns - self.stamp_ns
        if elapsed <= 0:
            raise ValueError(
                f"ping seq {detections.seq} has stamp {detections.stamp_ns} ns, not after the last ping's "
                f"{self.stamp_ns} ns; pings must come in the order of their stamps"
            )
        return elapsed * 1e-9

    def grain_of(self, view: View) -> Grain:
        """The grain of `view`, worked out again only when the view's geometry changes."""
        key = (
            view.range_min_m,
            view.range_max_m,
            view.cell_m,
            view.beamwidth_rad,
            view.bearing_rad.tobytes(),
        )
        if self._grain is None or self._grain[0] != key:
            self._grain = (key, grain_of(view, self.settings))
        return self._grain[1]

    def pose(self, detections: Detections) -> Pose | None:
        """The sensor's pose in the frame of the tracks; None when that is `ned` and it is not known."""
        if self.frame == "sensor":
            return ORIGIN
        view = detections.view
        if view.nav is not None:
            north, east, _ = view.nav.position_m
            if np.isfinite([north, east, view.nav.attitude_rad[2]]).all():
                return sensor_pose(view.nav, view.mount)
        self.warn_once(
            f"ping seq {detections.seq}: no position or heading; tracks in ned are then only predicted"
        )
        return None

    def warn_once(self, text: str) -> None:
        """Log a warning, once for all texts that differ only before their first colon."""
        reason = text.partition(":")[2]
        if reason not in self._said:
            self._said.add(reason)
            log.warning("%s", text)


def check_finite(detections: Detections) -> None:
    """Raise ValueError, which names the first of them, when a detection is not finite."""
    bad = ~(np.isfinite(detections.range_m) & np.isfinite(detections.bearing_rad))
    if bad.any():
        first = int(np.argmax(bad))
        raise ValueError(
            f"ping seq {detections.seq}: {np.count_nonzero(bad)} of {len(detections)} detections are not "
            f"finite; the first (index {first}) is at {detections.range_m[first]} m, "
            f"{detections.bearing_rad[first]} rad"
        )
