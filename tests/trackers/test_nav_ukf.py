"""The tracker of still objects: synthetic targets and a manoeuvring vehicle, as in Quidu 2010, 6.2."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_flow import Detections, NavState, TrackStatus, View
from fls_flow.testing import check_node
from fls_sources.ground_nav import GroundNav
from fls_sources.ground_scene import GroundScene, GroundView
from fls_trackers.ground_bank import afloat_probability
from fls_trackers.ground_filter import correct, measurement_noise, nearest_tracks, start_groups
from fls_trackers.ground_noise import NoiseEstimate
from fls_trackers.nav_fusion import NavFusion
from fls_trackers.nav_ukf import NavUkf

POSE = {"position_sd_m": 1e-3, "heading_sd_deg": 0.05, "tilt_sd_deg": 0.05, "altitude_sd_m": 0.02}

Scene = list[tuple[GroundView, Detections]]


def joined(scene: GroundScene, nav: GroundNav) -> Scene:
    """Each ping with its true detections, navigation joined to them."""
    fusion, stream, last, out = NavFusion(), iter(nav()), -1, []
    for view in scene():
        samples = []
        while last < view.ping.stamp_ns and (sample := next(stream, None)) is not None:
            samples.append(sample.nav_state)
            last = samples[-1].stamp_ns
        out.append((view, fusion(view.ping, tuple(samples), (), view.detections).detections))
    return out


@pytest.fixture(scope="module")
def manoeuvres() -> list[Scene]:
    """The manoeuvre with four different draws of navigation errors; detections without noise."""
    scene = GroundScene(mode="points", range_sd_m=0.0, bearing_sd_deg=0.0, n_ranges=1000)
    return [joined(scene, GroundNav(seed=seed)) for seed in range(4)]


def noisy(
    scene: Scene, seed: int, range_sd_m: float = 1.0, bearing_sd_deg: float = 1.5
) -> Iterator[tuple[GroundView, Detections]]:
    rng = np.random.default_rng(seed)
    for view, exact in scene:
        yield (
            view,
            replace(
                exact,
                range_m=exact.range_m + range_sd_m * rng.standard_normal(len(exact)),
                bearing_rad=exact.bearing_rad + np.deg2rad(bearing_sd_deg) * rng.standard_normal(len(exact)),
            ),
        )


def errors(pings: Any, tracker: NavUkf) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Errors (pings, 2 targets, 2), NEES (pings, 2), raw errors (pings, 2, 2); how many tracks were lost.

    Which track follows which target is decided in the first ping.
    """
    apart, nees, raw, lost = [], [], [], 0
    order = np.array([0, 1])
    for view, detections in pings:
        tracks = tracker(detections).tracks
        assert tracks.id.tolist() == [1, 2], "a track was lost or a false one began"
        lost += int((tracks.status == TrackStatus.LOST).sum())
        truth = view.truth if tracks.frame == "sensor" else view.truth_ned
        error = tracks.state[order, :2] - truth.state[:, :2]
        if not apart and np.linalg.norm(error) > 15.0:
            order = np.array([1, 0])
            error = tracks.state[order, :2] - truth.state[:, :2]
        P = tracks.covariance[order, :2, :2]
        apart.append(error)
        nees.append(np.einsum("na,nab,nb->n", error, np.linalg.inv(P), error))
        raw.append(detections.position_m - view.truth.state[:, :2])
    return np.array(apart), np.array(nees), np.array(raw), lost


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).sum(axis=-1).mean()))


@pytest.mark.parametrize(("range_sd_m", "step"), [(1.0, "exact"), (2.0, "exact"), (2.0, "euler")])
def test_both_targets_are_kept_through_the_manoeuvre_and_better_known_than_measured(
    manoeuvres, range_sd_m, step
):
    """Paper: works with noise below 2 m. The mean over 12 runs, from ping 20 on."""
    all_errors, all_raw = [], []
    for seed in range(12):
        pings = noisy(manoeuvres[seed % 4], seed, range_sd_m)
        apart, _, raw, lost = errors(pings, NavUkf(frame="sensor", step=step))
        assert lost == 0
        all_errors.append(apart[20:])
        all_raw.append(raw[20:])
    gain = rms(np.array(all_raw)) / rms(np.array(all_errors))
    assert gain > (4.0 if step == "exact" else 2.5), f"{gain:.2f} times better than the measurements"


