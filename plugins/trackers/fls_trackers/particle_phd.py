"""Track an unknown number of targets in clutter with a particle PHD filter."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Intensity, hookimpl
from fls_trackers.phd_births import born
from fls_trackers.phd_clouds import clouds
from fls_trackers.phd_clutter import ClutterRate
from fls_trackers.phd_identity import Identities, TracksAndIntensity, elapsed_s
from fls_trackers.phd_mixture import centres, fitted, local_mass
from fls_trackers.phd_particles import Update, propagated, resampled, updated, updated_by_label
from fls_trackers.phd_sector import Measurements, Sector, births_of, measurements_of, pose_of, sector_of
from fls_trackers.phd_settings import PhdSettings

__all__ = ["ParticlePhd", "fls_node"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Proposal = Literal["uniform", "measured"]
Recursion = Literal["labelled", "phd"]

log = logging.getLogger(__name__)


@dataclass
class ParticlePhd(PhdSettings):
    """The expected number of targets, their states, and tracks with identities.

    The intensity of targets is a cloud of weighted particles, `particles` per expected target and
    `birth_particles` for births; its mass is the expected number. The `recursion` of the mass is that of the
    paper (`phd`): the estimates are then a Gaussian mixture of round(mass) components fitted to the cloud,
    started where measurements or tracks say that targets are. Or it is `labelled`: particles bear the label
    of the measurement near which they were born, each label exists with a probability that one missed
    detection does not take away, and the estimates are the round(mass) likeliest labels' moments.
    A `resampling_power` below 1 keeps more particles on targets that are not certain yet.
    `birth_proposal` says where birth particles are drawn, from the same density: over the whole region of
    births (as in the paper; `phd` alone) or near the measurements, which wastes none.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it was.

    Source: Clark & Bell 2005, with the corrections of ALGORITHMS, section 4; `labelled`: see `phd_existence`.
    """

    recursion: Recursion = "labelled"
    particles: int = 2000
    birth_particles: int = 1000
    birth_proposal: Proposal = "measured"
    resampling_power: float = 0.7  # 1: equal weights after resampling, as in the paper
    max_particles: int = 40_000
    floor_sd_m: float = 0.05  # of the estimates
    prune_existence: float = 1e-5
    merge_distance: float = 4.0  # squared, of labels that are one target
    seed: int = 0

    _state: FloatArray = field(default_factory=lambda: np.zeros((0, 4)), init=False, repr=False)
    _weight: FloatArray = field(default_factory=lambda: np.zeros(0), init=False, repr=False)
    _label: IntArray = field(default_factory=lambda: np.zeros(0, np.int64), init=False, repr=False)
    _pings: int = field(default=0, init=False, repr=False)
    _views: int = field(default=0, init=False, repr=False)
    _stamp_ns: int | None = field(default=None, init=False, repr=False)
    _clutter: ClutterRate = field(init=False, repr=False)
    _identities: Identities = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("particles", "birth_particles", "max_particles"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)}: must be at least 1")
        for name, known in (("birth_proposal", Proposal), ("recursion", Recursion)):
            if getattr(self, name) not in get_args(known):
                raise ValueError(
                    f"{name} = {getattr(self, name)!r}: must be one of {', '.join(get_args(known))}"
                )
        if self.recursion == "labelled" and self.birth_proposal == "uniform":
            raise ValueError("birth_proposal = 'uniform': needs recursion = 'phd', as it gives no labels")
        for name, holds, what in (
            ("prune_existence", 0.0 <= self.prune_existence < 0.1, "0 or more, and below 0.1"),
            ("merge_distance", 0.0 <= self.merge_distance < math.inf, "0 or more"),
            ("resampling_power", 0.0 < self.resampling_power <= 1.0, "above 0 and at most 1"),
            ("floor_sd_m", 0.0 < self.floor_sd_m < math.inf, "positive"),
            ("seed", self.seed >= 0, "0 or more"),
        ):
            if not holds:
                raise ValueError(f"{name} = {getattr(self, name)}: must be {what}")
        self._clutter = ClutterRate(self.clutter_per_ping)
        self._identities = Identities(self.rules, self.gamma, self.sigma_v_mps2)

    def __call__(self, detections: Detections) -> TracksAndIntensity:
        """Tracks and intensity at the stamp of `detections`, after its update."""
        dt_s = elapsed_s(detections, self._stamp_ns)
        flat = sector_of(detections.view)
        z = measurements_of(detections, self, flat)
        rng = np.random.default_rng((self.seed, self._pings))
        self._stamp_ns, self._pings = detections.stamp_ns, self._pings + 1
        self._identities.predict(dt_s)
        pose = pose_of(detections.view, self)
        sector = None if pose is None or flat is None else flat.seen_from(pose)
        self._predict(detections, sector, z, dt_s, rng)
        if sector is None:
            return self._unseen(detections)
        kappa = self._clutter.per_ping / sector.polar_area
        if self.recursion == "labelled":
            weight, (state, covariance, mass) = self._labelled(z, kappa, sector)
        else:
            update = updated(self._state, self._weight, z, kappa, self.p_d, sector)
            self._clutter.learn(update.taken)
            weight, (state, covariance, mass) = update.weight, self._estimates(update, z, sector)
        self._resample(weight, rng)
        seq, stamp_ns = detections.seq, detections.stamp_ns
        total = float(weight.sum())
        return TracksAndIntensity(
            self._identities.update(state, covariance, seq, stamp_ns, self.frame, sector),
            Intensity(seq, stamp_ns, total, state, mass, covariance, self.frame),
        )

    def _predict(
        self,
        detections: Detections,
        sector: Sector | None,
        z: Measurements,
        dt_s: float,
        rng: np.random.Generator,
    ) -> None:
        """Move the particles and add those of births."""
        self._state, self._weight = propagated(
            self._state, self._weight, dt_s, self.sigma_v_mps2, self.p_s, sector, rng
        )
        if sector is None:
            return
        range_sd = float(z.range_sd_m.max()) if len(z) else 0.0
        births = births_of(detections.view, sector, range_sd, dt_s, self)
        number, near = self.birth_particles, z if self.birth_proposal == "measured" else None
        if self.recursion == "labelled":
            births = births.started(self._views, self, sector)
        elif not self._views:  # particles over all of the sector hold the unseen ones
            births, near = births.everywhere(self.prior_targets, sector), None
        if not self._views:
            number = self.particles
        self._views += 1
        state, weight, which = born(number, sector, births, near, rng)
        first = int(self._label.max()) + 1 if self._label.size else 0
        self._state = np.concatenate([self._state, state])
        self._weight = np.concatenate([self._weight, weight])
        self._label = np.concatenate([self._label, first + which])

    def _labelled(
        self, z: Measurements, kappa: float, sector: Sector
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
        """The particles' new weights, and the estimates; the labels are then those of the clouds."""
        labels = int(self._label.max()) + 1 if self._label.size else 0
        update = updated_by_label(self._state, self._weight, self._label, labels, z, kappa, self.p_d, sector)
        self._clutter.learn(update.taken)
        found = clouds(
            self._state, update.weight, self._label, self.prune_existence, self.merge_distance,
            self.floor_sd_m,
        )  # fmt: skip
        self._label = found.label
        return found.weight, found.strongest(math.floor(float(found.weight.sum()) + 0.5))

    def _estimates(
        self, update: Update, z: Measurements, sector: Sector
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States (k, 4), covariances and masses of the estimates, k = round(mass) where so many are found."""
        n = math.floor(float(update.weight.sum()) + 0.5)
        if n == 0:
            return np.zeros((0, 4)), np.zeros((0, 4, 4)), np.zeros(0)
        sd = np.maximum(z.range_sd_m, z.range_m * z.bearing_sd_rad)
        typical = float(np.median(sd)) if len(z) else 4.0 * self.floor_sd_m
        seen = np.flatnonzero(update.taken > 0.0)
        held = self._identities.position_m
        place = np.concatenate([update.mean[seen, :2], held])
        mass = np.concatenate(
            [update.taken[seen], local_mass(self._state, update.missed, held, 3.0 * typical)]
        )
        reach = np.concatenate([3.0 * sd[seen], np.full(len(held), 3.0 * typical)])
        chosen = centres(place, mass, n, reach)
        if not len(chosen):
            chosen = (update.weight @ self._state[:, :2] / update.weight.sum())[None]
        return fitted(self._state, update.weight, chosen, typical, self.floor_sd_m, sector.area_m2)

    def _resample(self, weight: FloatArray, rng: np.random.Generator) -> None:
        """L = max(N / 2, N round(mass)) particles, at most `max_particles`."""
        wanted = max(self.particles // 2, self.particles * math.floor(float(weight.sum()) + 0.5), 1)
        n = min(wanted, self.max_particles)
        drawn, self._weight = resampled(weight, n, self.resampling_power, rng)
        self._state, self._label = self._state[drawn], self._label[drawn]

    def _unseen(self, detections: Detections) -> TracksAndIntensity:
        seq, stamp_ns = detections.seq, detections.stamp_ns
        mass = float(self._weight.sum())
        return TracksAndIntensity(
            self._identities.unseen(seq, stamp_ns, self.frame),
            Intensity(seq, stamp_ns, mass, frame=self.frame),
        )

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            "state": self._state.copy(),
            "weight": self._weight.copy(),
            "label": self._label.copy(),
            "pings": self._pings,
            "views": self._views,
            "stamp_ns": self._stamp_ns,
            "clutter": self._clutter.snapshot(),
            "identities": self._identities.snapshot(),
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._state = np.array(saved["state"], float).reshape(-1, 4)
        self._weight = np.array(saved["weight"], float)
        self._label = np.array(saved["label"], np.int64)
        self._pings, self._views = int(saved["pings"]), int(saved["views"])
        stamp = saved["stamp_ns"]
        self._stamp_ns = None if stamp is None else int(stamp)
        self._clutter.restore(saved["clutter"])
        self._identities.restore(saved["identities"])


@hookimpl
def fls_node() -> type[ParticlePhd]:
    """Give the node class of kind `particle-phd`."""
    return ParticlePhd
