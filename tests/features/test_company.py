"""Regions with another track in them: when they describe their object, and when nobody."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_features.chips import CutChips
from fls_features.company import FORGOTTEN, KNOWN, Company, nearest_cells_m
from fls_features.region_growing import RegionGrowing
from fls_flow import TrackStatus
from fls_flow.testing import check_node

ALONE_M = 0.6


@pytest.fixture
def swum(make_ping, make_tracks):
    """Chips and regions of pings with two bodies 1 m wide, tracks 1 and 2 at ranges (pings, 2)."""

    def made(range_m, tentative=()):
        node, chips = CutChips(half_range_m=4.0), []
        for seq, (first, second) in enumerate(range_m):
            ping = make_ping(np.zeros((400, 81), np.float32), seq)
            amplitude = ping.amplitude.copy()
            for at in (first, second):
                amplitude[np.abs(ping.range_m - at) < 0.5, 39:42] = 10.0
            status = [TrackStatus.TENTATIVE if n in tentative else TrackStatus.CONFIRMED for n in (1, 2)]
            tracks = make_tracks(seq, [1, 2], [first, second], [0.0, 0.0], status=status)
            chips.append(node(make_ping(amplitude, seq), tracks))
        return chips

    return made


def kept(chips, alone_m=ALONE_M):
    node = RegionGrowing(filter_rows=1, filter_columns=1, level=0.5, seed_within_m=1.0, alone_m=alone_m)
    return [dict(zip(c.track_id.tolist(), node(c).kept.tolist(), strict=True)) for c in chips]


APART, TOGETHER = (20.0, 25.0), (20.0, 20.8)


def test_swimmers_that_meet_are_described_before_and_after_and_not_within(swum):
    found = kept(swum([APART] * 6 + [TOGETHER] * 3 + [APART] * 2))
    yes, no = {1: True, 2: True}, {1: False, 2: False}
    assert found == [yes] * 6 + [no] * 3 + [yes] * 2
    assert kept(swum([APART] * 6 + [TOGETHER] * 3), alone_m=None) == [yes] * 9


def test_two_tracks_on_one_school_describe_it(swum):
    assert kept(swum([TOGETHER] * 12)) == [{1: True, 2: True}] * 12


def test_a_few_pings_alone_say_nothing(swum):
    found = kept(swum([APART] * (KNOWN - 1) + [TOGETHER] * 3))
    assert all(all(one.values()) for one in found)


def test_who_is_mostly_together_is_described_together(swum):
    found = kept(swum([TOGETHER] * 10 + [APART] * 8 + [TOGETHER] * 2))
    assert all(all(one.values()) for one in found)


def test_the_newcomer_beside_a_known_swimmer_is_not_described(swum, make_ping, make_tracks):
    node, cutter = Company(), CutChips(half_range_m=4.0)
    mask = np.zeros((1, 81, 21), bool)
    mask[:, 35:46, 9:12] = True
    ping = make_ping(np.zeros((400, 81), np.float32))
    for seq in range(KNOWN):
        chips = cutter(ping, make_tracks(seq, [1], [20.0], [0.0]))
        assert node.describes(chips, mask, ALONE_M).all()
    chips = cutter(ping, make_tracks(KNOWN, [1, 2], [20.0, 20.8], [0.0, 0.0]))
    assert node.describes(chips, np.repeat(mask, 2, axis=0), ALONE_M).tolist() == [False, False]


def test_only_confirmed_tracks_are_company(swum):
    found = kept(swum([APART] * 6 + [TOGETHER] * 3, tentative=(2,)))
    assert found == [{1: True}] * 9


def test_distances_are_to_the_nearest_cell(swum):
    chips = swum([(20.0, 21.5)])[0]
    mask = np.zeros(chips.amplitude.shape, bool)
    for k in range(2):
        mask[
            k,
            chips.centre[k, 0] - 3 : chips.centre[k, 0] + 4,
            chips.centre[k, 1] - 2 : chips.centre[k, 1] + 3,
        ] = True
    slow = []
    for k, (r0, b0) in zip(chips.near_chip, chips.near_polar, strict=True):
        i, j = np.nonzero(mask[k])
        r, b = chips.range_m[k][i], chips.bearing_rad[k][j]
        x, y = r * np.cos(b) - r0 * np.cos(b0), r * np.sin(b) - r0 * np.sin(b0)
        slow.append(np.hypot(x, y).min())
    assert chips.near_chip.tolist() == [0, 1]
    assert chips.near_id.tolist() == [2, 1]
    assert_allclose(nearest_cells_m(chips, mask), slow, rtol=1e-9)
    assert_allclose(slow, 1.2, atol=0.06)
    assert np.isinf(nearest_cells_m(chips, np.zeros_like(mask))).all()


def test_a_track_that_has_ended_is_forgotten(swum):
    node, chips = Company(), swum([APART])[0]
    node.describes(chips, np.zeros(chips.amplitude.shape, bool), ALONE_M)
    for _ in range(FORGOTTEN):
        node.describes(type(chips)(0, 0), np.zeros((0, 0, 0), bool), ALONE_M)
    assert node.snapshot()["id"].size == 0


def test_the_contract_of_nodes_and_snapshots(swum):
    scans = swum([APART] * 6 + [TOGETHER] * 3 + [APART] * 2)
    settings = {"filter_rows": 1, "filter_columns": 1, "level": 0.5, "seed_within_m": 1.0, "alone_m": ALONE_M}
    check_node(RegionGrowing(**settings), [{"chips": one} for one in scans])
    first, second = RegionGrowing(**settings), RegionGrowing(**settings)
    for one in scans[:7]:
        first(one)
    second.restore(first.snapshot())
    for one in scans[7:]:
        assert first(one).kept.tolist() == second(one).kept.tolist()


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_bad_distance_is_named(value):
    with pytest.raises(ValueError, match=f"alone_m is {value}; it must be positive"):
        RegionGrowing(alone_m=value)
