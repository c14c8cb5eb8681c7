"""`fls-flow train` on recordings: a graph describes their tracks first."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from fls_flow import Ping, Truth
from fls_flow.cli.train import train as command
from fls_flow.errors import GraphError, UserError
from fls_flow.recording import RecordingWriter
from fls_flow.tools.train_recordings import Describing, prepared
from fls_flow.tools.train_samples import Labelling, gather
from fls_flow.tools.train_tables import find_runs

GRAPH = """
graph: describe
nodes:
  sonar: {use: harbour-scene, with: {pings: 5}}
  cfar: {use: threshold-centroids, in: {ping: sonar.ping}, with: {threshold: 30.0}}
  tracker: {use: jpda, in: {detections: cfar}, with: {start_score: 3.0, m1: 4, n1: 3}}
  chips: {use: chips, in: {ping: sonar.ping, tracks: tracker}, with: {half_range_m: 2.0, half_bearing_deg: 4.0}}
  regions: {use: region-growing, in: {chips: chips}, with: {filter_rows: 1, filter_columns: 1, level: 0.3}}
  static: {use: static-features, in: {chips: chips, regions: regions}}
  table: {use: feature-table, in: {features: static}, with: {path: static.csv}}
  csv: {use: track-csv, in: {tracks: tracker}, with: {path: tracks.csv}}
  truth: {use: truth-csv, in: {truth: sonar.truth}, with: {path: truth.csv}}
