"""Which tracks get a chip, where it lies, and what it holds."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_features.chips import CutChips
from fls_features.cutting import chip_size, nearest_cells, windows
from fls_flow import NavState
from fls_flow.geometry import sensor_pose
from fls_flow.messages import Mount
from fls_flow.testing import check_node


@pytest.fixture
def numbered(make_ping):
    """An image whose amplitudes tell their cell: 1000 row + column."""

    def made(seq=0, shape=(400, 120), **options):
        row, column = np.indices(shape)
        return make_ping((1000 * row + column).astype(np.float32), seq, **options)

    return made


def test_a_chip_is_20_m_by_10_degrees_around_the_track(numbered, make_tracks):
    chips = CutChips()(numbered(), make_tracks(ids=[4], range_m=[22.0], bearing_rad=[0.0]))
    assert chips.track_id.tolist() == [4]
    assert chips.amplitude.shape == (1, 201, 21)
    row, column = chips.origin[0]
    assert (row, column) == (100, 49)  # range cell 200 at 22 m; beam 59 or 60 is nearest to 0
    assert chips.centre.tolist() == [[100, 10]]
    expected = 1000 * np.arange(row, row + 201)[:, None] + np.arange(column, column + 21)
    assert_array_equal(chips.amplitude[0], expected)
    assert_allclose(chips.range_m[0, 100], 22.0)
    assert_allclose(np.ptp(chips.bearing_rad), math.radians(10.0))


@pytest.mark.parametrize("range_m", [2.0, 6.0, 40.0, 41.9])
@pytest.mark.parametrize("bearing_deg", [-29.75, -27.0, 28.0, 29.75])
def test_at_the_borders_chips_keep_their_size_and_hold_the_track(numbered, make_tracks, range_m, bearing_deg):
    ping = numbered()
    chips = CutChips()(ping, make_tracks(ids=[1], range_m=[range_m], bearing_rad=[math.radians(bearing_deg)]))
    assert chips.amplitude.shape == (1, 201, 21)
    i, j = chips.centre[0]
    assert abs(chips.range_m[0, i] - range_m) <= 0.05 + 1e-9
    assert abs(np.degrees(chips.bearing_rad[0, j]) - bearing_deg) <= 0.25 + 1e-9
    assert chips.amplitude[0, i, j] == 1000 * (chips.origin[0, 0] + i) + chips.origin[0, 1] + j


def test_an_image_smaller_than_a_chip_bounds_it(numbered, make_tracks):
    chips = CutChips()(numbered(shape=(30, 5)), make_tracks(ids=[1], range_m=[3.0], bearing_rad=[0.0]))
    assert chips.amplitude.shape == (1, 30, 5)
    assert chips.origin.tolist() == [[0, 0]]


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1)])
def test_an_image_of_one_row_or_beam(numbered, make_tracks, shape):
    chips = CutChips()(numbered(shape=shape), make_tracks(ids=[1], range_m=[2.0], bearing_rad=[0.0]))
    assert len(chips) == 1
    assert chips.amplitude.size > 0


def test_only_updated_tracks_get_chips(numbered, make_tracks):
    node = CutChips()
    places = {"range_m": [15.0, 25.0], "bearing_rad": [0.1, -0.1]}
    got = [
        node(numbered(seq), make_tracks(seq, ids=[1, 2], hits=hits, **places)).track_id.tolist()
        for seq, hits in enumerate([[5, 1], [6, 1], [6, 2], [6, 2], [7, 3]])
    ]
    assert got == [[1, 2], [1], [2], [], [1, 2]]


def test_ids_in_any_order_and_tracks_that_come_and_go(numbered, make_tracks):
    node = CutChips()

    def ids(seq, ids, hits):
        n = len(ids)
        tracks = make_tracks(seq, ids=ids, hits=hits, range_m=[20.0] * n, bearing_rad=[0.0] * n)
        return node(numbered(seq), tracks).track_id.tolist()

    assert ids(0, [9, 2], [3, 3]) == [9, 2]
    assert ids(1, [2, 9], [3, 4]) == [9]
    assert ids(2, [], []) == []
    assert ids(3, [9], [4]) == [9]  # forgotten meanwhile: new


def test_tentative_tracks_only_on_demand_and_lost_ones_never(numbered, make_tracks):
    tracks = make_tracks(ids=[1, 2, 3], range_m=[20.0] * 3, bearing_rad=[0.0] * 3, status=[0, 1, 2])
    assert CutChips()(numbered(), tracks).track_id.tolist() == [2]
    assert CutChips(tentative=True)(numbered(), tracks).track_id.tolist() == [1, 2]


def test_a_track_outside_the_image_gets_no_chip(numbered, make_tracks):
    tracks = make_tracks(ids=[1, 2, 3, 4], range_m=[51.0, 60.0, 20.0, 20.0], bearing_rad=[0, 0, 0.6, 0.7])
    assert CutChips()(numbered(), tracks).track_id.tolist() == [1, 3]
    none = CutChips()(numbered(), tracks.select(np.array([1])))
    assert none.amplitude.shape == (0, 0, 0)


def test_cells_without_data_are_zero(make_ping, make_tracks):
    amplitude = np.full((60, 20), 5.0, np.float32)
    amplitude[30, 10], amplitude[31, 10] = np.nan, np.inf
    valid = np.ones((60, 20), bool)
    valid[29] = False
    chips = CutChips()(
        make_ping(amplitude, valid=valid), make_tracks(ids=[1], range_m=[5.0], bearing_rad=[0.0])
    )
    assert chips.amplitude[0][29:32, 10].tolist() == [0.0, 0.0, 0.0]
    assert (chips.amplitude == 5.0).sum() == 60 * 20 - 20 - 2


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_chips_keep_the_sensor_dtype(make_ping, make_tracks, dtype):
    ping = make_ping(np.ones((60, 20), dtype))
    assert CutChips()(ping, make_tracks(ids=[1], range_m=[5.0], bearing_rad=[0.0])).amplitude.dtype == dtype


def test_uneven_and_reversed_bearing_tables(make_ping, make_tracks):
    table = np.sort(np.random.default_rng(2).uniform(-0.5, 0.5, 80))
    row, column = np.indices((300, 80))
    image = (1000 * row + column).astype(np.float32)
    tracks = make_tracks(ids=[1], range_m=[20.0], bearing_rad=[0.21])
    one = CutChips()(make_ping(image, bearing_rad=table), tracks)
    other = CutChips()(make_ping(image[:, ::-1], bearing_rad=table[::-1]), tracks)
    j = one.centre[0, 1]
    assert abs(one.bearing_rad[0, j] - 0.21) == np.abs(table - 0.21).min()
    assert_array_equal(one.amplitude[0], other.amplitude[0, :, ::-1])


def test_tracks_in_ned_are_found_through_the_navigation(numbered, make_tracks):
    nav = NavState(0, 0, position_m=(100.0, -50.0, 3.0), attitude_rad=(0.0, 0.0, 0.7))
    world = sensor_pose(nav, Mount()).to_ned(np.array([[20.0 * math.cos(0.1), 20.0 * math.sin(0.1)]]))[0]
    at = {"range_m": [math.hypot(*world)], "bearing_rad": [math.atan2(world[1], world[0])]}
    ned = CutChips()(numbered(nav=nav), make_tracks(ids=[1], frame="ned", **at))
    own = CutChips()(numbered(), make_tracks(ids=[1], range_m=[20.0], bearing_rad=[0.1]))
    assert_array_equal(ned.origin, own.origin)
    assert not len(CutChips()(numbered(), make_tracks(ids=[1], frame="ned", **at)))
    lost = NavState(0, 0, position_m=(100.0, -50.0, 3.0))
    assert not len(CutChips()(numbered(nav=lost), make_tracks(ids=[1], frame="ned", **at)))


def test_courses_are_those_in_the_frame_of_the_sensor(numbered, make_tracks):
    nav = NavState(0, 0, position_m=(3.0, -2.0, 3.0), attitude_rad=(0.0, 0.0, 0.7))
    for frame, heading in (("sensor", 0.0), ("ned", 0.7)):
        tracks = make_tracks(ids=[4, 5], range_m=[20.0, 21.0], bearing_rad=[0.5, 0.6], frame=frame)
        state = tracks.state.copy()
        state[:, 2:] = [[0.3, 0.4], [-1.0, -0.1]]
        chips = CutChips(half_bearing_deg=60.0)(numbered(nav=nav), replace(tracks, state=state))
        expected = np.array([math.atan2(0.4, 0.3), math.atan2(-0.1, -1.0)]) - heading
        assert_allclose(np.cos(chips.course_rad - expected), 1.0)
        assert chips.track_id.tolist() == [4, 5]


def test_sizes_are_rounded_half_up():
    assert chip_size(10.0, 0.25, 0.1, 0.1) == (201, 7)  # 2.5 beams are 3
    assert chip_size(0.04, 0.01, 0.1, 0.1) == (1, 1)
    assert chip_size(10.0, 0.1, float("nan"), 0.0) == (1, 1)


def test_nearest_cells_against_a_full_search(rng):
    range_m, bearing_rad = np.sort(rng.uniform(1, 50, 60)), rng.uniform(-np.pi, np.pi, 40)
    r, b = rng.uniform(-5, 60, 300), rng.uniform(-np.pi, np.pi, 300)
    apart = np.abs(np.angle(np.exp(1j * (b[:, None] - bearing_rad))))
    expected = np.stack([np.abs(r[:, None] - range_m).argmin(1), apart.argmin(1)], 1)
    assert_array_equal(nearest_cells(range_m, bearing_rad, r, b), expected)


def test_windows_stay_inside(rng):
    cell = np.stack([rng.integers(0, 50, 100), rng.integers(0, 9, 100)], 1)
    found = windows(cell, (21, 31), (50, 9))
    assert found.size == (21, 9)
    assert (found.origin >= 0).all()
    assert (found.origin + found.size <= [50, 9]).all()
    assert_array_equal(found.origin + found.centre, cell)
    assert ((found.centre >= 0) & (found.centre < found.size)).all()


def test_the_node_keeps_the_contract(numbered, make_tracks):
    firings = [
        {
            "ping": numbered(seq, shape=(300, 60)),
            "tracks": make_tracks(
                seq,
                ids=ids,
                hits=[seq + 1] * len(ids),
                range_m=[20.0 + seq] * len(ids),
                bearing_rad=[0.1] * len(ids),
            ),
        }
        for seq, ids in enumerate([[1], [1, 2], [], [2, 1], [2], [3, 2]])
    ]
    check_node(CutChips(), firings)
    check_node("chips")


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"half_range_m": 0.0}, "half_range_m is 0.0"),
        ({"half_bearing_deg": 181.0}, "half_bearing_deg is 181.0"),
    ],
)
def test_bad_values_are_named(parameters, says):
    with pytest.raises(ValueError, match=says):
        CutChips(**parameters)
