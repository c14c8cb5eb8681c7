import gc
import importlib
import weakref
from dataclasses import FrozenInstanceError, dataclass, field, fields
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fls_flow
from fls_flow import (
    BeamMask,
    Classes,
    DetectionKind,
    Detections,
    Features,
    HydrophoneBlock,
    Intensity,
    Mount,
    NavState,
    Ping,
    Sealed,
    Tracks,
    TrackStatus,
    Truth,
    View,
    Wakes,
    array,
    messages,
)

CLASSES = [
    BeamMask,
    Classes,
    Detections,
    Features,
    HydrophoneBlock,
    Intensity,
    NavState,
    Ping,
    Tracks,
    Truth,
    Wakes,
]
SEALED = [cls for cls in CLASSES if issubclass(cls, Sealed)]
COUNTED = [Detections, Tracks, Wakes, BeamMask, Intensity, Features, Classes, Truth]


def ping(n_ranges: int = 5, n_beams: int = 3, dtype: npt.DTypeLike = np.float32, **changes: Any) -> Ping:
    cells = np.arange(n_ranges * n_beams).reshape(n_ranges, n_beams).astype(dtype)
    ranges = 2.0 + 0.5 * np.arange(n_ranges)
    bearings = np.radians(1.5) * (np.arange(n_beams) - (n_beams - 1) / 2)
    return Ping(11, 22, cells, ranges, bearings, **changes)


def detections(n: int = 4) -> Detections:
    return Detections.of(
        ping(),
        range_m=np.arange(n) + 1.0,
        bearing_rad=np.arange(n) / 10,
        amplitude=np.arange(n) * 2.0,
        kind=np.arange(n) % 3,
    )


def tracks(n: int = 3) -> Tracks:
    each = np.arange(n)
    return Tracks(
        1, 2, each, each % 3, np.tile(each[:, None], 4), np.tile(np.eye(4), (n, 1, 1)), each, each, "ned"
    )


# ---- the public names


@pytest.mark.parametrize("name", ["fls_flow", "fls_flow.messages", "fls_flow.geometry", "fls_flow.errors"])
def test_all_is_sorted_and_complete(name: str) -> None:
    module = importlib.import_module(name)
    assert module.__all__ == sorted(
        set(module.__all__), key=lambda n: (not n.isupper(), not n[0].isupper(), n)
    )
    public = {n: thing for n, thing in vars(module).items() if not n.startswith("_")}
    assert set(module.__all__) <= set(public)
    if name == "fls_flow":  # it has nothing of its own: all that it imports is for others
        expected = {n for n, thing in public.items() if not isinstance(thing, ModuleType)}
    else:
        expected = {n for n, thing in public.items() if getattr(thing, "__module__", None) == name}
    assert expected <= set(module.__all__)


def test_plugins_find_the_vocabulary_at_the_top() -> None:
    assert set(messages.__all__) - set(fls_flow.__all__) <= {"is_message_type"}


# ---- every message


@pytest.mark.parametrize("cls", CLASSES)
def test_every_message_begins_with_seq_and_stamp_and_can_be_empty(cls: Any) -> None:
    assert messages.is_message_type(cls)
    empty = cls(5, 6)
    assert (empty.seq, empty.stamp_ns) == (5, 6)
    with pytest.raises(FrozenInstanceError):
        empty.seq = 7


@pytest.mark.parametrize("cls", COUNTED)
def test_empty_messages_have_no_entries(cls: Any) -> None:
    assert len(cls(5, 6)) == 0


@pytest.mark.parametrize("thing", [Mount, View, int, "Ping", Ping(1, 2), None])
def test_other_things_are_no_message_types(thing: object) -> None:
    assert not messages.is_message_type(thing)


def test_only_frozen_dataclasses_are_messages() -> None:
    @dataclass
    class Thawed:
        seq: int
        stamp_ns: int

    @dataclass(frozen=True)
    class Swapped:
        stamp_ns: int
        seq: int

    class Bare:
        seq = 1
        stamp_ns = 2

    assert not any(map(messages.is_message_type, [Thawed, Swapped, Bare]))


