"""Probabilistic data association, each track for itself among the others, with the management of `jpda`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fls_flow import hookimpl
from fls_trackers.association import LINEAR
from fls_trackers.multi_target import MultiTargetNode

__all__ = ["Pda", "fls_node"]


@dataclass
class Pda(MultiTargetNode):
    """Tracks as `jpda` makes them, but each weighs the measurements in its gate for itself.

    beta_j = ratio_j / (1 + sum of ratios), ratio_j = p_d N(y_j; H x, S) / (density_j (1 - p_d p_g)): a track
    without neighbours has what it has in `jpda`, and the time does not grow with how many share measurements.
    To a track with neighbours, what may be theirs adds to the density of clutter (`linear.against_others`):
    as if each were alone, tracks of objects that cross would draw together and be merged. Two tracks may
    still take the same measurement. Confirmed tracks take first: a tentative one gets the measurements that
    more likely are no confirmed track's.

    Parameters are those of `jpda`.

    Source: Bar-Shalom & Li 1995, section 3.4; Musicki & La Scala 2008 for the neighbours; Karoui et al. 2015
    for conversion, start and end.
    """

    sharing: ClassVar[int] = LINEAR


@hookimpl
def fls_node() -> type[Pda]:
    """Give the node class of kind `pda`."""
    return Pda
