"""All scores of one run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fls_flow.evaluate.assignment import pairs_within
from fls_flow.evaluate.classifier import ClassifierScores, Groups, classifier_scores, grouped
from fls_flow.evaluate.clear import clear_scores, identity_scores, matched
from fls_flow.evaluate.detector import DetectorScores, detector_scores
from fls_flow.evaluate.hota import hota_scores
from fls_flow.evaluate.intensity import IntensityScores, intensity_scores
from fls_flow.evaluate.scene import Pings, Points, common_pings, targets_of, tracks_of
from fls_flow.evaluate.sets import SetDistances, ospa2, set_distances
from fls_flow.evaluate.table import Table, read
from fls_flow.evaluate.tracking import (
    Errors,
    error_scores,
    errors_of,
    follow_scores,
    target_scores,
    track_counts,
)

__all__ = ["Scores", "Settings", "TrackScores", "score"]

LARGE = 1e9  # its power of the greatest order is a number still
MAX_ORDER = 20.0

Row = dict[str, float | int | str]


@dataclass(frozen=True, slots=True)
class Settings:
    """What the scores depend on beside the files."""

    cutoff_m: float = 10.0  # c of OSPA, GOSPA and HOTA
    order: float = 1.0  # p of OSPA and GOSPA
    gate_m: float = 5.0  # a track or detection this close belongs to the target
    window_pings: int = 10  # of OSPA(2)
    tentative: bool = False  # score tentative tracks too
    positive: str | None = None  # the class of the ROC; by default the first by name
    miss_cost: float = 1.0  # of taking the positive class for another
    false_alarm_cost: float = 1.0  # of taking another for the positive class
    groups: Groups = ()  # classes of the truth that count as one

    def __post_init__(self) -> None:
        for name in ("cutoff_m", "gate_m", "miss_cost", "false_alarm_cost"):
            if not 0.0 < getattr(self, name) <= LARGE:
                raise ValueError(f"{name} must be positive, not {getattr(self, name)}")
        if not 1.0 <= self.order <= MAX_ORDER:
            raise ValueError(f"order must lie between 1 and {MAX_ORDER:g}, not {self.order}")
        if self.window_pings < 1:
            raise ValueError(f"window_pings must be 1 or more, not {self.window_pings}")


DEFAULTS = Settings()


@dataclass(frozen=True, eq=False)
class TrackScores:
    """What the pictures of tracks against truth are drawn from."""

    pings: Pings
    targets: Points
    tracks: Points
    follows: npt.NDArray[np.int64]  # (n_target_rows,) the row of tracks, or -1
    errors: Errors
    sets: SetDistances
    ospa2_m: npt.NDArray[np.float64]  # (n_pings,)
    overall: dict[str, float]
    of_target: dict[int, dict[str, float]]


@dataclass(frozen=True, eq=False)
class Scores:
    """The scores of one run; what could not be measured is nan."""

    settings: Settings
    overall: dict[str, float]
    targets: tuple[Row, ...] = ()  # a row per target
    notes: tuple[str, ...] = ()
    tracking: TrackScores | None = None
    classifier: ClassifierScores | None = None
    detector: DetectorScores | None = None
    intensity: IntensityScores | None = None


def score(
    tracks: Path | str | None,
    truth: Path | str,
    *,
    detections: Path | str | None = None,
    estimates: Path | str | None = None,
    settings: Settings = DEFAULTS,
) -> Scores:
    """The scores of tracks, detections and PHD estimates against truth, of what is given.

    Raises UserError, one line with file and line, for a file that cannot be read or does not fit the truth.
    """
    known = read(Path(truth), "truth")
    rows = _rows(known)
    overall: dict[str, float] = {}
    notes: list[str] = []
    tracking = classifier = detector = intensity = None
    if tracks is not None:
        tracking, classifier = _tracking(known, read(Path(tracks), "tracks"), settings)
        overall |= tracking.overall | (classifier.overall if classifier else {})
        notes += tracking.pings.notes
        _add(rows, tracking.of_target)
    if detections is not None:
        detector = detector_scores(known, read(Path(detections), "detections"), settings.gate_m)
        overall |= detector.overall
        notes += detector.notes
        _add(rows, {name: {"pd": pd} for name, pd in detector.target_pd.items()})
    if estimates is not None:
        table = read(Path(estimates), "estimates")
        intensity = intensity_scores(known, table, settings.cutoff_m, settings.order)
        overall |= intensity.overall
        notes += intensity.pings.notes
    unique = tuple(dict.fromkeys(notes))
    return Scores(settings, overall, tuple(rows.values()), unique, tracking, classifier, detector, intensity)


def _rows(truth: Table) -> dict[int, Row]:
    """A row per target: who it is and how many pings it is there."""
    names, first, count = np.unique(truth.columns["target_id"], return_index=True, return_counts=True)
    classes = truth.columns.get("class", np.full(truth.ping.size, "", np.str_))[first]
    return {
        name: {"target_id": name, "class": word, "pings": pings}
        for name, word, pings in zip(names.tolist(), classes.tolist(), count.tolist(), strict=True)
    }


def _add(rows: dict[int, Row], scores: Mapping[int, Mapping[str, float]]) -> None:
    for name, one in scores.items():
        rows[name].update(one)


def _tracking(truth: Table, tracks: Table, settings: Settings) -> tuple[TrackScores, ClassifierScores | None]:
    pings = common_pings(truth, tracks)
    x, y = targets_of(truth, pings), tracks_of(tracks, pings, tentative=settings.tentative)
    near = pairs_within(x, y, max(settings.cutoff_m, settings.gate_m))
    close = near.select(near.distance_m < settings.cutoff_m)
    sets = set_distances(x, y, close, len(pings), settings.cutoff_m, settings.order)
    ospa2_m = ospa2(x, y, close, len(pings), settings.cutoff_m, settings.order, settings.window_pings)
    inside = near.select(near.distance_m <= settings.gate_m)
    follows = matched(x, y, inside, settings.gate_m)
    errors = errors_of(x, y, follows)
    of_target = target_scores(pings, x, y, follows, errors)
    overall = {
        **_means(sets, ospa2_m),
        **follow_scores(of_target),
        **track_counts(x, y, follows, inside, settings.gate_m),
        **clear_scores(x, y, follows, inside),
        **identity_scores(x, y, inside, settings.gate_m),
        **hota_scores(x, y, close, settings.cutoff_m),
        **error_scores(errors),
    }
    classifier = classifier_scores(
        replace(x, word=grouped(x.word, settings.groups)),
        replace(y, word=grouped(y.word, settings.groups)),
        follows,
        positive=settings.positive,
        miss_cost=settings.miss_cost,
        false_alarm_cost=settings.false_alarm_cost,
    )
    return TrackScores(pings, x, y, follows, errors, sets, ospa2_m, overall, of_target), classifier


def _means(sets: SetDistances, ospa2_m: npt.NDArray[np.float64]) -> dict[str, float]:
    columns = {
        "ospa2": ospa2_m,
        "ospa": sets.ospa,
        "gospa": sets.gospa,
        "gospa_localisation": sets.localisation,
        "gospa_missed": sets.missed,
        "gospa_false": sets.false,
        "cardinality_error": (sets.n_tracks - sets.n_targets).astype(float),
    }
    return {name: float(values.mean()) if values.size else math.nan for name, values in columns.items()}
