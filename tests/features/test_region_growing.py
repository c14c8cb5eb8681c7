"""The node `region-growing`: what is kept, and what is refused."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fls_features.chip_messages import Chips, Regions
from fls_features.region_growing import RegionGrowing
from fls_flow import wire
from fls_flow.testing import check_node


@pytest.fixture
def make_chips():
    def made(amplitude, seq=3, centre=None):
        amplitude = np.asarray(amplitude)
        n, rows, columns = amplitude.shape
        centre = np.tile([rows // 2, columns // 2], (n, 1)) if centre is None else np.asarray(centre)
        range_m = np.tile(20.0 + 0.1 * np.arange(rows), (n, 1))
        bearing = np.tile(np.radians(0.5) * np.arange(columns), (n, 1))
        origin = np.zeros((n, 2), np.int64)
        return Chips(
            seq, 7, np.arange(n) + 5, amplitude, origin, centre, range_m, bearing, 0.1, np.radians(0.5),
            course_rad=np.zeros(n),
        )  # fmt: skip

    return made


def object_in(shape, row, column, half=(8, 2), level=20.0):
    chip = np.zeros(shape, np.float32)
    chip[row - half[0] : row + half[0] + 1, column - half[1] : column + half[1] + 1] = level
    return chip


def test_an_object_is_found_in_noise(make_chips, rng):
    noise = rng.rayleigh(1.0, (100, 21)).astype(np.float32)
    regions = RegionGrowing()(make_chips([noise + object_in((100, 21), 48, 10)]))
    truth = object_in((100, 21), 48, 10) > 0
    assert regions.kept.all()
    overlap = (regions.mask[0] & truth).sum() / (regions.mask[0] | truth).sum()
    assert overlap > 0.6


def test_a_flat_chip_leaks_and_a_dark_one_has_no_region(make_chips):
    regions = RegionGrowing(filter_rows=1, filter_columns=1)(
        make_chips([np.full((60, 20), 5.0, np.float32), np.zeros((60, 20), np.float32)])
    )
    assert regions.mask[0].all()
    assert not regions.mask[1].any()
    assert regions.kept.tolist() == [False, False]


def test_half_of_the_chip_is_kept_and_more_is_not(make_chips):
    chips = np.zeros((2, 60, 20), np.float32)
    chips[0, 15:45] = 5.0
    chips[1, 15:46] = 5.0
    found = RegionGrowing(filter_rows=1, filter_columns=1)(make_chips(chips))
    assert found.kept.tolist() == [True, False]
    assert RegionGrowing(filter_rows=1, filter_columns=1, max_fill=1.0)(make_chips(chips)).kept.all()


def test_only_near_the_track_a_brighter_neighbour_is_not_taken(make_chips):
    chip = object_in((100, 21), 30, 6) + object_in((100, 21), 80, 16, level=40.0)
    anywhere = RegionGrowing()(make_chips([chip], centre=[[30, 6]]))
    near = RegionGrowing(seed_within_m=3.0)(make_chips([chip], centre=[[30, 6]]))
    assert anywhere.seed[0, 0] > 60
    assert near.seed[0, 0] < 50
    assert not (near.mask & anywhere.mask).any()


@pytest.mark.parametrize("rule", ["seed", "histogram", "percentile"])
def test_all_thresholds_find_a_clear_object(make_chips, rng, rule):
    noise = rng.rayleigh(0.5, (100, 21)).astype(np.float32)
    found = RegionGrowing(threshold=rule)(make_chips([noise + object_in((100, 21), 48, 10)]))
    assert found.mask[0, 48, 10]
    assert found.kept[0] == (found.mask[0].mean() <= 0.5)


def test_scaling_the_amplitudes_changes_no_region(make_chips, rng):
    chips = rng.rayleigh(1.0, (5, 80, 21)).astype(np.float32)
    for rule in ("seed", "histogram", "percentile"):
        one, other = (RegionGrowing(threshold=rule)(make_chips(c)) for c in (chips, 64.0 * chips))
        assert_array_equal(one.mask, other.mask)


def test_messages_travel(make_chips, rng):
    chips = make_chips(rng.integers(0, 255, (3, 40, 11)).astype(np.uint8))
    regions = RegionGrowing()(chips)
    for message, cls in ((chips, Chips), (regions, Regions), (Chips(1, 2), Chips), (Regions(1, 2), Regions)):
        back = wire.decode(wire.encode(message), cls)
        assert len(back) == len(message)
        assert wire.encode(back) == wire.encode(message)
    assert wire.decode(wire.encode(chips), Chips).amplitude.dtype == np.uint8


def test_two_parts_of_a_body_are_one_region_up_to_the_gap(make_chips):
    """Torso and legs, 5 dark rows of 0.1 m between them: their cells are 0.6 m apart."""
    chip = object_in((60, 20), 20, 10, (4, 2)) + object_in((60, 20), 34, 10, (4, 2), 12.0)
    for gap_m, rows in ((0.0, 9), (0.55, 9), (0.6001, 18)):
        node = RegionGrowing(filter_rows=1, filter_columns=1, level=0.2, gap_m=gap_m)
        assert node(make_chips([chip])).mask[0].any(axis=1).sum() == rows


def test_the_node_keeps_the_contract(make_chips, rng):
    firings = [
        {"chips": make_chips(rng.rayleigh(1.0, (n, 50, 11)).astype(np.float32), seq=n)}
        for n in (0, 1, 4, 0, 2)
    ]
    check_node(RegionGrowing(), firings)
    check_node(RegionGrowing(gap_m=0.3), firings)


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"filter_rows": 0}, "filter_rows is 0"),
        ({"threshold": "otsu"}, "threshold is 'otsu'"),
        ({"level": 1.0}, "level is 1.0"),
        ({"level": float("nan")}, "level is nan"),
        ({"seed_within_m": 0.0}, "seed_within_m is 0.0"),
        ({"max_fill": 0.0}, "max_fill is 0.0"),
        ({"gap_m": -0.1}, "gap_m is -0.1"),
    ],
)
def test_bad_values_are_named(parameters, says):
    with pytest.raises(ValueError, match=says):
        RegionGrowing(**parameters)


def test_whatever_comes_in_finite_features_come_out(rng):
    """Images of any size and dtype, with gaps, odd tables and tracks anywhere."""
    from fls_features.chips import CutChips
    from fls_features.static_features import StaticFeatures
    from fls_flow import Ping, Tracks

    described = 0
    for trial in range(400):
        rows, beams, n = rng.integers(1, 70), rng.integers(1, 40), rng.integers(0, 6)
        dtype = rng.choice([np.uint8, np.uint16, np.float32])
        amplitude = (rng.rayleigh(1.0, (rows, beams)) * rng.choice([0, 1, 50])).astype(dtype)
        if dtype == np.float32:
            amplitude[rng.random((rows, beams)) < 0.1] = rng.choice([np.nan, np.inf, -np.inf, -5.0, 3e38])
        range_m = rng.uniform(0, 5) + rng.choice([0.02, 0.5]) * np.arange(rows)
        bearing_rad = np.sort(rng.uniform(-3.1, 3.1, beams))[:: rng.choice([-1, 1])]
        valid = rng.random((rows, beams)) < 0.9 if trial % 2 else None
        ping = Ping(trial, trial, amplitude, range_m, bearing_rad, valid=valid)
        state = rng.normal(0, 10, (n, 4))
        state[: trial % 11 == 0] = np.nan
        ones = np.ones(n, np.uint8)
        tracks = Tracks(trial, trial, rng.permutation(9)[:n], ones, state, np.zeros((n, 4, 4)), ones, ones)
        chips = CutChips(rng.choice([0.1, 3.0, 100.0]), rng.choice([1.0, 30.0, 180.0]))(ping, tracks)
        rule = ("seed", "histogram", "percentile")[trial % 3]
        regions = RegionGrowing(threshold=rule, seed_within_m=rng.choice([None, 0.5, 5.0]))(chips)
        for shape in ("cells", "metres"):
            values = StaticFeatures(shape=shape)(chips, regions).values
            assert np.isfinite(values).all()
            described += len(values)
    assert described > 300
