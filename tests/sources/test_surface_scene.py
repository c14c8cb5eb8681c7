"""The simulated sea-surface sonar as a source: sequences, truth, clutter, what detectors find in it."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow.geometry import sensor_pose, to_polar
from fls_sources.scene_image import Stage
from fls_sources.scene_motion import TimedPath
from fls_sources.scene_objects import SceneObject, scatterers
from fls_sources.surface_scene import SurfaceScene, fls_node

SIZES = {
    "buoys-and-blocks": (600, 4000),
    "inflatable-and-buoy": (280, 1000),
    "inflatable-and-sailboat": (480, 1000),
    "passenger-boat": (20, 6000),
    "random": (200, 1000),
    "empty": (200, 1000),
}
INFLATABLE, BUOY = 2, 1


def ping_at(scene, seq):
    """Ping `seq` alone: it depends on nothing that came before."""
    stage: Stage = scene._stage()
    return next(islice(scene(), seq, None)), stage


def cfar(amplitude, pfa, guard=20, taps=8, stride=3):
    """Rayleigh CFAR with the same beam and its neighbours as reference, J <= 48."""
    power = np.pad(amplitude.astype(float) ** 2, ((80, 80), (1, 1)), constant_values=np.nan)
    n_ranges, n_beams = amplitude.shape
    total, used = np.zeros(amplitude.shape), np.zeros(amplitude.shape)
    for step in guard + 1 + stride * np.arange(taps):
        for first in (80 - step, 80 + step):
            for beam in range(3):
                cells = power[first : first + n_ranges, beam : beam + n_beams]
                total += np.nan_to_num(cells)
                used += np.isfinite(cells)
    return amplitude.astype(float) ** 2 > (pfa ** (-1.0 / used) - 1.0) * total


def found(ping, pfa=1e-6):
    rows, columns = np.nonzero(cfar(ping.amplitude, pfa))
    distance, bearing = ping.range_m[rows], ping.bearing_rad[columns]
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)


def place_of(truth, number):
    return truth.state[truth.target_id == number][0, :2]


@pytest.mark.parametrize("sequence", SIZES)
def test_each_sequence_has_its_size(sequence):
    scene = SurfaceScene(sequence=sequence)
    pings, n_ranges = SIZES[sequence]
    assert len(scene) == pings
    ping, truth = next(scene())
    assert ping.amplitude.shape == (n_ranges, 39)
    assert ping.amplitude.dtype == np.float32
    assert np.isfinite(ping.amplitude).all()
    assert (ping.amplitude >= 0.0).all()
    assert ping.cell_m == pytest.approx(0.05)
    assert ping.range_m[0] == pytest.approx(0.025)
    assert_allclose(np.rad2deg(ping.bearing_rad[[0, 19, 38]]), [-28.5, 0.0, 28.5], atol=1e-12)
    assert np.rad2deg(ping.beamwidth_rad) == pytest.approx(1.5)
    assert (ping.seq, truth.seq) == (0, 0)
    assert truth.stamp_ns == ping.stamp_ns
    assert truth.frame == "sensor"
    assert len(truth.class_name) == len(truth)


def test_the_hook_gives_the_node():
    assert fls_node() is SurfaceScene


def test_a_sequence_ends_after_its_pings_which_are_numbered_and_timed():
    given = list(SurfaceScene(pings=5, start_ns=10**18, ping_rate_hz=4.0)())
    assert [item.ping.seq for item in given] == [0, 1, 2, 3, 4]
    assert np.diff([item.ping.stamp_ns for item in given]).tolist() == [250_000_000] * 4
    assert given[0].ping.stamp_ns == 10**18


@pytest.mark.parametrize("clutter", ["rayleigh", "k", "measured"])
def test_iterating_again_gives_the_same_bits(clutter):
    scene = SurfaceScene(pings=3, clutter=clutter, seed=4)
    for (a, ta), (b, tb) in zip(scene(), SurfaceScene(pings=3, clutter=clutter, seed=4)(), strict=True):
        assert a.amplitude.tobytes() == b.amplitude.tobytes()
        assert ta.state.tobytes() == tb.state.tobytes()
        assert (a.stamp_ns, a.nav.attitude_rad) == (b.stamp_ns, b.nav.attitude_rad)


def test_two_iterators_do_not_disturb_each_other():
    scene = SurfaceScene(pings=3)
    alone = [item.ping.amplitude for item in scene()]
    first, second = scene(), scene()
    for amplitude in alone:
        assert_array_equal(next(first).ping.amplitude, amplitude)
        assert_array_equal(next(second).ping.amplitude, amplitude)


def test_a_ping_does_not_depend_on_the_number_of_pings():
    few, many = list(SurfaceScene(pings=2)()), list(SurfaceScene(pings=4)())
    assert_array_equal(few[1].ping.amplitude, many[1].ping.amplitude)


def test_seeds_differ_and_so_do_pings():
    one, other = (list(SurfaceScene(sequence="empty", pings=2, seed=s)()) for s in (1, 2))
    assert not np.array_equal(one[0].ping.amplitude, other[0].ping.amplitude)
    assert abs(np.corrcoef(one[0].ping.amplitude.ravel(), one[1].ping.amplitude.ravel())[0, 1]) < 0.1


def test_images_do_not_share_memory():
    a, b = list(SurfaceScene(pings=2)())
    assert not np.shares_memory(a.ping.amplitude, b.ping.amplitude)
    assert not a.ping.amplitude.flags.writeable
    assert not np.shares_memory(a.truth.state, b.truth.state)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sequence": "bathtub"}, "sequence is 'bathtub'; it must be one of"),
        ({"clutter": "weibull"}, "clutter is 'weibull'"),
        ({"dtype": "int8"}, "dtype is 'int8'"),
        ({"truth_frame": "earth"}, "truth_frame is 'earth'; it must be one of"),
        ({"pings": 0}, "pings is 0; it must be 1 or more"),
        ({"n_ranges": -3}, "n_ranges is -3"),
        ({"n_beams": 0}, "n_beams is 0"),
        ({"cell_m": 0.0}, "cell_m is 0.0; it must be positive"),
        ({"cell_m": float("nan")}, "cell_m is nan; it must be finite"),
        ({"range_min_m": -1.0}, "range_min_m is -1.0"),
        ({"beamwidth_deg": -1.5}, "beamwidth_deg is -1.5"),
        ({"side_lobe_db": 3.0}, "side_lobe_db is 3.0; it must be negative"),
        ({"ping_rate_hz": float("inf")}, "ping_rate_hz is inf"),
        ({"k_shape": 0.0}, "k_shape is 0.0"),
        ({"yaw_period_s": 0.0}, "yaw_period_s is 0.0"),
        ({"n_boats": -1}, "n_boats is -1"),
        ({"seed": -1}, "seed is -1; it must be 0 or more"),
        ({"n_beams": 1024}, "is 1536.0; a sector has at most 180 degrees"),
    ],
)
def test_bad_parameters_are_refused_with_their_value(given, message):
    with pytest.raises(ValueError, match=message):
        SurfaceScene(**given)


def test_many_beams_and_odd_geometries():
    ping, _ = next(SurfaceScene(n_beams=1024, beam_spacing_deg=0.1, beamwidth_deg=0.2, n_ranges=900)())
    assert ping.amplitude.shape == (900, 1024)
    assert np.isfinite(ping.amplitude).all()
    ping, _ = next(SurfaceScene(n_beams=1, n_ranges=1)())
    assert ping.amplitude.shape == (1, 1)
    ping, truth = next(SurfaceScene(range_min_m=45.0, n_ranges=20)())
    assert ping.range_m[0] == pytest.approx(45.025)
    assert len(truth) == 0


@pytest.mark.parametrize(("dtype", "top"), [("uint8", 255), ("uint16", 65535)])
def test_whole_number_formats_clip_next_to_nothing(dtype, top):
    ping, _ = next(islice(SurfaceScene(dtype=dtype)(), 60, None))
    assert ping.amplitude.dtype == np.dtype(dtype)
    assert (ping.amplitude == top).mean() < 1e-3
    assert 5.0 < np.median(ping.amplitude) < top / 10


@pytest.mark.parametrize("sequence", ["buoys-and-blocks", "inflatable-and-sailboat", "random"])
def test_truth_velocity_is_the_derivative_of_truth_position(sequence):
    scene = SurfaceScene(sequence=sequence, n_boats=2, yaw_deg=4.0, yaw_period_s=11.0, speed_mps=0.5)
    stage = scene._stage()
    for time_s in (3.0, 41.5, 90.25):
        before, now, after = (stage.states(time_s + h) for h in (-1e-4, 0.0, 1e-4))
        assert_allclose(now[:, 2:], (after - before)[:, :2] / 2e-4, atol=1e-5)


def test_truth_holds_what_is_inside_the_sector():
    for ping, truth in islice(SurfaceScene(sequence="buoys-and-blocks")(), 0, 400, 57):
        distance, bearing = to_polar(truth.state[:, :2])
        assert (distance < 200.0).all()
        assert (np.abs(np.rad2deg(bearing)) <= 29.25).all()
        assert len(set(truth.target_id.tolist())) == len(truth)
        assert ping.seq == truth.seq


def test_nav_is_exact_still_things_stay_where_they_are_in_the_world():
    seen = [
        sensor_pose(ping.nav, ping.mount).to_ned(place_of(truth, BUOY))
        for ping, truth in SurfaceScene(pings=12, yaw_deg=5.0, speed_mps=0.8)()
    ]
    assert_allclose(seen, np.broadcast_to(seen[0], (12, 2)), atol=1e-9)


@pytest.mark.parametrize("sequence", ["buoys-and-blocks", "inflatable-and-buoy"])
def test_truth_in_the_world_is_that_of_the_sensor_placed_by_its_pose(sequence):
    given = {"sequence": sequence, "pings": 40, "yaw_deg": 6.0, "speed_mps": 0.7}
    places = []
    for (ping, here), (_, there) in zip(
        SurfaceScene(**given)(), SurfaceScene(truth_frame="ned", **given)(), strict=True
    ):
        assert (here.frame, there.frame) == ("sensor", "ned")
        assert here.target_id.tolist() == there.target_id.tolist()
        assert here.class_name == there.class_name
        pose = sensor_pose(ping.nav, ping.mount)
        assert_allclose(pose.to_ned(here.state[:, :2]), there.state[:, :2], atol=1e-9)
        places.append((ping.stamp_ns * 1e-9, place_of(there, BUOY), there.state[there.target_id == BUOY, 2:]))
    (t0, first, _), (t1, last, velocity) = places[0], places[-1]
    assert_allclose((last - first) / (t1 - t0), velocity[0], atol=0.02)  # over ground: it lies still


def test_nav_velocity_is_in_the_body_frame_and_nav_can_be_left_out():
    for ping, _ in SurfaceScene(pings=6, yaw_deg=20.0, speed_mps=0.5)():
        yaw, (ahead, starboard, _) = ping.nav.attitude_rad[2], ping.nav.velocity_mps
        north = ahead * np.cos(yaw) - starboard * np.sin(yaw)
        east = ahead * np.sin(yaw) + starboard * np.cos(yaw)
        assert_allclose([north, east], [0.5, 0.0], atol=1e-12)
        assert (ping.nav.seq, ping.nav.stamp_ns) == (ping.seq, ping.stamp_ns)
    assert next(SurfaceScene(nav=False)()).ping.nav is None


def test_yaw_moves_still_things_in_the_image():
    bearings = [
        to_polar(place_of(truth, BUOY))[1]
        for _, truth in SurfaceScene(pings=40, yaw_deg=3.0, speed_mps=0.0)()
    ]
    assert np.rad2deg(np.ptp(bearings)) == pytest.approx(6.0, abs=1.2)


def stage_with(thing):
    parts = scatterers([thing], 0.05, np.random.default_rng(0))
    stage = SurfaceScene(sequence="empty", n_ranges=500)._stage()
    return replace(stage, things=(thing,), scatterers=parts)


def test_a_steady_echo_in_clutter_is_rician():
    # |c + s|^2 has mean 1 + S and variance 1 + 2 S, S = 100
    stage = stage_with(SceneObject(1, "point", TimedPath.still(10.01, 0.0), snr_db=20.0, coherence=1.0))
    images = [stage.image(0.0, np.random.default_rng(k)) for k in range(600)]
    power = (np.stack([image[200, 19] for image in images]) / stage.water.range_gain[200, 0]) ** 2
    assert power.mean() == pytest.approx(101.0, rel=0.03)
    assert power.var() == pytest.approx(201.0, rel=0.25)


def test_an_extended_thing_is_brighter_on_its_near_side():
    stage = stage_with(SceneObject(1, "buoy", TimedPath.still(15.0, 0.0), 6.0, 6.0, 25.0))
    image = sum(stage.image(0.0, np.random.default_rng(k)).astype(float) ** 2 for k in range(20))
    near, far = image[240:300].sum(), image[300:360].sum()
    assert 1.4 < near / far < 5.0  # 2.2, were all scatterers alike
    assert image[180:235].mean() < 0.2 * image[240:360].mean()


@pytest.mark.parametrize(("distance", "bearing_deg"), [(3.0, 0.0), (20.02, -12.3), (21.0, 28.6), (24.9, 7.5)])
def test_a_point_echo_lies_in_its_cell_and_its_beam(distance, bearing_deg):
    north, east = distance * np.cos(np.deg2rad(bearing_deg)), distance * np.sin(np.deg2rad(bearing_deg))
    stage = stage_with(SceneObject(1, "point", TimedPath.still(north, east), snr_db=40.0, coherence=1.0))
    amplitude = stage.image(0.0, np.random.default_rng(1))
    row, column = np.unravel_index(amplitude.argmax(), amplitude.shape)
    assert abs(stage.sonar.range_m[row] - distance) <= 0.025 + 1e-9
    assert abs(np.rad2deg(stage.sonar.beams_rad[column]) - bearing_deg) <= 0.75 + 1e-9
    clutter = np.sqrt((amplitude.astype(float)[row - 10 : row] ** 2).mean())
    off = bearing_deg - np.rad2deg(stage.sonar.beams_rad[column])
    lobe_db = -12.04 * (off / 1.5) ** 2
    assert 20.0 * np.log10(amplitude.max() / clutter) == pytest.approx(40.0 + lobe_db, abs=1.0)


def test_extended_echoes_lie_on_their_things():
    scene = SurfaceScene(sequence="random", n_objects=6, n_boats=0, snr_offset_db=25.0, seed=11)
    for ping, truth in islice(scene(), 0, 60, 20):
        for number in truth.target_id:
            distance, bearing = to_polar(place_of(truth, number))
            near = np.abs(ping.range_m - distance) < 2.0
            patch = np.where(near[:, None], ping.amplitude.astype(float) ** 2, 0.0)
            patch[:, np.abs(ping.bearing_rad - bearing) > 0.08] = 0.0
            patch -= 30.0 * np.median(patch[near])
            patch = np.maximum(patch, 0.0)
            at = (patch.sum(axis=1) @ ping.range_m) / patch.sum()
            of = (patch.sum(axis=0) @ ping.bearing_rad) / patch.sum()
            assert abs(at - distance) < 1.0  # things of 0.5 to 3 m, brighter on the near side
            assert abs(of - bearing) < np.deg2rad(0.75) + 1.0 / distance


def test_empty_is_rayleigh_at_every_range():
    stack = np.stack([ping.amplitude for ping, _ in SurfaceScene(sequence="empty", pings=20)()]).astype(float)
    band = stack.transpose(1, 0, 2).reshape(1000, -1)
    ratio = band.mean(axis=1) / band.std(axis=1)
    assert ratio.mean() == pytest.approx(1.913, abs=0.01)
    assert np.abs(ratio - 1.913).max() < 0.25


@pytest.mark.parametrize("pfa", [1e-2, 1e-3])
def test_false_alarms_in_rayleigh_clutter_are_what_theory_says(pfa):
    hits = [cfar(ping.amplitude, pfa).mean() for ping, _ in SurfaceScene(sequence="empty", pings=10)()]
    assert np.mean(hits) == pytest.approx(pfa, rel=4.0 / np.sqrt(pfa * 390_000) + 0.03)


def test_k_clutter_gives_many_more_false_alarms():
    hits = [
        cfar(ping.amplitude, 1e-4).mean()
        for ping, _ in SurfaceScene(sequence="empty", pings=4, clutter="k")()
    ]
    assert np.mean(hits) > 1e-3


def test_measured_clutter_is_what_was_measured():
    given = [ping for ping, _ in SurfaceScene(sequence="empty", pings=60, clutter="measured")()]
    stack = np.stack([ping.amplitude for ping in given])
    assert stack.dtype == np.uint8
    near = stack[:, :200].astype(float)
    assert near.mean() / near.std() == pytest.approx(0.61, abs=0.02)
    assert stack[:, :40].mean() == pytest.approx(4.4, abs=0.25)
    assert stack[:, -40:].mean() == pytest.approx(1.5, abs=0.12)
    assert 0.3 < (stack == 0).mean() < 0.6
    beams = stack.mean(axis=(0, 1))
    assert beams.std() / beams.mean() > 0.1
    assert_allclose(stack[:30].mean(axis=(0, 1)), stack[30:].mean(axis=(0, 1)), rtol=0.05)
    interval = np.diff([ping.stamp_ns for ping in given]) * 2e-9
    assert interval.std() > 0.01
    assert interval.max() > 1.9
    assert interval.min() > 0.89


def test_clutter_and_intervals_can_be_chosen_apart():
    stamps = [p.stamp_ns for p, _ in SurfaceScene(pings=9, clutter="measured", uneven_pings=False)()]
    assert set(np.diff(stamps)) == {500_000_000}
    stamps = [p.stamp_ns for p, _ in SurfaceScene(pings=9, uneven_pings=True)()]
    assert len(set(np.diff(stamps))) > 4


def test_the_wake_of_sequence_two_grows_as_in_the_paper():
    for seq, shortest, longest in ((47, 8.0, 12.0), (161, 20.0, 35.0)):
        (ping, truth), stage = ping_at(SurfaceScene(), seq)
        boat, trail = stage.wakes[0]
        way = trail.alive(boat.path, seq * 0.5)[0][::50]
        assert shortest < np.hypot(*np.diff(way, axis=0).T).sum() < 2.2 * longest
        points = found(ping)
        wake = points[np.hypot(*(points - place_of(truth, BUOY)).T) > 3.0]
        assert shortest * 0.7 < np.ptp(wake[:, 1]) < longest
        assert len(points) > (100 if seq == 47 else 280)


@pytest.mark.parametrize(("seq", "seed"), [(80, 0), (161, 1), (220, 2)])
def test_a_wake_fills_the_strip_at_its_end(seq, seed):
    (ping, truth), _ = ping_at(SurfaceScene(seed=seed), seq)
    arm = found(ping) - place_of(truth, INFLATABLE)
    distance, angle = np.hypot(*arm.T), np.arctan2(arm[:, 1], arm[:, 0])
    for length, least in ((15.0, 50), (7.5, 33)):
        inside = angle[distance <= length]
        wedge = np.deg2rad(np.arange(0, 360, 10))[:, None]
        off = np.abs((inside - wedge + np.pi) % (2.0 * np.pi) - np.pi)
        counts = (off <= np.deg2rad(10.0)).sum(axis=1)
        assert counts.max() > least
        assert counts.max() > 5.0 * counts.mean()


def test_both_things_of_sequence_two_are_seen_throughout_and_pass_close():
    stage = SurfaceScene()._stage()
    states = np.stack([stage.states(0.5 * k)[:, :2] for k in range(280)])
    assert stage.sonar.sees(states.reshape(-1, 2)).all()
    gap = np.hypot(*(states[:, 1] - states[:, 0]).T)
    assert 3.0 < gap.min() < 4.2
    behind = states[gap.argmin()]
    assert np.hypot(*behind[1]) > np.hypot(*behind[0])


def test_the_five_things_of_sequence_one_come_into_view_one_by_one():
    stage = SurfaceScene(sequence="buoys-and-blocks")._stage()
    seen = np.stack([stage.sonar.sees(stage.states(0.5 * k)[:, :2]) for k in range(600)])
    known, pier = seen[:, :5], seen[:, 5:]
    assert known[0].tolist() == [True, False, False, False, False]
    assert not pier[0].any()
    assert known[450:590].all()
    flips = np.abs(np.diff(pier.astype(int), axis=0)).sum(axis=0)
    assert flips.max() >= 4  # yaw makes pillars come and go


def test_the_sail_boat_shows_up_in_the_last_third_and_meets_the_inflatable():
    stage = SurfaceScene(sequence="inflatable-and-sailboat")._stage()
    states = np.stack([stage.states(0.5 * k)[:, :2] for k in range(480)])
    seen = stage.sonar.sees(states.reshape(-1, 2)).reshape(480, 3)
    assert seen[:, :2].all()
    assert 280 < np.flatnonzero(seen[:, 2])[0] < 340
    assert seen[340:, 2].all()
    assert 2.0 < np.hypot(*(states[:, 2] - states[:, 1]).T).min() < 4.5


@pytest.mark.parametrize("seq", [0, 9, 19])
def test_the_passenger_boat_is_loud_in_its_beam_and_its_neighbours(seq):
    (ping, truth), _ = ping_at(SurfaceScene(sequence="passenger-boat"), seq)
    level = np.median(ping.amplitude, axis=0)
    loud = np.flatnonzero(level > 1.5 * np.median(level))
    distance, bearing = to_polar(place_of(truth, 1))
    beam = int(np.argmin(np.abs(ping.bearing_rad - bearing)))
    assert level.argmax() == beam
    assert 1 <= loud.size <= 4
    assert np.ptp(loud) == loud.size - 1
    thirds = np.array_split(ping.amplitude[:, beam].astype(float) / np.median(level), 3)
    assert np.median(thirds[2]) > 2.0 * np.median(thirds[0])
    hull = np.abs(ping.range_m - distance) < 2.0
    assert ping.amplitude[hull, beam].max() > 3.0 * np.median(ping.amplitude[hull, beam])


def test_echoes_obey_the_snr_offset():
    quiet, loud = (ping_at(SurfaceScene(snr_offset_db=db), 161)[0].ping for db in (-60.0, 0.0))
    assert cfar(quiet.amplitude, 1e-6).sum() < 3
    assert cfar(loud.amplitude, 1e-6).sum() > 280


def test_a_random_scene_places_as_many_things_as_asked_inside_the_sector():
    for seed in range(5):
        scene = SurfaceScene(sequence="random", n_objects=3, n_boats=2, seed=seed, speed_mps=0.0, yaw_deg=0.0)
        stage = scene._stage()
        middle = stage.states(len(scene) / 2.0 / 2.0)
        assert stage.sonar.sees(middle[:, :2]).all()
        assert [thing.class_name for thing in stage.things] == ["object"] * 3 + ["boat"] * 2
    ping, truth = next(SurfaceScene(sequence="random", n_objects=0, n_boats=0)())
    assert len(truth) == 0
    assert ping.amplitude.shape == (1000, 39)
