"""Global nearest neighbour on converted measurements, with the track management of `jpda`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fls_flow import hookimpl
from fls_trackers.association import ASSIGNED
from fls_trackers.multi_target import MultiTargetNode

__all__ = ["Gnn", "fls_node"]


@dataclass
class Gnn(MultiTargetNode):
    """Tracks as `jpda` makes them, but each takes one measurement at most, assigned to all at once.

    The assignment maximises the product of p_d N(y_j; H x_t, S_t) / (density_j (1 - p_d p_g)) over its pairs:
    it is the most probable of `jpda`'s joint events, so that a pair less likely than a miss is never made.
    A track's score counts the ratio of its own measurement. A track whose measurement another one gates is
    updated by the mean over the assignment and its `exchanges`: tracks of objects that cross keep their own.

    Parameters are those of `jpda`.

    Source: Blackman & Popoli 1999, section 6.4; Karoui et al. 2015 for conversion, start and end.
    """

    sharing: ClassVar[int] = ASSIGNED


@hookimpl
def fls_node() -> type[Gnn]:
    """Give the node class of kind `gnn`."""
    return Gnn