@pytest.mark.parametrize(
    ("frame", "range_sd_m", "runs"), [("ned", 0.5, 100), ("ned", 1.0, 100), ("ned", 2.0, 100), ("sensor", 2.0, 25)]
)  # fmt: skip
def test_nees_lies_inside_its_bounds_whatever_the_noise(manoeuvres, frame, range_sd_m, runs):
    """Mean of two targets and all runs: 99.9 % of chi-square(4 runs) / (2 runs), at pings far apart.

    The tracker is told nothing of the noise; by ping 15 it has 30 measurements.
    """
    nees = [
        errors(noisy(manoeuvres[k % 4], 5000 + k, range_sd_m), NavUkf(frame=frame, **POSE))[1]
        for k in range(runs)
    ]
    spread = 3.3 * np.sqrt(8.0 * runs) / (2.0 * runs)
    for ping in (15, 25, 35, 45, 55, 64):
        mean = np.array(nees)[:, ping].mean()
        assert abs(mean - 2.0) < spread, f"ping {ping}: {mean:.2f}"


def test_without_navigation_the_same_run_is_clearly_worse(manoeuvres):
    blind = []
    for view, detections in noisy(manoeuvres[0], 3):
        blind.append((view, replace(detections, view=replace(detections.view, nav=None))))
    apart, *_ = errors(noisy(manoeuvres[0], 3), NavUkf(frame="sensor"))
    alone, *_ = errors(blind, NavUkf(frame="sensor"))
    assert rms(alone[20:]) > 2.5 * rms(apart[20:])
    sure = NavUkf(frame="sensor", drift_mps=0.02, drift_dps=0.1)  # as sure of a still scene as of navigation
    ids = {tuple(sure(detections).tracks.id.tolist()) for _, detections in blind}
    assert ids != {(1, 2)}, "it should lose the targets"


def test_noise_is_learnt_and_places_targets_better_than_noise_by_the_innovation(manoeuvres):
    """With twice the noise that was expected; both rules of the paper lose by it."""

    def scores(noise: str) -> tuple[float, float]:
        runs = [
            errors(noisy(manoeuvres[k % 4], k, 2.0), NavUkf(frame="sensor", noise=noise)) for k in range(8)
        ]
        return rms(np.array([one[0][20:] for one in runs])), float(np.mean([one[1][20:] for one in runs]))

    (learnt, nees), (paper, far), (huber, near) = (scores(one) for one in ("adaptive", "paper", "huber"))
    assert learnt < 0.9 * huber < paper
    assert nees < near - 1.0 < far


def test_the_learnt_noise_is_the_true_one_and_a_few_far_measurements_do_not_move_it():
    rng, cell, sd = np.random.default_rng(3), np.array([0.05, 0.026]), np.array([35.0, 0.7])
    truth = np.array([[30.0, 0.1], [24.0, -0.3], [40.0, 0.2]]) / cell
    limits = (np.array([4.0, 0.01]), np.array([4e4, 100.0]))
    for far in (0.0, 0.03):
        noise = NoiseEstimate.guess(np.array([20.0, 1.0]))
        x, P = truth * cell, np.broadcast_to(np.diag([25.0, 0.006]), (3, 2, 2))
        for _ in range(200):
            y = truth + sd * rng.standard_normal((3, 2)) * np.where(rng.random((3, 1)) < far, 10.0, 1.0)
            x, P, noise = noise.corrected(x, P, y, cell, limits, 300.0)
        assert_allclose(np.sqrt(noise.variance_px2), sd, rtol=0.25 if far else 0.1)  # else twice as large
        assert (np.abs(x / cell - truth) < 4.0 * sd / np.sqrt(200.0)).all()


def test_covariances_follow_the_learnt_noise():
    """With a still target and noise that was guessed far too small, P comes to sd^2 / pings."""
    rng, cell, sd = np.random.default_rng(4), np.ones(2), np.array([8.0, 8.0])
    limits = (np.full(2, 1e-2), np.full(2, 1e4))
    noise, x, P = NoiseEstimate.guess(np.ones(2)), np.zeros((2, 2)), np.full((2, 2, 2), 1e4) * np.eye(2)
    for _ in range(100):
        x, P, noise = noise.corrected(x, P, sd * rng.standard_normal((2, 2)), cell, limits, 1e3)
    assert_allclose(P[:, [0, 1], [0, 1]], 0.64, rtol=0.35)


def test_the_learnt_noise_stays_within_its_limits():
    limits = (np.full(2, 4.0), np.full(2, 100.0))
    for spread, bound in ((0.0, 4.0), (1e6, 100.0)):
        noise, rng = NoiseEstimate.guess(np.full(2, 5.0)), np.random.default_rng(0)
        for _ in range(50):
            x, P = np.zeros((4, 2)), np.broadcast_to(1e-9 * np.eye(2), (4, 2, 2))
            *_, noise = noise.corrected(x, P, spread * rng.standard_normal((4, 2)), np.ones(2), limits, 50.0)
        assert_allclose(noise.variance_px2, bound)


