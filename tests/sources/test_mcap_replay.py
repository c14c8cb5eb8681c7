"""`mcap-replay`: what a graph recorded, played into another one, gives the same files."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fls_flow import Detections, InputError, NavState, Ping, Tracks, wire
from fls_flow import graph as graphs
from fls_flow.errors import GraphError
from fls_flow.recording import RecordingWriter
from fls_flow.testing import check_node, run_graph
from fls_sources.mcap_replay import McapReplay

SCENE = """
graph: recorded
nodes:
  sonar:   {use: surface-scene, with: {pings: 25, seed: 3}}
  cfar:    {use: rayleigh-cfar, in: {ping: sonar.ping, tracks: tracker@previous}}
  tracker: {use: jpda, in: {detections: cfar}}
  csv:     {use: track-csv, in: {tracks: tracker}, with: {path: tracks.csv}}
  truth:   {use: truth-csv, in: {truth: sonar.truth}, with: {path: truth.csv}}
  file:    {use: mcap, in: {ping: sonar.ping, truth: sonar.truth, tracks: tracker, detections: cfar}, with: {path: run.mcap, chunk_pings: 7}}
"""
REPLAY = """
graph: replayed
nodes:
  sonar:   {use: mcap-replay, with: {path: one/run.mcap, topic: ping}}
  cfar:    {use: rayleigh-cfar, in: {ping: sonar, tracks: tracker@previous}}
  tracker: {use: jpda, in: {detections: cfar}}
  csv:     {use: track-csv, in: {tracks: tracker}, with: {path: tracks.csv}}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(SCENE)
    Path("replay.yaml").write_text(REPLAY)
    return tmp_path


@pytest.fixture
def recorded(folder):
    run_graph("scene.yaml", out=folder / "one")
    return folder / "one" / "run.mcap"


def fls_flow(*words, cwd):
    environment = {**os.environ, "COLUMNS": "120"}
    return subprocess.run(
        [sys.executable, "-m", "fls_flow.cli", *words],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
    )


def test_a_replay_gives_the_same_tracks_byte_for_byte(folder, recorded):
    run_graph("replay.yaml", out=folder / "two")
    assert (folder / "two" / "tracks.csv").read_bytes() == (folder / "one" / "tracks.csv").read_bytes()
    part = run_graph(
        "replay.yaml", collect=["sonar.ping"], set_=["sonar.first=5", "sonar.pings=10"], out=folder / "p"
    )
    whole = run_graph("scene.yaml", collect=["sonar.ping"], out=folder / "w")["sonar.ping"]
    assert [*map(wire.encode, part["sonar.ping"])] == [*map(wire.encode, whole[5:15])]


