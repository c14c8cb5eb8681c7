"""Recordings of hydrophone arrays: real WAV files, their settings, and every mistake in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import InputError, Mount
from fls_flow.testing import check_node
from fls_sources.array_waveform import Chirp
from fls_sources.wav_array import WavArray, fls_node

RATE, PERIOD_S = 96_000, 0.05
SETTINGS = """
positions_m: [[-0.385, 0, 0], [0, 0.395, 0], [0.405, 0, 0], [0, -0.405, 0]]
pulse: {start_hz: 31000, stop_hz: 41000, duration_s: 0.01}
sound_speed_mps: 1520
first_ping_s: 0.01
period_s: 0.05
start_ns: 1_700_000_000_000_000_000
"""
SAMPLES = (
    np.random.default_rng(0)
    .integers(-20_000, 20_000, (round((0.01 + 3 * PERIOD_S) * RATE), 4))
    .astype(np.int16)
)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    soundfile.write(tmp_path / "sea.wav", SAMPLES, RATE, "PCM_16")
    (tmp_path / "sea.yaml").write_text(SETTINGS)
    return tmp_path


def rewrite(place: Path, *changes: tuple[str, str]) -> None:
    text = SETTINGS
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (place / "sea.yaml").write_text(text)


def test_kind_and_contract(place) -> None:
    assert fls_node() is WavArray
    check_node(WavArray(place / "sea.wav"))


def test_pings_are_the_recordings_samples(place) -> None:
    source = WavArray(place / "sea.wav", mount=Mount((1.0, 0.0, 2.0)))
    pings = list(source())
    assert len(pings) == len(source) == 3
    for k, block in enumerate(pings):
        begin = 960 + 4800 * k
        assert block.samples.dtype == np.int16
        assert_array_equal(block.samples, SAMPLES[begin : begin + 4800].T)
        assert block.seq == k
        assert block.stamp_ns == 1_700_000_000_000_000_000 + 10_000_000 + 50_000_000 * k
        assert block.mount == Mount((1.0, 0.0, 2.0))
    assert_allclose(pings[0].position_m[1], [0.0, 0.395, 0.0])
    assert_array_equal(pings[0].waveform, Chirp().samples(RATE))
    assert (pings[0].sample_rate_hz, pings[0].sound_speed_mps) == (RATE, 1520.0)


@pytest.mark.parametrize(
    ("subtype", "name"), [("PCM_24", "sea.wav"), ("FLOAT", "sea.wav"), ("PCM_24", "sea.flac")]
)
def test_other_formats_become_float32(place, subtype, name) -> None:
    soundfile.write(place / name, SAMPLES / 32768.0, RATE, subtype)
    block = next(WavArray(place / name)())
    assert block.samples.dtype == np.float32
    assert_allclose(block.samples, SAMPLES[960 : 960 + 4800].T / 32768.0, atol=1e-6)


def test_some_of_the_pings(place) -> None:
    source = WavArray(place / "sea.wav", first=1, pings=1, sound_speed_mps=1490.0)
    (block,) = source()
    assert len(source) == 1
    assert (block.seq, block.sound_speed_mps) == (1, 1490.0)
    assert_array_equal(block.samples, SAMPLES[960 + 4800 : 960 + 9600].T)
    assert len(WavArray(place / "sea.wav", pings=50)) == 3
    with pytest.raises(InputError, match="has 3 pings by its settings; parameter first = 3"):
        len(WavArray(place / "sea.wav", first=3))


def test_settings_elsewhere(place) -> None:
    (place / "sea.yaml").rename(place / "array.yaml")
    assert len(WavArray(place / "sea.wav", settings=place / "array.yaml")) == 3


def test_times_one_by_one_and_a_listening_time(place) -> None:
    rewrite(place, ("first_ping_s: 0.01\nperiod_s: 0.05", "ping_times_s: [0.0, 0.06, 0.1]\nlisten_s: 0.05"))
    lengths = [block.samples.shape[1] for block in WavArray(place / "sea.wav")()]
    assert lengths == [4800, 3840, 3840]  # 0.05 s; to the next ping; as the last gap
    rewrite(place, ("first_ping_s: 0.01\nperiod_s: 0.05", "first_ping_s: 0.0"))
    (block,) = WavArray(place / "sea.wav")()
    assert_array_equal(block.samples, SAMPLES.T)


@pytest.mark.parametrize(("cut", "pings"), [(0, 3), (2000, 3), (3000, 2), (4801, 2)])
def test_a_last_ping_that_is_cut_counts_when_half_of_it_is_there(place, cut, pings) -> None:
    soundfile.write(place / "sea.wav", SAMPLES[: len(SAMPLES) - cut], RATE, "PCM_16")
    blocks = list(WavArray(place / "sea.wav")())
    assert len(blocks) == pings
    if 0 < cut < 2400:
        assert blocks[-1].samples.shape == (4, 4800 - cut)


def test_positions_by_distances_and_speed_by_layers(place) -> None:
    rewrite(
        place,
        (
            "positions_m: [[-0.385, 0, 0], [0, 0.395, 0], [0.405, 0, 0], [0, -0.405, 0]]",
            "distances_m: [[0, 3, 4, 5], [3, 0, 5, 4], [4, 5, 0, 3], [5, 4, 3, 0]]\nfirst_bearing_deg: 90\nclockwise: false",
        ),
        ("sound_speed_mps: 1520", "layers: [[0, 1500], [3, 1520]]\narray_depth_m: 20\ntarget_depth_m: 0"),
    )
    block = next(WavArray(place / "sea.wav")())
    apart = np.linalg.norm(block.position_m[:, None] - block.position_m, axis=-1)
    assert_allclose(apart[0], [0.0, 3.0, 4.0, 5.0], atol=1e-9)
    assert_allclose(block.position_m[0, 0], 0.0, atol=1e-9)
    assert block.position_m[0, 1] > 0.0
    assert_allclose(block.sound_speed_mps, 20.0 / (3.0 / 1500.0 + 17.0 / 1520.0))


def test_a_pulse_from_a_file(place) -> None:
    pulse = np.sin(np.arange(500) / 3.0)
    soundfile.write(place / "pulse.wav", pulse, RATE, "DOUBLE")
    rewrite(place, ("pulse: {start_hz: 31000, stop_hz: 41000, duration_s: 0.01}", "pulse: {file: pulse.wav}"))
    assert_allclose(next(WavArray(place / "sea.wav")()).waveform, pulse, atol=1e-12)
    soundfile.write(place / "pulse.wav", pulse, 48_000)
    with pytest.raises(InputError, match=r"pulse.wav: has 1 channels, 500 samples at 48000 Hz"):
        WavArray(place / "sea.wav")()


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("sound_speed_mps: 1520", "", "'sound_speed_mps' is missing"),
        ("sound_speed_mps: 1520", "sound_speed_mps: fast", "'sound_speed_mps' is 'fast'"),
        ("sound_speed_mps: 1520", "sound_speed_mps: -1", "'sound_speed_mps' is -1.0; it must be positive"),
        ("sound_speed_mps: 1520", "sound_speed: 1520", "unknown key 'sound_speed'"),
        ("sound_speed_mps: 1520", "layers: [[0, 1500]]", "'array_depth_m' is missing"),
        ("sound_speed_mps: 1520", "layers: [[2, 1500]]\narray_depth_m: 1", "begin at 0"),
        ("sound_speed_mps: 1520", "sound_speed_mps: 1520\nlayers: [[0, 1500]]", "leave one out"),
        ("positions_m", "places_m", "unknown key 'places_m'"),
        ("[0, -0.405, 0]]", "[0, -0.405]]", "'positions_m' must be numbers, in rows of one length"),
        ("[0, -0.405, 0]]", "[0, .nan, 0]]", "'positions_m' has entries that are not finite"),
        (", [0, -0.405, 0]]", "]", "has 4 channels, its settings place 3 hydrophones"),
        ("start_hz: 31000", "start_hz: 0", "pulse: start_hz is 0"),
        ("start_hz: 31000, ", "", "'start_hz' is missing"),
        ("stop_hz: 41000", "stop_hz: 49000", "the pulse reaches 49000 Hz"),
        ("pulse: {start_hz: 31000, stop_hz: 41000, duration_s: 0.01}", "pulse: chirp", "'pulse' is missing"),
        ("pulse: {start_hz: 31000, stop_hz: 41000, duration_s: 0.01}", "pulse: {file: no.wav}", "no.wav: No such file"),
        ("period_s: 0.05", "period_s: 0", "'period_s' is 0.0; it must be positive"),
        ("period_s: 0.05", "period_s: true", "'period_s' is True; it takes a number"),
        ("first_ping_s: 0.01", "first_ping_s: -1", "'first_ping_s' is -1.0"),
        ("period_s: 0.05", "ping_times_s: [0.1]", "leave out 'period_s'"),
        ("first_ping_s: 0.01\nperiod_s: 0.05", "ping_times_s: [0.1, 0.1]", "increasing seconds"),
        ("first_ping_s: 0.01", "first_ping_s: 9", "has 0 pings by its settings"),
        ("start_ns: 1_700_000_000_000_000_000", "start_ns: noon", "'start_ns' is 'noon'"),
        ("pulse: {", "pulse: {{", "no YAML"),
    ],
)  # fmt: skip
def test_mistakes_in_the_settings_are_one_line(place, old, new, named) -> None:
    rewrite(place, (old, new))
    with pytest.raises(InputError, match=named) as caught:
        WavArray(place / "sea.wav")()
    assert "\n" not in str(caught.value)


def test_files_that_are_none_are_one_line(place) -> None:
    def said() -> str:
        with pytest.raises(InputError) as caught:
            list(WavArray(place / "sea.wav")())
        assert "\n" not in str(caught.value)
        assert "sea." in str(caught.value)
        return str(caught.value)

    wav = (place / "sea.wav").read_bytes()
    (place / "sea.wav").write_bytes(b"no sound at all")
    assert "give a sound file" in said()
    (place / "sea.wav").write_bytes(b"")
    said()
    (place / "sea.wav").unlink()
    assert "No such file" in said()
    (place / "sea.wav").write_bytes(wav)
    (place / "sea.yaml").write_text("[1, 2]")
    assert "holds no mapping" in said()
    (place / "sea.yaml").write_bytes(b"\xff\xfe\x00")
    assert "no YAML" in said()
    (place / "sea.yaml").unlink()
    assert "needs a YAML file" in said()


def test_a_truncated_recording_plays_what_is_whole(place) -> None:
    """libsndfile counts the frames that are there, whatever the header says."""
    wav = (place / "sea.wav").read_bytes()
    (place / "sea.wav").write_bytes(wav[: len(wav) // 2])
    blocks = list(WavArray(place / "sea.wav")())
    assert 1 <= len(blocks) <= 2
    assert_array_equal(blocks[0].samples, SAMPLES[960:5760].T)


@pytest.mark.parametrize(
    ("settings", "named"), [({"first": -1}, "-1"), ({"pings": 0}, "0"), ({"sound_speed_mps": 0.0}, "0.0")]
)
def test_bad_parameters(settings, named) -> None:
    with pytest.raises(ValueError, match=named):
        WavArray(Path("sea.wav"), **settings)
