"""The shipped ground-obstacle graphs: a wreck, synthetic targets, an obstacle in the water column."""

from __future__ import annotations

import csv
import datetime
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pynmeagps import calc_checksum

from fls_flow import TrackStatus, wire
from fls_flow import graph as graphs
from fls_flow.runtime import Options, Run
from fls_flow.testing import run_graph
from fls_sources.ground_nav import GroundNav

TRACKS, TRUTH, FOUND, SHADOWS = "tracker.tracks", "sonar.truth_ned", "ratio.detections", "ratio.shadows"


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(("seed", "dtype"), [(7, "float32"), (1, "float32"), (2, "uint16"), (3, "uint8")])
def test_the_wreck_has_highlight_and_shadow_and_one_stable_track(tmp_path, seed, dtype):
    seen = run_graph(
        "ground_obstacle",
        collect=(TRACKS, TRUTH, FOUND, SHADOWS),
        set_=[f"sonar.seed={seed}", f"nav.seed={seed}", f"sonar.dtype={dtype}"],
        out=tmp_path,
    )
    confirmed = [t.id[t.status == TrackStatus.CONFIRMED].tolist() for t in seen[TRACKS]]
    assert all(ids == confirmed[10] for ids in confirmed[10:])
    assert len(confirmed[10]) == 1
    places = np.array([t.state[t.id == confirmed[10][0], :2][0] for t in seen[TRACKS][10:]])
    assert (np.linalg.norm(places - seen[TRUTH][-1].state[0, :2], axis=1) < 3.0).all()
    assert np.linalg.norm(places[30:].std(axis=0)) < 0.5
    for found, shadows in zip(seen[FOUND][10:], seen[SHADOWS][10:], strict=True):
        assert (found.extent[:, 0] > 1.0).any()
        large = shadows.select(shadows.extent[:, 0] > 3.0)
        assert len(large) == 1
        assert large.range_m[0] > found.range_m.min()
    assert {row["frame"] for row in rows(tmp_path / "tracks.csv") if row["track_id"]} == {"ned"}


def last_errors(seen: dict[str, list[Any]]) -> np.ndarray:
    """Distances between the two targets and their nearest confirmed tracks, in the last 20 pings."""
    apart = []
    for tracks, truth in zip(seen[TRACKS][-20:], seen[TRUTH][-20:], strict=True):
        tracks = tracks.select(tracks.status == TrackStatus.CONFIRMED)
        between = np.linalg.norm(tracks.state[:, None, :2] - truth.state[:, :2], axis=-1)
        apart.append(between.min(axis=0))
    return np.array(apart)


@pytest.mark.parametrize("step", ["exact", "euler"])
def test_both_synthetic_targets_are_kept(tmp_path, step):
    seen = run_graph("ground_points", collect=(TRACKS, TRUTH), set_=[f"tracker.step={step}"], out=tmp_path)
    ids = {tuple(one.id.tolist()) for one in seen[TRACKS]}
    assert ids == {(1, 2)}
    assert np.sqrt((last_errors(seen) ** 2).mean()) < 0.6


def test_jpda_takes_the_place_of_the_tracker_and_is_stabilised_by_the_same_navigation(tmp_path):
    settings = ["tracker.frame=ned", "tracker.sigma_d_m=1.0", "tracker.sigma_delta_deg=1.5"]
    seen = run_graph(
        "ground_points", collect=(TRACKS, TRUTH), use=["tracker=jpda"], set_=settings, out=tmp_path
    )
    assert last_errors(seen).max() < 3.0


def test_jpda_takes_the_place_of_the_tracker_on_the_wreck(tmp_path):
    seen = run_graph(
        "ground_obstacle",
        collect=(TRACKS, TRUTH),
        use=["tracker=jpda"],
        set_=["tracker.frame=ned", "sonar.pings=50"],
        out=tmp_path,
    )
    assert (seen[TRACKS][-1].status == TrackStatus.CONFIRMED).sum() >= 1


def test_a_silent_link_does_not_lose_the_targets(tmp_path):
    """Three seconds without navigation: uncertainty grows, then the same tracks go on."""
    silence = ["nav.silent_from_s=5.0", "nav.silent_to_s=7.0", "fusion.max_age_s=0.3", "tracker.frame=sensor"]
    seen = run_graph("ground_points", collect=(TRACKS, "sonar.truth"), set_=silence, out=tmp_path)
    spread = [float(np.trace(one.covariance[0, :2, :2])) for one in seen[TRACKS]]
    assert {tuple(one.id.tolist()) for one in seen[TRACKS]} == {(1, 2)}
    assert max(spread[27:35]) > 2.0 * spread[24]
    assert spread[-1] < 0.5 * max(spread[27:35])


def test_an_obstacle_in_the_water_column_is_said_to_be_one(tmp_path):
    seen = run_graph("ground_mid_water", collect=(TRACKS, "tracker.classes"), out=tmp_path)
    label = [dict(zip(c.track_id.tolist(), c.label.tolist(), strict=True)) for c in seen["tracker.classes"]]
    assert label[10] == {1: 0, 2: 0}
    assert label[-1] == {1: 1, 2: 0}
    buoy = seen[TRACKS][-1].state[0, :2]
    assert np.linalg.norm(buoy - [22.0, 0.5]) < 1.0
    words = {(row["track_id"], row["label"]) for row in rows(tmp_path / "tracks.csv")}
    assert ("1", "water-column") in words
    assert ("2", "water-column") not in words


