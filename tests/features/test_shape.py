"""The ten features against their closed forms, and against straight definitions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_features.shape import CELL_NAMES, METRIC_NAMES, in_cells, in_metres, names_of


def measured(mask, amplitude=None):
    amplitude = np.ones(mask.shape) if amplitude is None else amplitude
    return dict(zip(CELL_NAMES, in_cells(mask[None], amplitude[None].astype(np.float32))[0], strict=True))


def rectangle(blank, a, b, top=3, left=4):
    mask = blank(a + top + 5, b + left + 6)
    mask[top : top + a, left : left + b] = True
    return mask


def ellipse(a, b, turn=0.0, size=161):
    """Cells whose centres lie within half-axes a, b."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    u, v = x * np.cos(turn) + y * np.sin(turn), -x * np.sin(turn) + y * np.cos(turn)
    return (u / a) ** 2 + (v / b) ** 2 <= 1.0


@pytest.mark.parametrize(("a", "b"), [(1, 1), (1, 7), (2, 2), (5, 5), (4, 9), (20, 3), (1, 2)])
def test_a_rectangle_by_closed_form(blank, a, b):
    found = measured(rectangle(blank, a, b))
    outline = a * b - max(a - 2, 0) * max(b - 2, 0)
    assert found["area"] == a * b
    assert found["perimeter"] == outline
    assert_allclose(found["compactness"], 4 * np.pi * a * b / outline**2)
    assert_allclose(found["phi1"], (a * a + b * b - 2) / (12 * a * b), atol=1e-15)
    assert_allclose(found["phi2"], ((a * a - b * b) / (12 * a * b)) ** 2, atol=1e-15)
    # variance of a cells in a row, each a unit wide: (a^2 - 1) / 12 + 1 / 12
    assert_allclose(found["major_axis"], 4 * max(a, b) / np.sqrt(12))
    assert_allclose(found["minor_axis"], 4 * min(a, b) / np.sqrt(12))
    assert_allclose(found["eccentricity"], np.sqrt(1 - (min(a, b) / max(a, b)) ** 2), atol=1e-7)


def test_a_disc_by_closed_form():
    radius = 70.0
    found = measured(ellipse(radius, radius))
    assert_allclose(found["area"], np.pi * radius**2, rtol=2e-3)
    assert_allclose(found["phi1"], 1 / (2 * np.pi), rtol=1e-3)
    assert_allclose(found["phi2"], 0.0, atol=1e-6)
    assert_allclose([found["major_axis"], found["minor_axis"]], 2 * radius, rtol=2e-3)
    assert found["eccentricity"] < 0.05
    # the boundary cells of a digital disc: a digital circle has 4 sqrt(2) R of them (8-connected)
    assert_allclose(found["perimeter"], 4 * np.sqrt(2) * radius, rtol=0.03)


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 4, 1.2, np.pi / 2])
def test_an_ellipse_by_closed_form_at_any_angle(turn):
    a, b = 70.0, 28.0
    found = measured(ellipse(a, b, turn))
    assert_allclose(found["area"], np.pi * a * b, rtol=4e-3)
    assert_allclose(found["major_axis"], 2 * a, rtol=5e-3)
    assert_allclose(found["minor_axis"], 2 * b, rtol=5e-3)
    assert_allclose(found["eccentricity"], np.sqrt(1 - (b / a) ** 2), rtol=2e-3)
    # continuous: mu_20 = pi a^3 b / 4, A = pi a b
    assert_allclose(found["phi1"], (a / b + b / a) / (4 * np.pi), rtol=5e-3)
    assert_allclose(found["phi2"], ((a / b - b / a) / (4 * np.pi)) ** 2, rtol=2e-2)


def test_mean_and_variance_are_of_the_unfiltered_region_alone(blank, rng):
    mask = blank()
    mask[5:9, 3:20] = True
    amplitude = rng.gamma(2.0, 100.0, mask.shape)
    found = measured(mask, amplitude)
    inside = amplitude[mask].astype(np.float32).astype(float)
    assert_allclose([found["mean"], found["variance"]], [inside.mean(), inside.var()], rtol=1e-10)


def test_a_bright_region_keeps_its_small_variance(blank):
    mask = blank()
    mask[2:10, 2:10] = True
    amplitude = np.where(mask, 65_000.0, 0.0)
    amplitude[2, 2] += 1.0
    assert_allclose(measured(mask, amplitude)["variance"], amplitude[mask].var(), rtol=1e-9)
    assert measured(mask, np.full(mask.shape, 1e7))["variance"] == 0.0


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_every_sensor_dtype_gives_the_same(blank, rng, dtype):
    mask = blank()
    mask[4:20, 10:14] = True
    amplitude = rng.integers(0, 255, mask.shape)
    assert_array_equal(
        in_cells(mask[None], amplitude[None].astype(dtype)),
        in_cells(mask[None], amplitude[None].astype(float)),
    )


