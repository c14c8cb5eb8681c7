"""From a simulated or recorded array to pings: the graph of sources, compression and beams."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile
from numpy.testing import assert_allclose

from fls_flow import Ping
from fls_flow.geometry import to_polar, wrap
from fls_flow.testing import run_graph

SCENE = "scene: {use: array-scene, with: {pings: 3, range_max_m: 120, targets: [[60, 45, 0.6, -0.2]], scr_db: 24, seed: 2}}"
GRAPH = """
graph: front-half
nodes:
  %s
  compression: {use: pulse-compression, in: {block: %s}}
  beams: {use: %s, in: {block: compression}}
"""


def pings(
    tmp_path: Path, beamformer: str, source: str = SCENE, port: str = "scene.block"
) -> tuple[list, list]:
    (tmp_path / "g.yaml").write_text(GRAPH % (source, port, beamformer))
    collect = ["beams.ping", *(["scene.truth"] if "array-scene" in source else [])]
    seen = run_graph(tmp_path / "g.yaml", collect=collect)
    return seen["beams.ping"], seen.get("scene.truth", [])


def strongest(ping: Ping) -> tuple[float, float]:
    i, j = np.unravel_index(int(ping.amplitude.argmax()), ping.amplitude.shape)
    return ping.range_m[i], ping.bearing_rad[j]


@pytest.mark.parametrize("beamformer", ["delay-and-sum", "capon"])
def test_a_target_stands_where_the_truth_is_all_around(tmp_path, beamformer) -> None:
    images, truths = pings(tmp_path, beamformer)
    assert len(images) == 3
    for ping, truth in zip(images, truths, strict=True):
        (r,), (bearing,) = to_polar(truth.state[:, :2])
        found_r, found_bearing = strongest(ping)
        # struck r / c after the stamp, and moved by Doppler times the chirp's range coupling
        assert_allclose(found_r, r, atol=0.15)
        assert abs(wrap(found_bearing - bearing)) <= np.deg2rad(1.0)
        assert_allclose(np.mean(ping.amplitude.astype(float) ** 2), 1.0, atol=0.3)
        assert ping.amplitude.shape[1] == 360


def test_a_recording_of_the_scene_gives_the_same_image(tmp_path) -> None:
    from fls_sources.array_scene import ArrayScene

    images, _ = pings(tmp_path, "delay-and-sum")
    settings = {
        "pings": 3,
        "range_max_m": 120.0,
        "targets": ((60.0, 45.0, 0.6, -0.2),),
        "scr_db": 24.0,
        "seed": 2,
    }
    heard = [one.block.samples for one in ArrayScene(**settings)()]
    silence = np.zeros((4, 96_000 - heard[0].shape[1]), np.float32)
    sea = np.concatenate([np.concatenate([one, silence], axis=1) for one in heard], axis=1)
    soundfile.write(tmp_path / "sea.wav", sea.T, 96_000, "FLOAT")
    (tmp_path / "sea.yaml").write_text(
        "positions_m: [[-0.385, 0], [0, 0.395], [0.405, 0], [0, -0.405]]\n"
        "pulse: {start_hz: 31000, stop_hz: 41000, duration_s: 0.01}\n"
        f"sound_speed_mps: 1520\nperiod_s: 1\nlisten_s: {heard[0].shape[1] / 96_000!r}\n"
    )
    played, _ = pings(tmp_path, "delay-and-sum", "sea: {use: wav-array, with: {path: sea.wav}}", "sea")
    for one, other in zip(images, played, strict=True):
        assert_allclose(one.amplitude, other.amplitude, atol=1e-5)
