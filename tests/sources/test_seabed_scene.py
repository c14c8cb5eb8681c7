"""The simulated sonar over the sea floor: geometry, objects in view, speckle, sediments, shadows, truth."""

from __future__ import annotations

import math
from itertools import islice

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow.geometry import sensor_pose, to_polar
from fls_flow.testing import check_node
from fls_sources.scene_motion import TimedPath
from fls_sources.seabed_floor import Patch, floor
from fls_sources.seabed_image import shadowed
from fls_sources.seabed_plan import Vehicle, apparent
from fls_sources.seabed_scene import SeabedScene, fls_node


def power(ping) -> np.ndarray:
    return ping.amplitude.astype(float) ** 2


def test_kind_and_contract() -> None:
    assert fls_node() is SeabedScene
    for settings in ({}, {"path": "sinusoidal", "nav": True, "n_fish": 2}, {"sequence": "cylinder"}):
        check_node(SeabedScene(pings=6, false_echoes=3.0, **settings))


def test_the_sector_is_the_papers() -> None:
    ping, _ = next(SeabedScene()())
    assert ping.amplitude.shape == (400, 20)
    assert_allclose(ping.range_m[[0, -1]], [20.05, 59.95])
    assert_allclose(np.degrees(ping.bearing_rad[[0, -1]]), [-4.75, 4.75])
    assert len(SeabedScene()) == len(list(SeabedScene()())) == 100
    assert len(SeabedScene(sequence="cylinder")) == 18


@pytest.mark.parametrize("path", ["straight", "sinusoidal"])
@pytest.mark.parametrize("seed", range(4))
def test_one_to_four_spheres_are_in_view_at_every_ping(path, seed) -> None:
    scene = SeabedScene(path=path, seed=seed)
    stage = scene._stage()
    seen = np.array([stage.sonar.sees(stage.states(float(t))[:, :2]) for t in range(100)])
    count = seen.sum(axis=1)
    assert count.min() >= 1
    assert count.max() <= 4
    assert len(np.unique(count)) >= 3  # they come and go
    assert (np.diff(count) != 0).sum() >= 10


def test_on_a_straight_way_objects_come_in_at_the_far_end() -> None:
    stage = SeabedScene(sway_m=0.0, seed=2)._stage()
    states = np.array([stage.states(float(t)) for t in range(100)])
    seen = np.array([stage.sonar.sees(one[:, :2]) for one in states])
    for k in range(seen.shape[1]):
        (entries,) = np.nonzero(~seen[:-1, k] & seen[1:, k])
        for t in entries:
            assert np.hypot(*states[t + 1, k, :2]) > 58.0
        assert entries.size <= 1


def test_truth_is_what_lies_inside_and_its_velocity_is_apparent() -> None:
    scene = SeabedScene(path="sinusoidal", n_fish=3, seed=4)
    stage = scene._stage()
    for ping, truth in islice(scene(), 0, 100, 9):
        r, b = to_polar(truth.state[:, :2])
        assert ((r >= 20.0) & (r < 60.0) & (np.abs(b) <= math.radians(5.0))).all()
        assert ping.seq == truth.seq
        before, after = (stage.states(ping.seq + h)[truth.target_id - 1, :2] for h in (-1e-4, 1e-4))
        assert_allclose(truth.state[:, 2:], (after - before) / 2e-4, atol=1e-5)
    assert {name for _, truth in scene() for name in truth.class_name} == {"sphere", "fish"}


def test_fish_swim_straight_at_their_speed_and_spheres_lie_still() -> None:
    stage = SeabedScene(n_fish=4, fish_speed_mps=0.7)._stage()
    for thing in stage.things:
        _, velocity = thing.path.at(3.0)
        assert_allclose(np.hypot(*velocity), 0.7 if thing.class_name == "fish" else 0.0, atol=1e-12)


