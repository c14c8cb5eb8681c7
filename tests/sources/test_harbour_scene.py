"""The simulated harbour: who is there, how it moves and looks, what stands still, the statistics of the water."""

from __future__ import annotations

import math
from itertools import islice

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow.geometry import to_polar
from fls_flow.testing import check_node
from fls_sources.harbour_bodies import Diver, Dolphin, School, Seal
from fls_sources.harbour_bubbles import RISE_MPS, breathing
from fls_sources.harbour_echoes import faced
from fls_sources.harbour_image import blurred, echo_power
from fls_sources.harbour_plan import SPECIES
from fls_sources.harbour_scene import HarbourScene, fls_node

NOBODY = dict.fromkeys(
    ("open_divers", "semi_closed_divers", "closed_divers", "seals", "dolphins", "fish_schools"), 0
)
SMALL = {"n_ranges": 120, "n_beams": 48, "beam_spacing_deg": 1.0, "beamwidth_deg": 1.0, "cell_m": 0.3}


def planned(**parameters):
    scene = HarbourScene(**parameters)
    return scene, scene._plan(scene._sonar(), scene._stamps())


def test_kind_and_contract() -> None:
    assert fls_node() is HarbourScene
    check_node(HarbourScene(pings=6, **SMALL))
    check_node(HarbourScene(pings=6, clutter="measured", uneven_pings=True, **SMALL))
    check_node(HarbourScene(pings=6, clutter="k", dtype="uint16", matched_motion=True, **SMALL))
    check_node(HarbourScene(pings=6, structures=0, matched_echo=True, **NOBODY, **SMALL))


def test_geometry_and_formats() -> None:
    ping, truth = next(HarbourScene()())
    assert ping.amplitude.shape == (400, 256)
    assert ping.amplitude.dtype == np.float32
    assert_allclose(ping.range_m[[0, -1]], [8.05, 47.95])
    assert_allclose(np.degrees(np.ptp(ping.bearing_rad)), 255 * 0.25)
    assert sorted(truth.class_name) == ["diver", "diver", "diver", "dolphin", "fish", "seal"]
    ping, truth = next(HarbourScene(clutter="measured", name_circuits=True)())
    assert ping.amplitude.dtype == np.uint8
    assert {"diver-open", "diver-semi-closed", "diver-closed"} <= set(truth.class_name)
    assert len(HarbourScene(pings=7)) == len(list(HarbourScene(pings=7, **SMALL)())) == 7


def test_a_longer_scene_begins_with_the_same_bits() -> None:
    short = list(HarbourScene(pings=8, stay_s=1.0, **SMALL)())
    long = list(islice(HarbourScene(pings=30, stay_s=1.0, **SMALL)(), 8))
    for (ping, truth), (same, same_truth) in zip(short, long, strict=True):
        assert_array_equal(ping.amplitude, same.amplitude)
        assert_array_equal(truth.state, same_truth.state)
        assert_array_equal(truth.target_id, same_truth.target_id)


def test_seeds_differ_and_equal_seeds_do_not() -> None:
    one, same, other = (next(HarbourScene(seed=seed, **SMALL)()).ping.amplitude for seed in (1, 1, 2))
    assert_array_equal(one, same)
    assert np.mean(one == other) < 0.01


def test_truth_is_in_the_sector_and_its_velocity_is_that_of_the_path() -> None:
    scene, plan = planned(pings=200, seed=4)
    sonar = scene._sonar()
    for stamp in scene._stamps()[:-1:7]:
        time_s = (int(stamp) - scene.start_ns) * 1e-9
        places, _ = plan.present(time_s)
        state = plan.states(time_s + 0.01, places)
        later = plan.states(time_s + 0.02, places)
        assert_allclose((later[:, :2] - state[:, :2]) / 0.01, state[:, 2:4], atol=1e-6)
        assert sonar.sees(state[:, :2]).mean() > 0.6
    for _, truth in islice(HarbourScene(pings=200, seed=4, **SMALL)(), 0, 200, 9):
        r, b = to_polar(truth.state[:, :2])
        assert (np.abs(b) <= math.radians(24.0)).all()
        assert ((r >= 8.0) & (r <= 44.0)).all()


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [("open_divers", 0.3, 0.6), ("seals", 0.6, 1.6), ("dolphins", 1.5, 3.0), ("fish_schools", 0.1, 0.5)],
)
def test_mean_speeds_are_those_of_the_species(kind, low, high) -> None:
    _, plan = planned(pings=4000, stay_s=250.0, **{**NOBODY, kind: 4})
    for place in range(4):
        speed = np.hypot(*plan.path[50:2400, place, 2:4].T)
        # it wanders by up to two thirds, with a memory of some seconds, about a mean within the range
        assert 0.75 * low < speed.mean() < 1.25 * high
        assert 0.05 < speed.std() / speed.mean() < 0.9


