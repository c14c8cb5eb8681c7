"""Nearest neighbour Kalman filter for divers and marine animals."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from fls_flow import Detections, Tracks, hookimpl
from fls_flow.messages import Frame
from fls_trackers.clutter import Clutter
from fls_trackers.diver_tracks import DiverTracks
from fls_trackers.fusion import Fusion
from fls_trackers.settings import Hit

__all__ = ["Nnkf", "fls_node"]


@dataclass
class Nnkf:
    """Tracks of divers and animals, each updated by the event nearest to it in its gate.

    The nearest is that with the least d2 = nu^T S^-1 nu <= `gamma`. With `hit: probable` it must also be
    more likely than none, p_d N(y; H x, S) / lambda > 1 - p_d p_g; without an event state and covariance
    stay as predicted. Two tracks may take the same event, until they are fused.

    Everything else, and every parameter, is as in `pdaf`. A single nearest event is a surer one than PDAF's
    mean in little clutter, and loses its object sooner in much.

    Source: Brinkmann 2010, chapter 3, with its errors mended.
    """

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
    group_m: float = 2.0
    m1: int = 10
    n1: int = 5
    start_score: float = 12.0
    speed_sd_mps: float = 0.5
    max_propagate: int = 20
    max_sd_m: float = 2.5
    max_common_events: int = 3
    fusion: Fusion = "algebraic"
    max_tracks: int = 500

    _tracker: DiverTracks = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._tracker = DiverTracks.of(vars(self), one_event=True)

    def __call__(self, detections: Detections) -> Tracks:
        """The tracks at the stamp of `detections`, after its update."""
        return self._tracker(detections)

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return self._tracker.snapshot()

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._tracker.restore(saved)


@hookimpl
def fls_node() -> type[Nnkf]:
    """Give the node class of kind `nnkf`."""
    return Nnkf
