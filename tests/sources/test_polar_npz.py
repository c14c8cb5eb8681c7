"""Recordings in the documented layout: what they give, and one line for every fault."""

import importlib.util
import io
import itertools
import random
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import InputError, Mount
from fls_sources.npz_stream import MAX_PIECE_BYTES, NpzArchive
from fls_sources.polar_npz import PolarNpz

GOLDEN = Path(__file__).parents[1] / "golden" / "didson" / "lamprey1_40.npz"
SHAPE = (5, 30, 7)


def content(dtype=np.uint8, **changes):
    rng = np.random.default_rng(5)
    arrays = {
        "image": (rng.random(SHAPE) * 200).astype(dtype),
        "bearing_rad": np.radians(np.linspace(-20, 20, SHAPE[2])),
        "range_m": np.linspace(1.0, 10.0, SHAPE[1]),
        "fps": np.array(4.0),
    }
    arrays.update(changes)
    return {key: value for key, value in arrays.items() if value is not None}


@pytest.fixture
def write(tmp_path):
    count = itertools.count()

    def written(save=np.savez_compressed, **changes):
        path = tmp_path / f"r{next(count)}.npz"
        save(path, **content(**changes))
        return path

    return written


def fault(path, **parameters):
    with pytest.raises(InputError) as caught:
        list(PolarNpz(path, **parameters)())
    said = str(caught.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    return said


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_pings_are_the_images_in_order(write, dtype, save):
    path = write(save, dtype=dtype)
    pings = list(PolarNpz(path)())
    arrays = content(dtype)
    assert len(pings) == len(PolarNpz(path)) == 5
    assert_array_equal([p.amplitude for p in pings], arrays["image"])
    assert {p.amplitude.dtype for p in pings} == {np.dtype(dtype)}
    assert [(p.seq, p.stamp_ns) for p in pings] == [(i, i * 250_000_000) for i in range(5)]
    assert_array_equal(pings[2].range_m, arrays["range_m"])
    assert_array_equal(pings[2].bearing_rad, arrays["bearing_rad"])
    assert pings[0].valid is None
    assert np.isnan([pings[0].beamwidth_rad, pings[0].frequency_hz]).all()
    assert pings[0].sound_speed_mps == 1500.0


def test_optional_arrays_are_passed_on(write):
    valid = np.random.default_rng(1).random(SHAPE) > 0.5
    stamps = np.array([10, 20, 25, 2**60, 2**60 + 1])
    path = write(
        fps=None, stamp_ns=stamps, seq=np.array([3, 4, 4, 9, 8], np.uint16), valid=valid, frequency_hz=1.8e6,
        beamwidth_rad=0.005, sound_speed_mps=np.array([1480.0]),
    )  # fmt: skip
    pings = list(PolarNpz(path, mount=Mount((1.0, 0.0, 0.5)))())
    assert [p.seq for p in pings] == [3, 4, 4, 9, 8]
    assert [p.stamp_ns for p in pings] == stamps.tolist()
    assert_array_equal([p.valid for p in pings], valid)
    assert (pings[0].frequency_hz, pings[0].beamwidth_rad, pings[0].sound_speed_mps) == (1.8e6, 0.005, 1480.0)
    assert pings[0].mount.position_m == (1.0, 0.0, 0.5)


def test_one_mask_holds_for_all_pings(write):
    mask = np.eye(30, 7, dtype=bool)
    pings = list(PolarNpz(write(valid=mask))())
    assert_array_equal([p.valid for p in pings], np.broadcast_to(mask, SHAPE))
    assert not np.shares_memory(pings[0].valid, pings[1].valid)


def test_relative_ranges_are_scaled(write):
    relative = np.linspace(0.1, 1.0, 30)
    path = write(range_m=None, range_rel=relative)
    assert_allclose(next(PolarNpz(path, range_max_m=12.0)()).range_m, 12.0 * relative)
    assert "range_max_m" in fault(path)


def test_metres_are_never_scaled(write):
    assert "leave out the parameter range_max_m" in fault(write(), range_max_m=5.0)


def test_a_selection_is_a_part_of_the_whole(write):
    valid = np.random.default_rng(1).random(SHAPE) > 0.5
    path = write(valid=valid)
    whole = list(PolarNpz(path)())
    for first, pings in [(0, 2), (2, None), (3, 1), (4, 99), (1, 3)]:
        node = PolarNpz(path, first=first, pings=pings)
        part, expected = list(node()), whole[first:][:pings]
        assert len(node) == len(part) == len(expected)
        for a, b in zip(part, expected, strict=True):
            assert (a.seq, a.stamp_ns) == (b.seq, b.stamp_ns)
            assert_array_equal(a.amplitude, b.amplitude)
            assert_array_equal(a.valid, b.valid)
    assert "first = 5" in fault(path, first=5)


def test_start_moves_all_stamps(write):
    start = 1_700_000_000_000_000_000
    by_rate = [p.stamp_ns for p in PolarNpz(write(), start_ns=start)()]
    assert by_rate == [start + i * 250_000_000 for i in range(5)]
    path = write(stamp_ns=np.array([100, 110, 140, 141, 150]))
    assert [p.stamp_ns for p in PolarNpz(path, start_ns=5, first=2)()] == [45, 46, 55]


def test_stamps_of_a_rate_do_not_drift(write):
    pings = list(PolarNpz(write(fps=3.0))())
    assert [p.stamp_ns for p in pings] == [0, 333333333, 666666667, 1000000000, 1333333333]


def test_pings_share_no_memory(write):
    first, second = itertools.islice(PolarNpz(write())(), 2)
    for name in ("amplitude", "range_m", "bearing_rad"):
        assert not np.shares_memory(getattr(first, name), getattr(second, name))


def test_it_plays_twice_the_same(write):
    node = PolarNpz(write())
    for a, b in zip(node(), node(), strict=True):
        assert_array_equal(a.amplitude, b.amplitude)


def test_other_byte_orders_and_extra_arrays_are_read(write):
    image = content()["image"].astype(">u2")
    path = write(image=image, range_px=np.zeros(3), bearing_rad=content()["bearing_rad"].astype(">f4"))
    ping = next(PolarNpz(path)())
    assert ping.amplitude.dtype == np.uint16
    assert ping.amplitude.dtype.isnative
    assert_array_equal(ping.amplitude, image[0])


def test_one_ping_one_range_one_beam(write):
    path = write(image=np.full((1, 1, 1), 9, np.uint8), range_m=np.array([2.0]), bearing_rad=np.zeros(1))
    (ping,) = PolarNpz(path)()
    assert_array_equal(ping.amplitude, [[9]])


def test_nan_amplitudes_are_passed_on(write):
    image = content(np.float32)["image"]
    image[0, 0, 0] = np.nan
    assert np.isnan(next(PolarNpz(write(image=image))()).amplitude[0, 0])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"image": None}, "has no 'image' but bearing_rad, fps, range_m"),
        ({"bearing_rad": None}, "has no 'bearing_rad'"),
        ({"range_m": None}, "neither 'range_m' nor 'range_rel'"),
        ({"fps": None}, "neither 'stamp_ns' nor 'fps'"),
        ({"image": np.zeros((30, 7), np.uint8)}, "shape (30, 7)"),
        ({"image": np.zeros((0, 30, 7), np.uint8)}, "shape (0, 30, 7)"),
        ({"image": np.zeros(SHAPE)}, "dtype float64"),
        ({"image": np.zeros(SHAPE, np.int8)}, "dtype int8"),
        ({"image": np.asfortranarray(np.zeros(SHAPE, np.uint8))}, "Fortran order"),
        ({"bearing_rad": np.zeros(6)}, "'bearing_rad' has shape (6,), but 'image' has n_beams = 7"),
        ({"bearing_rad": np.zeros((7, 1))}, "shape (7, 1)"),
        ({"bearing_rad": np.zeros(7)}, "not monotonic"),
        ({"bearing_rad": np.linspace(-20, 20, 7)}, "degrees"),
        ({"bearing_rad": np.full(7, np.nan)}, "no finite numbers"),
        ({"bearing_rad": np.array(list("abcdefg"))}, "no finite numbers"),
        ({"range_m": np.linspace(1, 10, 29)}, "'range_m' has shape (29,), but 'image' has n_ranges = 30"),
        ({"range_m": np.linspace(10, 1, 30)}, "increase"),
        ({"range_m": np.linspace(-1, 10, 30)}, "start at 0"),
        ({"range_m": np.append(np.linspace(1, 9, 29), np.inf)}, "no finite numbers"),
        ({"range_m": np.full(30, 1j)}, "no finite numbers"),
        ({"fps": np.array(0.0)}, "'fps' is 0.0"),
        ({"fps": np.array(np.nan)}, "'fps' is nan"),
        ({"fps": np.array(1e12)}, "'fps' gives"),
        ({"fps": np.zeros(2)}, "one number"),
        ({"fps": np.array("ten")}, "one number"),
        ({"stamp_ns": np.array([0, 1, 1, 2, 3])}, "does not increase at ping 2"),
        ({"stamp_ns": np.arange(5.0)}, "float64; save it as int64"),
        ({"stamp_ns": np.arange(4)}, "n_pings = 5"),
        ({"stamp_ns": np.arange(5, dtype=np.uint64) + 2**63}, "save it as int64"),
        ({"seq": np.arange(5.0)}, "'seq'"),
        ({"valid": np.ones(SHAPE, np.uint8)}, "'valid' is uint8"),
        ({"valid": np.ones((7, 30), bool)}, "'valid' is bool (7, 30)"),
        ({"frequency_hz": np.array(-1.0)}, "'frequency_hz' is -1.0"),
        ({"sound_speed_mps": np.array(np.inf)}, "'sound_speed_mps' is inf"),
    ],
)
def test_faults_are_one_line(write, changes, said):
    assert said in fault(write(**changes))


