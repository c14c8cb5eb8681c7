"""The nodes `static-features` and `temporal-features`."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_features.blocks import STATISTICS, block_names, block_statistics
from fls_features.chip_messages import Chips, Regions
from fls_features.directions import alignment
from fls_features.shape import CELL_NAMES, METRIC_NAMES
from fls_features.static_features import StaticFeatures
from fls_features.temporal_features import TemporalFeatures
from fls_flow import Features, Tracks
from fls_flow.testing import check_node


@pytest.fixture
def make_pair(rng):
    """Chips and their regions, n of them."""

    def made(n, seq=0, kept=None, course_rad=0.0):
        mask = rng.random((n, 12, 9)) < 0.4
        chips = Chips(
            seq, 5, np.arange(n) + 1, rng.random((n, 12, 9)).astype(np.float32), np.zeros((n, 2), np.int64),
            np.zeros((n, 2), np.int64), np.tile(20 + 0.1 * np.arange(12), (n, 1)),
            np.tile(0.01 * np.arange(9), (n, 1)), 0.1, 0.01, course_rad=np.full(n, course_rad),
        )  # fmt: skip
        kept = np.ones(n, bool) if kept is None else np.asarray(kept, bool)
        return chips, Regions(seq, 5, chips.track_id, mask, np.zeros((n, 2), np.int64), kept)

    return made


def test_a_row_per_kept_region_with_the_names_of_the_kind(make_pair):
    chips, regions = make_pair(3, kept=[True, False, True])
    found = StaticFeatures()(chips, regions)
    assert found.track_id.tolist() == [1, 3]
    assert found.names == CELL_NAMES
    assert_array_equal(found.values[:, 0], regions.mask[[0, 2]].sum((1, 2)))
    assert StaticFeatures(shape="metres")(chips, regions).names == METRIC_NAMES


def test_names_are_there_without_rows():
    found = StaticFeatures()(Chips(1, 2), Regions(1, 2))
    assert (found.names, found.values.shape) == (CELL_NAMES, (0, 10))


def test_no_chips_of_some_size_have_no_features(make_pair):
    chips, _ = make_pair(0)
    assert chips.amplitude.shape == (0, 12, 9)
    assert not len(StaticFeatures()(chips, Regions(0, 5)))


def test_an_empty_region_that_was_kept_has_no_row(make_pair):
    chips, regions = make_pair(2)
    mask = regions.mask.copy()
    mask[0] = False
    again = Regions(0, 5, regions.track_id, mask, regions.seed, regions.kept)
    for shape in ("cells", "metres"):
        assert StaticFeatures(shape=shape)(chips, again).track_id.tolist() == [2]


def test_chips_and_regions_of_other_tracks_are_refused(make_pair):
    with pytest.raises(ValueError, match="wire both from the same chips"):
        StaticFeatures()(make_pair(2)[0], make_pair(3)[1])


def test_static_features_keep_the_contract(make_pair):
    pairs = [make_pair(n, seq) for seq, n in enumerate([2, 0, 3, 1])]
    firings = [{"chips": chips, "regions": regions} for chips, regions in pairs]
    check_node(StaticFeatures(), firings)
    check_node(StaticFeatures(shape="metres"), firings)


def tracks_of(ids, velocity):
    n = len(ids)
    state = np.zeros((n, 4))
    state[:, 2:] = velocity
    ints = np.zeros(n, np.int64)
    return Tracks(0, 5, np.array(ids, np.int64), np.ones(n, np.uint8), state, np.zeros((n, 4, 4)), ints, ints)


def test_with_tracks_the_motion_of_each_follows_the_ten(make_pair):
    chips, regions = make_pair(3, kept=[True, False, True], course_rad=0.3)
    tracks = tracks_of([9, 3, 2, 1], [[0.0, 0.0], [0.3, -0.4], [7.0, 7.0], [-1.2, 0.5]])
    plain, found = (StaticFeatures("metres")(chips, regions, *given) for given in ((), (tracks,)))
    assert found.names == (*METRIC_NAMES, "speed_mps", "axis_on_course", "axis_on_sight", "course_on_sight")
    assert_array_equal(found.values[:, :10], plain.values)
    assert_allclose(found.values[:, 10], [1.3, 0.5])
    kept = regions.kept
    angles = alignment(
        regions.mask[kept], chips.range_m[kept], chips.bearing_rad[kept], chips.course_rad[kept]
    )
    assert_array_equal(found.values[:, 11:], angles)
    nobody = StaticFeatures("metres")(Chips(1, 2), Regions(1, 2), tracks_of([], np.zeros((0, 2))))
    assert (nobody.names, nobody.values.shape) == (found.names, (0, 14))
    with pytest.raises(ValueError, match=r"chips are of tracks \[3\], which are not there"):
        StaticFeatures()(chips, regions, tracks_of([1, 2], np.zeros((2, 2))))
    check_node(StaticFeatures(), [{"chips": chips, "regions": regions, "tracks": tracks}] * 3)


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.3, -0.9])
def test_a_rod_has_the_angles_that_it_lies_at(turn):
    """A rod of 2 m x 0.2 m at 20 m and 0.2 rad, `turn` off the line of sight, that moves at 0.7 rad."""
    range_m, bearing = 17.0 + 0.05 * np.arange(121), np.radians(0.1) * np.arange(-60, 180)
    r, b = np.meshgrid(range_m, bearing, indexing="ij")
    x, y = r * np.cos(b) - 20.0 * np.cos(0.2), r * np.sin(b) - 20.0 * np.sin(0.2)
    axis = 0.2 + turn
    along, across = x * np.cos(axis) + y * np.sin(axis), y * np.cos(axis) - x * np.sin(axis)
    rod = (np.abs(along) <= 1.0) & (np.abs(across) <= 0.1)
    found = alignment(rod[None], range_m[None], bearing[None], np.array([0.7]))
    assert_allclose(found, [[abs(np.cos(axis - 0.7)), abs(np.cos(turn)), abs(np.cos(0.5))]], atol=0.01)
    back = alignment(rod[None, ::-1, ::-1], range_m[None, ::-1], bearing[None, ::-1], np.array([0.7 + np.pi]))
    assert_allclose(back, found)  # neither has a sign, whichever way the tables run


def test_alignment_equals_that_of_the_eigenvector_of_the_covariance(make_pair, rng):
    chips, regions = make_pair(40)
    course = rng.uniform(-4.0, 4.0, 40)
    found = alignment(regions.mask, chips.range_m, chips.bearing_rad, course)
    for k in range(40):
        r, b = np.meshgrid(chips.range_m[k], chips.bearing_rad[k], indexing="ij")
        cells = np.stack([r * np.cos(b), r * np.sin(b)])[:, regions.mask[k]]
        weights = r[regions.mask[k]]
        axis = np.linalg.eigh(np.cov(cells, ddof=0, aweights=weights))[1][:, 1]
        sight = np.average(cells, axis=1, weights=weights)
        sight /= np.hypot(*sight)
        ahead = np.array([np.cos(course[k]), np.sin(course[k])])
        assert_allclose(found[k], np.abs([axis @ ahead, axis @ sight, ahead @ sight]), atol=1e-6)


def test_alignment_of_one_cell_and_of_none():
    mask = np.zeros((2, 3, 3), bool)
    mask[0, 1, 1] = True
    tables = np.tile([10.0, 11.0, 12.0], (2, 1)), np.tile([-0.1, 0.0, 0.1], (2, 1))
    found = alignment(mask, *tables, np.array([0.0, 0.0]))
    assert_allclose(found[0], 1.0)
    assert np.isnan(found[1]).all()


def test_bad_values_are_named():
    with pytest.raises(ValueError, match="shape is 'feet'"):
        StaticFeatures(shape="feet")
    with pytest.raises(ValueError, match="block is 1"):
        TemporalFeatures(block=1)
    with pytest.raises(ValueError, match="max_gap is 0"):
        TemporalFeatures(max_gap=0)
    with pytest.raises(ValueError, match=r"max_leap is 1\.0"):
        TemporalFeatures(max_leap=1.0)
    with pytest.raises(ValueError, match="leap_of is 'c'; the features are a, b"):
        TemporalFeatures(leap_of="c")(described(0, {}))


def test_statistics_of_a_block_by_hand():
    """1, 3, 2, 6, 8: mean 4, differences 2, -1, 4, 2."""
    found = dict(
        zip(STATISTICS, block_statistics(np.array([1.0, 3, 2, 6, 8]).reshape(1, 5, 1))[0], strict=True)
    )
    assert found["mean"] == 4.0
    assert_allclose(found["variance"], (9 + 1 + 4 + 4 + 16) / 5)
    assert_allclose(found["mean_rate"], (8 - 1) / 4)
    assert_allclose(found["rate_variance"], np.mean((np.array([2, -1, 4, 2]) - 1.75) ** 2))


def test_a_ramp_has_its_slope_and_no_variance_of_it():
    block = np.arange(5.0)[None, :, None] * np.array([3.0, -0.5])
    mean, variance, rate, spread = block_statistics(block).reshape(2, 4).T
    assert_allclose(mean, [6.0, -1.0])
    assert_allclose(variance, 2.0 * np.array([9.0, 0.25]))
    assert_allclose(rate, [3.0, -0.5])
    assert_allclose(spread, 0.0, atol=1e-15)


def described(seq, rows, names=("a", "b")):
    """Features of tracks: id -> value of `a`; `b` is its square."""
    values = np.array([[v, v * v] for v in rows.values()]).reshape(len(rows), 2)
    return Features(seq, 10 * seq, np.array(list(rows), np.int64), names, values)


def rows_of(found):
    return {
        track: dict(zip(found.names, values, strict=True))
        for track, values in zip(found.track_id.tolist(), found.values.tolist(), strict=True)
    }


def test_a_row_comes_with_the_ping_that_completes_a_block():
    node = TemporalFeatures(block=3)
    found = [node(described(seq, {7: float(seq)})) for seq in range(7)]
    assert [len(one) for one in found] == [0, 0, 1, 0, 0, 1, 0]
    assert found[5].seq == 5
    assert found[0].names == block_names(("a", "b"))
    assert rows_of(found[2])[7]["a.mean"] == 1.0
    assert rows_of(found[5])[7]["a.mean"] == 4.0  # blocks do not overlap
    assert_allclose(rows_of(found[5])[7]["b.mean_rate"], (25 - 9) / 2)


def test_a_gap_begins_the_block_anew():
    node = TemporalFeatures(block=3)
    found = [node(described(seq, {1: float(seq)} if seq != 2 else {})) for seq in range(6)]
    assert [len(one) for one in found] == [0, 0, 0, 0, 0, 1]
    assert rows_of(found[5])[1]["a.mean"] == 4.0  # pings 3, 4, 5
    longer = TemporalFeatures(block=3, max_gap=2)
    found = [longer(described(seq, {1: float(seq)} if seq != 2 else {})) for seq in range(6)]
    assert [len(one) for one in found] == [0, 0, 0, 1, 0, 0]
    assert_allclose(rows_of(found[3])[1]["a.mean"], (0 + 1 + 3) / 3)


def test_a_leap_begins_the_block_with_what_came_after_it():
    node = TemporalFeatures(block=3, leap_of="a", max_leap=2.0)
    sizes = [1.0, 1.9, 4.0, 2.0, 2.5, 1.0, 1.0, 2.0]
    found = [node(described(seq, {1: size, 2: 5.0})) for seq, size in enumerate(sizes)]
    assert [one.track_id.tolist() for one in found] == [[], [], [2], [], [1], [2], [], [1]]
    assert_allclose(rows_of(found[4])[1]["a.mean"], (4.0 + 2.0 + 2.5) / 3)  # twice as large is no leap
    assert_allclose(rows_of(found[7])[1]["a.mean"], (1.0 + 1.0 + 2.0) / 3)  # nor one between two blocks


@pytest.mark.parametrize("leap_of", [None, "b"])
def test_tracks_are_independent_of_each_other(rng, leap_of):
    """Many tracks that come and go, against one node per track."""
    given = {"block": 4, "leap_of": leap_of, "max_leap": 30.0}
    together, alone = TemporalFeatures(**given), {n: TemporalFeatures(**given) for n in range(12)}
    rows = 0
    for seq in range(200):
        here = {int(n): float(rng.normal()) for n in rng.permutation(12) if rng.random() < 0.9}
        found = rows_of(together(described(seq, here)))
        expected = {}
        for n, node in alone.items():
            expected |= rows_of(node(described(seq, {n: here[n]} if n in here else {})))
        assert found == expected
        rows += len(found)
    assert rows > (200 if leap_of is None else 100)


def test_tracks_that_are_gone_are_forgotten():
    node = TemporalFeatures()
    for seq in range(500):
        node(described(seq, {seq: 1.0}))
    assert node.snapshot()["id"].size <= 2


def test_other_names_begin_all_blocks_anew():
    node = TemporalFeatures(block=2)
    node(described(0, {1: 1.0}))
    assert not len(node(described(1, {1: 2.0}, names=("a", "c"))))
    found = node(described(2, {1: 4.0}, names=("a", "c")))
    assert rows_of(found)[1]["a.mean"] == 3.0
    assert found.names[4] == "c.mean"


def test_features_without_names_or_rows_pass():
    node = TemporalFeatures(block=2)
    assert node(Features(0, 0)).names == ()
    node(described(1, {1: 1.0}))
    assert len(node(described(2, {1: 1.0}))) == 1


def test_temporal_features_keep_the_contract(rng):
    firings = [
        {"features": described(seq, {n: float(rng.normal()) for n in range(seq % 4, 5)} if seq != 3 else {})}
        for seq in range(12)
    ]
    check_node(TemporalFeatures(block=2), firings)
    check_node(TemporalFeatures(block=2, leap_of="b"), firings)
    check_node("temporal-features")