def test_processes_record_and_replay_the_same_bytes(folder, recorded):
    done = fls_flow("run", "scene.yaml", "--out", "three", "--no-progress", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert (folder / "three" / "run.mcap").read_bytes() == recorded.read_bytes()
    done = fls_flow("run", "replay.yaml", "--out", "four", "--no-progress", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert (folder / "four" / "tracks.csv").read_bytes() == (folder / "one" / "tracks.csv").read_bytes()


def test_a_recording_is_scored_as_the_files_of_its_run_are(folder, recorded):
    from fls_flow.evaluate import find, score

    files, topics = find([folder / "one"]), find([recorded])
    assert topics.truth.name == "run.mcap#truth"
    expected = score(files.tracks, files.truth)
    found = score(topics.tracks, topics.truth, detections=topics.detections)
    same = {name: found.overall[name] for name in expected.overall}
    np.testing.assert_equal(same, expected.overall)
    assert "ospa" in expected.overall
    mixed = find([folder / "one" / "tracks.csv"], truth=recorded)
    np.testing.assert_equal(score(mixed.tracks, mixed.truth).overall, expected.overall)
    done = fls_flow("evaluate", "one/run.mcap", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr


def test_a_topic_reads_as_the_file_that_a_sink_would_have_written(folder, recorded):
    from fls_flow.evaluate.recording import csv_lines

    for topic in ("tracks", "truth"):
        with (folder / "one" / f"{topic}.csv").open(newline="") as file:
            expected = list(csv.reader(file))
        assert list(csv.reader(csv_lines(recorded.with_name(f"run.mcap#{topic}")))) == expected


def test_two_topics_of_a_kind_must_be_named(folder):
    from fls_flow.errors import UserError
    from fls_flow.evaluate import find

    writer = RecordingWriter(folder / "two.mcap")
    writer.write({"a": Detections(0, 0), "b": Detections(0, 0)})
    writer.close()
    with pytest.raises(UserError, match=r"name one of them: .*two\.mcap#a or .*two\.mcap#b"):
        find([folder / "two.mcap"])
    assert find([folder / "two.mcap#a"], truth=folder / "truth.csv").detections == folder / "two.mcap#a"
    with pytest.raises(UserError, match="has no topic 'c'"):
        find([folder / "two.mcap#c"])
    writer = RecordingWriter(folder / "one.mcap")
    writer.write({"a": Detections(0, 0)})
    writer.close()
    with pytest.raises(UserError, match="has no topic of truth"):
        find([folder / "two.mcap#a"], truth=folder / "one.mcap")
    (folder / "broken.mcap").write_bytes(b"nothing")
    with pytest.raises(UserError, match=r"broken\.mcap"):
        find([folder / "broken.mcap"])


def test_check_knows_the_type_from_the_file(folder, recorded):
    sonar = graphs.load("replay.yaml").node("sonar")
    assert [(port.name, port.message) for port in sonar.kind.outputs] == [("ping", Ping)]
    with pytest.raises(
        GraphError, match=r"input 'ping' takes Ping; node 'sonar' has no output.*tracks \(Tracks\)"
    ):
        graphs.load("replay.yaml", set_=["sonar.topic=tracks"])
    with pytest.raises(GraphError, match="has no topic 'pings'; it has detections, ping, tracks, truth"):
        graphs.load("replay.yaml", set_=["sonar.topic=pings"])
    with pytest.raises(GraphError, match="has 4 topics; name one of: detections, ping, tracks, truth"):
        graphs.load("replay.yaml", set_=["sonar.topic=null"])
    with pytest.raises(GraphError, match="No such file"):
        graphs.load("replay.yaml", set_=["sonar.path=none.mcap"])


def test_every_mistake_is_still_found_at_once(folder, recorded):
    text = REPLAY.replace("topic: ping", "topic: ping, frist: 3").replace(
        "detections: cfar", "detection: cfar"
    )
    Path("wrong.yaml").write_text(text)
    with pytest.raises(GraphError) as caught:
        graphs.load("wrong.yaml")
    said = [problem.what for problem in caught.value.problems]
    assert len(said) == 2
    assert any("'frist'; did you mean 'first'" in one for one in said)
    assert any("'detection'; did you mean 'detections'" in one for one in said)


def test_a_topic_can_be_a_stream_beside_the_clock(folder):
    writer = RecordingWriter(folder / "nav.mcap")
    for n in range(50):
        writer.write({"nav": NavState(n, n * 100_000_000)})
    writer.close()
    graph = """
graph: nav
nodes:
  sonar: {use: ground-scene, with: {sequence: wreck, pings: 6}}
  nav:   {use: mcap-replay, with: {path: nav.mcap}}
  fused: {use: nav-fusion, in: {ping: sonar.ping, nav: nav@time}}
  spots: {use: threshold-centroids, in: {ping: fused.ping}}
  out:   {use: detection-csv, in: {detections: spots}}
"""
    Path("nav.yaml").write_text(graph)
    checked = graphs.load("nav.yaml")
    assert checked.streams == ("nav",)
    assert checked.node("nav").kind.outputs[0].message is NavState
    fused = run_graph(checked, collect=["fused.ping"], out=folder / "out")["fused.ping"]
    assert len(fused) == 6


def test_a_recording_that_a_crash_cut_off_is_played_to_its_last_chunk(folder, recorded, caplog):
    cut = folder / "cut.mcap"
    cut.write_bytes(recorded.read_bytes()[: int(0.6 * recorded.stat().st_size)])
    node = McapReplay(cut, "ping")
    played = list(node())
    assert 0 < len(played) < 25
    assert len(node) == len(played)
    assert [ping.seq for ping in played] == list(range(len(played)))
    assert "was never closed" in caplog.text


def test_selections_beyond_the_end_and_bad_parameters_are_named(folder, recorded):
    with pytest.raises(InputError, match="has 25 messages of 'ping'; first = 25 lies beyond"):
        list(McapReplay(recorded, "ping", first=25)())
    assert len(McapReplay(recorded, "ping", first=20, pings=100)) == 5
    with pytest.raises(ValueError, match="first must be 0 or more, not -1"):
        McapReplay(recorded, first=-1)
    with pytest.raises(ValueError, match="pings must be 1 or more, not 0"):
        McapReplay(recorded, pings=0)


def test_the_node_keeps_the_contract(folder, recorded):
    check_node(McapReplay(recorded, "ping"))
    assert McapReplay(recorded, "tracks").output_type() is Tracks