def test_on_a_sloping_floor_the_four_beams_give_its_slope_and_the_objects_are_kept(tmp_path):
    seen = run_graph(
        "ground_slope", collect=(TRACKS, TRUTH, "fusion.floor"), set_=["picture.pings=[]"], out=tmp_path
    )
    normals = np.array([one.normal for one in seen["fusion.floor"][10:]])
    tilt = np.degrees(np.arctan(-normals[:, :2] / normals[:, 2:]))
    assert_allclose(tilt.mean(axis=0), [3.0, 2.0], atol=0.1)
    assert_allclose(tilt, np.broadcast_to([3.0, 2.0], tilt.shape), atol=1.0)
    for tracks, truth in zip(seen[TRACKS][-40:], seen[TRUTH][-40:], strict=True):
        tracks = tracks.select(tracks.status == TrackStatus.CONFIRMED)
        apart = np.linalg.norm(tracks.state[:, None, :2] - truth.state[:, :2], axis=-1)
        assert (apart.min(axis=0, initial=99.0) < 2.0).all()
    assert len({identity for one in seen[TRACKS] for identity in one.id[one.status == 1].tolist()}) == 3


def test_the_same_bits_in_threads_in_order_and_for_any_window(tmp_path):
    def bits(name: str, options: Options) -> list[bytes]:
        graph = graphs.load("ground_obstacle", set_=["sonar.pings=30", "picture.pings=[20]"])
        kept: list[bytes] = []
        taps = {
            ("tracker", "tracks"): lambda index, message: kept.append(wire.encode(message)),
            ("fusion", "ping"): lambda index, message: kept.append(wire.encode(message)),
        }
        out = tmp_path / name
        out.mkdir()
        assert Run(graph, options, out=out, taps=taps).start().error is None
        return [*sorted(kept), (out / "tracks.csv").read_bytes()]

    whole = bits("threads", Options())
    assert whole == bits("order", Options(in_order=True))
    assert whole == bits("window-1", Options(window=1))
    assert whole == bits("window-20", Options(window=20))


def test_the_same_bytes_as_processes(tmp_path):
    command = [sys.executable, "-m", "fls_flow.cli", "run", "ground_obstacle", "--no-progress"]
    command += ["--set", "sonar.pings=30", "--set", "picture.pings=[20]", "--out"]
    for name, mode in (("processes", ()), ("inside", ("--in-process",))):
        subprocess.run([*command, str(tmp_path / name), *mode], check=True, capture_output=True, timeout=120)
    for name in ("tracks.csv", "truth.csv"):
        assert (tmp_path / "processes" / name).read_bytes() == (tmp_path / "inside" / name).read_bytes()


def nmea(nav: Any) -> list[str]:
    """What the vehicle's instruments would say: GPS, attitude, velocity and altitude."""
    when = datetime.datetime.fromtimestamp(nav.stamp_ns * 1e-9, datetime.UTC)
    clock = when.strftime("%H%M%S.") + f"{when.microsecond // 10000:02d}"
    latitude, longitude = 48.5 + nav.position_m[0] / 111_194.6, 4.5 + nav.position_m[1] / 74_630.0
    minutes = [60.0 * (value % 1.0) for value in (latitude, longitude)]
    roll, pitch, yaw = np.degrees(nav.attitude_rad)
    knots = np.array(nav.velocity_mps[:2]) * 3600.0 / 1852.0
    bodies = [
        f"GPRMC,{clock},A,48{minutes[0]:011.8f},N,004{minutes[1]:011.8f},E,,,140406,,,A",
        f"PASHR,{clock},{yaw % 360.0:.4f},T,{roll:.4f},{pitch:.4f},0.0,0.01,0.01,0.02,1,0",
        f"VDVBW,,,V,{knots[0]:.4f},{knots[1]:.4f},A",
        f"SDDBT,,f,{nav.altitude_m:.3f},M,,F",
    ]
    return [f"${body}*{calc_checksum(body)}" for body in bodies]


def test_navigation_from_an_nmea_file_does_as_well(tmp_path):
    """Rates come from the angles; heave velocity is not in it."""
    path = tmp_path / "nav.nmea"
    path.write_text("\r\n".join(line for one in GroundNav(duration_s=15.0)() for line in nmea(one.nav_state)))
    seen = run_graph(
        "ground_points",
        collect=(TRACKS, TRUTH),
        use=["nav=nmea-nav"],
        set_=[f"nav.path={path}", "nav.origin_deg=[48.5, 4.5]"],
        out=tmp_path / "run",
    )
    # in the first ping there is one sample only, and no turn rate yet
    assert {tuple(one.id.tolist()) for one in seen[TRACKS][1:]} == {(1, 2)}
    assert np.sqrt((last_errors(seen) ** 2).mean()) < 0.6
