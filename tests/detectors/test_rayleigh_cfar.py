from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.rayleigh_cfar import RayleighCfar
from fls_flow import BeamMask, DetectionKind, Mount, NavState, Tracks, TrackStatus, Wakes
from fls_flow.geometry import sensor_pose

ECHOES = [(150, 4), (150, 20), (400, 30), (600, 10)]


@pytest.fixture
def scene():
    """Rayleigh clutter with four echoes of two cells."""
    amplitude = np.random.default_rng(21).rayleigh(10.0, (800, 39))
    for row, beam in ECHOES:
        amplitude[row : row + 2, beam] = 150.0
    return amplitude


def tracks_at(
    xy, *, stamp_ns=1_000, velocity=(0.0, 0.0), frame="sensor", status=TrackStatus.CONFIRMED, sd_m=0.3
):
    n = len(xy)
    return Tracks(
        6,
        stamp_ns,
        np.arange(n),
        np.full(n, status),
        np.concatenate([np.asarray(xy, float), np.tile(velocity, (n, 1))], axis=1),
        np.tile(np.diag([sd_m**2, sd_m**2, 0.01, 0.01]), (n, 1, 1)),
        np.ones(n),
        np.ones(n),
        frame,
    )


def wedge_at(apex, orientation, length=15.0):
    return Wakes(6, 0, [apex], [orientation], [length], [np.deg2rad(10)], [0], [True])


