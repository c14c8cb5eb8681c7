"""The picture: marks where they belong, odd pings, whole files, bounded memory."""

import logging
import math

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import BeamMask, Classes, Detections, InputError, NavState, Tracks, Truth, Wakes
from fls_flow.geometry import sensor_pose
from fls_sinks.marks import ellipse, wedge
from fls_sinks.picture import Look, drawn, levels, when
from fls_sinks.plot import Plot
from fls_sinks.scene import History, Scene

LOOK = Look(dynamic_range_db=40.0, gate_probability=0.99, colormap="gray", dpi=100)


def pixels(figure):
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[:, :, :3].astype(int)


def dot(figure, x, y, panel=0):
    """Row and column of the dot at x forward, y starboard."""
    column, row = figure.axes[2 * panel].transData.transform((y, x))
    return int(figure.bbox.height - row), int(column)


def near(image, where, reach=3):
    row, column = where
    return image[row - reach : row + reach + 1, column - reach : column + reach + 1].reshape(-1, 3)


def texts(figure, panel=0):
    return [text.get_text() for text in figure.axes[2 * panel].texts]


def labels(figure):
    return {text.get_text() for text in figure.legends[0].get_texts()}


def nav(north=0.0, east=0.0, yaw=0.0):
    return NavState(0, 0, (north, east, 0.0), (0.0, 0.0, yaw))


def plotted(path, *messages, **parameters):
    node = Plot(path, **parameters)
    for message in messages:
        node(**message)
    node.close()
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture


def test_a_bright_cell_is_white_at_its_place(make_ping):
    amplitude = np.full((60, 21), 10.0, np.float32)
    amplitude[40, 4] = 1000.0
    ping = make_ping(amplitude=amplitude)
    figure = drawn([Scene.of(ping)], LOOK)
    image = pixels(figure)
    x = ping.range_m[40] * np.cos(ping.bearing_rad[4])
    y = ping.range_m[40] * np.sin(ping.bearing_rad[4])
    assert (near(image, dot(figure, x, y), 1) > 250).all()
    assert (near(image, dot(figure, x, -y), 1) < 120).all()


def test_both_axes_have_one_scale(make_ping):
    for shape in [(60, 1), (60, 21)]:
        figure = drawn([Scene.of(make_ping(shape=shape))], LOOK)
        pixels(figure)
        (row, column), (up, _), (_, right) = (dot(figure, x, y) for x, y in [(10, 0), (20, 0), (10, 10)])
        assert abs((row - up) - (right - column)) <= 1


def test_x_is_up_and_starboard_is_right(make_ping):
    figure = drawn([Scene.of(make_ping())], LOOK)
    pixels(figure)
    assert dot(figure, 20, 0)[0] < dot(figure, 10, 0)[0]
    assert dot(figure, 20, 5)[1] > dot(figure, 20, -5)[1]


def test_detections_are_marked(make_ping):
    ping = make_ping()
    detections = Detections.of(
        ping, range_m=[15.0, 20.0, 25.0], bearing_rad=[0.2, -0.3, 0.0], amplitude=[1, 1, 1], kind=[0, 1, 2]
    )
    figure = drawn([Scene.of(ping, detections)], LOOK)
    image = pixels(figure)
    for x, y in detections.position_m:
        around = near(image, dot(figure, x, y), 6)
        assert (np.ptp(around, axis=1) > 60).any()  # coloured, on a grey image
    assert labels(figure) == {"echo", "self-noise", "wake end"}


def test_tracks_carry_ids_and_lost_ones_none(make_ping, make_tracks):
    tracks = make_tracks(
        ids=(17, 4, 99), status=(1, 0, 2), state=[[20, 2, 0, 0], [15, -3, 0, 0], [25, 0, 0, 0]]
    )
    figure = drawn([Scene.of(make_ping(), tracks=tracks)], LOOK)
    image = pixels(figure)
    assert texts(figure) == ["17"]
    assert labels(figure) == {"confirmed track", "tentative track"}
    assert (np.ptp(near(image, dot(figure, 20, 2)), axis=1) > 60).any()
    assert (np.ptp(near(image, dot(figure, 25, 0)), axis=1) < 60).all()
    assert "3 confirmed" not in figure.axes[0].get_title()


