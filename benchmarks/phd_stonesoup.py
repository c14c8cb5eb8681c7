"""Stone Soup's PHD filters on the scene of the PHD benchmarks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
from stonesoup.measures import Mahalanobis
from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.predictor.particle import SMCPHDBirthSchemeEnum, SMCPHDPredictor
from stonesoup.resampler.particle import SystematicResampler
from stonesoup.sampler.particle import ParticleSampler
from stonesoup.types.angle import Bearing
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection, MissedDetection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.multihypothesis import MultipleHypothesis
from stonesoup.types.state import ParticleState, TaggedWeightedGaussianState
from stonesoup.updater.kalman import ExtendedKalmanUpdater
from stonesoup.updater.particle import SMCPHDUpdater
from stonesoup.updater.pointprocess import PHDUpdater

from benchmarks.phd_scene import (
    BEARING_SD_RAD,
    FAR_M,
    HALF_RAD,
    NEAR_M,
    P_B,
    P_D,
    P_S,
    RANGE_SD_M,
    SIGMA_V,
    SPEED_SD,
    Estimate,
    Filter,
)
from fls_flow import Detections

EPOCH = datetime(2005, 1, 1)


@dataclass
class _Peer:
    """What both filters share."""

    clutter: float
    measurement: Any = field(init=False)
    motion: Any = field(init=False)

    def __post_init__(self) -> None:
        noise = np.diag([BEARING_SD_RAD**2, RANGE_SD_M**2])
        self.measurement = CartesianToBearingRange(4, (0, 2), noise)
        axis = ConstantVelocity(SIGMA_V**2)
        self.motion = CombinedLinearGaussianTransitionModel([axis, axis])

    @property
    def density(self) -> float:
        """Of clutter, per (m rad)."""
        return self.clutter / ((FAR_M - NEAR_M) * 2.0 * HALF_RAD)

    def detections(self, ping: Detections) -> tuple[datetime, list[Any]]:
        """The ping as Stone Soup's detections."""
        at = EPOCH + timedelta(seconds=float(ping.seq))
        return at, [
            Detection(StateVector([Bearing(b), r]), timestamp=at, measurement_model=self.measurement)
            for r, b in zip(ping.range_m.tolist(), ping.bearing_rad.tolist(), strict=True)
        ]


def gm_phd(
    clutter: float, extract: float | None = 0.5, gate: float = 5.0, merge: float = 4.0, depth_m: float = 2.0
) -> Filter:
    """Stone Soup's Gaussian-mixture PHD, set up as in its tutorial, with births that tile the far end."""
    peer = _Peer(clutter)
    kalman = ExtendedKalmanUpdater(peer.measurement)
    updater = PHDUpdater(kalman, clutter_spatial_density=peer.density, prob_detection=P_D, prob_survival=P_S)
    pairs = DistanceHypothesiser(KalmanPredictor(peer.motion), kalman, Mahalanobis(), missed_distance=gate)
    hypothesiser = GaussianMixtureHypothesiser(pairs, order_by_detection=True)
    reducer = GaussianMixtureReducer(prune_threshold=1e-5, merge_threshold=merge, max_number_components=200)
    components: list[Any] = []

    def births(at: datetime) -> list[Any]:
        rows = np.arange(FAR_M - depth_m + 0.5, FAR_M)
        places = [(r, b) for r in rows for b in np.linspace(-0.8, 0.8, 5) * HALF_RAD]
        spread = np.diag([0.5**2, SPEED_SD**2, 1.1**2, SPEED_SD**2])
        return [
            TaggedWeightedGaussianState(
                np.array([[r * math.cos(b)], [-1.0], [r * math.sin(b)], [0.0]]), spread,
                weight=P_B / len(places), tag=TaggedWeightedGaussianState.BIRTH, timestamp=at,
            )
            for r, b in places
        ]  # fmt: skip

    def step(ping: Detections) -> Estimate:
        at, found = peer.detections(ping)
        hypotheses = hypothesiser.hypothesise(components + births(at), found, at)
        components[:] = reducer.reduce(list(updater.update(hypotheses).components))
        weight = np.array([float(c.weight) for c in components])
        state = np.array([np.ravel(c.mean)[[0, 2]] for c in components], float).reshape(-1, 2)
        if extract is None:
            chosen = np.argsort(-weight, kind="stable")[: math.floor(weight.sum() + 0.5)]
            return state[chosen], float(weight.sum())
        return state[weight > extract], float(weight.sum())

    return step


def smc_phd(clutter: float, particles: int = 4000) -> Filter:
    """Stone Soup's sequential Monte Carlo PHD; its time counts, so that no estimates are extracted."""
    peer, rng = _Peer(clutter), np.random.default_rng(0)

    def drawn(num_samples: int, near: float = 58.0) -> Any:
        r = np.sqrt(rng.uniform(near**2, FAR_M**2, num_samples))
        b = rng.uniform(-HALF_RAD, HALF_RAD, num_samples)
        v = np.array([[-1.0], [0.0]]) + SPEED_SD * rng.standard_normal((2, num_samples))
        return StateVectors(np.stack([r * np.cos(b), v[0], r * np.sin(b), v[1]]))

    sampler = ParticleSampler(distribution_func=drawn, params={"num_samples": 500}, ndim_state=4)
    predictor = SMCPHDPredictor(
        transition_model=peer.motion, birth_sampler=sampler, birth_scheme=SMCPHDBirthSchemeEnum.EXPANSION,
        death_probability=1.0 - P_S, birth_probability=0.1, birth_rate=P_B,
    )  # fmt: skip
    updater = SMCPHDUpdater(
        peer.measurement, resampler=SystematicResampler(), prob_detect=P_D, clutter_intensity=peer.density,
        num_samples=particles,
    )  # fmt: skip
    start = drawn(particles, NEAR_M)
    held = [ParticleState(start, log_weight=np.full(particles, -math.log(particles)), timestamp=EPOCH)]

    def step(ping: Detections) -> Estimate:
        at, found = peer.detections(ping)
        prediction = predictor.predict(held[0], timestamp=at)
        whole = [SingleHypothesis(prediction, MissedDetection(timestamp=at))]
        whole += [SingleHypothesis(prediction, one) for one in found]
        held[0] = updater.update(MultipleHypothesis(whole))
        return np.zeros((0, 2)), float(np.exp(np.asarray(held[0].log_weight, float)).sum())

    return step
