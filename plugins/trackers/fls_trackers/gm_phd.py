"""Track an unknown number of targets in clutter with a Gaussian-mixture PHD filter."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Intensity, hookimpl
from fls_trackers.phd_clutter import ClutterRate
from fls_trackers.phd_gaussian import Explained, Mixture, explained, predicted
from fls_trackers.phd_identity import Identities, TracksAndIntensity, elapsed_s
from fls_trackers.phd_reduction import reduced
from fls_trackers.phd_sector import Births, Sector, births_of, measurements_of, pose_of, sector_of
from fls_trackers.phd_settings import PhdSettings

__all__ = ["GmPhd", "fls_node"]

FloatArray = npt.NDArray[np.float64]


@dataclass
class GmPhd(PhdSettings):
    """The expected number of targets, their states, and tracks with identities.

    The intensity is a mixture of Gaussians that an extended Kalman filter updates in range and bearing:
    deterministic, and faster and sharper than particles as long as a target's distribution is one ellipse.
    The estimates are the round(mass) heaviest components.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it was.

    Source: Vo & Ma 2006.
    """

    prune_weight: float = 1e-5
    merge_distance: float = 4.0  # squared
    max_components: int = 200

    _mixture: Mixture = field(default_factory=Mixture.empty, init=False, repr=False)
    _started: bool = field(default=False, init=False, repr=False)
    _stamp_ns: int | None = field(default=None, init=False, repr=False)
    _clutter: ClutterRate = field(init=False, repr=False)
    _identities: Identities = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.prune_weight < 0.1:
            raise ValueError(f"prune_weight = {self.prune_weight}: must lie between 0 and 0.1")
        if not 0.0 <= self.merge_distance < math.inf:
            raise ValueError(f"merge_distance = {self.merge_distance}: must be 0 or more")
        if self.max_components < 1:
            raise ValueError(f"max_components = {self.max_components}: must be at least 1")
        self._clutter = ClutterRate(self.clutter_per_ping)
        self._identities = Identities(self.rules, self.gamma, self.sigma_v_mps2)

    def __call__(self, detections: Detections) -> TracksAndIntensity:
        """Tracks and intensity at the stamp of `detections`, after its update."""
        dt_s = elapsed_s(detections, self._stamp_ns)
        z = measurements_of(detections, self)
        self._stamp_ns = detections.stamp_ns
        self._identities.predict(dt_s)
        pose = pose_of(detections.view, self)
        sector = None if pose is None else sector_of(detections.view, pose)
        before = self._mixture
        mixture = predicted(before, dt_s, self.sigma_v_mps2, self.p_s, sector)
        if sector is None:
            self._mixture = mixture
            return self._unseen(detections)
        range_sd = float(z.range_sd_m.max()) if len(z) else 0.0
        births = births_of(detections.view, sector, range_sd, dt_s, self)
        if not self._started:
            self._started, births = True, births.everywhere(self.prior_targets, sector)
        found = explained(mixture, births, z, self.p_d, sector)
        kappa = self._clutter.per_ping / sector.polar_area
        survived = _ratio(mixture.weight.sum(), before.weight.sum())
        missed, pairs = self._factors(mixture, births, found, kappa, survived)
        whole = Mixture(found.missed * mixture.weight * missed, mixture.state, mixture.covariance).joined(
            found.pairs._replace(weight=found.pairs.weight * pairs[found.measurement])
        )
        self._clutter.learn(found.total * pairs)
        return self._answer(whole, detections, sector)

    def _factors(
        self, mixture: Mixture, births: Births, found: Explained, kappa: float, survived: float
    ) -> tuple[float, FloatArray]:
        """The factors on missed components and on each measurement's pairs: 1, and 1 / (kappa + C)."""
        return 1.0, 1.0 / (kappa + found.total)

    def _number(self, mass: float) -> int:
        """The number of targets to report."""
        return math.floor(mass + 0.5)

    def _answer(self, whole: Mixture, detections: Detections, sector: Sector) -> TracksAndIntensity:
        mass = float(whole.weight.sum())
        self._mixture = mixture = reduced(whole, self.prune_weight, self.merge_distance, self.max_components)
        n = min(self._number(mass), mixture.weight.size)
        state, covariance = mixture.state[:n].copy(), mixture.covariance[:n].copy()
        seq, stamp_ns = detections.seq, detections.stamp_ns
        return TracksAndIntensity(
            self._identities.update(state, covariance, seq, stamp_ns, self.frame, sector),
            Intensity(seq, stamp_ns, mass, state, mixture.weight[:n].copy(), covariance, self.frame),
        )

    def _unseen(self, detections: Detections) -> TracksAndIntensity:
        seq, stamp_ns = detections.seq, detections.stamp_ns
        mass = float(self._mixture.weight.sum())
        return TracksAndIntensity(
            self._identities.unseen(seq, stamp_ns, self.frame),
            Intensity(seq, stamp_ns, mass, frame=self.frame),
        )

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            **{name: array.copy() for name, array in self._mixture._asdict().items()},
            "started": self._started,
            "stamp_ns": self._stamp_ns,
            "clutter": self._clutter.snapshot(),
            "identities": self._identities.snapshot(),
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._mixture = Mixture(
            np.array(saved["weight"], float),
            np.array(saved["state"], float).reshape(-1, 4),
            np.array(saved["covariance"], float).reshape(-1, 4, 4),
        )
        self._started, stamp = bool(saved["started"]), saved["stamp_ns"]
        self._stamp_ns = None if stamp is None else int(stamp)
        self._clutter.restore(saved["clutter"])
        self._identities.restore(saved["identities"])


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0.0 else 1.0


@hookimpl
def fls_node() -> type[GmPhd]:
    """Give the node class of kind `gm-phd`."""
    return GmPhd
