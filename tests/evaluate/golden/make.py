"""Make the golden scene and what three public packages say of it.

    pip install trackeval==1.3.0 motmetrics==1.4.0 stonesoup==1.9.1
    python tests/evaluate/golden/make.py

Run it in an environment of its own: TrackEval brings opencv-python, which overwrites opencv-python-headless.
"""

from __future__ import annotations

import csv
import datetime
import json
from pathlib import Path

import motmetrics
import numpy as np
from stonesoup.metricgenerator.ospametric import GOSPAMetric, OSPAMetric
from stonesoup.types.state import State
from trackeval.metrics import CLEAR, HOTA, Identity

HERE = Path(__file__).parent
PINGS, CUTOFF_M, GATE_M = 60, 10.0, 5.0
TRUTH = ("seq", "stamp_ns", "target_id", "x_m", "y_m")
TRACKS = ("seq", "stamp_ns", "track_id", "x_m", "y_m")


def scene(rng: np.random.Generator) -> tuple[list[list[object]], list[list[object]]]:
    """Five targets that cross, and tracks that switch, break, double and lie."""
    truth: list[list[object]] = []
    tracks: list[list[object]] = []
    for ping in range(PINGS):
        stamp = 500_000_000 * ping
        places = {
            1: (20 + 0.2 * ping, -6 + 0.2 * ping),
            2: (20 + 0.2 * ping, 6 - 0.2 * ping),  # crosses 1
            3: (40.0, 10.0),
            4: (43.0, 10 + 0.1 * ping),  # starts beside 3
            5: (10.0, 0.3 * ping),
        }
        alive = [name for name in places if not (name == 5 and (ping < 10 or ping > 50))]
        truth += [[ping, stamp, name, *np.round(places[name], 3).tolist()] for name in alive]
        follow = {11: 1, 12: 2, 13: 3, 14: 4, 15: 5}
        if ping >= 32:
            follow[11], follow[12] = 2, 1  # swapped where they cross
        if 20 <= ping < 26:
            del follow[13]  # breaks
        if ping >= 40:
            del follow[14]
            follow[16] = 4  # goes on under another id
        if 5 <= ping < 25:
            follow[17] = 3  # doubles 13
        for track, name in follow.items():
            if name in alive:
                spread = 1.5 if name in (3, 4) else 0.5
                place = np.add(places[name], rng.normal(0, spread, 2))
                tracks.append([ping, stamp, track, *np.round(place, 3).tolist()])
        if 15 <= ping < 30:
            tracks.append([ping, stamp, 18, 60.0, -20.0])
    return truth, tracks


def sequence(truth: list[list[object]], tracks: list[list[object]]) -> dict[str, object]:
    """The scene as TrackEval takes it: ids from 0, similarity 1 - d / cut-off."""
    ids = [{name: n for n, name in enumerate(sorted({row[2] for row in rows}))} for rows in (truth, tracks)]
    per_ping = [
        [[row for row in rows if row[0] == ping] for ping in range(PINGS)] for rows in (truth, tracks)
    ]
    similarity = [np.maximum(0.0, 1.0 - distances(a, b) / CUTOFF_M) for a, b in zip(*per_ping, strict=True)]
    return {
        "num_gt_dets": len(truth),
        "num_tracker_dets": len(tracks),
        "num_gt_ids": len(ids[0]),
        "num_tracker_ids": len(ids[1]),
        "num_timesteps": PINGS,
        "gt_ids": [np.array([ids[0][row[2]] for row in rows]) for rows in per_ping[0]],
        "tracker_ids": [np.array([ids[1][row[2]] for row in rows]) for rows in per_ping[1]],
        "similarity_scores": similarity,
        "per_ping": per_ping,
    }


def distances(truth: list[list[object]], tracks: list[list[object]]) -> np.ndarray:
    """(targets, tracks), m."""
    a = np.array([row[3:5] for row in truth], float)
    b = np.array([row[3:5] for row in tracks], float)
    return np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))


