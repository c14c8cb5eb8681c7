"""The tracker as a node: starting, keeping and ending tracks, frames, order, gaps, snapshots, bad input."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_flow import Detections, Mount, NavState, Tracks, View
from fls_flow.geometry import Pose
from fls_flow.kernels import compiled
from fls_flow.testing import check_node
from fls_trackers.jpda import Jpda, fls_node

Make = Callable[..., Detections]
TENTATIVE, CONFIRMED, LOST = 0, 1, 2
BOX: dict[str, Any] = {"preset": "paper"}


def same(a: Tracks, b: Tracks) -> bool:
    names = ("id", "status", "state", "covariance", "hits", "age")
    return all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in names)


def confirmed(tracks: Tracks) -> Tracks:
    return tracks.select(tracks.status == CONFIRMED)


def test_kind_and_port_types() -> None:
    assert fls_node() is Jpda
    assert Jpda.__call__.__annotations__ == {"detections": "Detections", "return": "Tracks"}


@pytest.mark.parametrize("settings", [{}, BOX, {"frame": "ned"}])
def test_the_contract_of_nodes(observe: Make, settings: dict[str, Any]) -> None:
    check_node(Jpda(**settings), [{"detections": ping} for ping in scene(observe, 1)])


def test_a_function_without_a_file_is_compiled_all_the_same() -> None:
    place: dict[str, Any] = {}
    exec("def plus_one(x):\n    return x + 1", place)
    assert compiled(place["plus_one"])(1) == 2


# --- starting -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("seen", "starts"), [(15, 0), (16, 1)])
def test_the_box_needs_16_of_20_pings(detections: Make, seen: int, starts: int) -> None:
    tracker = Jpda(**BOX)
    for k in range(20):
        there = k >= 20 - seen
        tracks = tracker(detections(k, [30.0] if there else [], [0.1] if there else []))
    assert confirmed(tracks).id.tolist() == [1] * starts


def test_many_detections_in_one_ping_start_nothing(detections: Make) -> None:
    tracker = Jpda(**BOX)
    spread = np.linspace(-1.0, 1.0, 16)
    for k in range(20):
        hot = k in (3, 19)
        tracks = tracker(detections(k, 30.0 + spread if hot else [], spread / 60 if hot else []))
    assert len(tracks) == 0


def test_a_started_box_track_has_the_printed_covariance(detections: Make) -> None:
    tracker = Jpda(**BOX, sigma_d_m=0.05, sigma_delta_deg=1.5)
    for k in range(16):
        tracks = tracker(detections(k, 40.0, 0.0))
    P = tracks.covariance[0]
    across = 40.0**2 * np.exp(-2 * np.deg2rad(1.5) ** 2) * np.sinh(np.deg2rad(1.5) ** 2)
    assert P[1, 1] == pytest.approx(5 * across, rel=0.01)
    assert P[2, 2] == pytest.approx(5 * (5.0 / (20 * 0.5)) ** 2)
    assert tracks.state[0, 2:].tolist() == [0.0, 0.0]
    assert (tracks.hits[0], tracks.age[0]) == (1, 0)


def test_two_boxes_in_one_ping_start_two_tracks_but_one_per_object(detections: Make) -> None:
    tracker = Jpda(**BOX, sigma_d_m=0.3)
    for k in range(16):
        tracks = tracker(detections(k, [30.0, 30.1, 20.0], [0.1, 0.1, -0.3]))
    assert tracks.id.tolist() == [1, 2]
    assert_allclose(sorted(np.hypot(*tracks.state[:, :2].T)), [20.0, 30.1], atol=0.11)


@pytest.mark.parametrize(("seen", "status"), [(4, TENTATIVE), (5, CONFIRMED)])
def test_gate_initiation_confirms_5_of_8(detections: Make, seen: int, status: int) -> None:
    tracker = Jpda()
    for k in range(8):
        there = k == 0 or k > 8 - seen
        tracks = tracker(detections(k, [30.0] if there else [], [0.1] if there else []))
    if seen == 4:
        assert CONFIRMED not in tracks.status
    else:
        assert tracks.id.tolist() == [1]
        assert tracks.status.tolist() == [status]
        assert (tracks.hits[0], tracks.age[0]) == (5, 7)


def test_a_tentative_track_that_is_not_seen_again_ends_unseen(detections: Make) -> None:
    tracker = Jpda()
    seen = [len(tracker(detections(k, [30.0] if k == 0 else [], [0.0] if k == 0 else []))) for k in range(5)]
    assert seen == [1, 1, 1, 1, 0]


def test_a_low_score_delays_confirmation(detections: Make) -> None:
    first: dict[float, int] = {}
    for score in (0.0, 8.0, 40.0):
        tracker = Jpda(start_score=score, clutter="paper", p_fa=0.05)
        for k in range(60):
            if CONFIRMED in tracker(detections(k, 30.0, 0.1)).status:
                first[score] = k
                break
    assert first[0.0] == 4
    assert first[0.0] < first[8.0] < first[40.0]


def test_ambiguous_candidates_start_no_track_but_single_ones_do(detections: Make) -> None:
    candidates = np.linspace(10.0, 45.0, 10)
    for several, starts in ((True, 0), (False, 1)):
        tracker = Jpda()
        for k in range(10):
            r = candidates if several else candidates[:1]
            tracks = tracker(detections(k, r, np.full(r.size, 0.2), kind=1))
        assert len(confirmed(tracks)) == starts
    paper = Jpda(start_from_candidates=True)
    for k in range(10):
        tracks = paper(detections(k, candidates, np.full(10, 0.2), kind=1))
    assert len(confirmed(tracks)) == 10


def test_candidates_update_a_track(detections: Make) -> None:
    tracker = Jpda()
    for k in range(8):
        tracker(detections(k, 30.0, 0.2, kind=2))
    for k in range(8, 40):
        tracks = tracker(detections(k, [12.0, 30.0, 41.0], [0.2, 0.2, 0.2], kind=1))
    assert confirmed(tracks).hits.tolist() == [40]


# --- ending -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("settings", "misses"), [({}, 16), ({"n2": 8}, 13), ({"preset": "paper"}, 13)])
def test_misses_end_a_track_once(detections: Make, settings: dict[str, Any], misses: int) -> None:
    tracker = Jpda(**settings)
    for k in range(40):
        tracks = tracker(detections(k, 30.0, 0.1))
    assert confirmed(tracks).id.tolist() == [1]
    statuses = [tracker(detections(40 + k, [], [])).status.tolist() for k in range(misses + 1)]
    assert statuses == [[CONFIRMED]] * (misses - 1) + [[LOST], []]


def test_ids_are_never_used_again(detections: Make) -> None:
    tracker = Jpda(n1=2, m1=2, start_score=0.0, m2=3, n2=1)
    seen: list[int] = []
    for k in range(30):
        tracks = tracker(detections(k, [30.0] if k % 10 < 5 else [], [0.1] if k % 10 < 5 else []))
        seen += confirmed(tracks).id.tolist()
        assert (np.diff(tracks.id) > 0).all()
    assert sorted(set(seen)) == [1, 2, 3]


def test_an_uncertain_position_ends_a_track(detections: Make) -> None:
    tracker = Jpda(sigma_v_mps2=1.0)
    for k in range(20):
        tracker(detections(k, 30.0, 0.0))
    # After 20 s without a ping: 1/2 * 20^2 * 1 m/s^2 = 200 m.
    lost = tracker(detections(20, [], [], stamp_ns=1_000_000_000 + 30 * 10**9))
    assert lost.status.tolist() == [LOST]


# --- duplicates and crossings -------------------------------------------------------------------------------


def test_a_repeated_track_ends_and_the_older_stays(detections: Make) -> None:
    for merge_pings, left in ((10, [1]), (0, [1, 2])):
        tracker = Jpda(merge_pings=merge_pings, hit="gated")
        for k in range(10):  # two echoes 1.5 m apart that become one
            tracker(detections(k, [30.0, 30.9], [0.1, 0.1]))
        for k in range(10, 70):
            tracks = tracker(detections(k, 30.4, 0.1))
        assert confirmed(tracks).id.tolist() == left


@pytest.mark.parametrize("speed", [0.4, 1.0, 2.0])
@pytest.mark.parametrize("resolved", [True, False])
def test_boat_behind_buoy_keeps_both_ids(detections: Make, speed: float, resolved: bool) -> None:
    # Unresolved: within 2 m of each other both give one detection between them, as clusters do.
    swaps = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        tracker, n = Jpda(), int(40 / speed)
        for k in range(n):
            xy = np.array([[25.0, 0.0], [26.5, -10.0 + speed * 0.5 * k]])
            shown = xy[rng.random(2) < 0.95]
            if not resolved and np.linalg.norm(xy[0] - xy[1]) < 2.0:
                shown = xy.mean(axis=0)[None]
            polar = np.hypot(*shown.T), np.arctan2(shown[:, 1], shown[:, 0])
            noise = rng.standard_normal((2, len(shown)))
            tracks = tracker(detections(k, polar[0] + 0.2 * noise[0], polar[1] + 0.01 * noise[1]))
            if k == 12:
                start = confirmed(tracks)
        end = confirmed(tracks)
        ids = [
            [int(t.id[np.argmin(np.hypot(*(t.state[:, :2] - p).T))]) for p in at]
            for t, at in ((start, [[25.0, 0.0], [26.5, -10.0 + speed * 6.0]]), (end, xy))
        ]
        swaps += ids[0] != ids[1]
    assert swaps <= (0 if speed >= 1.0 else 1)


# --- order, time and frames ---------------------------------------------------------------------------------


def scene(observe: Make, seed: int, pings: int = 60, false: float = 6.0) -> list[Detections]:
    rng = np.random.default_rng(seed)
    start, velocity = (
        np.array([[20.0, -6.0], [30.0, 5.0], [41.0, 0.0]]),
        np.array([[0.1, 0.3], [0.0, 0.0], [-0.3, 0.1]]),
    )
    return [observe(rng, k, start + velocity * 0.5 * k, false=false) for k in range(pings)]


def test_the_order_of_detections_does_not_matter(observe: Make) -> None:
    rng = np.random.default_rng(3)
    straight, shuffled = Jpda(), Jpda()
    for ping in scene(observe, 2):
        a = straight(ping)
        b = shuffled(ping.select(rng.permutation(len(ping))))
        assert a.id.tolist() == b.id.tolist()
        assert a.status.tolist() == b.status.tolist()
        assert_allclose(a.state, b.state, rtol=1e-8, atol=1e-8)


def test_gaps_between_pings_are_bridged_by_time(detections: Make) -> None:
    tracker = Jpda(sigma_d_m=0.05, sigma_delta_deg=0.1)
    t = 0.0
    rng = np.random.default_rng(4)
    for k in range(60):
        t += 5.0 if k == 40 else float(rng.uniform(0.2, 0.8))
        tracks = tracker(detections(3 * k, 10.0 + 0.5 * t, 0.0, stamp_ns=10**9 + int(t * 1e9)))
    assert tracks.id.tolist() == [1]
    assert_allclose(tracks.state[0], [10.0 + 0.5 * t, 0.0, 0.5, 0.0], atol=0.02)


@pytest.mark.parametrize("settings", [{}, BOX, {"clutter": "cell", "frame": "ned"}])
@pytest.mark.parametrize("at", [0, 1, 25])
def test_snapshot_and_restore_go_on_bit_for_bit(observe: Make, settings: dict[str, Any], at: int) -> None:
    nav = NavState(0, 0, (1.0, 2.0, 0.0), (0.0, 0.0, 0.3))
    pings = [replace(p, view=replace(p.view, nav=nav)) for p in scene(observe, 5)]
    first, second = Jpda(**settings), Jpda(**settings)
    for ping in pings[:at]:
        first(ping)
    saved = first.snapshot()
    kept = {name: np.copy(value) if isinstance(value, np.ndarray) else value for name, value in saved.items()}
    expected = [first(ping) for ping in pings[at:]]
    for name, value in kept.items():
        assert np.array_equal(saved[name], value), name  # the snapshot shares no memory
        assert value is None or isinstance(value, (int, float, np.ndarray)), name
        assert not (isinstance(value, np.ndarray) and value.dtype.names), name
    second.restore(saved)
    assert all(same(e, second(ping)) for e, ping in zip(expected, pings[at:], strict=True))
    assert any(CONFIRMED in e.status for e in expected)


def test_outputs_are_not_written_again(observe: Make) -> None:
    tracker = Jpda()
    outputs, copies = [], []
    for ping in scene(observe, 6):
        tracks = tracker(ping)
        outputs.append(tracks)
        copies.append((tracks.state.copy(), tracks.covariance.copy(), tracks.id.copy(), tracks.hits.copy()))
    for tracks, copy in zip(outputs, copies, strict=True):
        assert all(map(np.array_equal, (tracks.state, tracks.covariance, tracks.id, tracks.hits), copy))


def test_covariances_are_symmetric_and_positive(observe: Make) -> None:
    tracker = Jpda()
    for ping in scene(observe, 7, 100, 20.0):
        P = tracker(ping).covariance
        assert (P.transpose(0, 2, 1) == P).all()
        if len(P):
            eigenvalues = np.linalg.eigvalsh(P)
            assert (eigenvalues[:, 0] > -1e-12 * eigenvalues[:, -1]).all()


def navigated(ping: Detections, yaw: float, north: float = 0.0, nav: bool = True) -> Detections:
    state = NavState(ping.seq, ping.stamp_ns, (north, 5.0, 1.0), (0.0, 0.0, yaw)) if nav else None
    return replace(ping, view=replace(ping.view, mount=Mount((1.0, 0.0, 0.5)), nav=state))


def test_yaw_does_not_bend_tracks_in_ned(detections: Make) -> None:
    spread, speed = {}, {}
    for frame in ("sensor", "ned"):
        rng = np.random.default_rng(8)
        tracker = Jpda(frame=frame, sigma_v_mps2=0.3 if frame == "sensor" else None)
        states = []
        for k in range(120):
            yaw, north = 0.15 * np.sin(0.2 * k), 0.05 * k
            pose = Pose(north + np.cos(yaw), 5.0 + np.sin(yaw), yaw)
            x, y = pose.to_sensor([45.0, 9.0])
            r, b = (
                np.hypot(x, y) + 0.1 * rng.standard_normal(),
                np.arctan2(y, x) + 0.008 * rng.standard_normal(),
            )
            tracks = confirmed(tracker(navigated(detections(k, r, b), yaw, north)))
            assert tracks.frame == frame
            states += [tracks.state[0]] if k > 40 else []
        states = np.array(states)
        spread[frame], speed[frame] = states[:, :2].std(axis=0).max(), np.hypot(*states[:, 2:].T).mean()
    assert_allclose(states[:, :2].mean(axis=0), [45.0, 9.0], atol=0.2)
    assert spread["ned"] < 0.2 < 1.0 < spread["sensor"]
    assert speed["ned"] < 0.1


def test_a_ping_without_navigation_only_predicts_tracks(
    detections: Make, caplog: pytest.LogCaptureFixture
) -> None:
    tracker = Jpda(frame="ned")
    for k in range(20):
        before = tracker(navigated(detections(k, 30.0, 0.0), 0.0))
    with caplog.at_level(logging.WARNING, "fls_trackers"):
        for k in range(20, 50):
            unseen = tracker(navigated(detections(k, 30.0, 0.0), 0.0, nav=False))
    assert len(caplog.records) == 1
    assert "position or heading" in caplog.text
    assert unseen.status.tolist() == [CONFIRMED]
    assert unseen.hits.tolist() == before.hits.tolist()
    assert unseen.age[0] == before.age[0] + 30
    assert unseen.covariance[0, 0, 0] > before.covariance[0, 0, 0]
    again = tracker(navigated(detections(50, 30.0, 0.0), 0.0))
    assert again.id.tolist() == [1]
    assert again.hits[0] == before.hits[0] + 1


# --- edges --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{}, BOX, {"frame": "ned"}])
def test_empty_pings_are_answered(detections: Make, settings: dict[str, Any]) -> None:
    tracker = Jpda(**settings)
    for k in range(3):
        tracks = tracker(detections(7 * k, [], []))
        assert (tracks.seq, tracks.stamp_ns, len(tracks)) == (7 * k, 1_000_000_000 + 7 * k * 500_000_000, 0)
    assert len(Jpda()(Detections(1, 2))) == 0


def test_a_view_that_tells_nothing_is_enough(detections: Make) -> None:
    tracker = Jpda()
    for k in range(10):
        tracks = tracker(detections(k, [30.0, 10.0 + 3 * (k % 5)], [0.1, 0.02 * (k % 3)], view=View()))
    assert_allclose(np.hypot(*confirmed(tracks).state[:, :2].T), [30.0], atol=0.1)


@pytest.mark.parametrize("shift", [0, -1])
def test_a_stamp_that_does_not_increase_is_refused(detections: Make, shift: int) -> None:
    tracker = Jpda()
    tracker(detections(0, 30.0, 0.0, stamp_ns=100))
    with pytest.raises(
        ValueError, match=f"seq 1 has stamp {100 + shift} ns, not after the last ping's 100 ns"
    ):
        tracker(detections(1, 30.0, 0.0, stamp_ns=100 + shift))
    assert tracker(detections(2, 30.0, 0.0, stamp_ns=10**9)).age.tolist() == [1]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("field", ["range_m", "bearing_rad"])
def test_detections_that_are_not_finite_are_refused(detections: Make, bad: float, field: str) -> None:
    tracker = Jpda()
    for k in range(3):
        tracker(detections(k, [30.0, 20.0], [0.0, 0.1]))
    before = tracker.snapshot()
    ping = detections(3, [30.0, 20.0], [0.0, 0.1])
    wrong = replace(ping, **{field: np.array([1.0, bad])})
    with pytest.raises(ValueError, match="seq 3: 1 of 2 detections are not finite"):
        tracker(wrong)
    assert all(np.array_equal(value, before[name]) for name, value in tracker.snapshot().items())
    assert tracker(ping).hits.tolist() == [4, 4]


def test_a_huge_ping_is_bounded(observe: Make, caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(9)
    tracker = Jpda(max_tracks=200)
    with caplog.at_level(logging.WARNING, "fls_trackers"):
        for k in range(6):
            tracks = tracker(observe(rng, k, np.zeros((0, 2)), false=5000.0))
            assert len(tracks) <= 200 + np.count_nonzero(tracks.status == LOST)
            assert np.isfinite(tracks.state).all()
    said = sorted(record.getMessage().partition(": ")[2][:20] for record in caplog.records)
    assert said == ["only the strongest d", "tracks share more th"]


def test_only_the_strongest_start_beyond_max_tracks(detections: Make) -> None:
    r = np.linspace(5.0, 45.0, 30)
    tracks = Jpda(max_tracks=3)(detections(0, r, np.zeros(30), amplitude=np.where(r > 40.0, 9.0, 1.0)))
    assert (tracks.state[:, 0] > 40.0).all()
    assert len(tracks) == 3


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("preset", "best"),
        ("frame", "enu"),
        ("sigma_v_mps2", 0.0),
        ("sigma_d_m", -0.1),
        ("sigma_delta_deg", np.nan),
        ("gamma", 0.0),
        ("p_d", 1.0),
        ("p_g", 1.5),
        ("p_fa", 0.0),
        ("clutter", "none"),
        ("initiation", "never"),
        ("hit", "maybe"),
        ("m1", 63),
        ("n1", 9),
        ("n2", 0),
        ("m2", 4),
        ("x_max_m", 0.0),
        ("speed_sd_mps", -1.0),
        ("start_score", np.inf),
        ("max_sd_m", 0.0),
        ("merge_pings", -1),
        ("max_shared", 17),
        ("max_tracks", 0),
    ],
)
def test_bad_parameters_are_named_with_their_value(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name} = '?{value}"):
        Jpda(**{name: value})
