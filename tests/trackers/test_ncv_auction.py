"""The blob tracker: gates, counts, times of blobs, lobes, frames, the contract."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import chi2

from fls_flow import Detections, NavState, Tracks, TrackStatus, View
from fls_flow.geometry import Pose, to_polar, wrap
from fls_flow.testing import check_node
from fls_trackers.ncv_auction import NcvAuction
from fls_trackers.ncv_bank import ROW
from fls_trackers.ncv_lobes import companions, lobe_response
from fls_trackers.ncv_polar import along_arc, polar_noise, residuals, robust_noise
from fls_trackers.ncv_score import turns
from fls_trackers.ncv_steps import predict_each

FloatArray = npt.NDArray[np.float64]
C = 1520.0
VIEW = View(10.0, 300.0, 0.038, np.radians(np.arange(-179.0, 181.0)), np.radians(2.2), C)
PLUS = ((-0.385, 0.0), (0.0, 0.395), (0.405, 0.0), (0.0, -0.405))


def blobs(
    k: int, range_m: npt.ArrayLike, bearing_rad: npt.ArrayLike, amplitude: npt.ArrayLike = 3.0
) -> Detections:
    r = np.atleast_1d(np.asarray(range_m, float))
    b = np.atleast_1d(np.asarray(bearing_rad, float))
    a = np.broadcast_to(np.asarray(amplitude, float), r.shape)
    return Detections(
        k,
        k * 1_000_000_000,
        r,
        b,
        a,
        np.zeros((r.size, 2)),
        np.zeros((r.size, 2, 2)),
        np.zeros(r.size, np.uint8),
        VIEW,
    )


def confirmed(tracks: Tracks) -> Tracks:
    return tracks.select(tracks.status == TrackStatus.CONFIRMED)


def echo_of(k: int, start: FloatArray, velocity: FloatArray) -> tuple[float, float]:
    """Range and bearing of a target when the sound of ping k meets it."""
    delay = 0.0
    for _ in range(5):
        r, b = to_polar(start + velocity * (k + delay))
        delay = float(r) / C
    return float(r), float(b)


def test_confirmed_with_more_than_n_blobs_and_lost_after_too_many_misses():
    tracker = NcvAuction(confirm_hits=4)
    seen = [tracker(blobs(k, 100.0, 0.3)) for k in range(20)]
    assert [len(confirmed(tracks)) for tracks in seen[:6]] == [0, 0, 0, 0, 1, 1]
    after = [tracker(blobs(k, [], [])) for k in range(20, 32)]
    lost = [bool((tracks.status == TrackStatus.LOST).any()) for tracks in after]
    assert lost.index(True) == 7  # the eighth miss of 15 leaves 7 blobs
    assert sum(lost) == 1
    assert len(after[-1]) == 0


@pytest.mark.parametrize("priority", ["none", "score"])
def test_a_view_without_beams_is_answered(priority: str):
    view = View(10.0, 300.0, 0.038)
    tracker = NcvAuction(priority=priority)
    for k in range(4):
        assert tracker(replace(blobs(k, 100.0, 0.3), view=view)).seq == k


def test_young_tracks_count_their_misses_since_birth():
    tracker = NcvAuction()
    tracker(blobs(0, 100.0, 0.0))
    lengths = [len(tracker(blobs(k, [], []))) for k in range(1, 10)]
    assert lengths == [1] * 7 + [0, 0]


def test_the_gate_has_the_probability_asked_for():
    # Errors as the tracker believes: what a new track misses in its second ping is the gate's tail.
    rng = np.random.default_rng(1)
    taken, runs = 0, 3000
    for _ in range(runs):
        tracker = NcvAuction(
            range_sd_m=0.5, bearing_sd_deg=1.0, v_max_mps=1.0, gate_range_m=100.0, gate_bearing_deg=90.0
        )
        start, velocity = np.array([100.0, 0.0]), rng.standard_normal(2)
        for k in range(2):
            r, b = echo_of(k, start, velocity)
            tracks = tracker(
                blobs(k, r + 0.5 * rng.standard_normal(), b + np.radians(1.0) * rng.standard_normal())
            )
        taken += int(tracks.hits.max() == 2)
    assert abs(taken / runs - 0.9) < 4.0 * np.sqrt(0.09 / runs)


def test_the_coarse_gate_comes_first():
    for gate, hits in (({"gate_range_m": 0.5}, 1), ({"gate_bearing_deg": 0.5}, 1), ({}, 2)):
        tracker = NcvAuction(bearing_sd_deg=1.0, **gate)  # type: ignore[arg-type]  # floats
        tracker(blobs(0, 100.0, 0.0))
        assert tracker(blobs(1, 100.7, np.radians(1.0))).hits.max() == hits


def test_velocity_and_position_of_an_exact_target_at_the_stamp():
    start, velocity = np.array([80.0, 200.0]), np.array([-0.8, 0.5])
    tracker = NcvAuction(bearing_sd_deg=0.1, range_sd_m=0.05)
    for k in range(60):
        tracks = tracker(blobs(k, *echo_of(k, start, velocity)))
    assert tracks.state[0, 2:] == pytest.approx(velocity, abs=2e-3)
    # At the stamp, not when the sound met it 0.14 s later (0.13 m on).
    assert tracks.state[0, :2] == pytest.approx(start + 59 * velocity, abs=0.02)


@pytest.mark.parametrize("assignment", ["auction", "hungarian"])
def test_errors_match_covariances(assignment: str):
    q, runs, d2 = 0.05, 60, []
    for run in range(runs):
        rng = np.random.default_rng(run)
        x = np.array([120.0, 20.0, *rng.standard_normal(2)])
        tracker = NcvAuction(
            range_sd_m=0.3,
            bearing_sd_deg=1.0,
            sigma_v_mps2=q,
            v_max_mps=1.0,
            gate_threshold=1e-6,
            assignment=assignment,
        )  # type: ignore[arg-type]  # one of its words
        for k in range(40):
            a = q * rng.standard_normal(2)
            x = np.concatenate([x[:2] + x[2:] + 0.5 * a, x[2:] + a]) if k else x
            delay = np.hypot(*x[:2]) / C
            r, b = to_polar(x[:2] + delay * x[2:])
            tracks = tracker(
                blobs(
                    k,
                    float(r) + 0.3 * rng.standard_normal(),
                    float(b) + np.radians(1.0) * rng.standard_normal(),
                )
            )
        e = tracks.state[0] - x
        d2.append(e @ np.linalg.solve(tracks.covariance[0], e))
    low, high = chi2.ppf([0.001, 0.999], 4 * runs) / runs
    assert low < np.mean(d2) < high


def test_polar_innovations_are_sharp_in_range_however_vague_the_bearing():
    """Ranges and range rates as good as the pulse, though a third of the bearings are those of lobes."""
    runs, off, d2 = 40, [], []
    for run in range(runs):
        rng = np.random.default_rng(run)
        start, velocity = np.array([100.0, 20.0]), 0.4 * rng.standard_normal(2)
        tracker = NcvAuction(
            conversion="polar",
            range_sd_m=0.05,
            bearing_sd_deg=4.0,
            sigma_v_mps2=0.01,
            v_max_mps=0.5,
            gate_threshold=1e-6,
        )
        for k in range(40):
            r, b = echo_of(k, start, velocity)
            noise = rng.standard_normal(2) * [0.05, np.radians(0.7)]
            lobe = np.radians(rng.choice([0.0, 0.0, 0.0, 0.0, -6.0, 6.0]))
            tracks = tracker(blobs(k, r + noise[0], b + noise[1] + lobe))
        x, P = tracks.state[0], tracks.covariance[0]
        truth = start + 39 * velocity
        u = truth / np.hypot(*truth)
        off.append([np.hypot(*x[:2]) - np.hypot(*truth), u @ (x[2:] - velocity)])
        u, e = x[:2] / np.hypot(*x[:2]), x[:2] - truth
        d2.append(
            (e[1] * u[0] - e[0] * u[1]) ** 2
            / (P[0, 0] * u[1] ** 2 + P[1, 1] * u[0] ** 2 - 2 * P[0, 1] * u[0] * u[1])
        )
    assert np.sqrt(np.mean(np.square(off), axis=0)) == pytest.approx([0.0, 0.0], abs=0.06)
    assert np.mean(d2) < 1.6


def test_polar_innovations_and_noise_lie_along_and_across_the_line_of_sight():
    pose = Pose(30.0, -20.0, 0.7)
    position = np.array([[80.0, 40.0], [-10.0, -90.0]])
    r, b = to_polar(pose.to_sensor(position))
    nu = residuals(position, np.stack([r + 0.3, wrap(b + 0.01)], axis=1), pose)
    u = (position - pose.origin_m) / r[:, None]
    left = np.stack([-u[:, 1], u[:, 0]], axis=1)
    np.testing.assert_allclose((nu * u).sum(axis=1), 0.3, atol=1e-9)
    np.testing.assert_allclose((nu * left).sum(axis=1), 0.01 * r, atol=1e-9)
    R = polar_noise(position, 0.1, 0.05, pose)
    np.testing.assert_allclose(np.einsum("ni,nij,nj->n", u, R, u), 0.01)
    np.testing.assert_allclose(np.einsum("ni,nij,nj->n", left, R, left), (0.05 * r) ** 2)
    # Far bearings count less, near ones more; ranges as they were.
    P = np.tile(np.eye(4), (2, 1, 1))
    nu = np.stack([0.1 * left[0], 5.0 * 0.05 * r[1] * left[1]])
    changed = robust_noise(nu, position, P, R, pose)
    np.testing.assert_allclose(np.einsum("ni,nij,nj->n", u, changed, u), 0.01)
    wide = np.einsum("ni,nij,nj->n", left, changed, left) / (0.05 * r) ** 2
    assert wide[0] < 0.2
    assert wide[1] > 2.0


def test_a_correction_across_keeps_range_and_range_rate():
    pose = Pose(5.0, 5.0, 0.0)
    before = np.array([[105.0, 5.0, 0.3, 0.1]])
    after = before + np.array([0.0, 8.0, 0.0, 0.0])
    state, P = along_arc(before, after, np.diag([0.01, 25.0, 1e-4, 0.04])[None], pose)
    off = state[0, :2] - pose.origin_m
    assert np.hypot(*off) == pytest.approx(100.0)
    assert np.arctan2(off[1], off[0]) == pytest.approx(0.08)
    u = off / 100.0
    assert u @ state[0, 2:] == pytest.approx(0.3)
    assert u @ P[0, :2, :2] @ u == pytest.approx(0.01)
    assert u @ P[0, 2:, 2:] @ u == pytest.approx(1e-4)


def test_those_of_high_score_choose_first():
    rows = np.zeros(4, ROW)
    rows["status"] = [
        TrackStatus.TENTATIVE,
        TrackStatus.CONFIRMED,
        TrackStatus.TENTATIVE,
        TrackStatus.TENTATIVE,
    ]
    rows["score"] = [7.0, -5.0, 3.0, 0.0]
    assert [np.flatnonzero(turn).tolist() for turn in turns(rows, "score")] == [[1], [0], [2], [3]]
    assert [np.flatnonzero(turn).tolist() for turn in turns(rows, "confirmed")] == [[1], [0, 2, 3]]
    assert len(turns(rows, "none")) == 1


def test_going_back_undoes_going_on_without_noise():
    rng = np.random.default_rng(2)
    x, A = rng.standard_normal((5, 4)), rng.standard_normal((5, 4, 4))
    P = A @ np.swapaxes(A, 1, 2)
    dt = rng.uniform(0.1, 3.0, 5)
    there = predict_each(x, P, dt, 0.0)
    back = predict_each(*there, -dt, 0.0)
    np.testing.assert_allclose(back[0], x, atol=1e-12)
    np.testing.assert_allclose(back[1], P, atol=1e-10)
    assert (np.linalg.eigvalsh(predict_each(x, P, -dt, 1.0)[1]) > -1e-9).all()


def test_two_crossing_targets_keep_their_tracks():
    tracker = NcvAuction(bearing_sd_deg=1.0, range_sd_m=0.1, confirm_hits=4)
    starts = (np.array([100.0, -12.0]), np.array([100.5, 12.0]))
    speeds = (np.array([0.3, 0.6]), np.array([-0.3, -0.6]))
    rng = np.random.default_rng(3)
    for k in range(40):
        polar = np.array([echo_of(k, s, v) for s, v in zip(starts, speeds, strict=True)])
        order = rng.permutation(2)
        noisy = polar + rng.standard_normal((2, 2)) * [0.05, np.radians(0.3)]
        tracks = tracker(blobs(k, noisy[order, 0], noisy[order, 1]))
        if k == 10:
            first = {int(i): y for i, y in zip(tracks.id, tracks.state[:, 1], strict=True)}
    last = {int(i): y for i, y in zip(tracks.id, tracks.state[:, 1], strict=True)}
    assert len(confirmed(tracks)) == 2
    assert set(last) == set(first)
    assert all(np.sign(first[i]) != np.sign(last[i]) for i in first)


@pytest.mark.parametrize("hydrophones_m", [(), PLUS])
def test_the_mirrored_track_of_a_sparse_array_dies(hydrophones_m: tuple[tuple[float, float], ...]):
    tracker = NcvAuction(confirm_hits=4, hydrophones_m=hydrophones_m)
    lobe = np.radians(60.0)
    if hydrophones_m:
        table = np.radians(np.arange(30.0, 90.0, 0.25))
        response = lobe_response(np.array(PLUS), (31e3, 41e3), C, 0.0 * table, table)
        lobe = float(table[response.argmax()])
    for k in range(25):
        tracks = tracker(blobs(k, [100.0 + 0.3 * k] * 2, [0.0, lobe], [4.0, 1.5]))
        assert len(confirmed(tracks)) <= 1
    assert confirmed(tracks).state[0, 1] == pytest.approx(0.0, abs=1.0)


def test_a_second_target_that_the_array_would_not_show_there_lives():
    table = np.radians(np.arange(20.0, 160.0, 0.5))
    response = lobe_response(np.array(PLUS), (31e3, 41e3), C, 0.0 * table, table)
    null = float(table[response.argmin()])
    tracker = NcvAuction(confirm_hits=4, hydrophones_m=PLUS)
    for k in range(25):
        tracks = tracker(blobs(k, [100.0] * 2, [0.0, null], [4.0, 3.0]))
    assert len(confirmed(tracks)) == 2


def test_lobe_response_is_that_of_delay_and_sum():
    """Against pulses summed in the frequency domain, on a fine grid of times."""
    position, source, beam = np.array(PLUS), np.radians([0.0, 45.0, 10.0]), np.radians([5.0, 49.3, 10.0])
    found = lobe_response(position, (31e3, 41e3), C, source, beam)
    f = np.linspace(31e3, 41e3, 801)
    for one, s, b in zip(found, source, beam, strict=True):
        delay = position @ (np.array([np.cos(s), np.sin(s)]) - np.array([np.cos(b), np.sin(b)])) / C
        t = np.linspace(delay.min(), delay.max(), 201)
        pulse = np.exp(2j * np.pi * f * (t[:, None, None] - delay[:, None])).mean(axis=2)
        assert one == pytest.approx(np.abs(pulse.mean(axis=1)).max(), abs=0.02)
    assert found[2] == pytest.approx(1.0)
    assert found[1] == pytest.approx(0.96, abs=0.02)  # ALGORITHMS of the array: 0.96 at 4.3 degrees from 45


def test_companions_move_alike():
    r, rate = np.array([10.0, 10.3, 10.4, 30.0]), np.array([1.0, 1.1, -1.0, 1.0])
    weaker, stronger = companions(r, rate, np.array([2.0, 1.0, 9.0, 0.0]), np.ones(4, bool), 0.5, 0.3)
    assert (weaker.tolist(), stronger.tolist()) == ([1], [0])


def test_scores_hold_back_tracks_that_clutter_explains():
    def false_tracks(**settings: float) -> int:
        rng = np.random.default_rng(5)
        tracker = NcvAuction(confirm_hits=3, **settings)  # type: ignore[arg-type]  # floats
        ids: set[int] = set()
        for k in range(25):
            n = int(rng.poisson(150))
            tracks = tracker(
                blobs(
                    k,
                    rng.uniform(10.0, 300.0, n),
                    rng.uniform(-np.pi, np.pi, n),
                    np.sqrt(7.0 + rng.exponential(size=n)),
                )
            )
            ids |= set(confirmed(tracks).id.tolist())
        return len(ids)

    assert false_tracks() > 50
    assert false_tracks(confirm_score=12.0, drop_score=-3.0, snr_db=6.0) <= 2


def test_tentative_tracks_of_low_score_are_kept_unsaid():
    plain, quiet = NcvAuction(confirm_hits=4), NcvAuction(confirm_hits=4, report_score=1e9)
    for k in range(8):
        one, other = plain(blobs(k, 100.0, 0.3)), quiet(blobs(k, 100.0, 0.3))
        assert len(other) == (len(one) if k >= 4 else 0)
    assert np.array_equal(one.state, other.state)


def test_in_the_world_frame_own_motion_does_not_bend_tracks():
    tracker = NcvAuction(frame="ned", bearing_sd_deg=1.0, range_sd_m=0.1)
    target = np.array([150.0, 40.0])
    for k in range(40):
        heading, north = 0.02 * k, 0.5 * k
        seen = target - [north, 0.0]
        nav = NavState(k, k, (north, 0.0, 0.0), (0.0, 0.0, heading))
        one = blobs(k, np.hypot(*seen), float(wrap(np.arctan2(seen[1], seen[0]) - heading)))
        tracks = tracker(replace(one, view=replace(VIEW, nav=nav)))
    assert tracks.frame == "ned"
    assert tracks.state[0] == pytest.approx([*target, 0.0, 0.0], abs=0.05)
    unplaced = tracker(blobs(40, 100.0, 0.0))
    assert len(unplaced) == 1
    assert unplaced.age[0] == tracks.age[0] + 1


def test_stamps_must_increase_and_blobs_be_finite():
    tracker = NcvAuction()
    tracker(blobs(1, 100.0, 0.0))
    with pytest.raises(ValueError, match="not after"):
        tracker(blobs(1, 100.0, 0.0))
    with pytest.raises(ValueError, match="finite"):
        tracker(blobs(2, np.nan, 0.0))
    assert tracker(blobs(2, 100.0, 0.0)).hits.tolist() == [2]


def test_memory_is_bounded(caplog: pytest.LogCaptureFixture):
    rng, tracker = np.random.default_rng(6), NcvAuction(max_tracks=50)
    for k in range(5):
        tracks = tracker(blobs(k, rng.uniform(10.0, 300.0, 80), rng.uniform(-3.0, 3.0, 80), rng.random(80)))
        assert len(tracks) <= 50
    assert len(caplog.records) == 1


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {
            "cost": "likelihood",
            "conversion": "polar",
            "priority": "score",
            "snr_db": 6.0,
            "assignment": "hungarian",
            "hydrophones_m": PLUS,
        },
    ],
)
def test_the_contract_is_kept(settings: dict[str, object], observe: Callable[..., Detections]):
    tracker = NcvAuction(confirm_hits=2, **settings)  # type: ignore[arg-type]  # its parameters
    rng = np.random.default_rng(7)
    firings = [{"detections": observe(rng, k, [[20.0, 1.0], [30.0, -2.0]], false=6.0)} for k in range(12)]
    check_node(tracker, firings)
    check_node(NcvAuction)


@pytest.mark.parametrize(
    "bad",
    [
        {"range_sd_m": 0.0},
        {"gate_threshold": 1.0},
        {"keep_hits": 20},
        {"confirm_hits": -1},
        {"p_d": 2.0},
        {"band_hz": (5.0, 2.0)},
        {"assignment": "greedy"},
        {"conversion": "raw"},
        {"lobe_range_m": -1.0},
        {"drop_score": np.inf},
        {"hydrophones_m": ((0.0, 0.0),)},
    ],
)
def test_bad_parameters_are_refused(bad: dict[str, object]):
    with pytest.raises(ValueError, match=next(iter(bad))):
        NcvAuction(**bad)  # type: ignore[arg-type]  # they are wrong
