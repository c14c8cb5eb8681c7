"""Joint probabilistic data association on converted measurements (CMKF-D/JPDA), with track management."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fls_flow import hookimpl
from fls_trackers.association import JOINT
from fls_trackers.multi_target import MultiTargetNode

__all__ = ["Jpda", "fls_node"]


@dataclass
class Jpda(MultiTargetNode):
    """Tracks of the objects that detections come from, each in every ping until it is lost.

    Detections become Cartesian by debiased conversion; each track follows nearly constant velocity and is
    updated by all measurements in its gate, weighted by their joint probabilities. These are exact while a
    sweep over the tracks and measurements of a cluster keeps at most `max_shared` of them in mind; beyond,
    weak pairs count by loopy belief propagation alone (the log says it once), so that time is bounded.

    Parameters left None take the value of `preset`: `paper` is Karoui et al. 2015 as printed, except for its
    errors; `recommended` is what keeps tracks on clustered detections in clutter; `points` is for
    single echoes, whose noise is no more than the cell and the beam, of slow objects (up to some 0.6 m/s):
    their tracks are confirmed sooner and told apart when closer.

    `initiation`: `box` starts a confirmed track where n1 of m1 pings had an unclaimed detection within
    x_max, y_max; `gate` starts a tentative one at each unclaimed detection, confirmed with n1 updates in
    m1 pings and a log likelihood ratio of `start_score` against clutter (e^-start_score bounds the chance of
    a false detection to become a track). n1 of m1 is 16 of 20 with `box`, 5 of 8 with `gate`. With `box` more
    than a few false detections per ping make false starts. Tentative tracks weigh by how probable their score
    makes them, so that a newcomer takes nothing from one that is about to be confirmed.
    `hit`: what counts as an update, a detection in the gate (`gated`), or one also more likely than none
    (`probable`). Tracks end with fewer than n2 updates in m2 pings, or with a position less certain than
    max_sd_m, whether or not the sonar still looks their way.
    `merge_pings`: how long two tracks must share one echo and move as one until the younger ends; 0: never.
    `start_from_candidates`: whether each of several self-noise candidates in one beam may start a track; a
    single one always may, and all of them update tracks. Beyond `max_tracks` only the strongest detections
    start tracks, which bounds memory and time.

    With `frame: ned` tracks are in north and east, so that own motion does not bend them; in a ping without
    position or heading they are only predicted, and this counts neither as hit nor as miss.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it was.

    Source: Karoui et al. 2015, section IV.
    """

    max_shared: int = 14

    sharing: ClassVar[int] = JOINT


@hookimpl
def fls_node() -> type[Jpda]:
    """Give the node class of kind `jpda`."""
    return Jpda