def test_matched_motion_draws_all_kinds_from_one_law() -> None:
    _, plan = planned(pings=2400, stay_s=2.0, matched_motion=True, apart_m=0.0)
    by: dict[str, list[tuple[float, float]]] = {}
    for one in plan.visitors:
        by.setdefault(SPECIES[one.kind], []).append((one.gait.speed_mps, one.body.length_m))
    for values in by.values():
        speed, length = np.array(values).T
        assert len(values) > 80
        assert_allclose(speed.mean(), 0.75, atol=0.12)
        assert_allclose(length.mean(), 2.1, atol=0.12)
        assert 0.3 <= speed.min() < speed.max() <= 1.2
        assert 1.6 <= length.min() < length.max() <= 2.6


def test_matched_echo_gives_every_body_the_same_strength() -> None:
    _, plan = planned(pings=400, stay_s=10.0, matched_echo=True)
    totals = [one.echo_gain * one.body.echoes(0.0, 0.0).power.sum() for one in plan.visitors]
    assert_allclose(totals, totals[0])


def test_stays_follow_the_fitted_law_and_swimmers_come_and_go() -> None:
    _, plan = planned(pings=60_000, **{**NOBODY, "closed_divers": 2})
    stay = np.log([one.end_s - one.start_s for one in plan.visitors])
    assert len(stay) > 500
    assert_allclose(np.median(stay), math.log(15.6), atol=0.15)
    assert_allclose(stay.std(), 0.75, atol=0.1)
    ids = [one.target_id for one in plan.visitors]
    assert len(set(ids)) == len(ids)


def test_a_swimmer_that_stays_is_there_for_a_thousand_pings() -> None:
    scene = HarbourScene(pings=1100, stay_s=1000.0, **{**NOBODY, "open_divers": 2}, **SMALL)
    sonar, stamps = scene._sonar(), scene._stamps()
    plan = scene._plan(sonar, stamps)
    for stamp in stamps:
        truth = scene._truth(0, int(stamp), sonar, plan, (int(stamp) - scene.start_ns) * 1e-9)
        assert truth.target_id.tolist() == [1, 2]


def test_swimmers_keep_apart() -> None:
    near = {0.0: 0.0, 8.0: 0.0}
    for wanted in near:
        for seed in range(6):
            divers = {**NOBODY, "open_divers": 4}
            _, plan = planned(pings=2000, stay_s=1000.0, apart_m=wanted, seed=seed, **divers)
            xy = plan.path[100:-20, :, :2]
            distance = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1)[:, *np.triu_indices(4, 1)]
            near[wanted] += np.mean(distance < 3.0)
    assert near[8.0] < 0.5 * near[0.0]


def test_open_circuits_bubble_most_and_closed_ones_not() -> None:
    power = {
        circuit: breathing(circuit, 0.0, 600.0, np.random.default_rng(1)).power.sum()
        for circuit in ("open", "semi-closed", "closed")
    }
    assert power["open"] > 10.0 * power["semi-closed"] > 0.0
    assert power["closed"] == 0.0


def test_bubbles_stay_behind_drift_spread_and_rise_out_of_the_beam() -> None:
    puffs = breathing("open", 0.0, 600.0, np.random.default_rng(2))
    now, current = 300.0, np.array([0.1, 0.0])
    alive = puffs.alive(now)
    release = puffs.release_s[alive]
    assert release.max() <= now
    assert release.min() >= now - puffs.depth_m / RISE_MPS
    origin = np.tile([20.0, 0.0], (release.size, 1))
    place, power = puffs.at(now, origin, current, math.radians(20.0), alive)
    age = now - release
    old = age > 0.6 * age.max()
    assert_allclose((place[old, 0] - 20.0).mean(), (0.1 * age[old]).mean(), atol=0.25)
    assert place[old].std(axis=0).min() > 0.2
    narrow = puffs.at(now, origin, current, math.radians(4.0), alive)[1]
    assert narrow[old].sum() < 0.1 * power[old].sum()