@pytest.mark.parametrize(("instrument", "east_deg"), [("ahead", 0.0), ("beams", 0.0), ("beams", 4.0)])
def test_a_sloping_floor_is_used(instrument, east_deg):
    """Two altimeters tell the slope along the course, a DVL all of it; without, targets are placed wrongly."""
    slopes = {"slope_north_deg": 3.0, "slope_east_deg": east_deg, "altitude_m": 6.0}
    scene = GroundScene(mode="points", range_sd_m=0.2, bearing_sd_deg=0.3, **slopes)
    down, ahead = list(GroundNav(**slopes)()), list(GroundNav(ahead_depression_deg=20.0, **slopes)())
    fusion, sloped, level = NavFusion(ahead_depression_deg=20.0), NavUkf(), NavUkf()
    taken = 0
    for view in scene():
        upto = next(k for k, one in enumerate(down) if one.nav_state.stamp_ns >= view.ping.stamp_ns) + 1
        nav, beams = zip(*down[taken:upto], strict=True)
        slant = tuple(one.nav_state for one in ahead[taken:upto]) if instrument == "ahead" else ()
        taken = upto
        seen = beams if instrument == "beams" else ()
        fused = fusion(view.ping, nav, slant, view.detections, seen)
        truth = view.truth_ned.state[:, :2]
        a, b = sloped(fused.detections, fused.floor).tracks, level(fused.detections).tracks
    tilt = np.degrees(np.arctan(-fused.floor.normal[:2] / fused.floor.normal[2]))
    assert_allclose(tilt, [3.0, east_deg], atol=0.5)
    wrong = np.linalg.norm(b.state[:, :2] - truth, axis=1)
    right = np.linalg.norm(a.state[:, :2] - truth, axis=1)
    assert (right < 0.4).all()
    assert wrong.mean() > 2.0 * right.mean()
    assert wrong.max() > 2.0 * right.max()


NAV = NavState(0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 6.0)


@pytest.fixture
def ping_of(view: View, detections: Callable[..., Detections]) -> Callable[..., Detections]:
    """Detections of ping k, half a second apart, from a vehicle at 1 m/s to the north."""

    def make(k: int, range_m: Any = (), bearing_rad: Any = (), nav: NavState | None = NAV) -> Detections:
        moved = None if nav is None else replace(nav, position_m=(0.5 * k, 0.0, 0.0))
        return detections(k, np.array(range_m), np.array(bearing_rad), view=replace(view, nav=moved))

    return make


def test_three_misses_in_a_row_end_a_track_and_it_is_reported_lost_once(ping_of):
    tracker = NavUkf(frame="sensor")
    d = [20.0 - 0.475 * k for k in range(10)]
    for k in range(4):
        tracks = tracker(ping_of(k, [d[k]], [0.0])).tracks
    assert tracks.status.tolist() == [TrackStatus.CONFIRMED]
    assert tracks.hits.tolist() == [4]
    for k in (4, 5):
        assert tracker(ping_of(k)).tracks.status.tolist() == [TrackStatus.CONFIRMED]
    assert tracker(ping_of(6)).tracks.status.tolist() == [TrackStatus.LOST]
    assert not len(tracker(ping_of(7)).tracks)


def test_a_hit_in_time_sets_the_misses_back(ping_of):
    tracker = NavUkf(frame="sensor")
    for k in range(8):
        found = k % 3 == 0 or k < 3
        tracks = tracker(ping_of(k, [20.0 - 0.475 * k] if found else [], [0.0] if found else [])).tracks
    assert tracks.id.tolist() == [1]
    assert tracks.status.tolist() == [TrackStatus.CONFIRMED]


def test_a_track_that_was_never_confirmed_goes_without_a_word(ping_of):
    tracker = NavUkf(frame="sensor")
    tracker(ping_of(0, [20.0], [0.0]))
    assert [len(tracker(ping_of(k)).tracks) for k in (1, 2, 3)] == [1, 1, 0]


def test_measurements_of_one_track_are_averaged_and_far_ones_start_tracks(ping_of):
    tracker = NavUkf(frame="sensor", start_range_px=200.0, start_bearing_px=6.0)
    tracker(ping_of(0, [20.0], [0.0]))
    tracks = tracker(ping_of(1, [18.5, 20.5, 45.0], [-0.02, 0.04, 0.3])).tracks
    assert len(tracks) == 2
    assert_allclose(np.hypot(*tracks.state[0, :2]), 19.5, atol=0.15)
    assert_allclose(np.hypot(*tracks.state[1, :2]), 44.45, atol=0.05)  # the debiased mean


