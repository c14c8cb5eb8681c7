"""OSPA, GOSPA and OSPA(2): by hand, against all assignments, and against Stone Soup."""

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_flow.evaluate import score
from fls_flow.evaluate.assignment import best, pairs_within
from fls_flow.evaluate.scores import Settings
from fls_flow.evaluate.sets import ospa2, set_distances

GOLDEN = Path(__file__).parent / "golden"


def distances(x, y, n_pings, c, p):
    near = pairs_within(x, y, c)
    return set_distances(x, y, near.select(near.distance_m < c), n_pings, c, p)


def test_one_pair_one_missed_one_false_by_hand(points):
    """Targets at 0 and 30, tracks at 3 and -30: d = 3; c = 10."""
    x = points((0, 0, 0, 0), (0, 1, 30, 0))
    y = points((0, 0, 3, 0), (0, 1, -30, 0))
    found = distances(x, y, 1, 10.0, 1.0)
    assert found.ospa[0] == pytest.approx((3 + 10) / 2)
    assert found.gospa[0] == pytest.approx(3 + 5 + 5)
    assert (found.localisation[0], found.missed[0], found.false[0]) == pytest.approx((3, 5, 5))
    squared = distances(x, y, 1, 10.0, 2.0)
    assert squared.ospa[0] == pytest.approx(math.sqrt((9 + 100) / 2))
    assert squared.gospa[0] == pytest.approx(math.sqrt(9 + 50 + 50))


def test_empty_sets(points):
    nothing, one = points(), points((1, 0, 5, 5))
    found = distances(one, nothing, 3, 10.0, 1.0)
    assert found.ospa.tolist() == [0.0, 10.0, 0.0]  # both empty: 0; one empty: c
    assert found.gospa.tolist() == [0.0, 5.0, 0.0]
    assert distances(nothing, nothing, 2, 10.0, 1.0).ospa.tolist() == [0.0, 0.0]
    assert ospa2(nothing, one, pairs_within(nothing, one, 10.0), 3, 10.0, 1.0, 1).tolist() == [0.0, 10.0, 0.0]


def test_crossed_targets_need_the_assignment_not_the_nearest(points):
    """Greedy would take 0-1 (d = 1) and leave 9; the best is 4 + 4."""
    x = points((0, 0, 0, 0), (0, 1, 5, 0))
    y = points((0, 0, 4, 0), (0, 1, 9, 0))
    assert distances(x, y, 1, 10.0, 1.0).gospa[0] == pytest.approx(8.0)


def slow_distances(a, b, c, p):
    """OSPA and GOSPA over all assignments."""
    small, large = (a, b) if len(a) <= len(b) else (b, a)
    ospa, gospa = [], []
    for chosen in itertools.permutations(range(len(large)), len(small)):
        d = [math.dist(one, large[k]) for one, k in zip(small, chosen, strict=True)]
        ospa.append(sum(min(v, c) ** p for v in d) + c**p * (len(large) - len(small)))
        gospa.append(sum(min(v, c) ** p for v in d) + c**p / 2 * (len(large) - len(small)))
    return (min(ospa) / max(len(large), 1)) ** (1 / p), min(gospa) ** (1 / p)


@pytest.mark.parametrize("p", [1.0, 2.0, 3.0])
def test_all_assignments_agree(random_points, p):
    rng = np.random.default_rng(3)
    for _ in range(12):
        x, y = random_points(rng, int(rng.integers(0, 5)), 8), random_points(rng, int(rng.integers(0, 6)), 8)
        found = distances(x, y, 8, 6.0, p)
        for ping in range(8):
            a, b = x.position_m[x.ping == ping].tolist(), y.position_m[y.ping == ping].tolist()
            assert (found.ospa[ping], found.gospa[ping]) == pytest.approx(slow_distances(a, b, 6.0, p))
        parts = found.localisation + found.missed + found.false
        assert_allclose(parts, found.gospa**p, atol=1e-9)


def slow_ospa2(x, y, n_pings, c, p, window):
    """OSPA over all assignments of trajectories, whose distance is a mean over the window."""

    def lives(points, owner, last):
        rows = (points.owner == owner) & (points.ping <= last) & (points.ping > last - window)
        return dict(zip(points.ping[rows].tolist(), points.position_m[rows].tolist(), strict=True))

    found = []
    for last in range(n_pings):
        a = [one for one in (lives(x, owner, last) for owner in range(x.name.size)) if one]
        b = [one for one in (lives(y, owner, last) for owner in range(y.name.size)) if one]
        small, large = (a, b) if len(a) <= len(b) else (b, a)
        base = [
            [
                np.mean(
                    [min(c, math.dist(f[t], g[t])) if t in f and t in g else c for t in f.keys() | g.keys()]
                )
                for g in large
            ]
            for f in small
        ]
        sums = [
            sum(base[n][k] ** p for n, k in enumerate(chosen)) + c**p * (len(large) - len(small))
            for chosen in itertools.permutations(range(len(large)), len(small))
        ]
        found.append((min(sums) / max(len(large), 1)) ** (1 / p))
    return found


