"""The active-array graphs: targets are tracked, benchmarks run, the same bits in every order."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fls_beamformers.delay_and_sum import DelayAndSum
from fls_beamformers.pulse_compression import PulseCompression
from fls_flow import Tracks, TrackStatus, Truth, wire
from fls_flow import graph as graphs
from fls_flow.runtime import Options, Run
from fls_flow.testing import run_graph

ROOT = Path(__file__).parents[2]
NEAR = [
    "scene.range_max_m=140",
    "scene.target_min_m=80",
    "scene.target_max_m=110",
    "scene.speed_max_mps=0.5",
    "beams.range_min_m=40",
    "beams.range_max_m=138",
]
Play = Callable[..., tuple[list[Tracks], list[Truth]]]


@pytest.fixture
def play(tmp_path: Path) -> Play:
    def run(graph: str, *settings: str) -> tuple[list[Tracks], list[Truth]]:
        ports = ("tracker.tracks", "scene.truth")
        seen: dict[str, Any] = run_graph(graph, collect=ports, set_=[*NEAR, *settings], out=tmp_path)
        return seen["tracker.tracks"], seen["scene.truth"]

    return run


def followed(tracks: list[Tracks], truth: list[Truth], gate_m: float = 10.0) -> npt.NDArray[np.bool_]:
    """In which pings a confirmed track lies within the gate of the only target."""
    hit = []
    for one, true in zip(tracks, truth, strict=True):
        near = one.select(one.status == TrackStatus.CONFIRMED).state[:, :2] - true.state[0, :2]
        hit.append(bool((np.hypot(near[:, 0], near[:, 1]) < gate_m).any()))
    return np.array(hit)


def strangers(tracks: list[Tracks], truth: list[Truth]) -> int:
    """Confirmed tracks that are in most of their pings at another range than the target."""
    seen: dict[int, list[bool]] = {}
    for one, true in zip(tracks, truth, strict=True):
        sure = one.select(one.status == TrackStatus.CONFIRMED)
        off = np.abs(np.hypot(*sure.state[:, :2].T) - np.hypot(*true.state[0, :2]))
        for i, away in zip(sure.id.tolist(), off > 2.0, strict=True):
            seen.setdefault(i, []).append(bool(away))
    return sum(np.mean(one) > 0.5 for one in seen.values())


@pytest.mark.parametrize("seed", [11, 12])
def test_blobs_at_13_db_are_one_track(play: Play, seed: int):
    tracks, truth = play("active_array", "scene.pings=40", "scene.scr_db=13", f"scene.seed={seed}")
    assert followed(tracks, truth)[15:].mean() > 0.9
    assert strangers(tracks, truth) < 2


@pytest.mark.parametrize("pfa", ["1e-3", "3e-3"])
def test_clutter_that_persists_does_not_become_tracks(play: Play, pfa: str):
    settings = ("scene.pings=45", "scene.scr_db=13", "scene.seed=15", "scene.clutter_correlation_pings=3")
    tracks, truth = play("active_array", *settings, f"cfar.pfa={pfa}")
    assert followed(tracks, truth)[15:].mean() > 0.9
    assert strangers(tracks, truth) == 0


def test_integration_at_7_db_finds_what_blobs_do_not(play: Play):
    settings = ("scene.pings=45", "scene.scr_db=7", "scene.seed=13")
    tracks, truth = play("active_array_tbd", *settings)
    assert followed(tracks, truth)[30:].all()
    assert strangers(tracks, truth) == 0


@pytest.mark.parametrize("graph", ["active_array_karoui", "active_array_lo"])
def test_the_benchmarks_of_the_paper_track_a_strong_target(play: Play, graph: str):
    tracks, truth = play(graph, "scene.pings=35", "scene.scr_db=17", "scene.seed=14")
    assert followed(tracks, truth)[25:].mean() > 0.7


@pytest.fixture
def images(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The images that benchmarks/active_array.py makes once for all strengths."""
    name = "active_array_images"
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("correlation_pings", [0.0, 3.0])
def test_an_echo_that_is_added_later_is_that_of_a_simulation(images: ModuleType, correlation_pings: float):
    strengths = (5.0, 13.0)
    quick = images.Images(4, correlation_pings, strengths, 3)
    far_m = quick.far_m + 1.0
    straight = [iter(images.scene(4, correlation_pings, scr_db, 3, far_m)()) for scr_db in strengths]
    beams = DelayAndSum(range_min_m=quick.near_m, range_max_m=quick.far_m)
    for place in quick:
        for image, pings in zip(place.images, straight, strict=True):
            block, truth = next(pings)
            expected = beams(PulseCompression()(block))
            np.testing.assert_allclose(image.amplitude, expected.amplitude, atol=2e-5)
            assert np.array_equal(image.range_m, expected.range_m)
            assert np.array_equal(place.truth.state, truth.state)


def test_the_same_bits_in_threads_and_in_order(tmp_path: Path):
    def bits(name: str, options: Options) -> list[bytes]:
        graph = graphs.load("active_array_tbd", set_=[*NEAR, "scene.pings=8", "scene.scr_db=13"])
        buffers: list[bytes] = []
        taps = {("tracker", "tracks"): lambda index, message: buffers.append(wire.encode(message))}
        out = tmp_path / name
        out.mkdir()
        assert Run(graph, options, out=out, taps=taps).start().error is None
        return [*buffers, (out / "tracks.csv").read_bytes()]

    assert bits("threads", Options()) == bits("order", Options(in_order=True))
