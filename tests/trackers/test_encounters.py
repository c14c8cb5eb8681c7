"""Tracks that met: the costs by hand, when they exchange, and swimmers that cross within one echo."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_array_equal

from fls_flow import Detections
from fls_flow.testing import check_node
from fls_trackers import encounters as module
from fls_trackers.encounters import MEETING_COLUMNS, PINGS, Scan, encounters
from fls_trackers.life import CONFIRMED, LOST, TENTATIVE
from fls_trackers.nnkf import Nnkf
from fls_trackers.pdaf import Pdaf

FloatArray = npt.NDArray[np.float64]
Make = Callable[..., Detections]
WALK, MEETING_M, AMPLITUDE_SD = (0.25, 0.4), 3.0, 0.5
SLOW, FAST = (0.3, 0.0), (2.0, 0.0)  # velocities
WEAK, STRONG = 5.0, 7.0  # ln(amplitude)


def scan(
    apart_m: float,
    velocity: tuple[tuple[float, float], ...] = (SLOW, FAST),
    level: tuple[float, ...] = (WEAK, STRONG),
    event: tuple[int, ...] = (0, 1),
    status: tuple[int, ...] = (CONFIRMED, CONFIRMED),
) -> Scan:
    """Two tracks, so far from each other."""
    place = np.array([[20.0, 0.0], [20.0, apart_m]])
    return Scan(
        np.array([7, 9]),
        np.array(status),
        np.concatenate([place, np.array(velocity)], axis=1),
        np.tile(0.04 * np.eye(4), (2, 1, 1)),
        np.stack([np.array(level), np.full(2, 50.0)], axis=1),
        np.array(event),
        np.array(level),
    )


def played(scans: list[Scan], amplitude_sd: float = AMPLITUDE_SD) -> tuple[FloatArray, list[list[int]]]:
    table, paths = np.zeros((2, MEETING_COLUMNS)), []
    for one in scans:
        table, path = encounters(table, one, WALK, MEETING_M, amplitude_sd)
        paths.append(path.tolist())
    return table, paths


ALONE, MEETING = [scan(9.0)] * 12, [scan(0.5, event=(0, 0))] * 4
SAME, EXCHANGED = [0, 1], [1, 0]


def test_a_track_that_is_alone_is_known_by_its_means() -> None:
    table, paths = played(ALONE)
    assert paths == [SAME] * 12
    expected = [[*SLOW, np.log(0.3), WEAK, 3.0], [*FAST, np.log(2.0), STRONG, 3.0]]
    np.testing.assert_allclose(table[:, :5], expected, rtol=1e-12)
    assert not table[:, module.OTHER : module.BEGUN].any()


def test_tracks_that_left_with_each_others_swimmer_exchange_after_some_pings() -> None:
    swapped = scan(1.5, velocity=(FAST, SLOW), level=(STRONG, WEAK))
    table, paths = played([*ALONE, *MEETING, *[swapped] * PINGS])
    assert paths[-PINGS:] == [SAME] * (PINGS - 1) + [EXCHANGED]
    assert not table[:, module.OTHER : module.BEGUN].any()
    assert_array_equal(table[:, :2], [SLOW, FAST])  # what they were goes on with their numbers


def test_tracks_that_left_as_they_came_do_not_and_the_meeting_ends() -> None:
    parted = scan(4.0)
    table, paths = played([*ALONE, *MEETING, *[parted] * PINGS])
    assert paths == [SAME] * len(paths)
    assert not table[:, module.OTHER].any()


@pytest.mark.parametrize(
    "after",
    [
        scan(0.5, velocity=(FAST, SLOW), level=(STRONG, WEAK)),  # still as one echo
        scan(1.5, velocity=(FAST, SLOW), level=(STRONG, WEAK), event=(0, 0)),
        scan(1.5, velocity=((1.0, 0.0), (0.8, 0.0)), level=(6.0, 6.0)),  # between both
        scan(1.5, velocity=(FAST, SLOW), level=(STRONG, WEAK), status=(CONFIRMED, TENTATIVE)),
        scan(1.5, velocity=(FAST, SLOW), level=(STRONG, WEAK), status=(LOST, CONFIRMED)),
    ],
)
def test_doubt_changes_nothing(after: Scan) -> None:
    _, paths = played([*ALONE, *MEETING, *[after] * 12])
    assert paths == [SAME] * len(paths)


def test_tracks_that_were_never_alone_are_not_told_apart() -> None:
    _, paths = played([*MEETING, *[scan(1.5, velocity=(FAST, SLOW), level=(STRONG, WEAK))] * 12])
    assert paths == [SAME] * len(paths)


def test_a_track_without_echoes_goes_on_as_the_new_one_beside_it() -> None:
    came = [scan(9.0, status=(CONFIRMED, TENTATIVE))] * 12
    split = scan(1.5, velocity=((1.5, 0.0), SLOW), level=(WEAK, WEAK), event=(-1, 1))
    _, paths = played([*came, *MEETING, *[split] * 12])
    assert EXCHANGED in paths
    assert paths.index(EXCHANGED) == 12 + len(MEETING) + PINGS - 1


def test_the_gain_by_hand() -> None:
    table = np.zeros((2, MEETING_COLUMNS))
    table[:, : module.ALONE_S + 1] = [[0.3, 0.0, np.log(0.3), 5.0, 9.0], [0.9, 0.0, np.log(0.9), 5.4, 9.0]]
    table[:, module.SINCE_S] = 2.0
    table[:, module.HEARD], table[:, module.EVENTS] = [10.6, 15.6], [2.0, 3.0]  # means 5.3 and 5.2
    table[1, module.MISSED] = 2.0
    now = scan(1.5, velocity=((0.7, 0.1), (0.4, 0.0)))
    velocities, levels, misses = (
        np.array([[0.7, 0.1], [0.4, 0.0]]),
        np.array([5.3, 5.2]),
        np.array([0.0, 2.0]),
    )

    def cost(a: int, b: int) -> float:
        before = table[a, :2]
        variance = (0.4**2 + (0.5 * before[0]) ** 2) * 2.0 + 0.04
        off = 0.5 * np.sum((velocities[b] - before) ** 2) / variance
        faster = 0.5 * (np.log(np.hypot(*velocities[b]) / before[0]) / 0.6) ** 2
        return float(
            off + faster + 0.5 * ((levels[b] - table[a, module.LEVEL]) / 0.75) ** 2 + 0.7 * misses[b]
        )

    expected = cost(0, 0) + cost(1, 1) - cost(0, 1) - cost(1, 0)
    assert expected == pytest.approx(
        module._gain((0, 1, 1), module.EXCHANGES[0], table, now, 0.4, 0.5), rel=1e-12
    )


def test_the_order_of_tracks_does_not_matter() -> None:
    scans = [*ALONE, *MEETING, *[scan(1.5, velocity=(FAST, SLOW), level=(STRONG, WEAK))] * PINGS]
    reversed_scans = [
        one._replace(**{name: getattr(one, name)[::-1].copy() for name in Scan._fields[:-1]}) for one in scans
    ]
    table, paths = played(scans)
    mirrored, mirrored_paths = played(reversed_scans)
    assert paths == mirrored_paths
    assert_array_equal(table, mirrored[::-1])


def with_third(
    velocity: tuple[tuple[float, float], ...],
    level: tuple[float, ...],
    event: tuple[int, ...],
    y_m: tuple[float, float, float] = (0.0, 1.5, 3.0),
    status: int = CONFIRMED,
) -> Scan:
    """The two tracks and a third one; their places across."""
    place = np.array([[20.0, y] for y in y_m])
    return Scan(
        np.array([7, 9, 11]),
        np.array([CONFIRMED, CONFIRMED, status]),
        np.concatenate([place, np.array(velocity)], axis=1),
        np.tile(0.04 * np.eye(4), (3, 1, 1)),
        np.stack([np.array(level), np.full(3, 50.0)], axis=1),
        np.array(event),
        np.array(level),
    )


def joined(begun: Scan, then: Scan, pings: int) -> list[list[int]]:
    """The paths after the two met, when a third track begins as in `begun` and all go on as in `then`."""
    table, paths = np.zeros((2, MEETING_COLUMNS)), []
    for one in [*ALONE, *MEETING]:
        table, _ = encounters(table, one, WALK, MEETING_M, AMPLITUDE_SD)
    table = np.concatenate([table, np.zeros((1, MEETING_COLUMNS))])
    for one in [begun, *[then] * pings]:
        table, path = encounters(table, one, WALK, MEETING_M, AMPLITUDE_SD)
        paths.append(path.tolist())
    return paths


def test_the_fast_one_leaves_with_a_new_track_and_the_slow_one_with_its() -> None:
    """The slow one's track is left without echoes, the fast one's follows the slow one, a new one the fast."""
    begun = with_third((SLOW, SLOW, FAST), (WEAK, WEAK, STRONG), (-1, 1, 2), status=TENTATIVE)
    then = with_third((SLOW, SLOW, FAST), (WEAK, WEAK, STRONG), (-1, 1, 2), (0.0, 1.5, 5.0))
    paths = joined(begun, then, 12)
    at = paths.index([1, 2, 0])
    assert all(path == [0, 1, 2] for path in paths[:at] + paths[at + 1 : at + PINGS])


def test_a_new_track_that_began_elsewhere_takes_no_part() -> None:
    far = with_third((SLOW, SLOW, FAST), (WEAK, WEAK, STRONG), (-1, 1, 2), (0.0, 1.5, 9.0), TENTATIVE)
    then = with_third((SLOW, SLOW, FAST), (WEAK, WEAK, STRONG), (-1, 1, 2), (0.0, 1.5, 5.0))
    assert all(path[2] == 2 for path in joined(far, then, 12))


def test_a_track_left_on_what_its_swimmer_let_go_goes_on_with_the_new_one_that_has_it() -> None:
    """The swimmer is stronger and slower than when it was alone: the misses must say more than that."""
    came = [scan(9.0, status=(CONFIRMED, TENTATIVE))] * 12
    on = scan(1.5, velocity=((0.3, 0.3), (0.15, 0.0)), level=(WEAK, WEAK + 1.2), event=(-1, 1))
    _, paths = played([*came, *MEETING, *[on] * 15])
    assert EXCHANGED in paths


@pytest.mark.parametrize("seed", range(20))
def test_the_ways_are_a_permutation_whatever_happens(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 6
    table, ids = np.zeros((n, MEETING_COLUMNS)), np.arange(1, n + 1)
    place, exchanges = rng.uniform(0.0, 6.0, (n, 2)), 0
    for _ in range(80):
        place += 0.3 * rng.standard_normal((n, 2))
        state = np.concatenate([place, rng.choice([0.2, 2.0], (n, 1)) * rng.standard_normal((n, 2))], axis=1)
        status = np.where(rng.random(n) < 0.9, CONFIRMED, TENTATIVE)
        event = np.where(rng.random(n) < 0.7, rng.integers(0, n, n), -1)
        strength = np.stack([rng.choice([WEAK, STRONG], n), np.full(n, 9.0)], axis=1)
        one = Scan(ids, status, state, np.tile(0.04 * np.eye(4), (n, 1, 1)), strength, event, strength[:, 0])
        table, path = encounters(table, one, WALK, MEETING_M, AMPLITUDE_SD)
        assert sorted(path) == list(range(n))
        exchanges += int((path != np.arange(n)).sum())
        born = rng.random(n) < 0.03
        table[born], ids = 0.0, np.where(born, ids + 100, ids)
    assert np.isfinite(table).all()


# --- as nodes -----------------------------------------------------------------------------------------------

DT_S, PINGS_OF_SCENE, MET = 0.25, 96, 40
NODE: dict[str, Any] = {
    "group_m": 0.0, "resolution_m": 3.0, "p_d": 0.9, "sigma_d_m": 0.3, "sigma_delta_deg": 0.5, "extent_sd_m": 0.3,
    "velocity_walk_mps": 0.4, "amplitude_sd": 0.5, "estimate_noise": False, "max_propagate": 15,
}  # fmt: skip


def crossing(detections: Make, seed: int) -> tuple[list[Detections], FloatArray]:
    """A slow swimmer and a fast, stronger one, which turns about within the other's echo: one event then.

    Gives the pings and the way of the slow one (pings, 2).
    """
    rng = np.random.default_rng(seed)
    time_s = DT_S * (np.arange(PINGS_OF_SCENE) - MET)
    slow = np.array([25.0, 0.0]) + np.outer(time_s, [0.0, 0.3])
    bend = rng.uniform(2.0, 4.0)
    before, after = np.array([1.6, 1.0]), 1.9 * np.array([np.cos(bend), np.sin(bend)])
    fast = slow[MET] + np.where(time_s[:, None] < 0.0, np.outer(time_s, before), np.outer(time_s, after))
    scans = []
    for k, place in enumerate(np.stack([slow, fast], axis=1)):
        level = np.array([1.0, 1.8]) * np.exp(0.3 * rng.standard_normal(2))
        if np.hypot(*(place[1] - place[0])) < 1.6:
            place, level = np.average(place, axis=0, weights=level**2)[None], np.array([np.hypot(*level)])
        at = place + 0.25 * rng.standard_normal(place.shape)
        r, b = np.hypot(*at.T), np.arctan2(at[:, 1], at[:, 0])
        scans.append(detections(k, r, b, amplitude=level, stamp_ns=10**9 + round(k * DT_S * 1e9)))
    return scans, slow


def holds(tracker: Any, scans: list[Detections], slow: FloatArray) -> bool:
    """Whether the slow swimmer has the track at the end that it had before the two met."""
    on = []
    for k, ping in enumerate(scans):
        tracks = tracker(ping)
        sure = tracks.select(tracks.status == CONFIRMED)
        apart = np.hypot(*(sure.state[:, :2] - slow[k]).T)
        on.append(int(sure.id[apart.argmin()]) if apart.min(initial=np.inf) < 1.5 else 0)
    assert on[MET - 10] > 0
    return on[-1] == on[MET - 10]


@pytest.mark.parametrize("kind", [Pdaf, Nnkf])
def test_swimmers_that_cross_within_one_echo_keep_their_tracks(detections: Make, kind: type[Any]) -> None:
    scenes = [crossing(detections, seed) for seed in range(60)]
    plain = sum(holds(kind(**NODE), *scene) for scene in scenes)
    told = sum(holds(kind(**NODE, meeting_m=3.0), *scene) for scene in scenes)
    assert plain <= 30
    assert told >= 56


@pytest.mark.parametrize("kind", [Pdaf, Nnkf])
def test_the_contract_of_nodes_through_a_meeting(detections: Make, kind: type[Any]) -> None:
    check_node(kind(**NODE, meeting_m=3.0), [{"detections": ping} for ping in crossing(detections, 3)[0]])


@pytest.mark.parametrize("at", [MET - 2, MET + 3, MET + 8])
def test_snapshot_and_restore_within_a_meeting(detections: Make, at: int) -> None:
    scans, _ = crossing(detections, 5)
    first, second = Pdaf(**NODE, meeting_m=3.0), Pdaf(**NODE, meeting_m=3.0)
    for ping in scans[:at]:
        first(ping)
    second.restore(first.snapshot())
    for ping in scans[at:]:
        a, b = first(ping), second(ping)
        assert (a.id.tobytes(), a.state.tobytes()) == (b.id.tobytes(), b.state.tobytes())


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_bad_distance_is_named(value: float) -> None:
    with pytest.raises(ValueError, match=f"meeting_m = {value}: must be positive"):
        Pdaf(meeting_m=value)