def test_tracks_carry_the_labels_of_their_classes(make_ping, make_tracks):
    tracks = make_tracks(ids=(17, 4), status=(1, 1), state=[[20, 2, 0, 0], [15, -3, 0, 0]])
    classes = Classes(0, 0, np.array([17]), ("diver", "marine"), np.array([1]), np.array([[0.2, 0.8]]))
    scene = Scene.of(make_ping(), tracks=tracks, classes=classes)
    assert sorted(texts(drawn([scene], LOOK))) == ["17 marine", "4"]
    again = Scene.restored(scene.snapshot())
    assert again.track_label == ("marine", "")


def test_the_ellipse_is_turned_as_the_covariance(make_ping, make_tracks):
    tracks = make_tracks(ids=(1,), state=[[20, 0, 0, 0]])
    along = np.array([1.0, 0.5]) / math.hypot(1.0, 0.5)  # mostly forward, somewhat to starboard
    covariance = np.zeros((1, 4, 4))
    covariance[0, :2, :2] = 0.9 * np.outer(along, along) + 0.01 * np.eye(2)
    tracks = Tracks(0, 0, tracks.id, tracks.status, tracks.state, covariance, tracks.hits, tracks.age)
    figure = drawn([Scene.of(make_ping(), tracks=tracks)], LOOK)
    (patch,) = figure.axes[0].patches
    tip = patch.get_transform().transform(patch.get_path().vertices)
    y, x = figure.axes[0].transData.inverted().transform(tip).T
    far = np.argmax(np.hypot(x - 20, y))
    expected = math.sqrt(-2 * math.log(0.01) * 0.91)
    assert_allclose(abs((x[far] - 20) * along[0] + y[far] * along[1]), expected, rtol=0.02)


