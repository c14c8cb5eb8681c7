"""The shipped PHD graphs on the scenes of Clark & Bell 2005, on one with clutter, and on a recording."""

from __future__ import annotations

import itertools
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from fls_flow import Detections, TrackStatus, View, wire
from fls_flow import graph as graphs
from fls_flow.runtime import Options, Run
from fls_flow.testing import run_graph
from fls_trackers.gm_cphd import GmCphd
from fls_trackers.gm_phd import GmPhd
from fls_trackers.particle_phd import ParticlePhd

KINDS = ("particle-phd", "gm-phd", "gm-cphd")


@dataclass
class Seen:
    """What the outputs gave, ping by ping."""

    truth: list[Any]
    detections: list[Any]
    tracks: list[Any]
    intensity: list[Any]

    @property
    def error(self) -> np.ndarray:
        """Estimated number of targets less the true one."""
        return np.array([number(i) - len(t) for i, t in zip(self.intensity, self.truth, strict=True)])

    @property
    def ospa(self) -> np.ndarray:
        """OSPA of the estimates."""
        pairs = zip(self.intensity, self.truth, strict=True)
        return np.array([ospa(i.state, t.state) for i, t in pairs])


def number(intensity: Any) -> int:
    return math.floor(intensity.expected_targets + 0.5)


def ospa(x: np.ndarray, y: np.ndarray, c: float = 10.0) -> float:
    """OSPA with p = 1 over positions (Schuhmacher, Vo & Vo 2008)."""
    n, m = len(x), len(y)
    if min(n, m) == 0:
        return c if max(n, m) else 0.0
    apart = np.minimum(c, np.hypot(x[:, None, 0] - y[None, :, 0], x[:, None, 1] - y[None, :, 1]))
    return float((apart[linear_sum_assignment(apart)].sum() + c * abs(n - m)) / max(n, m))


@pytest.fixture(scope="module")
def play(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Seen]:
    """Run a graph; a run is kept for the tests of this module."""
    kept: dict[Any, Seen] = {}

    def start(graph: str, *settings: str, kind: str = "particle-phd") -> Seen:
        key = (graph, kind, *settings)
        if key not in kept:
            names = ("sonar.truth", "detect.detections", "tracker.tracks", "tracker.intensity")
            found = run_graph(
                graph,
                {},
                names,
                set_=["picture.dpi=30", *settings],
                use=[f"tracker={kind}"],
                out=tmp_path_factory.mktemp("run"),
            )
            kept[key] = Seen(*(found[name] for name in names))
        return kept[key]

    return start


@pytest.mark.parametrize("graph", ["phd", "phd_sinusoidal"])
def test_the_number_of_objects_without_navigation(play, graph):
    runs = [play(graph, f"sonar.seed={seed}") for seed in (5, 1, 2)]
    right = np.array([np.abs(seen.error[5:]) <= 1 for seen in runs]).mean(axis=1)
    assert right.min() >= 0.95
    assert np.mean([seen.ospa[5:].mean() for seen in runs]) < 1.3
    assert all(intensity.frame == "sensor" for seen in runs for intensity in seen.intensity)


@pytest.mark.parametrize("kind", KINDS)
def test_every_object_that_stays_in_view_has_one_identity(play, kind):
    seen = play("phd", "sonar.sway_m=0.0", kind=kind)
    targets = set(np.concatenate([t.target_id for t in seen.truth]).tolist())
    kept = 0
    for target in targets:
        pings = [k for k, t in enumerate(seen.truth) if target in t.target_id]
        if len(pings) < 15:
            continue
        followers = []
        for k in pings[4:-2]:
            place = seen.truth[k].state[seen.truth[k].target_id == target][0, :2]
            tracks = seen.tracks[k].select(seen.tracks[k].status == TrackStatus.CONFIRMED)
            apart = np.hypot(*(tracks.state[:, :2] - place).T)
            followers.append(int(tracks.id[apart.argmin()]) if apart.min(initial=9.0) < 1.5 else None)
        held = [one for one in followers if one is not None]
        assert len(held) >= 0.9 * len(followers)
        assert sum(a != b for a, b in itertools.pairwise(held)) <= 1
        kept += 1
    assert kept >= 5