@pytest.mark.parametrize(("p", "window"), [(1.0, 1), (1.0, 4), (2.0, 3), (1.0, 50)])
def test_ospa2_agrees_with_its_definition(random_points, p, window):
    rng = np.random.default_rng(8)
    for _ in range(8):
        x, y = random_points(rng, 3, 12), random_points(rng, 4, 12)
        near = pairs_within(x, y, 9.0)
        found = ospa2(x, y, near.select(near.distance_m < 9.0), 12, 9.0, p, window)
        assert_allclose(found, slow_ospa2(x, y, 12, 9.0, p, window), atol=1e-9)


def test_trajectories_that_meet_exactly_are_at_distance_zero(points):
    """Running sums leave rounding where a pair coincides; no order may stumble over it."""
    gap = np.random.default_rng(0).uniform(0, 5, 30)
    x = points(*((t, 0, 0.0, 0.0) for t in range(60)))
    y = points(*((t, 0, gap[t] if t < 30 else 0.0, 0.0) for t in range(60)))
    near = pairs_within(x, y, 10.0)
    for p in (1.0, 1.5, 2.0, 2.7):
        for window in (1, 3, 7):
            found = ospa2(x, y, near, 60, 10.0, p, window)
            assert_allclose(found, slow_ospa2(x, y, 60, 10.0, p, window), atol=1e-9)


def test_ospa2_of_a_window_of_one_is_ospa(random_points):
    rng = np.random.default_rng(4)
    x, y = random_points(rng, 5, 30), random_points(rng, 6, 30)
    near = pairs_within(x, y, 7.0)
    near = near.select(near.distance_m < 7.0)
    assert_allclose(ospa2(x, y, near, 30, 7.0, 1.0, 1), distances(x, y, 30, 7.0, 1.0).ospa, atol=1e-9)


def test_ospa2_sees_a_switch_that_ospa_does_not(points):
    """Two targets 4 m apart, followed without error, but the tracks change places half way."""
    x = points(*((t, n, 4.0 * n, 0.0) for t in range(10) for n in (0, 1)))
    y = points(*((t, n, 4.0 * (n if t < 5 else 1 - n), 0.0) for t in range(10) for n in (0, 1)))
    near = pairs_within(x, y, 10.0)
    assert distances(x, y, 10, 10.0, 1.0).ospa.tolist() == [0.0] * 10
    assert ospa2(x, y, near, 10, 10.0, 1.0, 10)[-1] == pytest.approx(2.0)  # half the time 4 m away


def test_pairs_do_not_depend_on_how_many_fit_in_memory(random_points, monkeypatch):
    rng = np.random.default_rng(1)
    x, y = random_points(rng, 9, 40), random_points(rng, 7, 40)
    whole = pairs_within(x, y, 8.0)
    slow = [
        (i, j)
        for i in range(len(x))
        for j in range(len(y))
        if x.ping[i] == y.ping[j] and math.dist(x.position_m[i], y.position_m[j]) <= 8.0
    ]
    assert list(zip(whole.left.tolist(), whole.right.tolist(), strict=True)) == slow
    for size in (1, 7):
        monkeypatch.setattr("fls_flow.evaluate.assignment.PAIRS_AT_ONCE", size)
        part = pairs_within(x, y, 8.0)
        assert part.left.tolist() == whole.left.tolist()
        assert part.right.tolist() == whole.right.tolist()


def test_best_takes_the_greatest_gain_of_each_group():
    group = np.array([0, 0, 0, 0, 1, 2, 2])
    left = np.array([0, 0, 1, 1, 2, 3, 4])
    right = np.array([0, 1, 0, 1, 2, 3, 3])
    gain = np.array([5.0, 4.0, 4.5, 1.0, -1.0, 2.0, 3.0])
    assert best(group, left, right, gain).tolist() == [False, True, True, False, False, False, True]


def test_stone_soup_agrees():
    """Its OSPA and GOSPA of each ping of the golden scene, p = 1, c = 10 m; see golden/make.py."""
    given = json.loads((GOLDEN / "scores.json").read_text())["stonesoup"]
    found = score(GOLDEN / "tracks.csv", GOLDEN / "truth.csv").tracking.sets
    for name in ("ospa", "gospa", "localisation", "missed", "false"):
        assert_allclose(getattr(found, name), given[name], atol=1e-9, err_msg=name)
    second = score(GOLDEN / "tracks.csv", GOLDEN / "truth.csv", settings=Settings(order=2.0)).tracking.sets
    assert_allclose(second.gospa, given["gospa_2"], atol=1e-9)
