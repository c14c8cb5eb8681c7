"""Scores as tables for people and as a document for programs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.table import Table

from fls_flow.evaluate.classifier import ClassifierScores, Roc
from fls_flow.evaluate.detector import DetectorScores
from fls_flow.evaluate.scores import Scores

__all__ = ["FAMILIES", "document", "tables"]

CURVE_POINTS = 100  # of an ROC in the document

# family -> score -> its line in the table
FAMILIES: dict[str, dict[str, str]] = {
    "sets of tracks and targets, means per ping": {
        "ospa2": "OSPA(2), m",
        "ospa": "OSPA, m",
        "gospa": "GOSPA, m",
        "gospa_localisation": "  its part of localisation, m^p",
        "gospa_missed": "  of missed targets, m^p",
        "gospa_false": "  of false tracks, m^p",
        "cardinality_error": "tracks more than targets",
    },
    "tracks": {
        "targets": "targets",
        "targets_found": "targets ever followed",
        "continuity": "tracked time over life time",
        "continuity_one_track": "  by one track",
        "time_to_confirm_s": "time to confirm, s",
        "confirmed_tracks": "confirmed tracks",
        "redundant_tracks": "  redundant",
        "false_tracks": "  false",
        "id_switches": "id switches",
        "fragmentations": "fragmentations",
    },
    "multi-object tracking": {
        "mota": "MOTA",
        "motp_m": "MOTP, m",
        "recall": "recall",
        "precision": "precision",
        "idf1": "IDF1",
        "hota": "HOTA",
        "deta": "  DetA",
        "assa": "  AssA",
        "loca": "  LocA",
    },
    "errors of followed targets": {
        "position_rmse_m": "position RMSE, m",
        "velocity_rmse_mps": "velocity RMSE, m/s",
        "nees": "NEES of the position, 2 if consistent",
        "nees_low": "  95 % bounds, low",
        "nees_high": "  95 % bounds, high",
        "nees_inside": "  inside the 95 % ellipse",
    },
    "detector": {
        "pd": "probability of detection",
        "false_alarms_per_ping": "false alarms per ping",
        "detections_per_ping": "detections per ping",
    },
    "PHD": {
        "phd_ospa": "OSPA of the estimates, m",
        "phd_gospa": "GOSPA of the estimates, m",
        "phd_expected_error": "expected number less targets",
        "phd_expected_rmse": "  its RMSE",
        "phd_cardinality_error": "estimates less targets",
        "phd_cardinality_rmse": "  its RMSE",
    },
    "classifier": {
        "class_error": "error per row",
        "class_error_tracks": "error per track",
        "class_labelled": "share of rows with a label",
        "class_roc_area": "area under the ROC",
        "class_threshold": "threshold that the costs ask for",
        "class_hit_rate": "  hit rate there",
        "class_false_alarm_rate": "  false-alarm rate there",
        "class_cost": "  cost per row there",
        "class_best_threshold": "threshold of least cost here",
        "class_best_cost": "  cost per row there",
    },
}
_COLUMNS = {
    "target_id": "id",
    "class": "class",
    "pings": "pings",
    "continuity": "time\nshare",
    "continuity_one_track": "by\none",
    "time_to_confirm_s": "conf.\ns",
    "id_switches": "sw.",
    "fragmentations": "frag.",
    "position_rmse_m": "pos.\nm",
    "velocity_rmse_mps": "vel.\nm/s",
    "nees": "NEES",
    "nees_inside": "in\n95 %",
    "pd": "Pd",
}


def tables(scores: Scores) -> Iterator[Table]:
    """A table of all scores, one of the targets, and one of the classes."""
    table = Table(box=None, header_style="bold", pad_edge=False, show_header=False)
    table.add_column()
    table.add_column(justify="right")
    for title, family in FAMILIES.items():
        present = [name for name in family if name in scores.overall]
        if present:
            table.add_row(f"[bold]{title}[/bold]")
        for name in present:
            table.add_row("  " + family[name], _shown(scores.overall[name]))
    yield table
    if scores.targets:
        yield _target_table(scores)
    if scores.classifier is not None:
        yield _confusion_table(scores.classifier)


def _target_table(scores: Scores) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 1, 0, 0))
    names = [name for name in _COLUMNS if any(name in row for row in scores.targets)]
    for name in names:
        table.add_column(_COLUMNS[name], justify="left" if name == "class" else "right", no_wrap=True)
    for row in scores.targets:
        table.add_row(*(_shown(row.get(name, ""), digits=2) for name in names))
    return table


def _confusion_table(found: ClassifierScores) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("true class")
    for label in found.labels:
        table.add_column(f"as {label}", justify="right")
    table.add_column("error", justify="right")
    for name, counts in zip(found.classes, found.confusion.tolist(), strict=True):
        table.add_row(name, *map(str, counts), _shown(found.class_error[name]))
    return table


def _shown(value: float | str, digits: int = 3) -> str:
    if isinstance(value, str | int):
        return str(value)
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def document(scores: Scores) -> dict[str, Any]:
    """Everything as JSON; what could not be measured is null."""
    found: dict[str, Any] = {
        "settings": asdict(scores.settings),
        "overall": scores.overall,
        "targets": list(scores.targets),
        "notes": list(scores.notes),
    }
    if scores.detector is not None:
        found["detector"] = {"roc": _detector_curve(scores.detector)}
    if scores.classifier is not None:
        found["classifier"] = _classifier(scores.classifier)
    plain: dict[str, Any] = _plain(found)
    return plain


def _classifier(found: ClassifierScores) -> dict[str, Any]:
    return {
        "classes": found.classes,
        "labels": found.labels,
        "confusion": found.confusion.tolist(),
        "track_confusion": found.track_confusion.tolist(),
        "class_error": found.class_error,
        "roc": None if found.roc is None else _class_curve(found.roc),
    }


def _detector_curve(found: DetectorScores) -> list[dict[str, float]]:
    chosen = _thinned(found.threshold.size)
    names = ("threshold", "pd", "false_alarms_per_ping")
    columns = (found.threshold[chosen], found.pd[chosen], found.false_alarms[chosen])
    return [
        dict(zip(names, row, strict=True)) for row in zip(*(one.tolist() for one in columns), strict=True)
    ]


def _class_curve(roc: Roc) -> dict[str, Any]:
    chosen = _thinned(roc.threshold.size)
    names = ("threshold", "hit_rate", "false_alarm_rate", "cost")
    columns = (roc.threshold[chosen], roc.hit_rate[chosen], roc.false_alarm_rate[chosen], roc.cost[chosen])
    rows = [
        dict(zip(names, row, strict=True)) for row in zip(*(one.tolist() for one in columns), strict=True)
    ]
    return {"positive": roc.positive, "area": roc.area, "points": rows}


def _thinned(n: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Up to `CURVE_POINTS` of n points, with both ends."""
    return np.unique(np.linspace(0, max(n - 1, 0), min(n, CURVE_POINTS)).astype(np.int64))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
