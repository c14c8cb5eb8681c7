"""Estimates of a PHD filter against truth: their number and their places."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.evaluate.assignment import pairs_within
from fls_flow.evaluate.scene import Pings, common_pings, estimates_of, targets_of
from fls_flow.evaluate.sets import SetDistances, set_distances
from fls_flow.evaluate.table import Table

__all__ = ["IntensityScores", "intensity_scores"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class IntensityScores:
    """What the pictures of estimates against truth are drawn from."""

    pings: Pings
    sets: SetDistances
    expected_targets: FloatArray  # (n_pings,) the mass of the intensity; nan: unknown
    overall: dict[str, float]


def intensity_scores(truth: Table, estimates: Table, cutoff_m: float, order: float) -> IntensityScores:
    """Cardinality error of the expected number and of the estimates, OSPA and GOSPA of the estimates."""
    pings = common_pings(truth, estimates)
    targets, points = targets_of(truth, pings), estimates_of(estimates, pings)
    near = pairs_within(targets, points, cutoff_m)
    near = near.select(near.distance_m < cutoff_m)
    sets = set_distances(targets, points, near, len(pings), cutoff_m, order)
    expected = np.full(len(pings), np.nan)
    if estimates.expected_targets is not None:
        expected[np.searchsorted(pings.stamp_ns, estimates.stamp_ns)] = estimates.expected_targets
    excess = expected - sets.n_targets
    excess = excess[np.isfinite(excess)]
    number = (sets.n_tracks - sets.n_targets).astype(float)
    overall = {
        "phd_expected_error": _mean(excess),
        "phd_expected_rmse": math.sqrt(_mean(excess**2)),
        "phd_cardinality_error": _mean(number),
        "phd_cardinality_rmse": math.sqrt(_mean(number**2)),
        "phd_ospa": _mean(sets.ospa),
        "phd_gospa": _mean(sets.gospa),
        "phd_gospa_localisation": _mean(sets.localisation),
        "phd_gospa_missed": _mean(sets.missed),
        "phd_gospa_false": _mean(sets.false),
    }
    return IntensityScores(pings, sets, expected, overall)


def _mean(values: npt.NDArray[np.float64 | np.int64]) -> float:
    return float(values.mean()) if values.size else math.nan