def test_navigation_makes_seabed_objects_stand_still(play):
    seen = play("phd_sinusoidal", "sonar.nav=true", "tracker.frame=ned")
    assert (np.abs(seen.error[5:]) <= 1).mean() >= 0.95
    speeds = [np.hypot(t.state[:, 2], t.state[:, 3])[t.age >= 8] for t in seen.tracks]
    assert np.median(np.concatenate(speeds)) < 0.25
    assert seen.tracks[-1].frame == "ned"


def test_moving_fish_are_counted_too(play):
    seen = play("phd_sinusoidal", "sonar.n_fish=6", "sonar.max_in_view=3")
    assert (np.abs(seen.error[5:]) <= 1).mean() >= 0.9


def test_cfar_swaps_in_for_the_threshold(play):
    seen = play("phd_cfar")
    assert (np.abs(seen.error[5:]) <= 1).mean() >= 0.9


def cylinder(
    play: Callable[..., Seen], seed: int, backward: bool, recursion: str
) -> tuple[np.ndarray, np.ndarray]:
    """OSPA and whether the cylinder is found, in the order of the forward images."""
    settings = [f"sonar.seed={seed}", f"tracker.seed={seed}", f"tracker.recursion={recursion}"]
    settings += ["sonar.backward=true", "tracker.closing_mps=-1.0"] if backward else []
    seen = play("phd_cylinder", *settings)
    hits = []
    for i, t in zip(seen.intensity, seen.truth, strict=True):
        hits.append(np.hypot(*(i.state[:, :2] - t.state[0, :2]).T).min(initial=9.0) < 1.0)
    order = slice(None, None, -1 if backward else 1)
    return seen.ospa[order], np.array(hits)[order]


def test_forward_clutter_misleads_at_first_and_backward_the_target_is_held_through_it(play):
    """Clark & Bell 2005, figures 6 and 7: images 0 to 9 are cluttered, 10 to 17 are not."""
    forward = [cylinder(play, seed, False, "phd") for seed in range(5)]
    backward = [cylinder(play, seed, True, "phd") for seed in range(5)]
    ahead, back = (np.array([one[0] for one in runs]) for runs in (forward, backward))
    assert ahead[:, :10].mean() > 3.0  # poor at first
    assert ahead[:, 10:].mean() < 0.6 * ahead[:, :10].mean()  # then it converges
    assert back[:, :10].mean() < 1.0  # held through the clutter
    assert np.array([one[1][:10] for one in backward]).mean() >= 0.95
    assert np.array([one[1][1:4] for one in forward]).mean() < 0.95


def test_with_identities_the_cylinder_is_held_through_the_clutter_both_ways(play):
    """Backward as good as the plain filter; forward the cylinder is found in nearly every image from the second on."""
    forward = [cylinder(play, seed, False, "labelled") for seed in range(3)]
    backward = [cylinder(play, seed, True, "labelled") for seed in range(3)]
    assert np.array([one[1][1:] for one in forward]).mean() >= 0.95
    assert np.array([one[1][:10] for one in backward]).mean() >= 0.95
    assert np.array([one[0][:10] for one in backward]).mean() < 1.0
    ahead = np.array([one[0] for one in forward])
    assert ahead[:, 10:].mean() < 0.6 * ahead[:, :10].mean()


def crossing_scene(seed: int, clutter: float) -> tuple[list[Detections], list[np.ndarray]]:
    """10 deg, 20 to 60 m, 1 to 4 targets born at the far end that come at 1 m/s, pd 0.9."""
    rng, half, sd = np.random.default_rng(seed), math.radians(5.0), (0.25, math.radians(0.5))
    view = View(20.0, 60.0, 0.25, np.radians((np.arange(20) - 9.5) * 0.5), math.radians(0.5))
    live, pings, truth = np.zeros((0, 4)), [], []
    for k in range(100):
        live = live + np.array([-1.0, 0.0, 0.0, 0.0])
        r, b = np.hypot(live[:, 0], live[:, 1]), np.arctan2(live[:, 1], live[:, 0])
        live = live[(r >= 20.0) & (np.abs(b) <= half)]
        while len(live) < 1 or (len(live) < 4 and rng.random() < 0.08):
            at = rng.uniform(-0.9 * half, 0.9 * half)
            live = np.vstack([live, [59.9 * math.cos(at), 59.9 * math.sin(at), -1.0, 0.0]])
        truth.append(live.copy())
        seen = live[rng.random(len(live)) < 0.9]
        n = int(rng.poisson(clutter))
        r = np.hypot(seen[:, 0], seen[:, 1]) + sd[0] * rng.standard_normal(len(seen))
        b = np.arctan2(seen[:, 1], seen[:, 0]) + sd[1] * rng.standard_normal(len(seen))
        r, b = np.append(r, rng.uniform(20, 60, n)), np.append(b, rng.uniform(-half, half, n))
        noise = np.broadcast_to(np.diag([sd[0] ** 2, sd[1] ** 2]), (r.size, 2, 2))
        pings.append(Detections(k, (k + 1) * 10**9, r, b, np.ones(r.size), np.zeros((r.size, 2)), noise, np.zeros(r.size, np.uint8), view))  # fmt: skip
    return pings, truth


