"""The parameters and ports that `pdaf` and `nnkf` have in common."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from fls_flow import Detections, Tracks
from fls_flow.messages import Frame
from fls_trackers.clutter import Clutter
from fls_trackers.diver_tracks import DiverTracks, Sharing
from fls_trackers.fusion import Fusion
from fls_trackers.settings import Hit

__all__ = ["DiverTracker"]


@dataclass
class DiverTracker:
    """A node that follows divers and animals; `pdaf` documents the parameters."""

    frame: Frame = "sensor"
    velocity_walk_mps: float = 0.2
    sigma_d_m: float | None = None
    sigma_delta_deg: float | None = None
    extent_sd_m: float = 0.4
    estimate_noise: bool = True
    gamma: float = 16.0
    p_d: float = 0.65
    p_g: float | None = None
    p_fa: float = 1e-4
    clutter: Clutter = "adaptive"
    hit: Hit = "probable"
    sharing: Sharing = "joint"
    amplitude_sd: float | None = None
    group_m: float = 2.0
    resolution_m: float | None = None
    meeting_m: float | None = None
    m1: int = 10
    n1: int = 5
    start_score: float = 12.0
    speed_sd_mps: float = 0.5
    max_propagate: int = 20
    max_sd_m: float = 2.5
    max_common_events: int = 3
    fusion: Fusion = "algebraic"
    max_tracks: int = 500

    one_event: ClassVar[bool] = False  # whether a track takes its nearest event alone
    _tracker: DiverTracks = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._tracker = DiverTracks.of(vars(self), one_event=self.one_event)

    def __call__(self, detections: Detections) -> Tracks:
        """The tracks at the stamp of `detections`, after its update."""
        return self._tracker(detections)

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return self._tracker.snapshot()

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._tracker.restore(saved)
