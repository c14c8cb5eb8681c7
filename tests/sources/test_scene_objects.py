"""Things of simulated scenes: their scatterers and the field of their echoes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_sources.scene_clutter import beam_power
from fls_sources.scene_motion import TimedPath
from fls_sources.scene_objects import SceneObject, echo_field, scatterers

WIDTH = np.deg2rad(1.5)
BEAMS = WIDTH * (np.arange(39) - 19)


def thing(length=0.0, width=0.0, snr=20.0, number=1):
    return SceneObject(number, "thing", TimedPath.still(20.0, 0.0), length, width, snr)


def field(row, bearing, power, coherence, seed=0):
    return echo_field(
        np.array(row),
        np.array(bearing, float),
        np.array(power, float),
        np.array(coherence, float),
        BEAMS,
        WIDTH,
        -28.0,
        np.random.default_rng(seed),
    )


def test_a_point_has_one_scatterer_with_its_snr():
    parts = scatterers([thing()], 0.05, np.random.default_rng(0))
    assert_array_equal(parts.offset_m, 0.0)
    assert_allclose(parts.power, [100.0])


def test_scatterers_fill_the_ellipse_and_share_its_power():
    parts = scatterers([thing(), thing(6.0, 1.5)], 0.05, np.random.default_rng(0))
    ahead, starboard = parts.offset_m[parts.owner == 1].T
    assert ((ahead / 3.0) ** 2 + (starboard / 0.75) ** 2 <= 1.0 + 1e-9).all()
    assert np.ptp(ahead) > 5.0
    assert parts.power[parts.owner == 1].sum() == pytest.approx(100.0 * 3.0 / 0.05)


def test_no_thing_no_scatterer():
    parts = scatterers([], 0.05, np.random.default_rng(0))
    assert parts.owner.size == 0
    assert parts.place(np.zeros((0, 2)), np.zeros((0, 2))).shape == (0, 2)


def test_a_boat_turns_its_scatterers_into_its_course():
    parts = scatterers([thing(6.0, 1.0)], 0.05, np.random.default_rng(0))
    east = parts.place(np.array([[20.0, 5.0]]), np.array([[0.0, 2.0]]))
    assert np.ptp(east[:, 1]) > 5.0
    assert np.ptp(east[:, 0]) < 1.0
    assert_allclose(east[:, 1] - 5.0, parts.offset_m[:, 0], atol=1e-12)


def test_a_steady_echo_has_the_beam_pattern_and_no_fluctuation():
    power = beam_power(BEAMS[23] + 0.005 - BEAMS, WIDTH, -28.0)
    for seed in range(3):
        rows, echo = field([77], [BEAMS[23] + 0.005], [400.0], [1.0], seed)
        assert_array_equal(rows, [77])
        assert_allclose(np.abs(echo[0]) ** 2, 400.0 * power, rtol=1e-4)


@pytest.mark.parametrize("coherence", [0.0, 0.5, 1.0])
def test_mean_and_variance_of_an_echo_follow_its_coherence(coherence):
    # 4000 rows with one scatterer each: Rician power has variance P^2 (1 - c^2)
    n = 4000
    _, echo = field(np.arange(n), np.zeros(n), np.full(n, 50.0), np.full(n, coherence))
    power = np.abs(echo[:, 19]).astype(float) ** 2
    assert power.mean() == pytest.approx(50.0, rel=0.08)
    assert power.var() == pytest.approx(2500.0 * (1.0 - coherence**2), rel=0.15, abs=1e-3)


def test_scatterers_of_one_cell_interfere_and_rows_are_sorted():
    rows, echo = field([9, 4, 9, 4, 4], np.zeros(5), np.ones(5), np.ones(5))
    assert_array_equal(rows, [4, 9])
    assert echo.shape == (2, 39)
    phases = np.exp(2j * np.pi * np.random.default_rng(0).random(5))
    assert_allclose(echo[:, 19], [phases[[1, 3, 4]].sum(), phases[[0, 2]].sum()], rtol=1e-4)


def test_no_echo():
    rows, echo = field(np.zeros(0, int), [], [], [])
    assert rows.size == 0
    assert echo.shape == (0, 39)
