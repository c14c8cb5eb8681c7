"""Detections against truth: probability of detection and false alarms over the threshold."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.evaluate.assignment import pairs_within
from fls_flow.evaluate.scene import Points, common_pings, detections_of, targets_of
from fls_flow.evaluate.table import Table

__all__ = ["DetectorScores", "detector_scores"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DetectorScores:
    """The operating points of a detector, from the highest threshold to the lowest; (n,) each."""

    threshold: FloatArray  # of the amplitude; -inf: all, also those without amplitude
    pd: FloatArray  # share of the target rows with a detection in the gate
    false_alarms: FloatArray  # per ping, in no target's gate
    target_pd: dict[int, float]  # of each target, at the lowest threshold
    overall: dict[str, float]
    notes: tuple[str, ...]


def detector_scores(truth: Table, detections: Table, gate_m: float) -> DetectorScores:
    """Pd and false alarms per ping when only detections of at least the threshold count.

    A target is detected in a ping when a detection lies at most `gate_m` away; further detections in a gate
    are neither hits nor false alarms. Raises UserError when the truth is not in the sensor's frame.
    """
    if truth.ping.size and truth.frame != "sensor":
        raise UserError(
            f"{truth.path}: frame is '{truth.frame}', that of detections 'sensor'; "
            f"convert the truth, or name the files to score without {detections.path.name}"
        )
    pings = common_pings(truth, detections)
    targets, points = targets_of(truth, pings), detections_of(detections, pings)
    pairs = pairs_within(targets, points, gate_m)
    amplitude = np.full(len(points), -math.inf)
    if "amplitude" in detections.columns:
        given = detections.columns["amplitude"]
        amplitude = np.where(np.isnan(given), -math.inf, given)
    strongest = np.full(len(targets), -math.inf)
    np.maximum.at(strongest, pairs.left, amplitude[pairs.right])
    found = np.zeros(len(targets), bool)
    found[pairs.left] = True
    false = np.ones(len(points), bool)
    false[pairs.right] = False

    threshold = np.unique(amplitude)[::-1]
    pd = _at_least(strongest[found], threshold) / max(len(targets), 1)
    false_alarms = _at_least(amplitude[false], threshold) / max(len(pings), 1)
    return DetectorScores(
        threshold,
        pd if len(targets) else np.full(threshold.size, math.nan),
        false_alarms,
        _per_target(targets, found),
        {
            "pd": float(found.mean()) if len(targets) else math.nan,
            "false_alarms_per_ping": float(np.count_nonzero(false)) / max(len(pings), 1),
            "detections_per_ping": len(points) / max(len(pings), 1),
        },
        pings.notes,
    )


def _at_least(values: FloatArray, threshold: FloatArray) -> npt.NDArray[np.int64]:
    """(n,) how many values reach each threshold."""
    return values.size - np.searchsorted(np.sort(values), threshold, side="left")


def _per_target(targets: Points, found: npt.NDArray[np.bool_]) -> dict[int, float]:
    n = targets.name.size
    share = np.bincount(targets.owner, weights=found, minlength=n) / np.bincount(targets.owner, minlength=n)
    return dict(zip(targets.name.tolist(), share.tolist(), strict=True))
