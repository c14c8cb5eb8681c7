"""Track an unknown number of targets in clutter with a cardinalised Gaussian-mixture PHD filter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import hookimpl
from fls_trackers.gm_phd import GmPhd, Recursion
from fls_trackers.phd_cardinality import cardinality_predicted, cardinality_updated
from fls_trackers.phd_gaussian import Explained, Mixture
from fls_trackers.phd_sector import Births

__all__ = ["GmCphd", "fls_node"]

FloatArray = npt.NDArray[np.float64]


@dataclass
class GmCphd(GmPhd):
    """As `gm-phd`, with the probability of each number of targets carried along.

    One missed detection then no longer halves the number: it is the most probable one, and its uncertainty
    does not grow with the number of targets.

    Source: Vo, Vo & Cantoni 2007.
    """

    recursion: Recursion = "phd"
    max_targets: int = 30
    _cardinality: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.recursion != "phd":
            raise ValueError(
                f"recursion = {self.recursion!r}: gm-cphd has phd alone, for its number of targets"
            )
        if not 1 <= self.max_targets <= 200:
            raise ValueError(f"max_targets = {self.max_targets}: must be 1 to 200")
        self._cardinality = np.zeros(self.max_targets + 1)
        self._cardinality[0] = 1.0

    def _factors(
        self, mixture: Mixture, births: Births, found: Explained, kappa: float, survived: float
    ) -> tuple[float, FloatArray]:
        mass = float(mixture.weight.sum()) + births.total
        detected = float(((1.0 - found.missed) * mixture.weight).sum()) + self.p_d * births.total
        p = cardinality_predicted(self._cardinality, survived, births.total)
        self._cardinality, missed, each = cardinality_updated(p, found.total / kappa, detected, mass)
        return missed, each / kappa

    def _number(self, mass: float) -> int:
        return int(np.argmax(self._cardinality))

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {**super().snapshot(), "cardinality": self._cardinality.copy()}

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        super().restore(saved)
        self._cardinality = np.array(saved["cardinality"], float)


@hookimpl
def fls_node() -> type[GmCphd]:
    """Give the node class of kind `gm-cphd`."""
    return GmCphd