def lengths(body, ages=(0.0, 0.3, 1.1)):
    return [np.ptp(body.echoes(age, 0.0).offset_m[:, 0]) for age in ages]


def test_bodies_are_as_long_as_they_say_and_change_with_their_strokes() -> None:
    rng = np.random.default_rng(0)
    for body in (Diver(2.3, True, rng), Diver(2.3, False, rng), Seal(1.6, rng), Dolphin(2.4, rng)):
        assert_allclose(lengths(body), body.length_m, rtol=0.2)
        before, after = (body.echoes(age, 0.0) for age in (1.0, 1.4))
        assert (
            np.abs(before.offset_m - after.offset_m).max() + np.abs(before.power - after.power).max() > 0.01
        )
    school = School(4.0, rng)
    assert_allclose(lengths(school), 4.0, rtol=0.35)


def test_a_seal_beats_its_hind_end_from_side_to_side() -> None:
    seal = Seal(1.6, np.random.default_rng(4))
    tail, head = [], []
    for age in np.arange(0.0, 20.0, 0.05):
        offset = seal.echoes(float(age), 0.0).offset_m
        tail.append(offset[offset[:, 0] < -0.7, 1].mean())
        head.append(offset[offset[:, 0] > 0.6, 1].mean())
    assert np.std(tail) > 0.05
    assert np.std(head) < 0.2 * np.std(tail)


def test_parts_are_brightest_broadside_and_round_ones_never_change() -> None:
    bearing = np.zeros(4)
    gain = faced(np.array([0.0, np.pi / 4, np.pi / 2, np.nan]), bearing)
    assert_allclose(gain, [0.15, 0.575, 1.0, 1.0])


@pytest.mark.parametrize("looks", [1, 4])
def test_the_echo_of_a_point_has_its_power_in_its_cell(looks) -> None:
    sonar = HarbourScene()._sonar()
    range_m, bearing = sonar.range_m[123], sonar.beams_rad[77]
    place = np.array([[range_m * np.cos(bearing), range_m * np.sin(bearing)]])
    power = echo_power(sonar, place, np.array([9.0]), looks, np.random.default_rng(0)) / looks
    assert np.unravel_index(power.argmax(), power.shape) == (123, 77)
    assert_allclose(power.max(), 9.0, rtol=1e-5)
    # a beamwidth of 0.3 degrees: half power 0.15 degrees off, beams are 0.25 apart
    assert_allclose(power[123, 78] / 9.0, 2 ** (-4 * (0.25 / 0.3) ** 2), rtol=1e-4)
    assert_allclose(power[123, 90] / 9.0, 10**-2.6 * (1.5 / (13 * 0.25 / 0.3)) ** 2, rtol=1e-3)


def test_echoes_of_many_points_add_in_power_on_average() -> None:
    sonar = HarbourScene()._sonar()
    rng = np.random.default_rng(0)
    place = np.array([20.0, 0.0]) + 0.3 * rng.standard_normal((200, 2))
    total = [echo_power(sonar, place, np.full(200, 0.5), 4, rng).sum() / 4 for _ in range(60)]
    alone = sum(echo_power(sonar, one[None], np.array([0.5]), 1, rng).sum() for one in place)
    assert_allclose(np.mean(total), alone, rtol=0.05)


def test_places_outside_the_image_make_no_echo() -> None:
    sonar = HarbourScene()._sonar()
    place = np.array([[2.0, 0.0], [90.0, 0.0]])
    assert not echo_power(sonar, place, np.ones(2), 2, np.random.default_rng(0)).any()
    assert not echo_power(sonar, np.zeros((0, 2)), np.zeros(0), 2, np.random.default_rng(0)).any()


def empty_water(pings: int = 40, **parameters: object) -> np.ndarray:
    still = {"structures": 0, "texture_db": 0.0, "drift_db": 0.0} | parameters
    return np.stack([ping.amplitude for ping, _ in HarbourScene(pings=pings, **NOBODY, **SMALL, **still)()])


