"""The shipped diver graphs: who is tracked, who is called a diver, the same bits in every way of running."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from fls_flow import TrackStatus, wire
from fls_flow import graph as graphs
from fls_flow.evaluate.table import read
from fls_flow.runtime import Options, Run
from fls_flow.testing import run_graph

TRACKS, TRUTH, CLASSES = "tracker.tracks", "sonar.truth", "label.classes"
FAST = ["picture.pings=[1]", "picture.dpi=30"]


def labels(seen, gate_m=1.5):
    """(true class, label) of every labelled track that is on a target, ping by ping, and the target."""
    found = []
    for tracks, truth, classes in zip(seen[TRACKS], seen[TRUTH], seen[CLASSES], strict=True):
        said = dict(zip(classes.track_id.tolist(), classes.label.tolist(), strict=True))
        for track, state in zip(tracks.id.tolist(), tracks.state, strict=True):
            if track not in said or not len(truth):
                continue
            apart = np.hypot(*(truth.state[:, :2] - state[:2]).T)
            if apart.min() < gate_m:
                k = int(apart.argmin())
                found.append((truth.class_name[k], classes.names[said[track]], int(truth.target_id[k])))
    return found


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    return run_graph(
        "diver_classification",
        collect=(TRACKS, TRUTH, CLASSES),
        set_=["sonar.pings=200", "sonar.seed=31", *FAST],
        out=tmp_path_factory.mktemp("run"),
    )


def test_divers_and_animals_are_told_apart(seen):
    found = labels(seen)
    assert len(found) > 300
    wrong = [(true == "diver") != (said == "diver") for true, said, _ in found]
    assert np.mean(wrong) < 0.1
    for target in {one[2] for one in found if one[0] == "diver"}:
        said = [one[1] == "diver" for one in found if one[2] == target]
        assert len(said) < 20 or np.mean(said) > 0.5  # most of the time of every diver that is seen for long


def test_most_targets_are_followed(seen):
    followed, there = 0, 0
    for tracks, truth in zip(seen[TRACKS][60:], seen[TRUTH][60:], strict=True):
        sure = tracks.state[tracks.status == TrackStatus.CONFIRMED, :2]
        apart = np.linalg.norm(truth.state[:, None, :2] - sure, axis=-1)
        followed += int((apart.min(axis=1, initial=np.inf) < 2.5).sum())
        there += len(truth)
    assert followed / there > 0.75


def test_the_files_carry_label_and_probability(tmp_path):
    run_graph("diver_classification", set_=["sonar.pings=80", "sonar.seed=3", *FAST], out=tmp_path)
    table = read(tmp_path / "tracks.csv", "tracks")
    with (tmp_path / "tracks.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["label"]]
    assert {row["label"] for row in rows} <= {"diver", "dolphin", "fish", "seal"}
    assert "diver" in {row["label"] for row in rows}
    assert all(0.0 < float(row["probability"]) <= 1.0 for row in rows)
    assert table.ping.size
    assert (tmp_path / "tracks.png").stat().st_size > 0


@pytest.mark.parametrize("kind", ["nnkf"])
def test_another_tracker_takes_the_place(tmp_path, kind):
    seen = run_graph(
        "diver_classification",
        collect=(TRACKS, TRUTH, CLASSES),
        use=[f"tracker={kind}"],
        set_=["sonar.pings=150", "sonar.seed=5", *FAST],
        out=tmp_path,
    )
    assert len({one[2] for one in labels(seen)}) >= 4


def test_quadratic_discriminants_take_the_same_model(tmp_path):
    seen = run_graph(
        "diver_classification",
        collect=(TRACKS, TRUTH, CLASSES),
        use=["label=quadratic-discriminant"],
        set_=["sonar.pings=150", "sonar.seed=5", *FAST],
        out=tmp_path,
    )
    found = labels(seen)
    assert found
    assert np.mean([(true == "diver") == (said == "diver") for true, said, _ in found]) > 0.7


def test_training_writes_both_tables_and_the_truth(tmp_path):
    run_graph("diver_training", set_=["sonar.pings=120"], out=tmp_path)
    heads = {
        name: (tmp_path / f"{name}.csv").read_text().split("\n", 2)[0] for name in ("static", "temporal")
    }
    assert heads["static"].startswith("seq,stamp_ns,track_id,area_m2,perimeter_m,")
    assert len(heads["static"].split(",")) == 3 + 14
    assert len(heads["temporal"].split(",")) == 3 + 56
    assert len((tmp_path / "temporal.csv").read_text().splitlines()) > 10
    assert {"tracks.csv", "truth.csv"} <= {path.name for path in tmp_path.iterdir()}


def test_the_shipped_model_takes_what_the_training_graph_gives():
    model = json.loads((Path(__file__).parents[2] / "models" / "diver.json").read_text())
    assert model["positive"] == "diver"
    assert {one["name"] for one in model["classes"]} == {"diver", "dolphin", "fish", "seal"}
    assert model["provenance"]


def test_a_model_of_other_features_is_refused_in_one_line(tmp_path):
    given = ["sonar.pings=80", "static.shape=cells", "temporal.leap_of=area", *FAST]
    with pytest.raises(
        Exception, match=r"diver\.json: the model needs .*; the features that come are area\.mean"
    ) as caught:
        run_graph("diver_classification", set_=given, out=tmp_path)
    assert "\n" not in str(caught.value)


def test_the_same_bits_in_threads_in_order_and_for_any_window(tmp_path):
    def bits(name: str, options: Options) -> list[bytes]:
        graph = graphs.load("diver_classification", set_=["sonar.pings=60", *FAST])
        kept: list[bytes] = []
        taps = {
            ("label", "classes"): lambda index, message: kept.append(wire.encode(message)),
            ("detect", "foreground"): lambda index, message: kept.append(wire.encode(message)),
        }
        out = tmp_path / name
        out.mkdir()
        assert Run(graph, options, out=out, taps=taps).start().error is None
        return [*sorted(kept), (out / "tracks.csv").read_bytes()]

    whole = bits("threads", Options())
    assert whole == bits("order", Options(in_order=True))
    assert whole == bits("window-1", Options(window=1))


def test_a_real_recording_goes_through_the_same_chain(tmp_path):
    """Swimming animals over still clutter: tracks and features come; what they are nobody has said."""
    golden = Path(__file__).parents[1] / "golden" / "didson" / "lamprey1_40.npz"
    seen = run_graph(
        "diver_on_recording",
        collect=("tracker.tracks", "static.features"),
        set_=[f"sonar.path={golden}", *FAST],
        out=tmp_path,
    )
    assert sum(len(one) for one in seen["static.features"]) > 10