@pytest.mark.parametrize("cls", SEALED)
def test_every_array_has_the_declared_default(cls: Any) -> None:
    empty = cls(5, 6)
    for spec in fields(cls):
        shape, value = spec.metadata.get("shape"), getattr(empty, spec.name)
        if shape is not None and value is not None:
            assert value.dtype == shape.dtypes[0]
            assert value.shape == tuple(0 if isinstance(d, str) else d for d in shape.dims)
            assert not value.flags.writeable


@pytest.mark.parametrize("cls", SEALED)
def test_a_wrong_number_of_dimensions_is_refused_with_the_fields_name(cls: Any) -> None:
    for spec in fields(cls):
        shape = spec.metadata.get("shape")
        if shape is None:
            continue
        wrong = np.zeros((1,) * (len(shape.dims) + 1), shape.dtypes[0])
        with pytest.raises(ValueError, match=rf"{cls.__name__}\.{spec.name} has shape \(1, .*it takes \("):
            cls(5, 6, **{spec.name: wrong})


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (
            lambda: Ping(1, 2, np.zeros((4, 3), np.uint8), np.zeros(4), np.zeros(2)),
            r"Ping.bearing_rad has shape \(2,\); it takes \(n_beams,\): 'amplitude' has n_beams = 3",
        ),
        (
            lambda: ping(valid=np.ones((5, 2), bool)),
            r"Ping.valid has shape \(5, 2\); it takes \(n_ranges, n_beams\): 'amplitude' has n_beams = 3",
        ),
        (
            lambda: Ping(1, 2, np.zeros((4, 3))),
            r"Ping.amplitude has dtype float64; it takes float32, uint8, uint16",
        ),
        (lambda: Ping(1, 2, np.zeros((4, 3), np.int16)), "Ping.amplitude has dtype int16"),
        (
            lambda: HydrophoneBlock(1, 2, np.zeros((2, 9), np.float32), position_m=np.zeros((2, 2))),
            r"HydrophoneBlock.position_m has shape \(2, 2\); it takes \(n_channels, 3\)",
        ),
        (
            lambda: Detections(1, 2, np.zeros(3), np.zeros(3), np.zeros(2)),
            r"Detections.amplitude has shape \(2,\); it takes \(n,\): 'range_m' has n = 3",
        ),
        (
            lambda: Tracks(1, 2, np.zeros(2), np.zeros(2), np.zeros((2, 6))),
            r"Tracks.state has shape \(2, 6\); it takes \(n, 4\)",
        ),
        (
            lambda: Features(1, 2, np.zeros(2), ("area",), np.zeros((3, 1))),
            r"Features.values has shape \(3, 1\); it takes \(n, n_features\): 'track_id' has n = 2",
        ),
        (lambda: View(bearing_rad=np.zeros((2, 2))), r"View.bearing_rad has shape \(2, 2\)"),
    ],
)
def test_wrong_shapes_are_refused_with_name_and_value(build: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        build()


# ---- arrays


def test_arrays_are_read_only_and_the_givers_stay_writable() -> None:
    given = np.zeros((2, 3), np.uint8)
    sealed = Ping(1, 2, given, np.zeros(2), np.zeros(3))
    with pytest.raises(ValueError, match="read-only"):
        sealed.amplitude[0, 0] = 1
    assert np.shares_memory(sealed.amplitude, given)
    assert given.flags.writeable


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_amplitudes_keep_the_sensors_dtype(dtype: Any) -> None:
    assert ping(dtype=dtype).amplitude.dtype == dtype


def test_arrays_of_one_dtype_are_converted() -> None:
    converted = Tracks(1, 2, [4], [1.0], [[1, 2, 3, 4]], np.eye(4, dtype=np.float32)[None], [1], [1])  # type: ignore[arg-type]
    assert (converted.id.dtype, converted.status.dtype, converted.state.dtype) == (
        np.int64,
        np.uint8,
        np.float64,
    )
    assert converted.covariance.dtype == np.float64


def test_a_plugins_class_is_checked_alike() -> None:
    @dataclass(frozen=True, eq=False)
    class Echoes(Sealed):
        seq: int
        stamp_ns: int
        delay_s: npt.NDArray[np.float64] = array(float, "n")
        pair: npt.NDArray[np.int16] = array((np.int16, np.int32), "n", 2)
        note: str = ""
        later: npt.NDArray[np.float64] | None = field(default=None)

    assert Echoes(1, 2).pair.shape == (0, 2)
    assert Echoes(1, 2, np.zeros(1), np.zeros((1, 2), np.int32)).pair.dtype == np.int32
    with pytest.raises(ValueError, match=r"Echoes.pair has shape \(2, 3\); it takes \(n, 2\)"):
        Echoes(1, 2, pair=np.zeros((2, 3), np.int16))
    with pytest.raises(ValueError, match=r"Echoes.pair has shape \(2, 2\).*'delay_s' has n = 1"):
        Echoes(1, 2, np.zeros(1), np.zeros((2, 2), np.int16))


# ---- Ping and View


def test_spacings() -> None:
    assert ping().cell_m == 0.5
    assert_allclose(ping().beam_spacing_rad, np.radians(1.5))
    uneven = Ping(1, 2, np.zeros((2, 4), np.uint8), np.zeros(2), np.array([0.3, 0.2, 0.1, -0.9]))
    assert_allclose(uneven.beam_spacing_rad, 0.1)


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (0, 4), (5, 0)])
def test_pings_without_spacing(shape: tuple[int, int]) -> None:
    small = ping(*shape, beamwidth_rad=0.02)
    assert np.isnan(small.cell_m) == (shape[0] < 2)
    assert (small.beam_spacing_rad == 0.02) == (shape[1] < 2)
    view = View.of(small)
    assert view.area_m2 >= 0.0
    assert view.range_max_m == (small.range_m[-1] if shape[0] else 0.0)


