"""Global nearest neighbour on converted measurements, with the track management of `jpda`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from fls_flow import Detections, Tracks, hookimpl
from fls_trackers.association import ASSIGNED
from fls_trackers.multi_target import MultiTarget
from fls_trackers.settings import Parameters

__all__ = ["Gnn", "fls_node"]


@dataclass
class Gnn(Parameters):
    """Tracks as `jpda` makes them, but each is updated by one measurement at most, assigned to all at once.

    The assignment maximises the product of p_d N(y_j; H x_t, S_t) / (density_j (1 - p_d p_g)) over its pairs:
    it is the most probable of `jpda`'s joint events, so that a pair less likely than a miss is never made.
    A track's score counts the ratio of its own measurement.

    Parameters are those of `jpda`.

    Source: Blackman & Popoli 1999, section 6.4; Karoui et al. 2015 for conversion, start and end.
    """

    _tracker: MultiTarget = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._tracker = MultiTarget.of(vars(self), ASSIGNED)

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
def fls_node() -> type[Gnn]:
    """Give the node class of kind `gnn`."""
    return Gnn
