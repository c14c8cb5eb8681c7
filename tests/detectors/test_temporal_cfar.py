"""Temporal CFAR: false-alarm rate against theory, running moments, what is absorbed, objects, geometry."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.temporal_background import rayleigh_threshold
from fls_detectors.temporal_cfar import TemporalCfar, fls_node
from fls_detectors.temporal_objects import around, linked
from fls_flow.testing import check_node


def rayleigh(make_ping, n, *, shape=(200, 50), scale=20.0, dtype=np.float32, seed=0):
    rng = np.random.default_rng(seed)
    return [make_ping(scale * np.sqrt(rng.exponential(size=shape)).astype(dtype)) for _ in range(n)]


def test_kind_and_contract(make_ping):
    assert fls_node() is TemporalCfar
    pings = [{"ping": ping} for ping in rayleigh(make_ping, 12, shape=(40, 20))]
    check_node(TemporalCfar(warm_up_pings=3, pfa=1e-2), pings)
    check_node(TemporalCfar(warm_up_pings=3, pfa=1e-2, link_m=0.3, smooth_cells=(1.0, 1.0)), pings)
    moving = {"reach_m": 0.5, "recent_rate": 0.2, "strength": "energy"}
    check_node(TemporalCfar(warm_up_pings=3, pfa=1e-2, **moving), pings)
    check_node(TemporalCfar)


@pytest.mark.parametrize(("pfa", "tau"), [(5e-3, 3.06), (1e-3, 3.76), (1e-4, 4.64)])
def test_thresholds_of_known_rayleigh_moments(pfa, tau):
    assert_allclose(rayleigh_threshold(pfa), tau, atol=5e-3)
    assert_allclose(TemporalCfar(pfa=pfa).tau, tau, atol=5e-3)
    x = np.sqrt(np.random.default_rng(0).exponential(size=2_000_000))
    found = np.mean((x - np.sqrt(np.pi) / 2) / np.sqrt(1 - np.pi / 4) > rayleigh_threshold(pfa))
    assert_allclose(found, pfa, rtol=4 / np.sqrt(2e6 * pfa))


@pytest.mark.parametrize(("rate", "expected"), [(0.01, 1.06e-2), (0.2, 2.1e-2)])
def test_false_alarms_come_at_the_rate_that_a_finite_memory_gives(make_ping, rate, expected):
    node = TemporalCfar(pfa=1e-2, rate=rate, warm_up_pings=2, max_detections=100_000)
    warm = int(4 / rate) + 20
    pings = rayleigh(make_ping, warm + 60, shape=(100, 50))
    count = [len(node(ping).detections) for ping in pings][warm:]
    assert_allclose(np.sum(count) / (60 * 100 * 50), expected, rtol=0.1)


def slow_reference(images, tau, rate, warm, floor, event_rate=None, early=None):
    """The recursion as it is written, one cell after the other."""
    mean, variance = images[0].astype(np.float64), np.zeros(images[0].shape)
    hits, heights = [], []
    for k, x in enumerate(images):
        a = max(rate, 1 / (k + 1))
        hit = np.zeros(x.shape, bool)
        height = np.zeros(x.shape)
        for i, j in np.ndindex(x.shape):
            d = float(x[i, j]) - mean[i, j]
            sd = max(np.sqrt(variance[i, j]), floor)
            hit[i, j] = k >= warm and d > tau * sd
            height[i, j] = max(d, 0.0) if k >= warm else 0.0
            rises = hit[i, j] or (early is not None and early <= k < warm and d > 2.0 * tau * sd)
            slow = rises and event_rate is not None
            mean[i, j] += (min(a, event_rate) if slow else a) * d
            variance[i, j] += (0.0 if slow else a) * (d * d - variance[i, j])
        hits.append(hit)
        heights.append(height)
    return hits, heights


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize(
    ("event_rate", "warm", "early"), [(None, 5, None), (0.01, 5, None), (0.01, 20, 4), (None, 20, 4)]
)
def test_equals_a_slow_reference(make_ping, dtype, event_rate, warm, early):
    rng = np.random.default_rng(3)
    images = [np.round(30 * np.sqrt(rng.exponential(size=(12, 7)))).astype(dtype) for _ in range(60)]
    node = TemporalCfar(
        threshold=1.5, warm_up_pings=warm, floor=0.5, event_rate=event_rate, early_pings=early
    )
    hits, heights = slow_reference(images, 1.5, 0.05, warm, 0.5, event_rate, early)
    for image, hit, height in zip(images, hits, heights, strict=True):
        ping = make_ping(image)
        found = node(ping)
        rows, beams = np.nonzero(hit)
        assert_allclose(found.detections.range_m, ping.range_m[rows])
        assert_allclose(found.detections.bearing_rad, ping.bearing_rad[beams])
        assert_allclose(found.foreground.amplitude, height, rtol=1e-3, atol=2e-3)


def test_the_estimates_are_the_moments_of_the_clutter(make_ping):
    node = TemporalCfar(rate=0.01)
    for ping in rayleigh(make_ping, 600, shape=(60, 30), scale=20.0):
        node(ping)
    state = node.snapshot()
    assert_allclose(state["mean"].mean(), 20.0 * np.sqrt(np.pi) / 2, rtol=0.01)
    # the mean itself wanders: E (X - mu)^2 = var (1 + a / (2 - a))
    assert_allclose(state["variance"].mean(), 400.0 * (1 - np.pi / 4) * (1 + 0.01 / 1.99), rtol=0.02)


def settled(make_ping, **parameters):
    node = TemporalCfar(**parameters)
    for ping in rayleigh(make_ping, 100, shape=(60, 30)):
        node(ping)
    return node


def test_a_rise_is_detected_and_a_drop_is_not(make_ping):
    node = settled(make_ping, pfa=1e-6)
    image = np.full((60, 30), 18.0, np.float32)
    image[20, 10], image[40, 10] = 150.0, 0.0
    found = node(make_ping(image))
    assert len(found.detections) == 1
    assert_allclose(found.detections.amplitude, 150.0)
    assert found.foreground.amplitude[40, 10] == 0.0
    assert_allclose(found.foreground.amplitude[20, 10], 150.0 - 17.7, atol=6.0)


@pytest.mark.parametrize(("early", "least"), [(None, 0.0), (8, 0.9)])
def test_who_swims_through_the_warm_up_is_whole_afterwards(make_ping, early, least):
    """A body of 20 cells that moves on by one cell a ping: how much of it stands out of the background."""
    node = TemporalCfar(rate=0.005, event_rate=0.001, warm_up_pings=30, early_pings=early)
    rng, seen = np.random.default_rng(4), []
    for k in range(40):
        image = np.sqrt(rng.exponential(size=(80, 9))).astype(np.float32)
        image[k : k + 20, 3:6] = 30.0
        height = node(make_ping(image)).foreground.amplitude
        if k >= 30:
            seen.append((height[k : k + 20, 3:6] > 25.0).mean())
    assert min(seen) >= least
    assert early is not None or max(seen) < 0.8


@pytest.mark.parametrize(("event_rate", "least", "most"), [(None, 1, 10), (0.001, 200, 201)])
def test_a_steady_echo_is_absorbed_unless_events_learn_slowly(make_ping, event_rate, least, most):
    node = settled(make_ping, pfa=1e-6, event_rate=event_rate)
    seen = 0
    for ping in rayleigh(make_ping, 200, shape=(60, 30), seed=5):
        image = ping.amplitude.copy()
        image[20, 10] = 300.0
        found = node(make_ping(image)).detections
        seen += bool((np.abs(found.amplitude - 300.0) < 1e-3).any())
    assert least <= seen <= most


def test_nothing_is_found_in_the_warm_up_or_after_a_change_of_geometry(make_ping):
    node = TemporalCfar(pfa=0.1, warm_up_pings=6)
    count = [len(node(ping).detections) for ping in rayleigh(make_ping, 9)]
    assert count[:6] == [0] * 6
    assert min(count[6:]) > 100
    moved = [
        make_ping(ping.amplitude, first_m=30.0) for ping in rayleigh(make_ping, 7, seed=1)
    ]  # the same size
    answers = [node(ping) for ping in moved]
    assert [len(one.detections) for one in answers[:6]] == [0] * 6
    assert not any(one.foreground.amplitude.any() for one in answers[:6])
    assert len(answers[6].detections) > 100


def test_the_strongest_events_are_kept_in_the_order_of_range(make_ping):
    node = settled(make_ping, pfa=1e-6, max_detections=2)
    image = np.full((60, 30), 18.0, np.float32)
    image[[5, 20, 40], [3, 10, 20]] = 200.0, 300.0, 400.0
    found = node(make_ping(image)).detections
    assert_allclose(found.amplitude, [300.0, 400.0])


def test_cells_without_data_are_no_events_and_leave_the_background_alone(make_ping):
    node = settled(make_ping)
    before = node.snapshot()["mean"]
    image = np.full((60, 30), 500.0, np.float32)
    image[:, 10:] = 18.0
    image[0, 11], image[1, 11], image[2, 11] = np.nan, np.inf, 1e30
    valid = np.ones((60, 30), bool)
    valid[:, :10] = False
    found = node(make_ping(image, valid=valid))
    assert len(found.detections) == 0
    assert np.isfinite(found.foreground.amplitude).all()
    assert_array_equal(node.snapshot()["mean"][:, :10], before[:, :10])
    assert_array_equal(node.snapshot()["mean"][:3, 11], before[:3, 11])


@pytest.mark.parametrize("hidden", ["nan", "masked"])
def test_a_sector_that_opens_later_has_its_own_warm_up_and_learns_as_well_as_the_rest(make_ping, hidden):
    node = TemporalCfar(pfa=1e-2, warm_up_pings=20, max_detections=100_000)
    opened, rates = 40, {"open": [], "late": []}
    for k, ping in enumerate(rayleigh(make_ping, 140, shape=(100, 40))):
        seen = np.ones(ping.amplitude.shape, bool)
        seen[:, 20:] = k >= opened
        if hidden == "nan":
            ping = make_ping(np.where(seen, ping.amplitude, np.nan))
        else:
            ping = make_ping(ping.amplitude, valid=seen)
        found = node(ping).detections.bearing_rad
        late = np.count_nonzero(found >= ping.bearing_rad[20])
        if k < opened + 20:
            assert late == 0
        else:
            rates["late"].append(late)
            rates["open"].append(len(found) - late)
    assert_allclose(np.mean(rates["late"]), np.mean(rates["open"]), rtol=0.1)


def test_cells_that_never_have_data_cost_nothing_of_the_others(make_ping):
    pings = rayleigh(make_ping, 30, shape=(60, 20))
    seen = np.ones((60, 20), bool)
    seen[:, 15:] = False
    whole, part = (TemporalCfar(pfa=1e-2, warm_up_pings=5) for _ in range(2))
    for ping in pings:
        expected, found = whole(ping).detections, part(make_ping(ping.amplitude, valid=seen)).detections
        within = expected.bearing_rad < ping.bearing_rad[15]
        assert_array_equal(found.range_m, expected.range_m[within])


def test_whole_numbers_must_rise_by_more_than_threshold_steps(make_ping):
    node = TemporalCfar(threshold=4.0, warm_up_pings=3)
    for _ in range(5):
        node(make_ping(np.full((6, 5), 7, np.uint8)))
    image = np.full((6, 5), 7, np.uint8)
    image[2, 2], image[4, 4] = 11, 12
    assert_allclose(node(make_ping(image)).detections.amplitude, [12.0])


def test_silence_that_breaks_is_an_event(make_ping):
    node = TemporalCfar(warm_up_pings=3)
    for _ in range(5):
        assert len(node(make_ping(np.zeros((6, 5), np.float32))).detections) == 0
    image = np.zeros((6, 5), np.float32)
    image[2, 2] = 1.0
    assert len(node(make_ping(image)).detections) == 1


@pytest.mark.parametrize("shape", [(0, 0), (0, 39), (39, 0), (1, 1), (1, 39), (39, 1)])
@pytest.mark.parametrize("link_m", [0.0, 1.0])
@pytest.mark.parametrize("recent_rate", [None, 0.1])
def test_small_and_empty_images(make_ping, shape, link_m, recent_rate):
    node = TemporalCfar(warm_up_pings=2, link_m=link_m, recent_rate=recent_rate)
    for _ in range(3):
        assert node(make_ping(np.zeros(shape, np.uint8))).foreground.amplitude.shape == shape
    found = node(make_ping(np.full(shape, 200, np.uint8)))
    assert len(found.detections) == (0 if not np.prod(shape) else 1 if link_m else np.prod(shape))


def test_cells_of_one_object_become_one_detection_at_their_weighted_mean(make_ping):
    image = np.zeros((400, 39), np.float32)
    node = TemporalCfar(warm_up_pings=2, link_m=0.5, min_cells=3)
    for _ in range(4):
        node(make_ping(image))
    image = image.copy()
    image[100:121, 19] = 10.0
    image[110, 19] = 30.0
    image[300:303, 5] = [1.0, 2.0, 1.0]
    image[200, 30] = 99.0  # too small
    ping = make_ping(image)
    found = node(ping).detections
    assert_allclose(found.range_m, ping.range_m[[110, 301]])
    assert_allclose(found.bearing_rad, ping.bearing_rad[[19, 5]], atol=1e-12)
    assert_allclose(found.amplitude, [30.0, 2.0])
    assert_allclose(found.extent, [[1.0, 0.0], [0.1, 0.0]], atol=1e-12)
    spread = np.average((ping.range_m[100:121] - ping.range_m[110]) ** 2, weights=image[100:121, 19] ** 2)
    assert_allclose(found.covariance[0], np.diag([spread + 0.05**2, np.deg2rad(1.5) ** 2]), rtol=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_linked_groups_are_those_of_the_graph_of_all_pairs(seed):
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial.distance import cdist

    rng = np.random.default_rng(seed)
    points, link_m = rng.uniform(-10.0, 10.0, (rng.integers(1, 90), 2)), rng.uniform(0.1, 4.0)
    member = linked(points, link_m)
    _, expected = connected_components(cdist(points, points) < link_m)
    assert_array_equal(member[:, None] == member, expected[:, None] == expected)
    assert_array_equal(np.unique(member, return_index=True)[1].argsort(), np.arange(member.max() + 1))


def test_points_of_nobody_are_no_groups():
    assert linked(np.zeros((0, 2)), 1.0).size == 0


@pytest.mark.parametrize("seed", range(20))
def test_groups_around_the_heaviest_points_are_those_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    points, reach_m = rng.uniform(-10.0, 10.0, (rng.integers(1, 90), 2)), rng.uniform(0.1, 4.0)
    weight = rng.permutation(len(points)) + 1.0
    left, expected, leaders = set(range(len(points))), np.empty(len(points), int), 0
    while left:
        leader = max(left, key=weight.__getitem__)
        near = {j for j in left if np.hypot(*(points[j] - points[leader])) <= reach_m}
        expected[list(near)] = leaders
        left, leaders = left - near, leaders + 1
    assert_array_equal(around(points, weight, reach_m), expected)
    order = rng.permutation(len(points))
    assert_array_equal(around(points[order], weight[order], reach_m), expected[order])
    assert around(np.zeros((0, 2)), np.zeros(0), reach_m).size == 0


def after_silence(make_ping, node, images):
    """What a node finds in images, after some pings of nothing."""
    for _ in range(4):
        node(make_ping(np.zeros_like(images[0])))
    return [node(make_ping(image)).detections for image in images]


def test_two_objects_that_touch_are_two_around_their_brightest_cells(make_ping):
    image = np.zeros((400, 39), np.float32)
    image[100:161, 19] = 5.0
    image[[110, 150], 19] = [40.0, 30.0]
    (chained,) = after_silence(make_ping, TemporalCfar(warm_up_pings=2, link_m=0.5), [image])
    (parted,) = after_silence(make_ping, TemporalCfar(warm_up_pings=2, reach_m=1.1), [image])
    assert len(chained) == 1
    assert len(parted) == 2
    assert_allclose(parted.range_m, make_ping(image).range_m[[110, 150]], atol=0.2)
    assert_allclose(parted.amplitude, [40.0, 30.0])
    whole = TemporalCfar(warm_up_pings=2, reach_m=1.1, strength="energy")
    (parted,) = after_silence(make_ping, whole, [image])
    assert_allclose(np.square(parted.amplitude).sum(), np.square(image, dtype=float).sum(), rtol=1e-5)


@pytest.mark.parametrize(
    ("fresh", "recent", "left", "least", "most"),
    [(0.2, 1.0, 1, 0.0, 0.1), (0.0, 1.0, 2, 0.0, 0.1), (0.2, 0.75, 2, 0.2, 0.4)],
)
def test_what_stays_in_place_fades_and_what_moves_does_not(make_ping, fresh, recent, left, least, most):
    def at(k):
        image = np.zeros((400, 39), np.float32)
        image[100:120, 10:13] = 20.0  # stays
        image[100 + 4 * k : 120 + 4 * k, 30:33] = 20.0  # swims its length in five pings
        return image

    settings = {
        "reach_m": 3.0,
        "min_cells": 20,
        "strength": "energy",
        "event_rate": 0.0,
        "fresh_share": fresh,
        "recent_share": recent,
    }
    node = TemporalCfar(warm_up_pings=2, recent_rate=0.15, recent_cells=(2.0, 1.0), **settings)
    found = after_silence(make_ping, node, [at(k) for k in range(40)])
    assert len(found[0]) == 2
    assert_allclose(found[0].amplitude[0], found[0].amplitude[1], rtol=0.01)
    last = found[-1]
    assert len(last) == left
    swims = last.bearing_rad > 0.0
    middle = 2.0 + 0.05 * (100 + 4 * 39 + 9.5)
    assert_allclose(last.range_m[swims], middle, atol=0.5)
    assert last.amplitude[swims] > 0.6 * found[0].amplitude[1]
    assert np.all(last.amplitude[~swims] < most * last.amplitude[swims])
    assert np.all(last.amplitude[~swims] > least * last.amplitude[swims])


def test_the_recent_past_is_forgotten_when_the_geometry_changes(make_ping):
    node = TemporalCfar(warm_up_pings=2, reach_m=1.0, recent_rate=0.2)
    image = np.zeros((60, 20), np.float32)
    image[20:30, 10] = 9.0
    after_silence(make_ping, node, [image] * 3)
    assert node.snapshot()["recent"].any()
    node(make_ping(np.zeros((50, 20), np.float32)))
    assert node.snapshot()["recent"].shape == (50, 20)
    assert not node.snapshot()["recent"].any()


@pytest.mark.parametrize(
    ("parameters", "complaint"),
    [
        ({"pfa": 0.0}, "pfa is 0.0"),
        ({"pfa": 1.0}, "pfa is 1.0"),
        ({"pfa": 0.6}, "pfa is 0.6"),
        ({"threshold": 0.0}, "threshold is 0.0"),
        ({"threshold": float("nan")}, "threshold is nan"),
        ({"rate": 0.0}, "rate is 0.0"),
        ({"variance_rate": 1.0}, "variance_rate is 1.0"),
        ({"event_rate": -0.1}, "event_rate is -0.1"),
        ({"warm_up_pings": 1}, "warm_up_pings is 1"),
        ({"early_pings": 1}, "early_pings is 1"),
        ({"floor": -1.0}, "floor is -1.0"),
        ({"max_detections": 0}, "max_detections is 0"),
        ({"link_m": -1.0}, "link_m is -1.0"),
        ({"min_cells": 0}, "min_cells is 0"),
        ({"smooth_cells": (-1.0, 0.0)}, "smooth_cells is"),
        ({"recent_cells": (0.0, float("inf"))}, "recent_cells is"),
        ({"reach_m": float("nan")}, "reach_m is nan"),
        ({"reach_m": 1.0, "link_m": 2.0}, "reach_m is 1.0 and link_m is 2.0"),
        ({"strength": "mean"}, "strength is mean"),
        ({"recent_rate": 0.0}, "recent_rate is 0.0"),
        ({"recent_rate": 1.5}, "recent_rate is 1.5"),
        ({"fresh_share": -0.1}, "fresh_share is -0.1"),
        ({"recent_share": 1.1}, "recent_share is 1.1"),
    ],
)
def test_bad_parameters_are_named(parameters, complaint):
    with pytest.raises(ValueError, match=complaint):
        TemporalCfar(**parameters)
