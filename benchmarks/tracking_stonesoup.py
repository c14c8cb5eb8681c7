"""Stone Soup's trackers for `benchmarks/tracking.py`, set up for its scenes.

Measurements are bearing and range with an extended Kalman filter, motion is its constant velocity with the
white acceleration that ours has over a scan (q = sigma_v^2 dt). Detection probability, gate (prob_gate of
three sigma) and noise are the scene's; clutter density is that of the scene per rad and m, at the middle of
the sector. Initiation is its `MultiMeasurementInitiator` with nearest neighbours on a Mahalanobis gate.
`SETTINGS` come from `benchmarks.tracking_search`, least mean GOSPA on a seed that the benchmark does not use:
in the dense scene over its first 60 scans, GNN, JPDA with EHM2 and PDA each for itself; in the scene of five
targets over the first 100, JPDA with EHM2 for all.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment, NearestNeighbour
from stonesoup.dataassociator.probability import JPDA, PDA, JPDAwithEHM2
from stonesoup.deleter.error import CovarianceBasedDeleter
from stonesoup.deleter.multi import CompositeDeleter
from stonesoup.deleter.time import UpdateTimeStepsDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.initiator.simple import MultiMeasurementInitiator
from stonesoup.measures import Mahalanobis
from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.tracker.simple import MultiTargetMixtureTracker, MultiTargetTracker
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import ExtendedKalmanUpdater

from benchmarks.tracking_scenes import BEARING_SD_RAD, P_D, PING_S, RANGE_M, RANGE_SD_M, Scene, Seen
from fls_flow import Tracks

__all__ = ["METHODS", "SETTINGS", "SoupSettings", "track"]

EPOCH = datetime.datetime(2000, 1, 1)
METHODS = {
    "JPDA": JPDA,
    "JPDAwithEHM2": JPDAwithEHM2,
    "PDA": PDA,
    "GNN": GNNWith2DAssignment,
    "NN": NearestNeighbour,
}
GATE_PROBABILITY = 1.0 - np.exp(-4.5)  # three sigma in two dimensions


@dataclass(frozen=True, slots=True)
class SoupSettings:
    """What Stone Soup leaves to its user."""

    min_points: int = 6  # updates before a track is shown
    missed_distance: float = 3.0  # sigmas
    hold_steps: int = 3  # scans without update after which a held track is dropped
    delete_steps: int = 10  # the same for a shown track
    max_trace: float = 25.0  # of a covariance
    start_speed_sd_mps: float = 0.5
    sigma_v_mps2: float = 0.03


SETTINGS = {
    "few": dict.fromkeys(METHODS, SoupSettings(min_points=5, hold_steps=2, start_speed_sd_mps=0.3)),
    "many": dict.fromkeys(METHODS, SoupSettings(min_points=5, hold_steps=2, delete_steps=6))
    | {"PDA": SoupSettings(delete_steps=6)},
}


class _Played:
    """A detector that gives prepared detections."""

    def __init__(self, scans: list[tuple[datetime.datetime, set[Detection]]]) -> None:
        self._scans = scans

    def __iter__(self) -> Iterator[tuple[datetime.datetime, set[Detection]]]:
        return iter(self._scans)


def track(
    method: str, scene: Scene, seen: Sequence[Seen], settings: SoupSettings
) -> tuple[list[Tracks], list[float]]:
    """The tracks of each scan, and its CPU time in seconds of this thread."""
    model = CartesianToBearingRange(
        ndim_state=4, mapping=(0, 2), noise_covar=np.diag([BEARING_SD_RAD**2, RANGE_SD_M**2])
    )
    played = _Played([_detections(one, model) for one in seen])
    running = iter(_tracker(method, scene, model, played, settings))
    numbers: dict[str, int] = {}
    found, times = [], []
    for one in seen:
        began = time.thread_time()
        _, tracks = next(running)
        times.append(time.thread_time() - began)
        found.append(_message(one, tracks, numbers))
    return found, times


def _detections(one: Seen, model: Any) -> tuple[datetime.datetime, set[Detection]]:
    stamp = EPOCH + datetime.timedelta(seconds=one.truth.seq * PING_S)
    polar = zip(one.detections.bearing_rad.tolist(), one.detections.range_m.tolist(), strict=True)
    return stamp, {Detection(np.array([[b], [r]]), stamp, measurement_model=model) for b, r in polar}


def _tracker(method: str, scene: Scene, model: Any, played: _Played, s: SoupSettings) -> Any:
    q = s.sigma_v_mps2**2 * PING_S
    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(q), ConstantVelocity(q)])
    predictor, updater = KalmanPredictor(motion), ExtendedKalmanUpdater(model)
    nearest = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=s.missed_distance)
    speed = s.start_speed_sd_mps**2
    initiator = MultiMeasurementInitiator(
        prior_state=GaussianState(np.zeros((4, 1)), np.diag([0.0, speed, 0.0, speed])),
        measurement_model=model,
        deleter=UpdateTimeStepsDeleter(s.hold_steps),
        data_associator=GNNWith2DAssignment(nearest),
        updater=updater,
        min_points=s.min_points,
    )
    deleter = CompositeDeleter(
        [UpdateTimeStepsDeleter(s.delete_steps), CovarianceBasedDeleter(s.max_trace)], intersect=False
    )
    if method in ("GNN", "NN"):
        return MultiTargetTracker(initiator, deleter, played, METHODS[method](nearest), updater)
    area = 2.0 * scene.half_sector_rad * (RANGE_M[1] - RANGE_M[0])
    weighing = PDAHypothesiser(
        predictor,
        updater,
        clutter_spatial_density=scene.false_per_scan / area,
        prob_detect=P_D,
        prob_gate=GATE_PROBABILITY,
    )
    return MultiTargetMixtureTracker(initiator, deleter, played, METHODS[method](weighing), updater)


def _message(one: Seen, tracks: set[Any], numbers: dict[str, int]) -> Tracks:
    ordered = sorted(tracks, key=lambda track: numbers.setdefault(track.id, len(numbers) + 1))
    order = [0, 2, 1, 3]  # x, vx, y, vy -> x, y, vx, vy
    n = len(ordered)
    state = np.array([np.asarray(track.state.mean, float)[order, 0] for track in ordered]).reshape(n, 4)
    covariance = np.array(
        [np.asarray(track.state.covar, float)[np.ix_(order, order)] for track in ordered]
    ).reshape(n, 4, 4)
    ids = np.array([numbers[track.id] for track in ordered], np.int64)
    lengths = np.array([len(track) for track in ordered], np.int64)
    status = np.ones(n, np.uint8)
    return Tracks(one.truth.seq, one.truth.stamp_ns, ids, status, state, covariance, lengths, lengths)
