"""Hydrophone positions from distances; sound through layers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_sources.array_geometry import FLOATER_M, effective_speed_mps, positions_from_distances


def table_of(places: np.ndarray) -> np.ndarray:
    return np.linalg.norm(places[:, None] - places, axis=-1)


def test_the_floater_comes_back_but_for_its_centre() -> None:
    """The listed first hydrophone lies astern, the second to starboard: counterclockwise of it."""
    places = np.array(FLOATER_M)
    centred = places - places.mean(axis=0)
    turn = np.arctan2(centred[0, 1], centred[0, 0])
    found = positions_from_distances(table_of(places), turn, clockwise=False)
    assert_allclose(found, centred, atol=1e-12)


@pytest.mark.parametrize("n", [2, 3, 4, 9])
def test_any_planar_array_keeps_its_distances_and_the_rule(n) -> None:
    rng = np.random.default_rng(n)
    for _ in range(20):
        places = np.pad(rng.standard_normal((n, 2)), ((0, 0), (0, 1)))
        found = positions_from_distances(table_of(places), 0.7)
        assert_allclose(table_of(found), table_of(places), atol=1e-9)
        assert_allclose(found.mean(axis=0), 0.0, atol=1e-12)
        assert_allclose(np.arctan2(found[0, 1], found[0, 0]), 0.7, atol=1e-9)
        if n > 2:
            assert found[0, 0] * found[1, 1] - found[0, 1] * found[1, 0] > 0.0  # the second to starboard
        mirrored = positions_from_distances(table_of(places), 0.7, clockwise=False)
        assert_allclose(table_of(mirrored), table_of(places), atol=1e-9)


def test_errors_of_measurement_stay_small() -> None:
    rng = np.random.default_rng(0)
    table = table_of(np.array(FLOATER_M))
    noise = rng.normal(0.0, 0.002, table.shape)
    measured = np.abs(table + np.triu(noise, 1) + np.triu(noise, 1).T)
    assert np.abs(table_of(positions_from_distances(measured)) - table).max() < 0.01


@pytest.mark.parametrize(
    ("table", "named"),
    [
        ([[0.0, 1.0]], "shape"),
        ([[0.0]], "shape"),
        ([[0.0, 1.0], [1.1, 0.0]], "1.0 from 1 to 2, but 1.1 back"),
        ([[0.0, -1.0], [-1.0, 0.0]], "negative"),
        ([[0.0, np.nan], [np.nan, 0.0]], "not finite"),
        ([[0.1, 1.0], [1.0, 0.0]], "diagonal"),
        ([[0.0, 0.0], [0.0, 0.0]], "positive"),
    ],
)
def test_tables_that_are_none(table, named) -> None:
    with pytest.raises(ValueError, match=named):
        positions_from_distances(table)


LAYERS = [[0.0, 1500.0], [3.0, 1520.0]]


def test_layers_by_hand() -> None:
    assert effective_speed_mps(LAYERS, 20.0, 20.0) == 1520.0
    assert effective_speed_mps(LAYERS, 1.0, 2.0) == 1500.0
    assert effective_speed_mps(LAYERS, 3.0, 3.0) == 1520.0
    assert_allclose(effective_speed_mps(LAYERS, 0.0, 6.0), 6.0 / (3.0 / 1500.0 + 3.0 / 1520.0))
    assert_allclose(effective_speed_mps(LAYERS, 6.0, 0.0), effective_speed_mps(LAYERS, 0.0, 6.0))
    assert_allclose(effective_speed_mps([[0.0, 1480.0]], 5.0, 90.0), 1480.0)


def test_a_straight_path_takes_the_time_that_it_takes() -> None:
    layers = [[0.0, 1500.0], [3.0, 1520.0], [10.0, 1505.0]]
    start, end = np.array([0.0, 20.0]), np.array([300.0, 1.0])
    points = start + np.linspace(0.0, 1.0, 200_001)[:, None] * (end - start)
    depth = 0.5 * (points[1:, 1] + points[:-1, 1])
    speed = np.array([1500.0, 1520.0, 1505.0])[np.searchsorted([0.0, 3.0, 10.0], depth, side="right") - 1]
    time_s = np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1) / speed)
    assert_allclose(np.linalg.norm(end - start) / effective_speed_mps(layers, 20.0, 1.0), time_s, rtol=1e-6)


@pytest.mark.parametrize(
    ("layers", "depths", "named"),
    [
        ([], (1.0, 2.0), "shape"),
        ([[1.0, 1500.0]], (1.0, 2.0), "begin at 0"),
        ([[0.0, 1500.0], [0.0, 1510.0]], (1.0, 2.0), "go down"),
        ([[0.0, 0.0]], (1.0, 2.0), "speeds"),
        (LAYERS, (-1.0, 2.0), "-1.0 and 2.0"),
        (LAYERS, (1.0, np.inf), "inf"),
    ],
)
def test_layers_that_are_none(layers, depths, named) -> None:
    with pytest.raises(ValueError, match=named):
        effective_speed_mps(layers, *depths)