def by_definition(mask, amplitude):
    """(3.36)-(3.46), straight."""
    padded = np.pad(mask, 1)
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    place = np.argwhere(mask).astype(float)
    area, outline = len(place), np.count_nonzero(mask & ~inner)
    values = np.linalg.eigvalsh(np.cov(place.T, bias=True).reshape(2, 2) + np.eye(2) / 12)
    e = place - place.mean(axis=0)
    eta = e.T @ e / area**2
    phi1, phi2 = eta[0, 0] + eta[1, 1], (eta[0, 0] - eta[1, 1]) ** 2 + 4 * eta[0, 1] ** 2
    return [
        area, outline, 4 * np.pi * area / outline**2, amplitude[mask].mean(), amplitude[mask].var(),
        *4 * np.sqrt(values[::-1]), np.sqrt(1 - values[0] / values[1]), phi1, phi2,
    ]  # fmt: skip


def test_random_regions_against_the_definition(rng):
    mask = rng.random((60, 23, 17)) < rng.random((60, 1, 1))
    mask[:, 0, 0] = True  # never empty, and at the border
    amplitude = rng.rayleigh(3.0, mask.shape).astype(np.float32)
    expected = [by_definition(one, a.astype(float)) for one, a in zip(mask, amplitude, strict=True)]
    assert_allclose(in_cells(mask, amplitude), expected, rtol=1e-9, atol=1e-9)


def test_a_chip_is_measured_alike_alone_and_among_others(rng):
    mask = rng.random((7, 20, 20)) < 0.4
    amplitude = rng.random(mask.shape).astype(np.float32)
    together = in_cells(mask, amplitude)
    alone = np.concatenate([in_cells(mask[n : n + 1], amplitude[n : n + 1]) for n in range(7)])
    assert_array_equal(together, alone)


def test_moving_and_turning_a_region_changes_nothing(rng):
    mask = np.zeros((30, 30), bool)
    mask[2:12, 3:10] = rng.random((10, 7)) < 0.7
    amplitude = rng.random((30, 30)).astype(np.float32)
    moved = np.roll(mask, (9, 11), (0, 1)), np.roll(amplitude, (9, 11), (0, 1))
    turned = np.rot90(mask), np.rot90(amplitude)
    base = measured(mask, amplitude)
    for other in (moved, turned):
        assert_allclose(list(measured(*other).values()), list(base.values()), rtol=1e-9)


def test_an_empty_region_is_nan_and_no_region_is_no_row(blank):
    assert np.isnan(in_cells(blank()[None], np.ones((1, 40, 30)))).all()
    assert in_cells(np.zeros((0, 4, 4), bool), np.zeros((0, 4, 4))).shape == (0, 10)
    assert in_metres(
        np.zeros((0, 4, 4), bool), np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 4)), 0.1, 0.1
    ).shape == (0, 10)


def polar(mask, range_m, bearing_rad, amplitude=None):
    amplitude = np.ones(mask.shape, np.float32) if amplitude is None else amplitude
    cell, beam = np.median(np.diff(range_m)), np.median(np.abs(np.diff(bearing_rad)))
    values = in_metres(mask[None], amplitude[None], range_m[None], bearing_rad[None], cell, beam)[0]
    return dict(zip(METRIC_NAMES, values, strict=True))


def in_world(range_m, bearing_rad, inside):
    """The cells whose centres a Cartesian region (x, y -> bool) holds."""
    r, b = np.meshgrid(range_m, bearing_rad, indexing="ij")
    return inside(r * np.cos(b), r * np.sin(b))


@pytest.mark.parametrize("distance", [15.0, 40.0, 90.0])
@pytest.mark.parametrize("off_axis", [0.0, 0.4])
def test_metres_do_not_change_with_range_or_bearing(distance, off_axis):
    """A disc of 2 m at any place, sampled finely enough."""
    radius = 2.0
    range_m = distance + np.arange(-3.0, 3.0, 0.02)
    bearing_rad = off_axis + np.arange(-3.0, 3.0, 0.02) / distance
    x0, y0 = distance * np.cos(off_axis), distance * np.sin(off_axis)
    mask = in_world(range_m, bearing_rad, lambda x, y: (x - x0) ** 2 + (y - y0) ** 2 <= radius**2)
    found = polar(mask, range_m, bearing_rad)
    assert_allclose(found["area_m2"], np.pi * radius**2, rtol=2e-3)
    assert_allclose(found["perimeter_m"], 8 * radius, rtol=0.02)
    assert_allclose(found["metric_compactness"], np.pi**2 / 16, rtol=0.04)
    assert_allclose([found["major_axis_m"], found["minor_axis_m"]], 2 * radius, rtol=5e-3)
    assert_allclose(found["metric_phi1"], 1 / (2 * np.pi), rtol=2e-3)
    assert_allclose(found["metric_phi2"], 0.0, atol=1e-5)


