"""Wakes of simulated scenes: where their bubbles lie, how they widen and fade, the power that they make."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_sources.scene_clutter import beam_power
from fls_sources.scene_motion import TimedPath
from fls_sources.scene_wake import N_BUBBLES, WakeLaw, bubbles, wake_patch

ACROSS = TimedPath.straight(0.0, (30.0, -10.0), (0.0, 0.5))
BEAMS = np.deg2rad(1.5) * (np.arange(39) - 19)


def trail(**law):
    return bubbles(WakeLaw(**law), np.random.default_rng(5))


def patch(distance, bearing, area, n_ranges=1000, beams=BEAMS, **geometry):
    given = {
        "range_min_m": 0.0,
        "cell_m": 0.05,
        "spacing_rad": np.deg2rad(1.5),
        "beamwidth_rad": np.deg2rad(1.5),
    }
    return wake_patch(
        np.array(distance, float),
        np.array(bearing, float),
        np.array(area, float),
        n_ranges=n_ranges,
        beams_rad=beams,
        **(given | geometry),
    )


def test_a_wake_ends_at_the_boat_and_begins_where_it_was_laid():
    position, _ = trail(life_s=100.0).alive(ACROSS, 40.0)
    assert position[:, 1].max() == pytest.approx(10.0, abs=0.02)
    assert position[:, 1].min() == pytest.approx(-10.0, abs=0.02)


def test_a_wake_widens_with_age():
    position, _ = trail(half_width_m=0.4, widening_mps=0.02, life_s=100.0).alive(ACROSS, 80.0)
    along, off = position[:, 1], position[:, 0] - 30.0
    young, old = off[along > 28.0], off[along < -8.0]
    assert old.std() > 3.0 * young.std()
    assert np.abs(young).max() <= 0.4 + 0.02 * 4.1
    assert np.abs(old).max() > 1.5


def test_a_wake_fades_with_age():
    wake = trail(decay_s=20.0, life_s=100.0)
    position, area = wake.alive(ACROSS, 80.0)
    fresh, old = area[position[:, 1] > 25.0].mean(), area[position[:, 1] < -5.0].mean()
    assert old / fresh == pytest.approx(np.exp(-70.0 / 20.0), rel=0.15)


def test_bubbles_stay_where_they_were_laid():
    wake = trail(widening_mps=0.0, life_s=60.0)
    earlier, later = wake.alive(ACROSS, 20.0)[0], wake.alive(ACROSS, 21.5)[0]
    assert_allclose(later[: len(earlier)], earlier, atol=1e-12)


@pytest.mark.parametrize(("time_s", "n"), [(-1.0, 0), (0.0, 1), (50.0, N_BUBBLES // 2 + 1), (1e6, N_BUBBLES)])
def test_the_number_of_bubbles_is_bounded(time_s, n):
    position, area = trail(life_s=100.0, start_s=0.0).alive(ACROSS, time_s)
    assert abs(len(position) - n) <= 1
    assert len(area) == len(position)


def test_a_boat_that_lies_still_leaves_no_wake():
    _, area = trail().alive(TimedPath.still(20.0, 0.0), 50.0)
    assert_array_equal(area, 0.0)


def test_mean_power_of_a_broad_wake_is_its_snr():
    # bubbles spread evenly over 4 m x 8 m with 16 dB: away from the border every cell has that power
    rng = np.random.default_rng(0)
    n = 200_000
    xy = np.stack([rng.uniform(28.0, 32.0, n), rng.uniform(-4.0, 4.0, n)], axis=-1)
    area = np.full(n, 4.0 * 8.0 / n * 10.0**1.6)
    rows, power = patch(np.hypot(*xy.T), np.arctan2(xy[:, 1], xy[:, 0]), area)
    inside = power[580 - rows.start : 620 - rows.start, 17:22]
    assert inside.mean() == pytest.approx(10.0**1.6, rel=0.02)


def test_wake_power_equals_a_slow_sum_over_bubbles():
    rng = np.random.default_rng(1)
    distance, bearing, area = rng.uniform(-5.0, 60.0, 80), rng.uniform(-0.6, 0.6, 80), rng.random(80)
    rows, power = patch(distance, bearing, area, range_min_m=2.0)
    slow = np.zeros((1000, 39))
    for d, b, a in zip(distance, bearing, area, strict=True):
        m = int(np.floor((d - 2.0) / 0.05))
        for n in range(39):
            nearest = round((b - BEAMS[0]) / np.deg2rad(1.5))
            if 0 <= m < 1000 and abs(n - nearest) <= 2:
                lobe = beam_power(b - BEAMS[n], np.deg2rad(1.5), -np.inf)
                slow[m, n] += a / (0.05 * d * 1.064 * np.deg2rad(1.5)) * lobe
    whole = np.zeros_like(slow)
    whole[rows] = power
    assert_allclose(whole, slow, rtol=1e-9)


@pytest.mark.parametrize("distance", [[], [70.0], [-1.0]])
def test_a_wake_out_of_sight_touches_nothing(distance):
    rows, power = patch(distance, np.zeros(len(distance)), np.ones(len(distance)))
    assert power.shape == (0, 39)
    assert rows == slice(0, 0)


def test_one_beam_and_one_cell():
    rows, power = patch([0.02], [0.0], [1.0], n_ranges=1, beams=np.zeros(1))
    assert power.shape == (1, 1)
    assert rows == slice(0, 1)


@pytest.mark.parametrize("beams_per_width", [1, 4, 40])
def test_wake_power_per_beam_does_not_depend_on_the_spacing_of_the_beams(beams_per_width):
    spacing = np.deg2rad(1.5) / beams_per_width
    beams = spacing * np.arange(-2 * beams_per_width, 2 * beams_per_width + 1)
    where = ([20.0, 20.0], [0.001, -0.02], [1.0, 3.0])
    _, wide = patch(*where)
    _, fine = patch(*where, beams=beams, spacing_rad=spacing)
    assert_allclose(fine[:, ::beams_per_width][:, 1:4], wide[:, 18:21], rtol=0.01)  # both cut the lobe off


def test_a_bubble_under_the_sonar_has_finite_power():
    _, power = patch([0.0], [0.0], [1.0])
    assert np.isfinite(power).all()
    assert power.max() > 0.0
