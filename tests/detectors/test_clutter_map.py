"""The clutter map: what stands still vanishes, what comes stands out in standard deviations."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_detectors.clutter_map import ClutterMap, clipped_variance, smoothed
from fls_flow import Ping


def normal_pings(make_ping, n, *, mean=100.0, sd=8.0, shape=(200, 20), seed=0):
    rng = np.random.default_rng(seed)
    return [make_ping(rng.normal(mean, sd, shape).astype(np.float32)) for _ in range(n)]


def settled(make_ping, **parameters):
    node = ClutterMap(smooth_cells=(0.0, 0.0), **parameters)
    for ping in normal_pings(make_ping, 200):
        node(ping)
    return node


@pytest.mark.parametrize("clip", [1.0, 2.0, 5.0])
def test_heights_in_still_clutter_are_those_of_a_half_normal(make_ping, clip):
    node = settled(make_ping, clip=clip, rate=0.02)
    height = np.stack([node(ping).amplitude for ping in normal_pings(make_ping, 50, seed=1)])
    assert_allclose(np.mean(height == 0.0), 0.5, atol=0.01)
    assert_allclose(np.sqrt(2.0 * np.mean(np.square(height))), 1.0, atol=0.03)
    assert_allclose(np.mean(height > 2.0), 0.0228, atol=0.004)


@pytest.mark.parametrize("clip", [0.5, 2.0])
def test_clipped_variance_is_that_of_clipped_normals(clip):
    z = np.random.default_rng(0).normal(size=1_000_000)
    assert_allclose(clipped_variance(clip), np.mean(np.minimum(z * z, clip * clip)), rtol=5e-3)


def test_a_scene_that_stands_still_vanishes_whatever_its_brightness(make_ping):
    scene = np.random.default_rng(2).integers(0, 250, (60, 30)).astype(np.uint8)
    node = ClutterMap(warm_up_pings=2)
    for _ in range(30):
        height = node(make_ping(scene)).amplitude
    assert height.dtype == np.float32
    assert_allclose(height, 0.0, atol=1e-4)


def test_what_comes_stands_out_by_its_height_over_the_spread(make_ping):
    node = settled(make_ping)
    image = np.full((200, 20), 100.0, np.float32)
    image[50, 10] = 100.0 + 10.0 * 8.0
    height = node(make_ping(image)).amplitude
    assert_allclose(height[50, 10], 10.0, rtol=0.35)  # mean and spread are learnt from some 20 pings
    assert np.delete(height.ravel(), 50 * 20 + 10).max() < 2.0


def test_what_stays_a_second_is_not_yet_background(make_ping):
    node = settled(make_ping)
    image = np.full((200, 20), 100.0, np.float32)
    image[50, 10] = 180.0
    heights = [float(node(make_ping(image)).amplitude[50, 10]) for _ in range(10)]
    assert min(heights) > 3.0
    assert heights[-1] < heights[0]


def test_warm_up_and_another_size_give_zeros(make_ping):
    node = ClutterMap(warm_up_pings=5)
    heights = [node(ping).amplitude for ping in normal_pings(make_ping, 8, sd=50.0)]
    assert [bool(height.any()) for height in heights] == [False] * 5 + [True] * 3
    other = normal_pings(make_ping, 6, shape=(50, 7), sd=50.0)
    assert [bool(node(ping).amplitude.any()) for ping in other] == [False] * 5 + [True]


def test_a_spread_below_the_floor_counts_as_the_floor(make_ping):
    node = ClutterMap(smooth_cells=(0.0, 0.0), warm_up_pings=2, floor=4.0)
    for _ in range(50):
        node(make_ping(np.full((5, 5), 10.0, np.float32)))
    assert_allclose(node(make_ping(np.full((5, 5), 22.0, np.float32))).amplitude, 3.0, rtol=1e-5)


@pytest.mark.parametrize("shape", [(0, 0), (0, 39), (39, 0), (1, 1), (1, 39)])
def test_small_and_empty_images(make_ping, shape):
    node = ClutterMap(warm_up_pings=2)
    for _ in range(4):
        assert node(make_ping(np.zeros(shape, np.uint8))).amplitude.shape == shape


def test_cells_without_a_number_count_as_silent(make_ping):
    image = np.full((20, 10), 50.0, np.float32)
    image[3:6, 2] = np.nan
    node = ClutterMap(warm_up_pings=2)
    for _ in range(5):
        height = node(make_ping(image)).amplitude
    assert_allclose(height, 0.0, atol=1e-4)


def test_smoothing_keeps_the_sum_and_leaves_an_axis_of_width_zero_alone():
    image = np.zeros((31, 31), np.float32)
    image[15, 15] = 1.0
    both, along = smoothed(image, (1.5, 1.0)), smoothed(image, (1.5, 0.0))
    assert_allclose(both.sum(), 1.0, atol=1e-5)
    assert_array_equal(np.flatnonzero(along.any(axis=0)), [15])
    assert smoothed(image, (0.0, 0.0)) is image


def test_goes_on_from_a_snapshot_bit_for_bit(make_ping):
    pings = normal_pings(make_ping, 20)
    one = ClutterMap(warm_up_pings=3)
    for ping in pings[:10]:
        one(ping)
    saved, two = one.snapshot(), ClutterMap(warm_up_pings=3)
    expected = [one(ping).amplitude for ping in pings[10:]]
    two.restore(saved)
    assert_array_equal([two(ping).amplitude for ping in pings[10:]], expected)


@pytest.mark.parametrize(
    ("parameters", "complaint"),
    [
        ({"rate": 0.0}, "rate is 0.0"),
        ({"rate": 1.0}, "rate is 1.0"),
        ({"warm_up_pings": 1}, "warm_up_pings is 1"),
        ({"smooth_cells": (-1.0, 1.0)}, "smooth_cells is"),
        ({"clip": 0.0}, "clip is 0.0"),
        ({"floor": 0.0}, "floor is 0.0"),
    ],
)
def test_bad_parameters_are_named(parameters, complaint):
    with pytest.raises(ValueError, match=complaint):
        ClutterMap(**parameters)


@pytest.mark.parametrize("missing", ["nan", "inf", "invalid"])
@pytest.mark.filterwarnings("error")
def test_cells_without_data_spoil_nothing_and_come_to_life_as_background(missing):
    """A sector without data up to ping 40, a flickering cell, and an object that comes at last."""
    rng = np.random.default_rng(4)
    node, whole = ClutterMap(warm_up_pings=10), ClutterMap(warm_up_pings=10)
    table = (1.0 + 0.1 * np.arange(60), 0.02 * np.arange(30))
    for number in range(60):
        image = 80.0 + rng.normal(0.0, 3.0, (60, 30))
        if number > 55:
            image[40:43, 20:23] += 60.0
        lost = np.zeros(image.shape, bool)
        lost[:, :8] = number < 40
        lost[20, 15] = number % 3 == 0
        spoilt = np.where(lost, {"nan": np.nan, "inf": np.inf, "invalid": 999.0}[missing], image)
        valid = ~lost if missing == "invalid" else None
        out = node(Ping(number, number, spoilt.astype(np.float32), *table, valid)).amplitude
        clean = whole(Ping(number, number, image.astype(np.float32), *table)).amplitude
        assert np.isfinite(out).all()
        assert not out[lost].any()
        if number < 56:
            assert out.max() < 6.0
        assert_allclose(out[:, 20:], clean[:, 20:], atol=0.2)
    assert out[41, 21] > 10.0