def test_fifteen_metres_bound_the_association():
    tracks = np.array([[10.0, 0.0], [30.0, 0.0]])
    y = np.array([[21.0, 0.0], [10.0, 14.9], [10.0, 15.1], [30.0, 15.0]])
    assert nearest_tracks(tracks, y, 15.0).tolist() == [1, 0, -1, 1]
    assert nearest_tracks(np.zeros((0, 2)), y, 15.0).tolist() == [-1] * 4
    assert nearest_tracks(tracks, np.zeros((0, 2)), 15.0).size == 0


def test_groups_of_starts_have_leaders():
    y = np.array([[0.0, 0.0], [3.0, 0.0], [6.0, 0.0], [7.5, 0.0]])
    assert start_groups(y, 4.0).tolist() == [0, 0, 1, 1]
    assert start_groups(np.zeros((0, 2)), 4.0).size == 0


def test_the_correction_is_the_textbook_one_and_covariances_stay_positive():
    rng = np.random.default_rng(1)
    cell, floor = np.array([0.05, 0.026]), np.array([20.0, 1.0])
    A = rng.standard_normal((50, 2, 2)) * np.array([[2.0], [0.05]])
    P = A @ A.transpose(0, 2, 1)
    x = np.array([30.0, 0.1]) + rng.standard_normal((50, 2)) * [2.0, 0.05]
    y = np.array([30.0, 0.1]) / cell + rng.standard_normal((50, 2)) * [40.0, 2.0]
    got_x, got_P = correct(x, P, y, cell, measurement_noise(y - x / cell, floor, "paper"))
    H = np.diag(1.0 / cell)
    for n in range(50):
        nu = y[n] - H @ x[n]
        R = np.diag(np.maximum(np.abs(nu), floor) ** 2)
        S = H @ P[n] @ H.T + R
        K = P[n] @ H.T @ np.linalg.inv(S)
        assert_allclose(got_x[n], x[n] + K @ nu, rtol=1e-9)
        assert_allclose(got_P[n], P[n] - K @ S @ K.T, rtol=1e-7, atol=1e-12)
    assert (np.linalg.eigvalsh(got_P) > -1e-12).all()


def test_the_noise_has_its_floor_and_grows_with_the_innovation():
    nu, floor = np.array([[5.0, -4.0]]), np.array([20.0, 1.0])
    assert measurement_noise(nu, floor, "paper").tolist() == [[400.0, 16.0]]
    assert measurement_noise(nu, floor, "huber").tolist() == [[400.0, 4.0]]
    assert measurement_noise(nu, floor, "fixed").tolist() == [[400.0, 1.0]]


def test_an_echo_nearer_than_the_floor_is_in_the_water_column_and_said_to_be(ping_of):
    tracker = NavUkf()
    for k in range(30):
        north = np.array([16.0, 24.0]) - 0.5 * k
        down = np.array([1.0, 6.0])  # the first hangs 5 m above the floor
        d, afar = np.hypot(north, down), np.array([0.0, 20.0])
        shown = north > 0.0
        tracks, classes = tracker(ping_of(k, (d + afar)[shown], np.array([0.0, 0.3])[shown]))
        label = dict(zip(classes.track_id.tolist(), classes.label.tolist(), strict=True))
    assert classes.names == ("ground", "water-column")
    assert label[1] == 1
    assert label[2] == 0
    assert_allclose(tracks.state[tracks.id == 1, 0], 16.0, atol=1.0)


def test_probability_of_the_water_column_follows_bayes():
    p = afloat_probability(np.array([0, 1, 2, 1000]))
    assert_allclose(p[:3], [0.1, 0.1 / (0.1 + 0.09), 0.1 / (0.1 + 0.009)])
    assert p[3] == 1.0


def test_without_navigation_uncertainty_grows_and_the_place_in_the_world_stays(ping_of):
    tracker, sensor = NavUkf(), NavUkf(frame="sensor")
    for k in range(4):
        one = ping_of(k, [20.0 - 0.475 * k], [0.1])
        before, flat = tracker(one).tracks, sensor(one).tracks
    lost_link = ping_of(4, nav=None)
    after, wide = tracker(lost_link).tracks, sensor(lost_link).tracks
    assert_allclose(after.state, before.state)
    assert_allclose(wide.state[:, :2], flat.state[:, :2], atol=0.1)
    assert np.trace(wide.covariance[0]) > np.trace(flat.covariance[0]) + 0.9
    assert not len(NavUkf()(ping_of(0, [20.0], [0.0], nav=None)).tracks)


