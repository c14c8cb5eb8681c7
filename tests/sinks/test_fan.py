"""The pixels of the fan."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow.geometry import to_cartesian
from fls_sinks.fan import Fan, decibels, edges, fan, peak_reduced, raster


def pixel_of(image: Fan, picture, x, y):
    left, right, bottom, top = image.extent_m
    n_x, n_y = picture.shape
    return int((x - bottom) / (top - bottom) * n_x), int((y - left) / (right - left) * n_y)


def polar(n_ranges=50, n_beams=31, sector_deg=60.0, value=0.0):
    level = np.full((n_ranges, n_beams), value)
    ranges = (np.arange(n_ranges) + 0.5) * 0.4
    return level, ranges, np.radians(np.linspace(-sector_deg / 2, sector_deg / 2, n_beams))


def test_edges_lie_halfway_and_are_symmetric_outside():
    assert_allclose(edges(np.array([1.0, 2.0, 4.0]), 9.9), [0.5, 1.5, 3.0, 5.0])
    assert_allclose(edges(np.array([3.0]), 0.5), [2.75, 3.25])


@pytest.mark.parametrize(("row", "beam"), [(45, 3), (20, 15), (30, 30), (49, 0), (0, 15), (2, 7)])
def test_a_bright_cell_lights_its_pixel(row, beam):
    level, ranges, bearing = polar()
    level[row, beam] = 30.0
    image = fan(level, ranges, bearing)
    picture = raster(image, 400)
    (x, y) = to_cartesian(ranges[row], bearing[beam])
    assert picture[pixel_of(image, picture, x, y)] == 30.0
    lit_x, lit_y = np.nonzero(picture == 30.0)
    assert np.ptp(lit_x) < 40
    assert np.ptp(lit_y) < 40


def test_a_pixel_shows_the_cell_at_its_centre():
    level, ranges, bearing = polar()
    level[:] = np.arange(level.size).reshape(level.shape)
    image = fan(level, ranges, bearing)
    picture = raster(image, 300)
    left, right, bottom, top = image.extent_m
    for i, j in [(290, 150), (200, 100), (150, 180), (270, 70)]:
        x = bottom + (i + 0.5) * (top - bottom) / picture.shape[0]
        y = left + (j + 0.5) * (right - left) / picture.shape[1]
        row = int(np.argmin(np.abs(ranges - np.hypot(x, y))))
        beam = int(np.argmin(np.abs(bearing - np.arctan2(y, x))))
        assert picture[i, j] == level[row, beam]


def test_outside_the_fan_there_is_nothing():
    level, ranges, bearing = polar()
    image = fan(level, ranges, bearing)
    picture = raster(image, 300)
    assert np.isnan(picture[0, 0])
    assert np.isnan(picture[0, -1])
    assert np.isnan(picture[-1, 0])
    area = np.mean(np.isfinite(picture)) * np.prod(np.diff(np.reshape(image.extent_m, (2, 2)), axis=1))
    width, reach = np.ptp(image.bearing_edge_rad), image.range_edge_m[-1]
    assert_allclose(area, 0.5 * width * reach**2, rtol=0.02)


def test_every_cell_of_a_large_image_keeps_its_peak():
    rng = np.random.default_rng(3)
    level, ranges, bearing = polar(4000, 700)
    cells = rng.integers(0, [4000, 700], (40, 2))
    level[tuple(cells.T)] = 50.0
    picture = raster(peak_reduced(fan(level, ranges, bearing), 500, 300), 400)
    image = fan(level, ranges, bearing)
    for row, beam in cells:
        i, j = pixel_of(image, picture, *to_cartesian(ranges[row], bearing[beam]))
        assert np.nanmax(picture[max(i - 3, 0) : i + 4, max(j - 3, 0) : j + 4]) == 50.0


def test_reduction_keeps_the_outline_and_passes_over_nan():
    level, ranges, bearing = polar(11, 7)
    level[4, :] = np.nan
    level[5, 3] = 8.0
    image = fan(level, ranges, bearing)
    small = peak_reduced(image, 4, 3)
    assert small.level.shape == (4, 3)
    assert small.level.max() == 8.0
    assert np.isfinite(small.level).all()
    assert_array_equal(small.extent_m, image.extent_m)
    assert_array_equal(peak_reduced(image, 11, 7).level, image.level)


def test_beams_in_any_order_give_one_picture():
    level, ranges, bearing = polar()
    level[:] = np.random.default_rng(0).normal(size=level.shape)
    a = raster(fan(level, ranges, bearing), 200)
    b = raster(fan(level[:, ::-1], ranges, bearing[::-1]), 200)
    assert_array_equal(a, b)


def test_uneven_bearings_keep_their_place():
    bearing = np.radians([-30.0, -29.0, -20.0, 5.0, 30.0])
    level = np.zeros((40, 5))
    level[:, 3] = 7.0
    image = fan(level, (np.arange(40) + 0.5) * 0.5, bearing)
    picture = raster(image, 300)
    assert picture[pixel_of(image, picture, *to_cartesian(19.0, np.radians(16.0)))] == 7.0
    assert picture[pixel_of(image, picture, *to_cartesian(19.0, np.radians(19.0)))] == 0.0


def test_a_full_circle_has_no_seam():
    bearing = np.radians(np.arange(-180.0, 180.0, 2.0) + 1.0)
    image = fan(np.full((20, 180), 3.0), (np.arange(20) + 0.5), bearing)
    picture = raster(image, 200)
    distance = np.hypot(*np.meshgrid(*(np.linspace(-19.9, 19.9, 200),) * 2))
    assert (picture[distance < 19.5] == 3.0).all()


def test_one_beam_and_one_cell_are_drawn():
    image = fan(np.array([[5.0]]), np.array([10.0]), np.array([0.1]))
    assert np.nanmax(raster(image, 100)) == 5.0


def test_decibels():
    assert_allclose(decibels(np.array([10, 100, 1], np.uint8), 10.0), [0.0, 20.0, -20.0])
    assert_array_equal(decibels(np.array([0.0, -1.0, np.nan]), 1.0), [-np.inf, -np.inf, np.nan])