def test_ellipse_holds_the_probability():
    rng = np.random.default_rng(1)
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    long, short, angle = ellipse(covariance, 0.9)
    points = rng.multivariate_normal([0, 0], covariance, 40_000) @ np.array(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    inside = np.mean((points[:, 0] / long) ** 2 + (points[:, 1] / short) ** 2 < 1)
    assert abs(inside - 0.9) < 4 * math.sqrt(0.9 * 0.1 / 40_000)


def test_wakes_noise_and_truth_are_drawn(make_ping):
    ping = make_ping()
    wakes = Wakes(
        0,
        0,
        np.array([[10.0, 0.0]]),
        np.zeros(1),
        np.array([8.0]),
        np.array([0.2]),
        np.zeros(1),
        np.ones(1, bool),
    )
    mask = BeamMask(0, 0, np.arange(21) == 15, ping.bearing_rad)
    truth = Truth(0, 0, np.array([1]), np.array([[22.0, -6.0, 0, 0]]), ("buoy",))
    figure = drawn([Scene.of(ping, wakes=wakes, beam_mask=mask, truth=truth)], LOOK)
    image = pixels(figure)
    assert labels(figure) == {"wake", "noisy beam", "truth"}
    assert np.median(np.ptp(near(image, dot(figure, 16, 0)), axis=1)) > 15  # tinted
    assert np.median(np.ptp(near(image, dot(figure, 16, -4)), axis=1)) == 0
    assert (near(image, dot(figure, 22, -6), 2) > 240).all(axis=1).any()


def test_wedge():
    corners = wedge(np.array([10.0, 2.0]), math.pi / 2, 4.0, 0.1)
    assert_allclose(corners[[0, -1]], [[10, 2], [10, 2]])
    assert_allclose(corners[5], [10.0, 6.0])
    assert_allclose(np.hypot(*(corners[1:-1] - [10, 2]).T), 4.0)
    assert_allclose(np.ptp(np.arctan2(*(corners[1:-1] - [10, 2]).T)), 0.2)


def test_overlapping_wedges_do_not_hide_the_echoes(make_ping):
    ping = make_ping(amplitude=np.full((60, 21), 10, np.uint8))

    def tint(n):
        wakes = Wakes(
            0,
            0,
            np.full((n, 2), [10.0, 0.0]),
            np.zeros(n),
            np.full(n, 8.0),
            np.full(n, 0.2),
            np.zeros(n),
            np.zeros(n, bool),
        )
        figure = drawn([Scene.of(ping, wakes=wakes)], LOOK)
        return np.median(near(pixels(figure), dot(figure, 16, 0)), axis=0)

    assert_array_equal(tint(1), tint(30))


def test_trails_follow_confirmed_tracks_and_outlive_them(tmp_path, make_ping, make_tracks):
    node = Plot(tmp_path / "t.png")
    for seq in range(10):
        status = (1 if seq < 6 else 2, 0)
        node(make_ping(seq), tracks=make_tracks(seq, (1, 2), status, [[10 + seq, 1, 1, 0], [9, 0, 0, 0]]))
    (scene,) = node._scenes()
    assert_array_equal(scene.trail_id, [1] * 6)
    assert_array_equal(scene.trail_m, [[10 + seq, 1] for seq in range(6)])
    figure = drawn([scene], LOOK)
    assert texts(figure) == ["1"]  # at the end of the trail


def test_trails_are_bounded(make_tracks):
    history = History(pings=5)
    for seq in range(50):
        history.add(make_tracks(seq, (1, 2, 3)))
    ids, positions = history.trail(None)
    assert ids.shape == (15,)
    assert_array_equal(positions[-3:], make_tracks(49, (1, 2, 3)).state[:, :2])


def test_ned_tracks_are_turned_by_navigation(make_ping, make_tracks):
    state = nav(north=100.0, east=50.0, yaw=math.pi / 2)  # looks east
    tracks = make_tracks(ids=(1,), state=[[98.0, 70.0, 0, 0]], frame="ned")
    covariance = tracks.covariance.copy()
    covariance[0, :2, :2] = np.diag([4.0, 1.0])  # long to the north: across the sensor
    tracks = Tracks(0, 0, tracks.id, tracks.status, tracks.state, covariance, tracks.hits, tracks.age, "ned")
    ping = make_ping(nav=state)
    scene = Scene.of(ping, tracks=tracks)
    assert_allclose(scene.track_m, [[20.0, 2.0]], atol=1e-9)
    assert_allclose(scene.track_covariance[0], np.diag([1.0, 4.0]), atol=1e-9)
    assert_allclose(sensor_pose(state, ping.mount).to_sensor([[98.0, 70.0]]), scene.track_m)


def test_ned_trails_stand_still_under_a_turning_vehicle(tmp_path, make_ping, make_tracks):
    node = Plot(tmp_path / "t.png")
    for seq in range(5):
        tracks = make_tracks(seq, (1,), state=[[20.0, 0.0, 0, 0]], frame="ned")
        node(make_ping(seq, nav=nav(yaw=0.1 * seq)), tracks=tracks)
    (scene,) = node._scenes()
    expected = [20 * math.cos(0.4), -20 * math.sin(0.4)]
    assert_allclose(scene.trail_m, np.tile(expected, (5, 1)))


@pytest.mark.parametrize("state", [None, NavState(0, 0)])
def test_ned_without_navigation_is_said_in_the_picture(make_ping, make_tracks, state):
    scene = Scene.of(make_ping(nav=state), tracks=make_tracks(ids=(1, 2), frame="ned"))
    figure = drawn([scene], LOOK)
    (said,) = texts(figure)
    assert "2 tracks in NED are not drawn" in said
    assert "no navigation" in said


def test_an_empty_ned_message_says_nothing(make_ping):
    assert Scene.of(make_ping(), tracks=Tracks(0, 0, frame="ned")).notes == ()


def test_cells_without_data_are_not_drawn(make_ping):
    amplitude = np.full((60, 21), 100, np.uint8)
    valid = np.ones((60, 21), bool)
    valid[30:40, 8:13] = False
    ping = make_ping(amplitude=amplitude, valid=valid)
    figure = drawn([Scene.of(ping)], LOOK)
    image = pixels(figure)
    background = near(image, dot(figure, 1, 8), 1)
    assert_array_equal(near(image, dot(figure, ping.range_m[35], 0), 1), background)
    assert (near(image, dot(figure, ping.range_m[50], 0), 1) != background).any()


def odd(make_ping, name):
    zeros = np.zeros((60, 21), np.float32)
    return {
        "one beam": lambda: make_ping(shape=(60, 1)),
        "one range": lambda: make_ping(shape=(1, 21)),
        "one cell": lambda: make_ping(shape=(1, 1)),
        "cell at 0 m": lambda: make_ping(shape=(1, 1), range_m=np.zeros(1)),
        "no cell": lambda: make_ping(shape=(0, 0)),
        "all zero": lambda: make_ping(amplitude=zeros),
        "all nan": lambda: make_ping(amplitude=zeros + np.nan),
        "some nan and inf": lambda: make_ping(amplitude=np.where(np.eye(60, 21), np.nan, zeros + np.inf)),
        "negative": lambda: make_ping(amplitude=zeros - 1),
        "constant": lambda: make_ping(amplitude=zeros + 7),
        "uint8": lambda: make_ping(dtype=np.uint8),
        "uint16": lambda: make_ping(dtype=np.uint16),
        "uneven": lambda: make_ping(shape=(60, 4), bearing_rad=np.array([-0.5, -0.49, 0.1, 0.5])),
        "descending": lambda: make_ping(bearing_rad=np.linspace(0.5, -0.5, 21)),
        "circle": lambda: make_ping(shape=(60, 120), bearing_rad=np.radians(np.arange(-180.0, 180.0, 3.0))),
        "equal bearings": lambda: make_ping(bearing_rad=np.zeros(21)),
        "all invalid": lambda: make_ping(valid=np.zeros((60, 21), bool)),
    }[name]()


ODD = [
    "one beam", "one range", "one cell", "cell at 0 m", "no cell", "all zero", "all nan", "some nan and inf",
    "negative", "constant", "uint8", "uint16", "uneven", "descending", "circle", "equal bearings",
    "all invalid",
]  # fmt: skip


@pytest.mark.parametrize("name", ODD)
def test_odd_pings_are_drawn(tmp_path, make_ping, name):
    ping = odd(make_ping, name)
    picture = plotted(
        tmp_path / "t.png", {"ping": ping, "detections": Detections(0, 0), "tracks": Tracks(0, 0)}, dpi=50
    )
    assert picture.std() > 5
    assert min(picture.shape[:2]) > 150


def test_tracks_that_are_not_finite_do_no_harm(tmp_path, make_ping, make_tracks):
    tracks = make_tracks(ids=(1, 2), state=[[np.nan, 1, 0, 0], [np.inf, 1, 0, 0]])
    detections = Detections.of(make_ping(), range_m=[np.nan], bearing_rad=[0.0], amplitude=[1])
    inputs = {"ping": make_ping(), "tracks": tracks, "detections": detections}
    assert plotted(tmp_path / "t.png", inputs, dpi=50).std() > 5


def test_marks_far_larger_than_the_fan_are_left_out(tmp_path, make_ping, make_tracks):
    """The renderer would take minutes for an ellipse of 1e150 m."""
    tracks = make_tracks(ids=(1, 2, 3), state=[[20, 1, 0, 0], [1e300, -1e300, 0, 0], [20, 5, 0, 0]])
    covariance = np.stack([np.eye(4) * value for value in (1e300, 1.0, 1.0)])
    tracks = Tracks(0, 0, tracks.id, tracks.status, tracks.state, covariance, tracks.hits, tracks.age)
    wakes = Wakes(
        0,
        0,
        np.array([[20.0, 0], [np.nan, 0]]),
        np.zeros(2),
        np.array([1e200, 5.0]),
        np.ones(2),
        np.zeros(2),
        np.ones(2, bool),
    )
    detections = Detections.of(make_ping(), range_m=[1e200, np.inf], bearing_rad=[0.1, 0.0], amplitude=[1, 1])
    scene = Scene.of(make_ping(), detections, wakes, tracks).within(100.0)
    assert_array_equal(np.isfinite(scene.track_m[:, 0]), [True, False, True])
    assert_array_equal(np.isfinite(scene.track_covariance[:, 0, 0]), [False, True, True])
    assert np.isnan(scene.wake_shape[0]).all()
    assert np.isnan(scene.detection_m).all()
    everything = {"ping": make_ping(), "tracks": tracks, "wakes": wakes, "detections": detections}
    assert plotted(tmp_path / "t.png", everything, dpi=50).std() > 5


def test_the_size_of_the_picture(tmp_path, make_ping):
    small = plotted(tmp_path / "a.png", {"ping": make_ping()}, dpi=50)
    large = plotted(tmp_path / "b.png", {"ping": make_ping()}, dpi=100)
    assert_allclose(np.array(large.shape[:2]) / np.array(small.shape[:2]), 2.0, atol=0.01)
    assert 600 < large.shape[0] < 1000
    assert 600 < large.shape[1] < 1400


def test_by_default_the_last_ping_is_drawn(tmp_path, make_ping):
    node = Plot(tmp_path / "t.png")
    for seq in range(4):
        node(make_ping(seq))
    assert [scene.seq for scene in node._scenes()] == [3]


def test_chosen_pings_get_a_panel_each(tmp_path, make_ping):
    node = Plot(tmp_path / "t.png", pings=(2, 5, 1))
    for seq in range(8):
        node(make_ping(seq))
    scenes = node._scenes()
    assert [scene.seq for scene in scenes] == [1, 2, 5]
    figure = drawn(scenes, LOOK)
    assert [axes.get_title().splitlines()[0] for axes in figure.axes[::2]] == [
        "ping 1, 0.500 s", "ping 2, 1.000 s", "ping 5, 2.500 s",
    ]  # fmt: skip


def test_the_trail_of_a_chosen_ping_ends_there(tmp_path, make_ping, make_tracks):
    node = Plot(tmp_path / "t.png", pings=(3,))
    for seq in range(8):
        node(make_ping(seq), tracks=make_tracks(seq, (1,), state=[[seq, 0, 0, 0]]))
    (scene,) = node._scenes()
    assert scene.trail_m[:, 0].tolist() == [0, 1, 2, 3]


def test_a_run_that_stops_early_shows_its_last_ping(tmp_path, make_ping, caplog):
    node = Plot(tmp_path / "t.png", pings=(1, 100), dpi=50)
    for seq in range(4):
        node(make_ping(seq))
    assert [scene.seq for scene in node._scenes()] == [1, 3]
    with caplog.at_level(logging.WARNING):
        node.close()
    assert "no ping with seq 100 came" in caplog.text
    assert (tmp_path / "t.png").exists()


def test_without_pings_the_picture_says_so(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        picture = plotted(tmp_path / "t.png")
    assert "none came" in caplog.text
    assert picture.std() > 1


def test_nothing_else_is_left_in_the_folder(tmp_path, make_ping):
    node = Plot(tmp_path / "deep" / "t.png", dpi=50)
    node(make_ping())
    assert not (tmp_path / "deep").exists()
    node.close()
    node.close()
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["t.png"]


def test_another_picture_is_never_overwritten(tmp_path, make_ping):
    (tmp_path / "t.png").write_text("precious")
    node = Plot(tmp_path / "t.png")
    with pytest.raises(InputError, match=r"t\.png: exists already"):
        node(make_ping())
    with pytest.raises(InputError, match="exists already"):
        Plot(tmp_path / "t.png").close()
    assert (tmp_path / "t.png").read_text() == "precious"


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_formats(tmp_path, make_ping, suffix):
    node = Plot(tmp_path / f"t{suffix}")
    node(make_ping())
    node.close()
    start = (tmp_path / f"t{suffix}").read_bytes()[:5]
    assert start in (b"\x89PNG\r", b"<?xml", b"%PDF-")


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"path": "t.gif"}, "t.gif"),
        ({"pings": tuple(range(13))}, "13"),
        ({"trail_pings": 0}, "not 0"),
        ({"dynamic_range_db": 0.5}, "0.5"),
        ({"gate_probability": 1.0}, "1.0"),
        ({"colormap": "nonesuch"}, "nonesuch"),
        ({"dpi": 5}, "not 5"),
    ],
)
def test_bad_parameters_are_named(parameters, said):
    with pytest.raises(ValueError, match=said):
        Plot(**parameters)