def test_a_rectangle_in_metres_by_closed_form():
    """Far away a sector of the polar grid is a rectangle."""
    distance, a, b = 10_000.0, 3.0, 5.0  # along range, across
    range_m = distance + 0.1 * np.arange(60)
    bearing_rad = 0.25 * np.arange(40) / distance
    mask = np.zeros((60, 40), bool)
    mask[10:40, 5:25] = True
    found = polar(mask, range_m, bearing_rad)
    assert_allclose(found["area_m2"], a * b, rtol=1e-3)
    assert_allclose(found["perimeter_m"], 2 * (a + b), rtol=1e-3)
    assert_allclose(found["major_axis_m"], 4 * b / np.sqrt(12), rtol=1e-3)
    assert_allclose(found["minor_axis_m"], 4 * a / np.sqrt(12), rtol=1e-3)
    assert_allclose(found["metric_phi1"], (a * a + b * b) / (12 * a * b), rtol=1e-3)
    assert_allclose(found["metric_phi2"], ((a * a - b * b) / (12 * a * b)) ** 2, rtol=5e-3)
    assert_allclose(found["metric_eccentricity"], np.sqrt(1 - (a / b) ** 2), rtol=1e-3)


def test_a_sector_has_the_moments_of_its_area():
    """Against a fine Cartesian sum over the very same cells."""
    range_m, bearing_rad = 5.0 + 0.5 * np.arange(8), np.radians(4.0) * np.arange(-3, 4)
    mask = np.zeros((8, 7), bool)
    mask[2:5, 1:6] = True
    mask[5, 3] = True
    fine_r = 4.75 + 0.01 * (np.arange(400) + 0.5)
    fine_b = np.radians(4.0) * (-3.5 + (np.arange(700) + 0.5) / 100)
    r, b = np.meshgrid(fine_r, fine_b, indexing="ij")
    inside = np.kron(mask, np.ones((50, 100), bool))
    w = r * inside
    place = np.stack([r * np.cos(b), r * np.sin(b)], -1)
    centre = (w[..., None] * place).sum((0, 1)) / w.sum()
    e = place - centre
    area = w.sum() * 0.01 * np.radians(0.04)
    spread = np.einsum("ij,ija,ijb->ab", w, e, e) / w.sum()
    low, high = np.linalg.eigvalsh(spread)
    found = polar(mask, range_m, bearing_rad)
    assert_allclose(found["area_m2"], area, rtol=1e-6)
    assert_allclose(found["major_axis_m"], 4 * np.sqrt(high), rtol=1e-3)
    assert_allclose(found["minor_axis_m"], 4 * np.sqrt(low), rtol=1e-3)
    assert_allclose(found["metric_phi1"], (low + high) / area, rtol=2e-3)


def test_uneven_and_reversed_beams_cover_the_same_area():
    range_m = 20.0 + 0.1 * np.arange(10)
    bearing_rad = np.radians([-3.0, -2.0, -1.5, 0.5, 4.0])
    mask = np.zeros((10, 5), bool)
    mask[3:6, 1:4] = True
    found, mirrored = polar(mask, range_m, bearing_rad), polar(mask[:, ::-1], range_m, bearing_rad[::-1])
    assert_allclose(list(found.values()), list(mirrored.values()), rtol=1e-12)
    from_halfway_to_halfway = np.radians(0.5 * (0.5 + 4.0) - 0.5 * (-3.0 - 2.0))
    assert_allclose(found["area_m2"], range_m[3:6].sum() * 0.1 * from_halfway_to_halfway)


def test_one_beam_and_one_row_take_the_spacing_of_the_ping():
    mask = np.ones((1, 1), bool)
    found = in_metres(mask[None], np.ones((1, 1, 1)), np.array([[10.0]]), np.array([[0.2]]), 0.5, 0.1)[0]
    assert_allclose(found[:2], [10.0 * 0.5 * 0.1, 2 * 0.5 + 2 * 10.0 * 0.1])


def test_names_of_the_two_kinds_differ_where_their_values_do():
    assert set(names_of("cells")) & set(names_of("metres")) == {"mean", "variance"}