def test_navigation_is_exact() -> None:
    places: dict[int, list[np.ndarray]] = {}
    for ping, truth in SeabedScene(path="sinusoidal", nav=True, pings=30)():
        pose = sensor_pose(ping.nav, ping.mount)
        for identity, state in zip(truth.target_id.tolist(), truth.state, strict=True):
            places.setdefault(identity, []).append(pose.to_ned(state[:2]))
        yaw = ping.nav.attitude_rad[2]
        ahead, side, _ = ping.nav.velocity_mps
        assert_allclose(ahead * math.cos(yaw) - side * math.sin(yaw), 1.0, atol=1e-12)
        assert abs(side) < 1e-12  # it heads where it goes
    for where in places.values():
        assert_allclose(where, np.broadcast_to(where[0], (len(where), 2)), atol=1e-9)
    assert next(SeabedScene()()).ping.nav is None


def test_backward_is_the_same_images_from_the_end() -> None:
    forward = list(SeabedScene(sequence="cylinder", seed=3)())
    backward = list(SeabedScene(sequence="cylinder", seed=3, backward=True)())
    for one, other in zip(forward, reversed(backward), strict=True):
        assert_array_equal(one.ping.amplitude, other.ping.amplitude)
        assert_array_equal(one.truth.state * [1, 1, -1, -1], other.truth.state)
    stamps = [one.ping.stamp_ns for one in backward]
    assert stamps == sorted(stamps)


def test_dark_sediment_is_rayleigh() -> None:
    scene = SeabedScene(min_in_view=0, max_in_view=0, bright_db=0.0, pings=12)
    stage = scene._stage()
    samples = []
    for k, (ping, truth) in enumerate(scene()):
        assert len(truth) == 0
        r, b = ping.range_m[:, None], ping.bearing_rad[None, :]
        cells = np.stack(np.broadcast_arrays(r * np.cos(b), r * np.sin(b)), axis=-1)
        mean = stage.floor.power(stage.vehicle.pose(float(k)).to_ned(cells))
        samples.append(power(ping) / mean / stage.water.range_gain.astype(float) ** 2)
    x = np.concatenate(samples).ravel()
    assert_allclose(x.mean(), 1.0, atol=0.02)
    for level in (1.0, 3.0, 6.0):
        expected = math.exp(-level)
        assert_allclose((x > level).mean(), expected, atol=5.0 * math.sqrt(expected / x.size))


def test_the_second_sediment_is_brighter_and_fixed_to_the_world() -> None:
    made = floor(6.0, None, np.random.default_rng(1))
    grid = np.stack(np.meshgrid(np.arange(0.0, 200.0, 1.0), np.arange(0.0, 200.0, 1.0)), axis=-1)
    level = 10.0 * np.log10(made.power(grid))
    bright = level > 3.0
    assert 0.15 < bright.mean() < 0.6
    assert_allclose(level[bright].mean() - level[~bright].mean(), 6.0, atol=1.0)
    assert_array_equal(made.power(grid), made.power(grid))
    patched = floor(12.0, Patch(20.0, 30.0), np.random.default_rng(1)).power(grid)
    inside = (grid[..., 0] >= 20.0) & (grid[..., 0] < 30.0)
    assert_allclose(10 * np.log10(patched[inside].mean() / patched[~inside].mean()), 12.0, atol=0.5)


def test_a_shadow_is_as_long_as_similar_triangles_say() -> None:
    range_m, beams = 20.0 + 0.1 * np.arange(400), np.radians(np.linspace(-5, 5, 21))
    factor = shadowed(range_m, beams, np.array([40.0]), np.array([0.0]), np.array([1.0]), 8.0)
    dark = range_m[factor[:, 10] < 1.0]
    assert_allclose([dark[0], dark[-1]], [40.5, 40.0 * 8.0 / 7.0], atol=0.11)
    assert (factor[:, [0, 20]] == 1.0).all()
    high = shadowed(range_m, beams, np.array([40.0]), np.array([0.0]), np.array([9.0]), 8.0)
    assert high[-1, 10] < 1.0


