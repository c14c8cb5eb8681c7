"""Track an unknown number of targets in clutter with a Gaussian-mixture PHD filter."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Intensity, hookimpl
from fls_trackers.phd_clutter import ClutterRate
from fls_trackers.phd_existence import Labelled, existing, reduced_by_label, strongest
from fls_trackers.phd_gaussian import Explained, Mixture, explained, predicted
from fls_trackers.phd_identity import Identities, TracksAndIntensity, elapsed_s
from fls_trackers.phd_reduction import reduced
from fls_trackers.phd_sector import Births, Sector, births_of, measurements_of, pose_of, sector_of
from fls_trackers.phd_settings import PhdSettings

__all__ = ["GmPhd", "fls_node"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Recursion = Literal["labelled", "phd"]


@dataclass
class GmPhd(PhdSettings):
    """The expected number of targets, their states, and tracks with identities.

    The intensity is a mixture of Gaussians that an extended Kalman filter updates in range and bearing:
    deterministic, and faster and sharper than particles as long as a target's distribution is one ellipse.
    The `recursion` of its mass is that of the paper (`phd`), with the round(mass) heaviest components as
    estimates; or `labelled`: components belong to identities, each of which exists with a probability that
    one missed detection does not take away, and the estimates are the round(mass) likeliest of them.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it was.

    Source: Vo & Ma 2006; `labelled`: see `phd_existence`.
    """

    recursion: Recursion = "labelled"
    prune_weight: float = 1e-5
    merge_distance: float = 4.0  # squared
    max_components: int = 200

    _mixture: Mixture = field(default_factory=Mixture.empty, init=False, repr=False)
    _label: IntArray = field(default_factory=lambda: np.zeros(0, np.int64), init=False, repr=False)
    _next_label: int = field(default=0, init=False, repr=False)
    _views: int = field(default=0, init=False, repr=False)
    _stamp_ns: int | None = field(default=None, init=False, repr=False)
    _clutter: ClutterRate = field(init=False, repr=False)
    _identities: Identities = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.recursion not in get_args(Recursion):
            raise ValueError(
                f"recursion = {self.recursion!r}: must be one of {', '.join(get_args(Recursion))}"
            )
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
        flat = sector_of(detections.view)
        z = measurements_of(detections, self, flat)
        self._stamp_ns = detections.stamp_ns
        self._identities.predict(dt_s)
        pose = pose_of(detections.view, self)
        sector = None if pose is None or flat is None else flat.seen_from(pose)
        before = self._mixture
        mixture = predicted(before, dt_s, self.sigma_v_mps2, self.p_s, sector)
        if sector is None:
            self._mixture = mixture
            return self._unseen(detections)
        range_sd = float(z.range_sd_m.max()) if len(z) else 0.0
        births = births_of(detections.view, sector, range_sd, dt_s, self).started(self._views, self, sector)
        self._views += 1
        found = explained(mixture, births, z, self.p_d, sector)
        kappa = self._clutter.per_ping / sector.polar_area
        if self.recursion == "labelled":
            return self._labelled(mixture, found, kappa, detections, sector)
        survived = _ratio(mixture.weight.sum(), before.weight.sum())
        missed, pairs = self._factors(mixture, births, found, kappa, survived)
        whole = Mixture(found.missed * mixture.weight * missed, mixture.state, mixture.covariance).joined(
            found.pairs._replace(weight=found.pairs.weight * pairs[found.measurement])
        )
        self._clutter.learn(found.total * pairs)
        mass = float(whole.weight.sum())
        self._mixture, _ = reduced(whole, self.prune_weight, self.merge_distance, self.max_components)
        heaviest = self._mixture.select(np.arange(min(self._number(mass), self._mixture.weight.size)))
        return self._answer(heaviest, mass, detections, sector)

    def _labelled(
        self, mixture: Mixture, found: Explained, kappa: float, detections: Detections, sector: Sector
    ) -> TracksAndIntensity:
        """The answer of the recursion with identities."""
        whole = existing(Labelled(mixture, self._label), found, kappa, self._next_label)
        self._next_label += found.total.size
        self._clutter.learn(found.total / (kappa + found.total))
        mass = float(whole.mixture.weight.sum())
        kept = reduced_by_label(whole, self.prune_weight, self.merge_distance, self.max_components)
        self._mixture, self._label = kept
        state, covariance, existence = strongest(kept, self._number(mass))
        return self._answer(Mixture(existence, state, covariance), mass, detections, sector)

    def _factors(
        self, mixture: Mixture, births: Births, found: Explained, kappa: float, survived: float
    ) -> tuple[float, FloatArray]:
        """The factors on missed components and on each measurement's pairs: 1, and 1 / (kappa + C)."""
        return 1.0, 1.0 / (kappa + found.total)

    def _number(self, mass: float) -> int:
        """The number of targets to report."""
        return math.floor(mass + 0.5)

    def _answer(
        self, estimates: Mixture, mass: float, detections: Detections, sector: Sector
    ) -> TracksAndIntensity:
        seq, stamp_ns = detections.seq, detections.stamp_ns
        weight, state, covariance = estimates
        return TracksAndIntensity(
            self._identities.update(state, covariance, seq, stamp_ns, self.frame, sector),
            Intensity(seq, stamp_ns, mass, state, weight, covariance, self.frame),
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
            "label": self._label.copy(),
            "next_label": self._next_label,
            "views": self._views,
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
        self._label = np.array(saved["label"], np.int64)
        self._next_label = int(saved["next_label"])
        self._views, stamp = int(saved["views"]), saved["stamp_ns"]
        self._stamp_ns = None if stamp is None else int(stamp)
        self._clutter.restore(saved["clutter"])
        self._identities.restore(saved["identities"])


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0.0 else 1.0


@hookimpl
def fls_node() -> type[GmPhd]:
    """Give the node class of kind `gm-phd`."""
    return GmPhd