def trackeval_scores(data: dict[str, object]) -> dict[str, float]:
    """HOTA, CLEAR and Identity; similarity 0.5 is a distance of half the cut-off, which is the gate."""
    quiet = {"PRINT_CONFIG": False}
    hota = HOTA().eval_sequence(data)
    clear = CLEAR({"THRESHOLD": 1 - GATE_M / CUTOFF_M, **quiet}).eval_sequence(data)
    identity = Identity({"THRESHOLD": 1 - GATE_M / CUTOFF_M, **quiet}).eval_sequence(data)
    return {
        **{
            name: float(np.mean(hota[key]))
            for name, key in {"hota": "HOTA", "deta": "DetA", "assa": "AssA", "loca": "LocA"}.items()
        },
        "mota": float(clear["MOTA"]),
        "motp_m": float((1 - clear["MOTP"]) * CUTOFF_M),
        "id_switches": int(clear["IDSW"]),
        "fragmentations": int(clear["Frag"]),
        "misses": int(clear["CLR_FN"]),
        "false_positives": int(clear["CLR_FP"]),
        "recall": float(clear["CLR_Re"]),
        "precision": float(clear["CLR_Pr"]),
        "idf1": float(identity["IDF1"]),
        "id_precision": float(identity["IDP"]),
        "id_recall": float(identity["IDR"]),
    }


def motmetrics_scores(data: dict[str, object]) -> dict[str, float]:
    """What it counts from distances."""
    counter = motmetrics.MOTAccumulator(auto_id=True)
    for truth, tracks in zip(*data["per_ping"], strict=True):
        distance = distances(truth, tracks)
        distance[distance > GATE_M] = np.nan
        counter.update([row[2] for row in truth], [row[2] for row in tracks], distance)
    names = {
        "idf1": "idf1",
        "idp": "id_precision",
        "idr": "id_recall",
        "num_misses": "misses",
        "num_false_positives": "false_positives",
    }
    table = motmetrics.metrics.create().compute(
        counter, metrics=[*names, "mota", "motp", "num_switches", "num_fragmentations"]
    )
    print(table.T)  # noqa: T201 - the script's product
    return {name: float(table[key].iloc[0]) for key, name in names.items()}


def stonesoup_scores(data: dict[str, object]) -> dict[str, object]:
    """OSPA and GOSPA of each ping, p = 1 (with another order its OSPA is not right)."""
    when = datetime.datetime(2024, 1, 1)
    gospa, ospa = GOSPAMetric(p=1, c=CUTOFF_M), OSPAMetric(p=1, c=CUTOFF_M)
    squared = GOSPAMetric(p=2, c=CUTOFF_M)
    found: dict[str, list[float]] = {
        name: [] for name in ("ospa", "gospa", "localisation", "missed", "false", "gospa_2")
    }
    for truth, tracks in zip(*data["per_ping"], strict=True):
        a = [State(np.array(row[3:5], float)[:, None], timestamp=when) for row in truth]
        b = [State(np.array(row[3:5], float)[:, None], timestamp=when) for row in tracks]
        one = gospa.compute_gospa_metric(b, a)
        value = (one[0] if isinstance(one, tuple) else one).value
        found["ospa"].append(float(ospa.compute_OSPA_distance(b, a).value))
        for name, key in {
            "gospa": "distance",
            "localisation": "localisation",
            "missed": "missed",
            "false": "false",
        }.items():
            found[name].append(float(value[key]))
        two = squared.compute_gospa_metric(b, a)
        found["gospa_2"].append(float((two[0] if isinstance(two, tuple) else two).value["distance"]))
    return found


def main() -> None:
    """Write truth.csv, tracks.csv and scores.json here."""
    truth, tracks = scene(np.random.default_rng(5))
    for name, columns, rows in (("truth", TRUTH, truth), ("tracks", TRACKS, tracks)):
        with (HERE / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([columns, *rows])
    data = sequence(truth, tracks)
    scores = {
        "trackeval": trackeval_scores(data),
        "motmetrics": motmetrics_scores(data),
        "stonesoup": stonesoup_scores(data),
    }
    (HERE / "scores.json").write_text(json.dumps(scores, indent=1) + "\n")


if __name__ == "__main__":
    main()
