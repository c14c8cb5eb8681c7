"""Who follows whom, MOTA, IDF1 and HOTA: by hand, and against TrackEval and motmetrics."""

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest

from fls_flow.evaluate import score
from fls_flow.evaluate.assignment import pairs_within
from fls_flow.evaluate.clear import clear_scores, identity_scores, matched, run_starts, switches
from fls_flow.evaluate.hota import hota_scores

GOLDEN = Path(__file__).parent / "golden"


def follow(x, y, gate=5.0):
    pairs = pairs_within(x, y, gate)
    return matched(x, y, pairs, gate), pairs


@pytest.mark.parametrize("package", ["trackeval", "motmetrics"])
def test_the_public_packages_agree(package):
    """On a scene with crossings, switches, gaps, doubles and a false track; see golden/make.py."""
    given = json.loads((GOLDEN / "scores.json").read_text())[package]
    found = score(GOLDEN / "tracks.csv", GOLDEN / "truth.csv").overall
    assert {name: found[name] for name in given} == pytest.approx(given, abs=1e-9)


def test_a_track_keeps_its_target_though_another_is_closer(points):
    x = points(*((t, 0, 0.0, 0.0) for t in range(3)))
    y = points((0, 0, 2.0, 0.0), (1, 0, 2.0, 0.0), (1, 1, 0.5, 0.0), (2, 0, 2.0, 0.0), (2, 1, 0.5, 0.0))
    follows, _ = follow(x, y)
    assert y.owner[follows].tolist() == [0, 0, 0]
    assert switches(x, y, follows).tolist() == [0]


def test_after_a_gap_the_closest_follows_and_a_switch_counts(points):
    x = points(*((t, 0, 0.0, 0.0) for t in range(4)))
    y = points((0, 0, 2.0, 0.0), (2, 0, 2.0, 0.0), (2, 1, 0.5, 0.0), (3, 1, 0.5, 0.0))
    follows, pairs = follow(x, y)
    assert follows.tolist() == [0, -1, 2, 3]
    assert switches(x, y, follows).tolist() == [1]
    assert run_starts(x, follows).tolist() == [2]
    scores = clear_scores(x, y, follows, pairs)
    assert scores["mota"] == pytest.approx(1 - (1 + 1 + 1) / 4)  # one missed, one false, one switch
    assert scores["motp_m"] == pytest.approx((2.0 + 0.5 + 0.5) / 3)
    assert (scores["id_switches"], scores["fragmentations"]) == (1, 1)


def test_a_target_out_of_sight_breaks_no_track(points):
    """Seen in pings 0, 1, 4, 5, 6, 7 and followed in all but ping 5: one interruption."""
    seen = (0, 1, 4, 5, 6, 7)
    x = points(*((t, 0, 0.0, 0.0) for t in seen), *((t, 1, 50.0, 0.0) for t in range(8)))
    y = points(*((t, 0, 1.0, 0.0) for t in seen if t != 5), *((t, 1, 50.0, 0.0) for t in range(8)))
    follows, pairs = follow(x, y)
    assert run_starts(x, follows).tolist() == [2, 1]
    assert clear_scores(x, y, follows, pairs)["fragmentations"] == 1


def test_the_gate_itself_is_inside(points):
    x, y = points((0, 0, 0, 0)), points((0, 0, 5.0, 0))
    assert follow(x, y, 5.0)[0].tolist() == [0]
    assert follow(x, y, 4.999)[0].tolist() == [-1]