@pytest.mark.parametrize("looks", [1, 4])
def test_speckle_is_that_of_its_looks(looks) -> None:
    power = empty_water(looks=looks).astype(float) ** 2
    ratio = power / power.mean(axis=(0, 2), keepdims=True)
    assert_allclose(ratio.std(), looks**-0.5, rtol=0.02)
    assert abs(np.corrcoef(ratio[:-1].ravel(), ratio[1:].ravel())[0, 1]) < 0.01


def test_measured_clutter_has_the_level_and_the_tail_of_a_real_sonar() -> None:
    image = empty_water(clutter="measured", pings=30).astype(float)
    near = image[:, :50]
    assert_allclose(image[:, :2].mean(), 4.4, rtol=0.15)
    assert_allclose(image[:, -2:].mean(), 1.5, rtol=0.15)
    assert_allclose(near.mean() / near.std(), 0.61, atol=0.08)
    pattern = image.mean(axis=(0, 1))
    halves = np.log(image[::2].mean(axis=(0, 1))), np.log(image[1::2].mean(axis=(0, 1)))
    assert 0.05 < np.log(pattern).std() < 0.3
    assert np.corrcoef(*halves)[0, 1] > 0.9  # every beam has its own, and keeps it


def test_texture_and_structures_stand_still_and_the_level_drifts() -> None:
    fixed = {"pings": 300, "drift_db": 0.0, "seed": 2, **NOBODY, **SMALL}
    image = np.stack([ping.amplitude for ping, _ in HarbourScene(**fixed)()]).astype(float)
    first, second = image[:150].mean(axis=0), image[150:].mean(axis=0)
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.95
    assert image.mean(axis=0).max() > 3.0 * np.median(image)
    drifting = [ping.amplitude.mean() for ping, _ in HarbourScene(**(fixed | {"drift_db": 3.0}))()]
    level = 20 * np.log10(drifting)
    assert 0.5 < np.ptp(level) < 6.1
    assert np.abs(np.diff(level)).max() < 0.5


def test_swimmers_stand_out_by_the_snr() -> None:
    scene = {**NOBODY, "closed_divers": 1, "structures": 0, "stay_s": 100.0, "pings": 20, "seed": 6}
    peak = {}
    for snr_db in (10.0, 20.0):
        bright = []
        for ping, truth in HarbourScene(snr_db=snr_db, **scene)():
            r, b = to_polar(truth.state[:1, :2])
            near = np.abs(ping.range_m[:, None] - r) < 1.5
            near = near & (np.abs(ping.bearing_rad[None] - b) * r < 1.5)
            bright.append((ping.amplitude[near].astype(float) ** 2).max())
        peak[snr_db] = 10 * np.log10(np.mean(bright))
    assert_allclose(peak[20.0] - peak[10.0], 10.0, atol=2.0)


def test_uneven_pings_have_gaps() -> None:
    stamps = HarbourScene(pings=300, uneven_pings=True)._stamps()
    interval_s = np.diff(stamps) * 1e-9
    assert_allclose(np.median(interval_s), 0.25, rtol=0.05)
    assert interval_s.max() > 0.45


def test_running_means_are_those_of_a_slow_reference() -> None:
    image = np.random.default_rng(0).normal(size=(9, 7))
    padded = np.pad(image, ((2, 2), (1, 1)), mode="edge")
    slow = [[padded[i : i + 5, j : j + 3].mean() for j in range(7)] for i in range(9)]
    assert_allclose(blurred(image, 2, 1), slow)


@pytest.mark.parametrize(
    ("parameters", "complaint"),
    [
        ({"pings": 0}, "pings is 0"),
        ({"seals": -1}, "seals is -1"),
        ({"snr_db": math.nan}, "snr_db is nan"),
        ({"cell_m": 0.0}, "cell_m is 0.0"),
        ({"stay_s": 0.5}, "stay_s is 0.5"),
        ({"side_lobe_db": 1.0}, "side_lobe_db is 1.0"),
        ({"clutter": "gauss"}, "clutter is 'gauss'"),
        ({"dtype": "int8"}, "dtype is 'int8'"),
        ({"looks": 0}, "looks is 0"),
        ({"ping_interval_s": 0.0}, "ping_interval_s is 0.0"),
        ({"n_beams": 800}, "n_beams times beam_spacing_deg is 200"),
    ],
)
def test_bad_parameters_are_named(parameters, complaint) -> None:
    with pytest.raises(ValueError, match=complaint):
        HarbourScene(**parameters)
