"""Nearest neighbour Kalman filter for divers and marine animals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fls_flow import hookimpl
from fls_trackers.diver_tracker import DiverTracker

__all__ = ["Nnkf", "fls_node"]


@dataclass
class Nnkf(DiverTracker):
    """Tracks of divers and animals, each updated by the event nearest to it in its gate.

    The nearest is that with the least d2 = nu^T S^-1 nu <= `gamma`. With `hit: probable` it must also be
    more likely than none, p_d N(y; H x, S) / lambda > 1 - p_d p_g; without an event state and covariance
    stay as predicted. With `sharing: joint` (and `hit: probable`) the tracks take their events by the most
    probable joint event, and move by the mean over it and its `exchanges`; else two tracks may take the same
    event, until they are fused.

    Everything else, and every parameter, is as in `pdaf`. A single nearest event is a surer one than PDAF's
    mean in little clutter, and loses its object sooner in much.

    Source: Brinkmann 2010, chapter 3, with its errors mended.
    """

    one_event: ClassVar[bool] = True


@hookimpl
def fls_node() -> type[Nnkf]:
    """Give the node class of kind `nnkf`."""
    return Nnkf
