"""Probabilistic data association, each track for itself, with the track management of `jpda`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from fls_flow import Detections, Tracks, hookimpl
from fls_trackers.association import INDEPENDENT
from fls_trackers.multi_target import MultiTarget
from fls_trackers.settings import Parameters

__all__ = ["Pda", "fls_node"]


@dataclass
class Pda(Parameters):
    """Tracks as `jpda` makes them, but each weighs the measurements in its gate as if it were alone.

    beta_j = ratio_j / (1 + sum of ratios), ratio_j = p_d N(y_j; H x, S) / (density (1 - p_d p_g)): two
    tracks may take the same measurement. So tracks of objects closer than their gates draw together; with
    `merge_pings` those that follow one echo as one are merged. Confirmed tracks still take first: a tentative
    one gets the measurements that more likely are no confirmed track's.

    Parameters are those of `jpda`.

    Source: Bar-Shalom & Li 1995, section 3.4; Karoui et al. 2015 for conversion, start and end.
    """

    _tracker: MultiTarget = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._tracker = MultiTarget.of(vars(self), INDEPENDENT)

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
def fls_node() -> type[Pda]:
    """Give the node class of kind `pda`."""
    return Pda