def test_the_view_says_what_the_ping_says() -> None:
    nav, mount = NavState(1, 2), Mount((1.0, 2.0, 3.0))
    view = View.of(ping(beamwidth_rad=0.03, sound_speed_mps=1490.0, mount=mount, nav=nav))
    assert (view.range_min_m, view.range_max_m, view.cell_m) == (2.0, 4.0, 0.5)
    assert (view.beamwidth_rad, view.sound_speed_mps) == (0.03, 1490.0)
    assert (view.mount, view.nav) == (mount, nav)
    assert_array_equal(view.bearing_rad, ping().bearing_rad)


def test_the_area_is_that_of_the_sector() -> None:
    # three beams of 1.5 degrees from 2 m to 4 m
    assert_allclose(View.of(ping()).area_m2, np.pi * (4.0**2 - 2.0**2) * 4.5 / 360.0)
    assert View().area_m2 == 0.0


def test_area_of_a_sector_across_180_degrees_is_that_of_the_same_sector_ahead() -> None:
    ahead = np.radians(np.arange(-30.0, 31.0))
    behind = np.arctan2(np.sin(ahead + np.pi), np.cos(ahead + np.pi))
    areas = [View(1.0, 9.0, 0.1, bearing).area_m2 for bearing in (ahead, behind)]
    assert_allclose(areas, 0.5 * np.radians(61.0) * 80.0)


def test_detections_hold_no_memory_of_the_ping() -> None:
    # the bearing table lies in one block with the image, as in a decoded buffer
    block = np.zeros(8 + 3 * 8 + 40, np.uint8)
    source = Ping(1, 2, block[-15:].reshape(5, 3), np.arange(5.0), block[:24].view(float))
    alive = weakref.ref(block)
    found = Detections.of(source, range_m=[1.0], bearing_rad=[0.0], amplitude=[3.0])
    for table in (found.view.bearing_rad, found.range_m, found.covariance, found.kind):
        assert not np.shares_memory(table, block)
    del source, block
    gc.collect()
    assert alive() is None
    assert found.view.bearing_rad.size == 3


# ---- Detections and Tracks