def test_nothing_of_the_messages_is_kept(tmp_path, make_ping, make_tracks):
    ping, tracks = make_ping(), make_tracks()
    node = Plot(tmp_path / "t.png")
    node(ping, tracks=tracks)
    snapshot = node.snapshot()
    kept = [*snapshot["last"].values(), *snapshot["history"].values(), *vars(node._last).values()]
    sent = [ping.amplitude, ping.range_m, ping.bearing_rad, tracks.id, tracks.state, tracks.covariance]
    assert not any(
        np.shares_memory(a, b)
        for a in kept
        if isinstance(a, np.ndarray)
        for b in sent
        if isinstance(a, np.ndarray)
    )


@pytest.mark.parametrize("pings", [(), (1, 4)])
def test_a_restart_gives_the_same_picture(tmp_path, make_ping, make_tracks, pings):
    def play(node, seqs):
        for seq in seqs:
            node(make_ping(seq, nav=nav(yaw=0.01 * seq)), tracks=make_tracks(seq, (1, 2), frame="ned"))

    whole, crashed, again = (
        Plot(tmp_path / name, pings=pings, dpi=60) for name in ("a.png", "b.png", "c.png")
    )
    play(whole, range(6))
    play(crashed, range(3))
    again.restore(crashed.snapshot())
    play(again, range(3, 6))
    whole.close()
    again.close()
    assert_array_equal(cv2.imread(str(tmp_path / "a.png")), cv2.imread(str(tmp_path / "c.png")))


def test_a_fresh_snapshot_restores(tmp_path):
    node = Plot(tmp_path / "t.png")
    node.restore(Plot(tmp_path / "t.png").snapshot())
    assert node._scenes() == []


def test_levels_span_what_the_image_has():
    assert levels(np.zeros((3, 3)), 40.0) == (1.0, -40.0, 0.0)
    rng = np.random.default_rng(0)
    clutter = rng.rayleigh(10.0, (200, 200))
    reference, lowest, highest = levels(clutter, 40.0)
    assert_allclose(reference, 10 * math.sqrt(2 * math.log(2)), rtol=0.02)
    assert -12 < lowest < -8
    assert highest < 15
    clutter[0, 0] = 1e6
    assert_allclose(levels(clutter, 40.0)[1:], (-10.0, 30.0), atol=0.5)


def test_when():
    assert when(1_500_000_000) == "1.500 s"
    assert when(1_767_225_600_123_456_789) == "2026-01-01 00:00:00.123 UTC"
