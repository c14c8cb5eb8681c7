"""Navigation joined to pings by time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_flow import AltimeterBeams, Detections, NavState, Ping
from fls_flow.geometry import rotation
from fls_flow.testing import check_node
from fls_sources.ground_nav import GroundNav
from fls_sources.ground_scene import GroundScene
from fls_trackers.ground_floor import four_beams
from fls_trackers.nav_fusion import NavFusion
from fls_trackers.nav_samples import interpolated, row

NAN = float("nan")
UNKNOWN = (NAN, NAN, NAN)
LEVEL = (0.0, 0.0, 0.0)
S = 1_000_000_000


def ping(t_s: float, nav: NavState | None = None) -> Ping:
    image = np.ones((4, 3), np.float32)
    return Ping(0, round(t_s * S), image, np.arange(1.0, 5.0), np.arange(3.0) - 1.0, nav=nav)


def sample(t_s: float, yaw: float = 0.0, **fields: object) -> NavState:
    whole = NavState(
        0,
        round(t_s * S),
        (2.0 * t_s, -t_s, 3.0),
        (0.1, -0.2, yaw),
        (0.0, 0.0, 0.5),
        (2.0, 0.0, 0.0),
        10.0 + t_s,
    )
    return replace(whole, **fields)


def test_between_two_samples_every_quantity_is_interpolated():
    nav = NavFusion()(ping(1.05), (sample(1.0, 0.0), sample(1.1, 0.05))).ping.nav
    assert_allclose(nav.position_m, (2.1, -1.05, 3.0))
    assert_allclose(nav.attitude_rad, (0.1, -0.2, 0.025))
    assert_allclose(nav.altitude_m, 11.05)
    assert nav.stamp_ns == round(1.05 * S)


def test_angles_take_the_shorter_way_round():
    nav = NavFusion()(ping(1.05), (sample(1.0, 3.1), sample(1.1, -3.1))).ping.nav
    assert abs(abs(nav.attitude_rad[2]) - np.pi) < 1e-9


def test_a_late_sample_is_carried_on_by_velocity_and_rates():
    nav = NavFusion()(ping(1.2), (sample(1.0, 0.3),)).ping.nav
    assert_allclose(nav.attitude_rad[2], 0.3 + 0.2 * 0.5)
    assert nav.position_m[0] > 2.0 + 0.3
    assert_allclose(nav.altitude_m, 11.0)


def test_quantities_from_different_samples_are_joined(caplog):
    fix = NavState(0, round(0.95 * S), position_m=(5.0, 6.0, NAN))
    log = NavState(1, round(0.97 * S), velocity_mps=(1.0, 0.0, NAN))
    compass = NavState(2, round(0.99 * S), attitude_rad=(NAN, NAN, 0.2))
    again = NavState(3, round(1.01 * S), attitude_rad=(NAN, NAN, 0.22))
    deep = NavState(4, round(1.02 * S), altitude_m=7.0)
    nav = NavFusion()(ping(1.0), (fix, log, compass, again, deep)).ping.nav
    assert_allclose(nav.velocity_mps[:2], (1.0, 0.0))
    assert_allclose(nav.attitude_rad[2], 0.21)
    assert_allclose(nav.attitude_rate_radps[2], 1.0)  # nobody gave it: the slope of the heading
    assert_allclose(nav.position_m[:2], (5.0 + 0.05 * np.cos(0.21), 6.0 + 0.05 * np.sin(0.21)))
    assert nav.altitude_m == 7.0
    assert np.isnan(nav.attitude_rad[0])
    assert not caplog.records


def test_navigation_that_is_too_old_is_not_used_and_the_log_says_when(caplog):
    fusion = NavFusion(max_age_s=0.5)
    assert fusion(ping(1.0), (sample(1.0),)).ping.nav.velocity_mps[0] == 2.0
    for t in (1.6, 1.8, 2.0):
        nav = fusion(ping(t)).ping.nav
        assert np.isnan(nav.velocity_mps).all()
        assert np.isnan(nav.altitude_m)
    assert [r.message for r in caplog.records] == [
        "ping seq 0: no velocity and heading and altitude within 0.5 s of it; check the navigation link"
    ]
    assert fusion(ping(2.2), (sample(2.2),)).ping.nav.velocity_mps[0] == 2.0
    assert caplog.records[-1].message == "ping seq 0: navigation is back"
    assert len(caplog.records) == 2


def test_without_any_sample_a_ping_keeps_the_state_that_it_brought():
    brought = sample(0.9)
    fused = NavFusion()(ping(1.0, brought))
    assert fused.ping.nav == brought
    assert fused.floor.height_m == brought.altitude_m


def test_detections_get_the_navigation_of_the_ping():
    one = ping(1.0)
    found = Detections.of(one, range_m=[2.0], bearing_rad=[0.0], amplitude=[1.0])
    fused = NavFusion()(one, (sample(1.0, 0.4),), (), found)
    assert fused.detections.view.nav == fused.ping.nav
    assert fused.detections.range_m.tolist() == [2.0]
    assert len(NavFusion()(one, (sample(1.0),)).detections) == 0


def test_dead_reckoning_comes_back_to_where_the_vehicle_is():
    """Velocity and attitude of the manoeuvre at 20 Hz, without a position: 20 s, 30 m."""
    exact = {"velocity_sd_mps": 0.0, "attitude_sd_deg": 0.0, "rate_sd_dps": 0.0, "altitude_sd_m": 0.0}
    fusion = NavFusion(dead_reckon=True)
    with_position = [one.nav_state for one in GroundNav(**exact, duration_s=20.0)()]
    start = np.array(with_position[0].position_m)
    reckoned = GroundNav(**exact, duration_s=20.0, position=False)()
    for known, (one, _) in zip(with_position, reckoned, strict=True):
        at = replace(ping(0.0), stamp_ns=one.stamp_ns)
        found = np.array(fusion(at, (one,)).ping.nav.position_m)
        assert_allclose(found[:2] + start[:2], known.position_m[:2], atol=0.02)
    assert known.position_m[0] > 29.0


def test_dead_reckoning_takes_log_and_compass_from_samples_of_their_own():
    """NMEA talkers speak in turn: no sample has both."""
    fusion, stamp_ns = NavFusion(dead_reckon=True), 0
    for number in range(120):
        stamp_ns += 100_000_000
        heading = (0.0, 0.0, 0.05 * stamp_ns * 1e-9)
        if number % 2:
            sample = NavState(number, stamp_ns, velocity_mps=(1.0, 0.1, 0.0), altitude_m=6.0)
        else:
            sample = NavState(number, stamp_ns, attitude_rad=heading)
        ping = Ping(number, stamp_ns, np.zeros((2, 2), np.float32), np.array([1.0, 2.0]), np.zeros(2))
        nav = fusion(ping, (sample,)).ping.nav
    t = np.linspace(0.0, 12.0, 2001)
    north = np.trapezoid(np.cos(0.05 * t) - 0.1 * np.sin(0.05 * t), t)
    east = np.trapezoid(np.sin(0.05 * t) + 0.1 * np.cos(0.05 * t), t)
    assert_allclose(nav.position_m[:2], [north, east], atol=0.2)


def test_dead_reckoning_bridges_a_dvl_that_has_lost_the_bottom():
    lost = replace(sample(0.2), velocity_mps=UNKNOWN, altitude_m=NAN)
    fusion = NavFusion(dead_reckon=True)
    level = {"attitude_rad": (0.0, 0.0, 0.0), "position_m": UNKNOWN}
    fusion(ping(0.0), (sample(0.0, **level),))
    fusion(ping(0.2), (replace(lost, **level),))
    nav = fusion(ping(0.4), (sample(0.4, **level),)).ping.nav
    assert_allclose(nav.position_m[:2], (0.8, 0.0), atol=1e-12)


def test_two_altimeters_give_the_floor_and_one_a_level_one():
    below = sample(1.0, attitude_rad=(0.0, 0.0, 0.0), altitude_m=6.0)
    rising = NavState(0, S, altitude_m=8.0)
    fusion = NavFusion(ahead_depression_deg=30.0)
    floor = fusion(ping(1.0), (below,), (rising,)).floor
    slope = (8.0 * 0.5 - 6.0) / (8.0 * np.cos(np.pi / 6.0))
    assert_allclose(floor.normal, np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1.0))
    level = NavFusion()(ping(1.0), (below,)).floor
    assert_allclose(level.normal, (0.0, 0.0, 1.0))
    assert level.height_m == 6.0
    assert not NavFusion()(ping(1.0), (replace(below, altitude_m=NAN),)).floor.known


def beams(
    t_s: float, slope: tuple[float, float], attitude: tuple[float, float, float] = LEVEL
) -> AltimeterBeams:
    """What four beams measure 10 m above a floor that falls by `slope` to north and east."""
    direction = four_beams(np.deg2rad(30.0))
    towards = direction @ rotation(attitude).T @ np.array([-slope[0], -slope[1], 1.0])
    return AltimeterBeams(0, round(t_s * S), direction, 10.0 / towards)


def tilted(t_s: float) -> NavState:
    return sample(t_s, attitude_rad=(0.1, -0.2, 0.7), altitude_m=10.0)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.1, -0.05), (-0.3, 0.2)])
def test_the_beams_of_a_dvl_give_the_whole_slope(slope):
    fused = NavFusion()(ping(1.0), (tilted(1.0),), (), None, (beams(1.0, slope, (0.1, -0.2, 0.7)),))
    normal = np.array([-slope[0], -slope[1], 1.0])
    assert_allclose(fused.floor.normal, normal / np.linalg.norm(normal), atol=1e-9)
    assert_allclose(fused.floor.height_m, 10.0 / np.linalg.norm(normal))


def test_three_beams_are_enough_two_are_not_and_one_wrong_measurement_does_no_harm():
    def floor_of(*seen: AltimeterBeams) -> np.ndarray:
        still = sample(1.0, attitude_rad=LEVEL, attitude_rate_radps=LEVEL)
        return NavFusion()(ping(1.0), (still,), (), None, seen).floor.normal

    true = np.array([-0.1, 0.05, 1.0]) / np.linalg.norm([-0.1, 0.05, 1.0])
    one = beams(1.0, (0.1, -0.05))
    three, two, lost = (
        replace(one, range_m=np.where(np.arange(4) < n, one.range_m, np.nan)) for n in (3, 2, 0)
    )
    assert_allclose(floor_of(three), true, atol=1e-9)
    assert_allclose(floor_of(two), (0.0, 0.0, 1.0))
    assert_allclose(floor_of(lost), (0.0, 0.0, 1.0))
    assert_allclose(floor_of(AltimeterBeams(0, S)), (0.0, 0.0, 1.0))
    line = replace(one, direction=np.array([[s, 0.0, 1.0] for s in (-0.3, -0.1, 0.1, 0.3)]))
    assert_allclose(floor_of(line), (0.0, 0.0, 1.0))
    wrong = replace(one, stamp_ns=round(0.95 * S), range_m=one.range_m * [1.0, 3.0, 1.0, 1.0])
    assert_allclose(floor_of(beams(0.9, (0.1, -0.05)), wrong, one), true, atol=1e-9)


def test_noisy_beams_are_averaged_and_old_ones_forgotten():
    rng, fusion = np.random.default_rng(0), NavFusion(floor_memory_s=1.0)
    apart = []
    for k in range(400):
        slope = (0.1, 0.0) if k < 200 else (-0.1, 0.0)
        true = beams(0.05 * k, slope)
        seen = replace(true, range_m=true.range_m + 0.05 * rng.standard_normal(4))
        fused = fusion(ping(0.05 * k), (sample(0.05 * k, attitude_rad=LEVEL),), (), None, (seen,))
        apart.append(-fused.floor.normal[0] / fused.floor.normal[2] - slope[0])
    settled = np.array(apart[25:200] + apart[225:])
    single = 0.05 / np.cos(np.deg2rad(30.0)) / (2.0 * 10.0 * np.tan(np.deg2rad(30.0)) / np.sqrt(2.0))
    assert settled.std() < 0.45 * single
    assert np.abs(settled).max() < 2.0 * single
    assert NavFusion()(ping(9.0), (sample(9.0),), (), None, (beams(1.0, (0.3, 0.0)),)).floor.slope_rad == 0.0


def test_memory_is_bounded():
    fusion = NavFusion()
    for k in range(2000):
        samples = tuple(sample(0.1 * k + 0.01 * n) for n in range(10))
        fusion(
            ping(0.1 * k), samples, (), None, tuple(beams(0.1 * k + 0.01 * n, LEVEL[:2]) for n in range(10))
        )
    assert len(fusion.snapshot()["samples"]["stamps_ns"]) < 150
    assert len(fusion.snapshot()["slopes"]["stamps_ns"]) < 250


def test_interpolation_of_nothing_is_unknown():
    values = interpolated(np.zeros(0, np.int64), np.zeros((0, 13)), S, 0.5)
    assert np.isnan(values).all()
    assert np.isnan(row(NavState(0, 0, (np.inf, 0.0, 0.0)))[0])


def test_the_error_after_interpolation_is_that_of_the_curvature():
    """20 Hz samples of the manoeuvre joined to 7 Hz pings."""
    exact = {"velocity_sd_mps": 0.0, "attitude_sd_deg": 0.0, "rate_sd_dps": 0.0, "altitude_sd_m": 0.0}
    scene = GroundScene(mode="points", nav=True, ping_rate_hz=7.0, pings=40)
    fusion, stream, last = NavFusion(), GroundNav(**exact)(), -1
    for view in scene():
        samples = []
        while last < view.ping.stamp_ns:
            samples.append(next(stream).nav_state)
            last = samples[-1].stamp_ns
        got, true = fusion(view.ping, tuple(samples)).ping.nav, view.ping.nav
        assert_allclose(got.attitude_rad, true.attitude_rad, atol=1e-4)
        assert_allclose(got.velocity_mps, true.velocity_mps, atol=1e-3)
        assert_allclose(got.position_m, true.position_m, atol=1e-3)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"max_age_s": 0.0}, "max_age_s is 0.0"),
        ({"floor_memory_s": 0.0}, "floor_memory_s is 0.0"),
        ({"ahead_depression_deg": 90.0}, "ahead_depression_deg is 90.0"),
    ],
)
def test_bad_parameters_are_named(parameters, text):
    with pytest.raises(ValueError, match=text):
        NavFusion(**parameters)


@pytest.mark.parametrize("dead_reckon", [False, True])
def test_the_node_keeps_the_contract(dead_reckon):
    check_node(NavFusion(dead_reckon=dead_reckon))