def test_detections_take_cell_and_beam_as_standard_deviation() -> None:
    found = Detections.of(ping(), range_m=[3.0, 4.0], bearing_rad=[0.1, 0.0], amplitude=[1, 2])
    assert (found.seq, found.stamp_ns, len(found)) == (11, 22, 2)
    assert_allclose(found.covariance, np.tile(np.diag([0.5**2, np.radians(1.5) ** 2]), (2, 1, 1)))
    assert_array_equal(found.extent, np.zeros((2, 2)))
    assert_array_equal(found.kind, [DetectionKind.ECHO] * 2)


def test_detections_take_what_is_given() -> None:
    covariance = np.arange(8.0).reshape(2, 2, 2)
    found = Detections.of(
        ping(),
        range_m=[3, 4],
        bearing_rad=[0, 1],
        amplitude=[1, 2],
        extent=[[1, 2], [3, 4]],
        covariance=covariance,
        kind=DetectionKind.SELF_NOISE,
    )
    assert_array_equal(found.covariance, covariance)
    assert_array_equal(found.extent, [[1, 2], [3, 4]])
    assert_array_equal(found.kind, [1, 1])
    assert found.range_m.dtype == float


def test_no_detections_still_carry_the_view() -> None:
    none = Detections.of(ping(), range_m=[], bearing_rad=[], amplitude=[])
    assert len(none) == 0
    assert (none.extent.shape, none.covariance.shape, none.position_m.shape) == ((0, 2), (0, 2, 2), (0, 2))
    assert none.view.range_max_m == 4.0


def test_positions_are_x_forward_y_starboard() -> None:
    found = Detections.of(
        ping(), range_m=[2, 2, 2], bearing_rad=[0, np.pi / 2, -np.pi / 6], amplitude=[1, 1, 1]
    )
    assert_allclose(found.position_m, [[2, 0], [0, 2], [np.sqrt(3), -1]], atol=1e-15)


@pytest.mark.parametrize(
    ("which", "expected"),
    [([True, False, True], [0, 2]), ([2, 0], [2, 0]), ([], []), ([False] * 3, []), ([1, 1], [1, 1])],
)
def test_select_follows_masks_and_indices(which: list[Any], expected: list[int]) -> None:
    index = np.array(which, dtype=None if which else int)
    for whole in (detections(3), tracks(3)):
        part = whole.select(index)
        assert len(part) == len(expected)
        for spec in fields(whole):
            before, after = getattr(whole, spec.name), getattr(part, spec.name)
            if isinstance(before, np.ndarray):
                assert_array_equal(after, before[expected], strict=True)
                assert not after.flags.writeable
            else:
                assert after is before


def test_beam_masks_count_their_noisy_beams() -> None:
    assert len(BeamMask(1, 2, np.array([True, False, True]), np.zeros(3))) == 2


def test_the_codes_in_files_stay_as_they_are() -> None:
    assert [(k.name, k.value) for k in DetectionKind] == [("ECHO", 0), ("SELF_NOISE", 1), ("WAKE_END", 2)]
    assert [(s.name, s.value) for s in TrackStatus] == [("TENTATIVE", 0), ("CONFIRMED", 1), ("LOST", 2)]


@pytest.mark.parametrize(
    ("cls", "given", "line"),
    [
        (
            messages.Features,
            {"names": ("area",), "values": np.zeros((1, 2))},
            "Features.names names 1; there are 2",
        ),
        (
            messages.Classes,
            {"names": (), "posterior": np.zeros((1, 2))},
            "Classes.names names 0; there are 2",
        ),
    ],
)
def test_names_count_the_columns(cls, given, line):
    rows = {name: np.zeros(1, np.int64) for name in ("track_id", "label") if name in cls.__dataclass_fields__}
    with pytest.raises(ValueError, match=line):
        cls(1, 2, **rows, **given)


def test_truth_names_each_target():
    with pytest.raises(ValueError, match=r"Truth\.class_name names 0; there are 1"):
        messages.Truth(1, 2, np.array([1]), np.zeros((1, 4)))


def test_an_empty_list_selects_nothing():
    assert len(messages.Detections(1, 2).select(np.array([]))) == 0