def slow_matched(x, y, gate):
    """Ping by ping, over all assignments, with the rule in words."""
    follows = np.full(len(x), -1)
    last: dict[int, int] = {}
    for ping in range(int(x.ping.max()) + 1):
        mine, other = np.flatnonzero(x.ping == ping), np.flatnonzero(y.ping == ping)
        most, choice = -1.0, {}
        padded = [*other.tolist(), *[-1] * mine.size]
        for chosen in set(itertools.permutations(padded, mine.size)):
            total, pairs = 0.0, {}
            for i, j in zip(mine.tolist(), chosen, strict=True):
                d = math.dist(x.position_m[i], y.position_m[j]) if j >= 0 else math.inf
                if d <= gate:
                    total += 1 - 0.5 * d / gate + 1000 * (last.get(int(x.owner[i])) == int(y.owner[j]))
                    pairs[i] = j
            if total > most:
                most, choice = total, pairs
        for i, j in choice.items():
            follows[i] = j
        last = {int(x.owner[i]): int(y.owner[j]) for i, j in choice.items()}
    return follows


def test_following_agrees_with_a_search_over_all_assignments(random_points):
    rng = np.random.default_rng(6)
    contested = 0
    for _ in range(25):
        x, y = random_points(rng, 3, 10), random_points(rng, 3, 10)
        follows, pairs = follow(x, y, 12.0)
        contested += len(pairs.left) - np.unique(pairs.left).size
        assert follows.tolist() == slow_matched(x, y, 12.0).tolist()
    assert contested > 50


def test_idf1_by_hand(points):
    """Ten pings; track 0 follows for 6, track 1 for 4: the target's own is track 0."""
    x = points(*((t, 0, 0.0, 0.0) for t in range(10)))
    y = points(*((t, 0 if t < 6 else 1, 0.0, 0.0) for t in range(10)))
    found = identity_scores(x, y, pairs_within(x, y, 5.0), 5.0)
    assert found == pytest.approx({"idf1": 0.6, "id_precision": 0.6, "id_recall": 0.6})


def test_hota_by_hand(points):
    """All found at distance 0, but half of the time under another id: A = 5 / 10 for each half."""
    x = points(*((t, 0, 0.0, 0.0) for t in range(10)))
    y = points(*((t, t // 5, 0.0, 0.0) for t in range(10)))
    found = hota_scores(x, y, pairs_within(x, y, 10.0), 10.0)
    assert found == pytest.approx({"hota": math.sqrt(0.5), "deta": 1.0, "assa": 0.5, "loca": 1.0})


def test_hota_falls_with_the_distance(points):
    """s = 0.6 passes 12 of the 19 thresholds."""
    x, y = points((0, 0, 0.0, 0.0)), points((0, 0, 4.0, 0.0))
    found = hota_scores(x, y, pairs_within(x, y, 10.0), 10.0)
    assert found["deta"] == pytest.approx(12 / 19)
    assert found["loca"] == pytest.approx((12 * 0.6 + 7) / 19)


def test_nothing_at_all(points):
    nothing, one = points(), points((0, 0, 1.0, 1.0))
    for x, y in ((nothing, one), (one, nothing), (nothing, nothing)):
        follows, pairs = follow(x, y)
        scores = clear_scores(x, y, follows, pairs) | identity_scores(x, y, pairs, 5.0)
        scores |= hota_scores(x, y, pairs, 10.0)
        assert scores["misses"] == len(x)
        assert scores["false_positives"] == len(y)
        assert scores["idf1"] == 0.0 or len(x) + len(y) == 0
        assert scores["hota"] == 0.0 or len(x) + len(y) == 0
    assert math.isnan(scores["mota"])


def test_the_order_of_ids_does_not_matter(random_points, points):
    rng = np.random.default_rng(2)
    x, y = random_points(rng, 4, 15), random_points(rng, 5, 15)
    turned = points(
        *((t, y.name.size - 1 - n, *p) for t, n, p in zip(y.ping, y.owner, y.position_m, strict=True))
    )
    for one in (
        hota_scores(x, y, pairs_within(x, y, 6.0), 6.0),
        identity_scores(x, y, pairs_within(x, y, 6.0), 6.0),
    ):
        other = hota_scores if "hota" in one else identity_scores
        assert other(x, turned, pairs_within(x, turned, 6.0), 6.0) == pytest.approx(one)