def test_relative_ranges_end_with_one(write):
    path = write(range_m=None, range_rel=np.linspace(0.1, 0.9, 30))
    assert "last entry must be 1" in fault(path, range_max_m=3.0)


def test_pickles_are_never_loaded(tmp_path, write):
    evil = np.array([print], dtype=object)
    assert "holds object" in fault(write(save=np.savez, image=evil))
    assert "holds object" in fault(write(save=np.savez, bearing_rad=np.full(7, None)))
    structured = np.zeros(5, [("a", "i4")])
    assert "not numbers" in fault(write(save=np.savez, seq=structured))


def test_files_that_are_no_npz(tmp_path):
    path = tmp_path / "r.npz"
    assert "No such file" in fault(path)
    assert "Is a directory" in fault(tmp_path)
    path.write_bytes(b"")
    assert "is not an npz" in fault(path)
    path.write_bytes(b"seq,stamp_ns\n")
    assert "is not an npz" in fault(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    assert "one npy array" in fault(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    assert "has no 'image' but readme.txt" in fault(path)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.7, 0.99])
def test_truncated_files_are_said_to_be(write, part):
    path = write()
    whole = path.read_bytes()
    path.write_bytes(whole[: max(10, int(part * len(whole)))])
    assert "truncated or damaged" in fault(path)