def mean_ospa(kind: Any, clutter: float, **settings: Any) -> float:
    errors = []
    for seed in range(4):
        extra = {"seed": seed} if kind is ParticlePhd else {}
        node = kind(clutter_per_ping=clutter, closing_mps=1.0, **extra, **settings)
        for ping, truth in zip(*crossing_scene(seed, clutter), strict=True):
            errors.append(ospa(node(ping).intensity.state, truth))
    return float(np.mean(errors))


# Stone Soup's Gaussian-mixture PHD on the scene of benchmarks/phd.py: see docs/phd.md
@pytest.mark.parametrize("kind", [ParticlePhd, GmPhd])
def test_ospa_with_identities_is_clearly_better_than_without(kind):
    for clutter, bound in ((5.0, 2.2), (20.0, 3.0)):
        labelled, plain = (mean_ospa(kind, clutter, recursion=one) for one in ("labelled", "phd"))
        assert labelled < bound
        assert labelled < plain - 0.5


def test_ospa_of_the_cardinalised_filter_in_heavy_clutter():
    assert mean_ospa(GmCphd, 20.0) < 3.8


def test_the_same_seed_gives_the_same_bits_in_threads_and_in_order(tmp_path):
    def bits(name: str, options: Options, seed: int = 1) -> list[bytes]:
        graph = graphs.load("phd", set_=["sonar.pings=25", f"tracker.seed={seed}"])
        buffers: list[bytes] = []
        taps = {
            ("tracker", port): lambda index, message: buffers.append(wire.encode(message))
            for port in ("tracks", "intensity")
        }
        out = tmp_path / name
        out.mkdir()
        assert Run(graph, options, out=out, taps=taps).start().error is None
        return [*buffers, (out / "estimates.csv").read_bytes(), (out / "tracks.csv").read_bytes()]

    assert bits("threads", Options()) == bits("order", Options(in_order=True))
    assert bits("other", Options(), seed=2) != bits("threads-1", Options(window=1))


def test_as_processes_the_files_have_the_same_bytes(tmp_path: Path):
    with tempfile.TemporaryDirectory(prefix="fls") as short:  # names of sockets have to be short
        for way in (["--in-process"], []):
            words = ["run", "phd", "--set", "sonar.pings=20", "--set", "picture.dpi=30", *way]
            out = tmp_path / ("here" if way else "processes")
            subprocess.run(
                [sys.executable, "-m", "fls_flow.cli", *words, "--out", str(out)],
                check=True,
                capture_output=True,
                timeout=200,
                env={**os.environ, "XDG_RUNTIME_DIR": short},
            )
    for name in ("estimates.csv", "tracks.csv", "truth.csv"):
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "processes" / name).read_bytes()


def test_recording_two_swimmers(tmp_path: Path):
    out = run_graph("phd_on_recording", {}, ["tracker.tracks", "tracker.intensity"], out=tmp_path)
    tracks, intensity = out["tracker.tracks"], out["tracker.intensity"]
    confirmed = [t.select(t.status == TrackStatus.CONFIRMED) for t in tracks]
    counts = np.array([number(i) for i in intensity[15:]])
    assert (np.abs(counts - 2) <= 1).mean() >= 0.9
    for each in confirmed[16:]:
        assert ((each.state[:, 0] > 8.0) & (each.state[:, 0] < 9.5)).all()
        assert (np.abs(each.state[:, 1]) < 1.0).all()
    longest = max(
        sum(identity in each.id for each in confirmed)
        for identity in np.concatenate([c.id for c in confirmed])
    )
    assert longest >= 25
    assert (tmp_path / "tracks.png").is_file()