def test_echoes_lie_on_their_spheres() -> None:
    for seed in range(3):
        for ping, truth in islice(SeabedScene(seed=seed, snr_db=40.0)(), 0, 100, 25):
            for r, b in zip(*to_polar(truth.state[:, :2]), strict=True):
                near = (np.abs(ping.range_m - r) < 1.0)[:, None] & (np.abs(ping.bearing_rad - b) < 0.02)
                patch = np.where(near, power(ping), 0.0)
                assert abs((patch.sum(axis=1) @ ping.range_m) / patch.sum() - r) < 0.5
                assert abs((patch.sum(axis=0) @ ping.bearing_rad) / patch.sum() - b) < math.radians(0.4)
                assert patch.max() > 100.0 * np.median(power(ping))


def test_false_echoes_come_in_the_number_asked_for() -> None:
    quiet = SeabedScene(min_in_view=0, max_in_view=0, pings=60, bright_db=0.0)
    loud = SeabedScene(min_in_view=0, max_in_view=0, pings=60, bright_db=0.0, false_echoes=5.0, snr_db=43.0)
    count = []
    for (a, _), (b, _) in zip(quiet(), loud(), strict=True):
        rows = np.flatnonzero((power(b) > 500.0 * np.median(power(a))).any(axis=1))
        count.append(1 + (np.diff(rows) > 3).sum() if rows.size else 0)
    assert_allclose(np.mean(count), 5.0, atol=1.0)


def test_a_wide_sector_and_number_formats() -> None:
    for dtype in ("uint8", "uint16", "float32"):
        scene = SeabedScene(
            sector_deg=90.0, n_beams=60, beamwidth_deg=1.5, range_min_m=2.0, pings=2, dtype=dtype
        )
        ping, truth = next(scene())
        assert str(ping.amplitude.dtype) == dtype
        assert ping.amplitude.shape == (580, 60)
        assert len(truth) >= 1
    ping, _ = next(SeabedScene(clutter="k", pings=1)())
    assert np.isfinite(ping.amplitude).all()


def test_the_vehicles_own_motion() -> None:
    vehicle = Vehicle(1.2, 1.5, 40.0, 0.1)
    for t in (0.0, 7.3, 31.0):
        before, after = vehicle.pose(t - 1e-4), vehicle.pose(t + 1e-4)
        assert_allclose((after.origin_m - before.origin_m) / 2e-4, vehicle.velocity_mps(t), atol=1e-6)
        rate = (after.heading_rad - before.heading_rad) / 2e-4
        assert_allclose(rate, vehicle.yaw_rate_radps(t), atol=1e-6)
        path = TimedPath.straight(0.0, (30.0, 2.0), (0.3, -0.2))
        low, high = (apparent(vehicle, s, *(a[None] for a in path.at(s)))[0] for s in (t - 1e-4, t + 1e-4))
        now = apparent(vehicle, t, *(a[None] for a in path.at(t)))[0]
        assert_allclose(now[2:], (high - low)[:2] / 2e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"sequence": "other"}, "sequence is 'other'"),
        ({"path": "zigzag"}, "path is 'zigzag'"),
        ({"speed_mps": 0.0}, "speed_mps is 0.0"),
        ({"cell_m": math.nan}, "cell_m is nan"),
        ({"range_max_m": 20.1}, "range_max_m is 20.1"),
        ({"max_in_view": 0}, "max_in_view is 0"),
        ({"sector_deg": 200.0}, "sector_deg is 200.0"),
        ({"pings": 0}, "pings is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"side_lobe_db": 3.0}, "side_lobe_db is 3.0"),
    ],
)
def test_bad_parameters_are_named_with_their_value(settings, what) -> None:
    with pytest.raises(ValueError, match=what):
        SeabedScene(**settings)