def test_damaged_pixels_are_noticed(write):
    path = write(save=np.savez)
    raw = bytearray(path.read_bytes())
    at = raw.index(content()["image"].tobytes())
    raw[at + 400] ^= 1
    path.write_bytes(raw)
    assert "'image' is damaged (Bad CRC-32" in fault(path)


def zipped(path, members, **options):
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, raw in members.items():
            archive.writestr(f"{name}.npy", raw)


def npy(array):
    raw = io.BytesIO()
    np.save(raw, array)
    return raw.getvalue()


def claimed(shape, dtype="|u1", order="False"):
    header = f"{{'descr': '{dtype}', 'fortran_order': {order}, 'shape': {shape}, }}"
    header += " " * (-(len(header) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()


@pytest.mark.parametrize(
    "shape",
    ["(5, 1000000, 1000000)", "(10**9, 30, 7)", "(5, -30, -7)", "(5, 30, 8)", "(1000000000000, 30, 7)"],
)
def test_headers_that_claim_more_than_there_is(tmp_path, shape):
    members = {key: npy(value) for key, value in content().items()}
    members["image"] = claimed(shape) + bytes(5 * 30 * 7)
    zipped(tmp_path / "r.npz", members)
    said = fault(tmp_path / "r.npz")
    assert "claims" in said or "damaged" in said


def test_a_bomb_takes_no_memory(tmp_path):
    """300 MB of zeros in a small file are refused as one ping and read piecewise as many."""
    size = 300 * 2**20
    one, many = tmp_path / "one.npz", tmp_path / "many.npz"
    for path, shape in ((one, (1, 300, 2**20)), (many, (300, 1024, 1024))):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for key in ("bearing_rad", "range_m", "fps"):
                archive.writestr(f"{key}.npy", npy(np.arange(1.0, 1025.0) if key != "fps" else np.array(2.0)))
            with archive.open("image.npy", "w") as member:
                member.write(claimed(shape))
                for _ in range(size // 2**20):
                    member.write(bytes(2**20))
    assert one.stat().st_size < 2**21
    with NpzArchive(one) as archive, pytest.raises(InputError, match=f"at most {MAX_PIECE_BYTES}"):
        next(archive.pieces("image", 0, 1))
    with NpzArchive(many) as archive:
        assert next(archive.pieces("image", 0, 300)).nbytes == 2**20


@pytest.mark.parametrize("dtype", [",f8", "|V0", "(2,)u1", "nonsense", "|O"])
def test_headers_with_odd_types(tmp_path, dtype):
    members = {key: npy(value) for key, value in content().items()}
    members["range_m"] = claimed("(30,)", dtype) + bytes(240)
    zipped(tmp_path / "r.npz", members)
    assert "'range_m'" in fault(tmp_path / "r.npz")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_compressions_without_bound_are_refused(tmp_path, method):
    zipped(tmp_path / "r.npz", {key: npy(value) for key, value in content().items()}, compression=method)
    assert "not deflated" in fault(tmp_path / "r.npz")


def test_no_mutation_escapes_as_another_error(tmp_path):
    """Whatever bytes are changed, there are pings or an InputError."""
    source = tmp_path / "r.npz"
    zipped(source, {key: npy(value) for key, value in content(valid=np.ones(SHAPE, bool)).items()})
    whole, dice = source.read_bytes(), random.Random(8)
    headers = [
        i for i in range(len(whole)) if i < 400 or whole[i : i + 6] == b"\x93NUMPY" or i > len(whole) - 500
    ]
    refused = []
    for _ in range(1000):
        raw = bytearray(whole)
        for _ in range(dice.choice([1, 1, 2, 8])):
            at = dice.choice(headers) if dice.random() < 0.7 else dice.randrange(len(raw))
            at = min(at + dice.randrange(130), len(raw) - 1)
            raw[at] = dice.choice([0, 1, 255, raw[at] ^ 1 << dice.randrange(8), *b"()',:{}0123456789"])
        source.write_bytes(raw)
        try:
            for ping in PolarNpz(source)():
                assert ping.amplitude.size
        except InputError as err:
            refused.append(str(err))
    assert len(refused) > 300
    assert not any("\n" in said for said in refused)


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"range_max_m": 0.0}, "not 0.0"),
        ({"range_max_m": np.inf}, "inf"),
        ({"first": -1}, "-1"),
        ({"pings": 0}, "not 0"),
    ],
)
def test_bad_parameters_are_named(parameters, said):
    with pytest.raises(ValueError, match=said):
        PolarNpz(Path("r.npz"), **parameters)