def cells(ping, detections):
    rows = np.searchsorted(ping.range_m, detections.range_m)
    return list(
        zip(rows, [int(np.argmin(abs(ping.bearing_rad - b))) for b in detections.bearing_rad], strict=True)
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_each_cell_of_an_echo_is_one_detection_in_order_of_range(scene, make_ping, dtype):
    ping = make_ping(scene.astype(dtype))
    detections = RayleighCfar(pfa=1e-8)(ping)
    assert cells(ping, detections) == sorted((r + k, b) for r, b in ECHOES for k in (0, 1))
    assert (detections.amplitude == 150).all()
    assert (detections.kind == DetectionKind.ECHO).all()
    assert (detections.seq, detections.stamp_ns) == (7, 1_000)
    assert_allclose(detections.covariance[0], np.diag([0.05**2, np.deg2rad(1.5) ** 2]))


def test_shifted_scene_shifts_detections(scene, make_ping):
    ping, shifted = (
        make_ping(scene.astype(np.float32)),
        make_ping(np.roll(scene, (5, 1), (0, 1)).astype(np.float32)),
    )
    a, b = RayleighCfar(pfa=1e-8)(ping), RayleighCfar(pfa=1e-8)(shifted)
    assert_allclose(b.range_m - a.range_m, 5 * 0.05, atol=1e-9)
    assert_allclose(b.bearing_rad - a.bearing_rad, np.deg2rad(1.5), atol=1e-9)


def test_a_falling_bearing_table_gives_the_same_detections(scene, make_ping):
    ping = make_ping(scene.astype(np.float32))
    turned = replace(ping, amplitude=ping.amplitude[:, ::-1], bearing_rad=ping.bearing_rad[::-1])
    wakes, tracks = wedge_at((20.0, 1.0), 0.3), tracks_at([(30.0, 3.0)])
    a, b = (
        RayleighCfar(pfa=1e-2)(ping, None, wakes, tracks),
        RayleighCfar(pfa=1e-2)(turned, None, wakes, tracks),
    )
    assert len(a) > 100
    order = np.lexsort((b.bearing_rad, b.range_m))
    assert_array_equal(a.range_m, b.range_m[order])
    assert_array_equal(a.bearing_rad, b.bearing_rad[order])


def test_noisy_beams_are_neither_tested_nor_reference(scene, make_ping):
    noisy = np.isin(np.arange(39), [19, 20])
    quiet, loud = make_ping(scene.astype(np.float32)), scene.copy()
    loud[:, noisy] *= 20.0
    mask = BeamMask(7, 1_000, noisy, quiet.bearing_rad)
    expected = RayleighCfar(pfa=1e-3)(quiet, mask)
    detections = RayleighCfar(pfa=1e-3)(make_ping(loud.astype(np.float32)), mask)
    assert_array_equal(detections.range_m, expected.range_m)
    assert not np.isin(detections.bearing_rad, quiet.bearing_rad[noisy]).any()


def test_a_mask_of_another_sonar_is_refused(scene, make_ping):
    with pytest.raises(ValueError, match="noisy has 3 beams, the ping has 39"):
        RayleighCfar()(make_ping(scene.astype(np.float32)), BeamMask(7, 0, np.zeros(3, bool), np.zeros(3)))


def target_behind_wake(rng, radial_m):
    """A weak echo with a strong extended one just behind its guard."""
    amplitude = rng.rayleigh(10.0, (800, 39)).astype(np.float32)
    amplitude[400, 19] = 70.0
    first = 400 + int(1.2 / 0.05)
    amplitude[first : first + int(radial_m / 0.05), 18:21] = 200.0
    return amplitude


def test_wakes_of_the_last_ping_do_not_mask_what_stands_before_them(make_ping):
    ping = make_ping(target_behind_wake(np.random.default_rng(3), 3.0))
    target = (400, 19)
    wakes = wedge_at((ping.range_m[400] - 4.0, 0.0), 0.0)
    assert target not in cells(ping, RayleighCfar()(ping))
    found = cells(ping, RayleighCfar()(ping, None, wakes))
    assert target in found
    assert (430, 19) in found  # the wake itself is tested all the same


@pytest.mark.parametrize("frame", ["sensor", "ned"])
def test_tracks_predicted_to_the_ping_do_not_mask_their_neighbours(make_ping, frame):
    nav = NavState(1, 0, (100.0, -50.0, 2.0), (0.0, 0.0, np.deg2rad(40.0)))
    mount = Mount((1.0, 0.5, 0.0), (0.0, 0.0, np.deg2rad(-5.0)))
    ping = make_ping(target_behind_wake(np.random.default_rng(3), 2.0), nav=nav, mount=mount)
    target, dt_s = (400, 19), 0.5
    ping = replace(ping, stamp_ns=ping.stamp_ns + int(dt_s * 1e9))
    here, velocity = np.array([ping.range_m[400] + 2.2, 0.0]), np.array([-8.0, 0.0])
    if frame == "ned":
        pose = sensor_pose(nav, mount)
        velocity = pose.to_ned(velocity) - pose.to_ned([0.0, 0.0])
        here = pose.to_ned(here)
    moving = tracks_at([here - velocity * dt_s], velocity=velocity, frame=frame)
    assert target not in cells(ping, RayleighCfar()(ping))
    assert target in cells(ping, RayleighCfar()(ping, None, None, moving))
    resting = tracks_at([here - velocity * dt_s], frame=frame)
    assert target not in cells(ping, RayleighCfar()(ping, None, None, resting))
    lost = replace(moving, status=np.full(1, TrackStatus.LOST))
    assert target not in cells(ping, RayleighCfar()(ping, None, None, lost))


def test_world_tracks_without_navigation_and_tracks_without_place_exclude_nothing(scene, make_ping):
    ping = make_ping(scene.astype(np.float32))
    expected = RayleighCfar()(ping)
    for given, tracks in (
        (ping, tracks_at([(20.0, 0.0)], frame="ned")),
        (replace(ping, nav=NavState(1, 0)), tracks_at([(20.0, 0.0)], frame="ned")),
        (ping, tracks_at([(np.nan, 0.0)])),
        (ping, tracks_at(np.zeros((0, 2)))),
    ):
        assert_array_equal(RayleighCfar()(given, None, None, tracks).range_m, expected.range_m)


def test_a_wake_that_fills_the_window_is_detected_again_and_again(make_ping):
    """Excluded from the reference, its middle has none within the window: it is taken from farther out."""
    amplitude = np.random.default_rng(4).rayleigh(10.0, (1000, 39)).astype(np.float32)
    amplitude[300:600, 15:25] *= 6.0
    ping = make_ping(amplitude)
    wakes = Wakes(6, 0, [(8.0, 0.0)], [0.0], [25.0], [np.deg2rad(15)], [0], [True])
    middle = (slice(420, 480), slice(17, 22))

    def share(cfar):
        found = np.zeros(amplitude.shape, bool)
        found[tuple(np.transpose(cells(ping, cfar(ping, None, wakes))))] = True
        return found[middle].mean()

    assert share(RayleighCfar(widen_m=0.0)) == 0.0
    assert share(RayleighCfar()) > 0.3


def test_a_track_that_may_be_anywhere_does_not_blind_the_detector(scene, make_ping):
    ping = make_ping(scene.astype(np.float32))
    lost = tracks_at([(22.0, 0.0)], sd_m=100.0)
    assert {(r, b) for r, b in ECHOES} <= set(cells(ping, RayleighCfar()(ping, None, None, lost)))


def test_cells_that_are_invalid_or_not_finite_are_left_out(scene, make_ping):
    holes = np.random.default_rng(5).random(scene.shape) < 0.1
    clean = scene.astype(np.float32)
    broken = np.where(holes, np.random.default_rng(6).choice([np.nan, np.inf, -np.inf], scene.shape), scene)
    expected = RayleighCfar(pfa=1e-3)(make_ping(clean, valid=~holes))
    detections = RayleighCfar(pfa=1e-3)(make_ping(broken.astype(np.float32)))
    assert len(expected) > len(ECHOES)
    assert_array_equal(detections.range_m, expected.range_m)
    assert_array_equal(detections.bearing_rad, expected.bearing_rad)


def test_the_strongest_are_kept_and_the_user_is_warned_once(scene, make_ping, caplog):
    ping = make_ping(scene.astype(np.float32))
    everything, cfar = RayleighCfar(pfa=0.05)(ping), RayleighCfar(pfa=0.05, max_detections=10)
    with caplog.at_level(logging.WARNING):
        kept = cfar(ping)
        again = RayleighCfar(pfa=0.05, max_detections=10)
        again.restore(cfar.snapshot())
        assert_array_equal(again(ping).range_m, kept.range_m)
    assert len(caplog.records) == 1
    assert len(kept) == 10
    assert_array_equal(np.sort(kept.amplitude), np.sort(everything.amplitude)[-10:])
    assert (np.diff(kept.range_m) >= 0).all()


@pytest.mark.parametrize("shape", [(0, 39), (800, 0), (0, 0), (1, 39), (3, 1)])
def test_small_pings_are_answered(make_ping, shape):
    ping = make_ping(np.ones(shape, np.uint8))
    mask = BeamMask(7, 1_000, np.zeros(shape[1], bool), ping.bearing_rad)
    answer = RayleighCfar()(ping, mask, wedge_at((10.0, 0.0), 0.0), tracks_at([(10.0, 0.0)]))
    assert len(answer) == 0
    assert (answer.seq, answer.stamp_ns) == (7, 1_000)


def test_one_beam_is_enough(make_ping):
    amplitude = np.random.default_rng(8).rayleigh(10.0, (400, 1)).astype(np.float32)
    amplitude[200] = 300.0
    ping = make_ping(amplitude)
    assert cells(ping, RayleighCfar()(ping)) == [(200, 0)]
    assert (200, 0) in cells(ping, RayleighCfar()(ping, None, None, tracks_at([(12.0, 0.0)])))


def test_zeros_and_small_integers_stay_silent_and_an_echo_in_them_is_heard(make_ping):
    amplitude = (np.random.default_rng(9).random((500, 39)) < 0.01).astype(np.uint8)
    assert len(RayleighCfar()(make_ping(amplitude))) == 0
    amplitude[250, 12] = 40
    ping = make_ping(amplitude)
    assert cells(ping, RayleighCfar()(ping)) == [(250, 12)]
    assert len(RayleighCfar()(make_ping(np.zeros((500, 39), np.float32)))) == 0


def test_a_scale_of_the_threshold_keeps_the_cells_whose_ratio_exceeds_it(scene, make_ping):
    ping = make_ping(scene.astype(np.float32))
    mask = BeamMask(7, 1_000, np.isin(np.arange(39), [3]), ping.bearing_rad)
    ratio = RayleighCfar(pfa=1e-2).threshold_ratio(ping, mask, wedge_at((20.0, 1.0), 0.3))
    assert np.isnan(ratio[:, 3]).all()
    scale = tuple(np.linspace(0.8, 1.6, 39))
    found = RayleighCfar(pfa=1e-2, threshold_scale=scale)(ping, mask, wedge_at((20.0, 1.0), 0.3))
    rows, beams = np.nonzero(np.nan_to_num(ratio, nan=0.0) > scale)
    assert cells(ping, found) == list(zip(rows, beams, strict=True))
    with pytest.raises(ValueError, match="threshold_scale has 2 entries, the ping has 39 beams"):
        RayleighCfar(threshold_scale=(1.0, 2.0))(ping)
    assert np.isnan(RayleighCfar().threshold_ratio(make_ping(np.ones((1, 39), np.uint8)))).all()


def test_outputs_hold_no_memory_of_the_ping(scene, make_ping):
    ping = make_ping(scene.astype(np.float32))
    detections = RayleighCfar(pfa=0.01)(ping)
    for given in (ping.amplitude, ping.range_m, ping.bearing_rad):
        for out in (
            detections.range_m,
            detections.bearing_rad,
            detections.amplitude,
            detections.view.bearing_rad,
        ):
            assert not np.shares_memory(given, out)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"pfa": 0.0}, "pfa must lie between 0 and 1, not 0.0"),
        ({"pfa": float("nan")}, "not nan"),
        ({"guard_m": -1.0}, "guard_m must be finite and not negative, not -1.0"),
        ({"guard_beams": -1}, "guard_beams .* not -1"),
        ({"widen_m": float("inf")}, "widen_m .* not inf"),
        ({"gate_radius_m": 0.0}, "gate_radius_m 0.0 to gate_limit_m 10.0 is no range"),
        ({"gate_radius_m": 20.0}, "gate_radius_m 20.0 to gate_limit_m 10.0 is no range"),
        ({"min_ref": 0}, "min_ref must be at least 1, not 0"),
        ({"max_ref": 7}, "max_ref must be at least 8 .* not 7"),
        ({"max_ref": 9, "guard_beams": 2}, "max_ref must be at least 10 .* not 9"),
        ({"max_detections": 0}, "max_detections must be at least 1, not 0"),
        ({"floor": -0.5}, "floor .* not -0.5"),
        ({"threshold_scale": -1.0}, "threshold_scale must be positive and finite, not -1.0"),
        ({"threshold_scale": (1.0, 0.0)}, "threshold_scale must be positive and finite, not 0.0"),
    ],
)
def test_bad_parameters_are_named(parameters, text):
    with pytest.raises(ValueError, match=text):
        RayleighCfar(**parameters)