def test_the_covariance_in_the_world_holds_the_pose_of_the_vehicle(ping_of):
    def covariance(**sd: float) -> np.ndarray:
        none = dict.fromkeys(POSE, 0.0)
        return NavUkf(**(none | sd))(ping_of(0, [40.0], [0.2])).tracks.covariance[0, :2, :2]

    bare = covariance()
    ground = np.array([np.sqrt(40.0**2 * np.cos(0.2) ** 2 - 36.0), 40.0 * np.sin(0.2)])
    assert_allclose(covariance(position_sd_m=2.0) - bare, 4.0 * np.eye(2), atol=1e-9)
    across = np.deg2rad(1.0) * np.array([-ground[1], ground[0]])
    assert_allclose(covariance(heading_sd_deg=1.0) - bare, np.outer(across, across), rtol=2e-3)
    down = 0.5 * np.array([-6.0 / ground[0], 0.0])
    assert_allclose(covariance(altitude_sd_m=0.5) - bare, np.outer(down, down), rtol=0.02, atol=1e-9)
    tilted = covariance(tilt_sd_deg=1.0) - bare
    assert (np.linalg.eigvalsh(tilted) > -1e-12).all()
    assert np.trace(tilted) > 1e-3


def test_order_of_detections_does_not_matter(ping_of):
    a, b = NavUkf(), NavUkf()
    for k in range(5):
        d, angle = np.array([20.0, 35.0, 44.0]) - 0.4 * k, np.array([0.0, -0.4, 0.4])
        one = a(ping_of(k, d, angle)).tracks
        other = b(ping_of(k, d[::-1], angle[::-1])).tracks
    assert_allclose(one.state, other.state, rtol=1e-12)
    assert one.id.tolist() == other.id.tolist()


def test_the_number_of_tracks_is_bounded(ping_of):
    tracker = NavUkf(max_tracks=5, start_limit_m=0.1, limit_m=0.2)
    for k in range(3):
        assert len(tracker(ping_of(k, np.linspace(10.0, 45.0, 40), np.zeros(40))).tracks) <= 5


def test_bad_input_is_refused_and_the_state_stays(ping_of):
    tracker = NavUkf(frame="sensor")
    tracker(ping_of(1, [20.0], [0.0]))
    with pytest.raises(ValueError, match="not after the last"):
        tracker(ping_of(1, [20.0], [0.0]))
    with pytest.raises(ValueError, match="detection 1 is at"):
        tracker(ping_of(2, [20.0, np.nan], [0.0, 0.0]))
    assert tracker(ping_of(2, [19.5], [0.0])).tracks.hits.tolist() == [2]


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"frame": "world"}, "frame is 'world'"),
        ({"step": "rk4"}, "step is 'rk4'"),
        ({"noise": "none"}, "noise is 'none'"),
        ({"limit_m": 0.0}, "limit_m is 0.0"),
        ({"misses": 0}, "misses is 0"),
        ({"q_range_m2": -1.0}, "q_range_m2 is -1.0"),
        ({"heading_sd_deg": float("nan")}, "heading_sd_deg is nan"),
        ({"noise_factor": 0.5}, "noise_factor is 0.5"),
        ({"noise_memory": 0}, "noise_memory is 0"),
        ({"max_tracks": 0}, "max_tracks is 0"),
    ],
)
def test_bad_parameters_are_named(parameters, text):
    with pytest.raises(ValueError, match=text):
        NavUkf(**parameters)


@pytest.mark.parametrize("frame", ["sensor", "ned"])
@pytest.mark.parametrize("step", ["exact", "euler"])
def test_the_node_keeps_the_contract(manoeuvres, frame, step):
    pings = [{"detections": one, "floor": None} for _, one in manoeuvres[0][:14]]
    check_node(NavUkf(frame=frame, step=step), pings)
    check_node(NavUkf(frame=frame, step=step))


def test_detections_abeam_and_astern_are_no_cone_angles_and_start_nothing(ping_of, caplog):
    tracker = NavUkf(frame="sensor")
    for k in range(6):
        tracks = tracker(ping_of(k, [20.0, 30.0, 25.0], [0.1, 0.5 * np.pi, -2.5])).tracks
    assert tracks.id.tolist() == [1]
    assert np.hypot(*tracks.state[0, :2]) < 21.0
    assert caplog.text.count("90 degrees") == 1