"""
RANGE_M = 10.0 + 0.2 * np.arange(100)
BEARING_RAD = np.deg2rad(np.arange(-30.0, 30.5, 1.0))
PLACES = ((20, 10), (50, 15), (20, 45), (60, 50))  # first cells of four objects that lie still
CLASSES = ("diver", "diver", "seal", "seal")
SIZES = {"diver": (6, 5), "seal": (3, 2)}
PINGS = 30


@pytest.fixture(scope="module")
def scene():
    """Pings of four bright objects, two large and two small, and the truth in them."""
    rng = np.random.default_rng(5)
    state = np.zeros((4, 4))
    for n, (i, j) in enumerate(PLACES):
        r, b = RANGE_M[i + 2], BEARING_RAD[j + 2]
        state[n, :2] = r * np.cos(b), r * np.sin(b)
    found = []
    for k in range(PINGS):
        image = rng.rayleigh(1.0, (RANGE_M.size, BEARING_RAD.size)).astype(np.float32)
        for (i, j), name in zip(PLACES, CLASSES, strict=True):
            rows, columns = SIZES[name]
            image[i : i + rows, j : j + columns] += rng.uniform(60.0, 90.0, (rows, columns))
        ping = Ping(k, 10**18 + k * 250_000_000, image, RANGE_M, BEARING_RAD, beamwidth_rad=np.deg2rad(1.0))
        found.append((ping, Truth(k, ping.stamp_ns, np.arange(4), state, CLASSES)))
    return found


@pytest.fixture
def as_npz(scene):
    def write(path):
        image = np.stack([ping.amplitude for ping, _ in scene])
        stamps = np.array([ping.stamp_ns for ping, _ in scene])
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, image=image, range_m=RANGE_M, bearing_rad=BEARING_RAD, stamp_ns=stamps)
        return path

    return write


@pytest.fixture
def as_mcap(scene):
    def write(path, truth=True):
        writer = RecordingWriter(path)
        for ping, seen in scene:
            writer.write({"sonar.ping": ping, **({"sonar.truth": seen} if truth else {})})
        writer.close()
        return path

    return write


@pytest.fixture
def how(tmp_path):
    (tmp_path / "describe.yaml").write_text(GRAPH)
    return Describing(str(tmp_path / "describe.yaml"), tmp_path / "runs")


def samples_of(runs):
    return gather(find_runs(runs), Labelling(gate_m=2.0))[0]["static"]


def test_a_recording_with_its_truth_needs_nothing_else(as_mcap, how, tmp_path):
    runs, unknown = prepared([as_mcap(tmp_path / "pier.mcap")], how)
    assert (runs, unknown) == ([tmp_path / "runs" / "pier"], [])
    samples = samples_of(runs)
    assert samples.classes == ("diver", "seal")
    assert [groups for _, groups in samples.counts.values()] == [2, 2]
    area = samples.values[:, samples.features.index("area")]
    assert area[samples.label == 0].min() > area[samples.label == 1].max()
    record = json.loads((runs[0] / "run.json").read_text())
    assert (record["status"], record["pings"]) == ("finished", PINGS)
    assert record["nodes"]["sonar"]["use"] == "mcap-replay"


def test_all_readers_describe_the_same(as_npz, as_mcap, how, tmp_path):
    prepared([as_npz(tmp_path / "a.npz"), as_mcap(tmp_path / "b.mcap")], how)
    one, other = (tmp_path / "runs" / name / "static.csv" for name in "ab")
    assert one.read_bytes() == other.read_bytes()
    assert len(one.read_text().splitlines()) > 2 * PINGS


def test_a_run_is_found_again_and_another_is_not_taken_for_it(as_npz, how, tmp_path):
    path = as_npz(tmp_path / "pier.npz")
    (run,), _ = prepared([path], how)
    before = (run / "run.json").stat().st_mtime_ns
    (again,), _ = prepared([path], how)
    assert (again, (again / "run.json").stat().st_mtime_ns) == (run, before)
    changed = Describing(how.graph, how.runs, set_=("regions.level=0.4",))
    with pytest.raises(UserError, match=r"pier in it is another run, or one that failed"):
        prepared([path], changed)


def test_what_lies_beside_a_recording_says_what_its_tracks_are(as_npz, how, tmp_path):
    path = as_npz(tmp_path / "rec" / "pier.npz")
    (run,), unknown = prepared([path], how)
    assert unknown == [run]
    (tmp_path / "rec" / "pier.labels.csv").write_text("track_id,class\n1,diver\n")
    assert prepared([path], how) == ([run], [])
    assert (run / "labels.csv").read_text().endswith("1,diver\n")


def test_labels_of_a_folder_are_those_of_its_only_recording(as_npz, how, tmp_path):
    one = as_npz(tmp_path / "rec" / "a.npz")
    (tmp_path / "rec" / "labels.csv").write_text("track_id,class\n1,diver\n")
    assert prepared([tmp_path / "rec"], how)[1] == []
    as_npz(tmp_path / "rec" / "b.npz")
    assert prepared([one.with_name("b.npz")], how)[1] == [tmp_path / "runs" / "b"]


def test_recordings_of_one_name_get_folders_of_their_own(as_npz, how, tmp_path):
    paths = [as_npz(tmp_path / folder / "pings.npz") for folder in "xy"]
    assert [run.name for run in prepared([tmp_path / "x", paths[1]], how)[0]] == ["x-pings", "y-pings"]


def test_tables_are_taken_as_they_are(how, tmp_path):
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "static.csv").write_text("seq,stamp_ns,track_id,area,class\n0,1,1,2.0,diver\n")
    (tmp_path / "t" / "pings.npz").write_bytes(b"of the run that wrote the table")
    assert prepared([tmp_path / "t", tmp_path / "t" / "static.csv"], how) == (
        [tmp_path / "t", tmp_path / "t" / "static.csv"],
        [],
    )


def test_a_recording_without_pings_and_a_graph_without_a_source_of_them(as_mcap, how, tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"PK no archive")
    with pytest.raises(Exception, match=r"bad\.npz"):
        prepared([tmp_path / "bad.npz"], how)
    (tmp_path / "nav.yaml").write_text("graph: g\nnodes:\n  nav: {use: ground-nav}\n")
    with pytest.raises(UserError, match="has 0 sources of pings"):
        prepared([as_mcap(tmp_path / "p.mcap")], Describing(str(tmp_path / "nav.yaml"), tmp_path / "runs"))
    (tmp_path / "sonar.dat").write_bytes(b"")
    with pytest.raises(GraphError, match="'harbour-scene' has no parameter 'path'"):
        prepared([tmp_path / "sonar.dat"], how)


def run(*arguments):
    """The command's result; errors of ours are raised, as the real command line shows them."""
    found = CliRunner().invoke(command, [str(one) for one in arguments], standalone_mode=False)
    if found.exception is not None:
        raise found.exception
    return found


def test_one_command_from_a_recording_and_labels_to_a_model(as_npz, how, tmp_path):
    words = [
        as_npz(tmp_path / "pier.npz"),
        "--graph",
        how.graph,
        "--runs",
        how.runs,
        "--out",
        tmp_path / "out",
    ]
    with pytest.raises(UserError, match=r"runs/pier: nothing says what its tracks are; .* write labels\.csv"):
        run(*words, "--json")
    header, *rows = (how.runs / "pier" / "static.csv").read_text().splitlines()
    at = header.split(",").index("area")
    area = {}
    for row in rows:
        cells = row.split(",")
        area.setdefault(int(cells[2] or -1), []).append(float(cells[at] or 0.0))
    said = {
        track: "diver" if np.median(sizes) > 15 else "seal" for track, sizes in area.items() if track >= 0
    }
    labels = tmp_path / "mine.csv"
    labels.write_text("track_id,class\n" + "".join(f"{track},{name}\n" for track, name in said.items()))
    found = json.loads(run(*words, "--labels", labels, "--repeats", "2", "--json").stdout)["sets"]["static"]
    assert found["classes"] == ["diver", "seal"]
    assert found["plain"]["error"] == 0.0
    assert (tmp_path / "out" / "static.json").is_file()