def test_the_golden_recording():
    node = PolarNpz(GOLDEN, range_max_m=12.0)
    pings = list(node())
    assert len(node) == len(pings) == 40
    assert [p.seq for p in pings] == list(range(70, 110))
    assert {p.amplitude.shape for p in pings} == {(512, 96)}
    assert_allclose(np.degrees(pings[0].bearing_rad[[0, -1]]), [-14.2, 14.2], atol=0.05)
    assert pings[0].range_m[-1] == 12.0
    assert_allclose(np.diff([p.stamp_ns for p in pings]), 1e8)
    assert zlib.crc32(np.stack([p.amplitude for p in pings])) == 153675816


def test_the_conversion_in_the_documentation_makes_a_recording(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text()
    code = page.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "docs/recordings.md", "exec"), {})
    pings = list(PolarNpz(Path("recording.npz"))())
    assert [pings[0].amplitude.shape, len(pings)] == [(400, 128), 30]
    assert_allclose(pings[0].range_m[[0, -1]], [1.05, 40.95])


def test_the_golden_maker_writes_the_same_bytes_again(tmp_path):
    spec = importlib.util.spec_from_file_location("make", GOLDEN.parents[1] / "make.py")
    make = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make)
    (tmp_path / "source").mkdir()
    recording = content(
        range_m=None, range_rel=np.linspace(0.1, 1, 30), image=np.arange(120 * 210).reshape(120, 30, 7) % 251
    )
    recording["image"] = recording["image"].astype(np.uint8)
    np.savez(tmp_path / "source" / "lamprey1_polar.npz", **recording, range_px=np.zeros(30))
    (tmp_path / "source" / "LICENSE.md").write_text("licence")
    written = []
    for name in ("a", "b"):
        make.didson(tmp_path / "source", tmp_path / name)
        written.append((tmp_path / name / "lamprey1_40.npz").read_bytes())
    assert written[0] == written[1]
    pings = list(PolarNpz(tmp_path / "a" / "lamprey1_40.npz", range_max_m=5.0)())
    assert_array_equal([p.amplitude for p in pings], recording["image"][70:110])
    assert (tmp_path / "a" / "LICENSE.md").read_text() == "licence"
