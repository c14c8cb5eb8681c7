"""Probabilistic data association filter for divers and marine animals."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from fls_flow import Detections, Tracks, hookimpl
from fls_flow.messages import Frame
from fls_trackers.clutter import Clutter
from fls_trackers.diver_tracks import DiverTracks
from fls_trackers.fusion import Fusion
from fls_trackers.settings import Hit

__all__ = ["Pdaf", "fls_node"]


@dataclass
class Pdaf:
    """Tracks of divers and animals, each updated by all events in its gate, weighted by their probabilities.

    beta_j = e_j / (b + sum of e), e_j = exp(-d2_j / 2), b = lambda sqrt|2 pi S| (1 - p_d p_g) / p_d, over
    the events with d2_j = nu_j^T S^-1 nu_j <= `gamma`. Events are Cartesian by debiased conversion, motion
    is nearly constant velocity: a component changes by `velocity_walk_mps` (standard deviation) within a
    second.

    `group_m`: events within that distance of a stronger one are first made one, as an object fills many
    cells (0: off, for detectors that give one event per object). `clutter`: lambda is the larger of `p_fa`
    per cell and what no confirmed track gated in the last 20 pings, or the first alone (`cell`).
    `estimate_noise`: each track learns factors on its process and its measurement noise from its
    innovations. `sigma_d_m` and `sigma_delta_deg` are by default the cell and the beam; `extent_sd_m` is
    how far an echo's centre wanders over the body, in any direction.

    Every event that no track gates starts a tentative track, confirmed with n1 updates in m1 pings and a
    log likelihood ratio of `start_score`; until then it gets only events that more likely are no confirmed
    track's. `hit`: what counts as an update, an event in the gate (`gated`), or one also more likely than
    none (`probable`). A confirmed track is propagated through misses; its score is `max_propagate` after an
    update and falls by one per miss, and a miss at 0 ends it (with p_d = 0.65, 5 ends a track after some
    800 pings on average). A position less certain than max_sd_m ends it too. Tracks that had the same most
    probable event in `max_common_events` common updates in a row (0: never), and are as near as if they
    followed one object, are fused into the older: `algebraic`, or by `covariance-intersection`, which
    allows for the events they shared.

    With `frame: ned` tracks are in north and east; in a ping without position or heading they are only
    predicted.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it
    was.

    Source: Brinkmann 2010, chapter 3, with its errors mended; noise estimation, tentative tracks and new
    tracks at any time are ours.
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
        self._tracker = DiverTracks.of(vars(self), one_event=False)

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
def fls_node() -> type[Pdaf]:
    """Give the node class of kind `pdaf`."""
    return Pdaf
