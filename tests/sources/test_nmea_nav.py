"""Navigation from NMEA 0183: worked sentences, files, a real UDP stream, and what comes from strangers."""

from __future__ import annotations

import math
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from pynmeagps import calc_checksum

from fls_flow import InputError
from fls_flow.testing import check_node
from fls_sources.nmea_nav import NmeaNav
from fls_sources.nmea_sentences import report

KNOT = 1852.0 / 3600.0


def line(body: str) -> str:
    return f"${body}*{calc_checksum(body)}"


GGA = line("GPGGA,120000.00,4823.0000,N,00430.0000,W,1,08,0.9,10.0,M,0.0,M,,")
RMC = line("GPRMC,120000.00,A,4823.0000,N,00430.0000,W,10.0,90.0,140406,,,A")


def file_of(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "nav.nmea"
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


def test_a_sentence_as_the_standard_prints_it():
    """The checksum of the much-quoted example."""
    known = "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47"
    said = report(known)
    assert_allclose(said.latitude_deg, 48.0 + 7.038 / 60.0)
    assert_allclose(said.longitude_deg, 11.0 + 31.0 / 60.0)
    assert said.time_s == 12 * 3600 + 35 * 60 + 19


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("HEHDT,271.5,T", {"heading_rad": math.radians(271.5)}),
        ("HETHS,10.0,A", {"heading_rad": math.radians(10.0)}),
        ("GPVTG,45.0,T,,M,5.0,N,9.3,K,A", {"course_rad": math.radians(45.0), "speed_mps": 5.0 * KNOT}),
        ("VDVBW,3.1,0.0,A,3.0,-0.5,A", {"ahead_mps": 3.0 * KNOT, "starboard_mps": -0.5 * KNOT}),
        ("VDVBW,3.1,0.0,A,3.0,-0.5,V", {}),
        ("HEROT,-60.0,A", {"turn_radps": -math.radians(1.0)}),
        ("SDDBT,32.8,f,10.0,M,5.4,F", {"altitude_m": 10.0}),
        ("SDDPT,7.5,0.3", {"altitude_m": 7.5}),
        (
            "IIXDR,A,-2.5,D,PTCH,A,1.5,D,ROLL,D,33.0,M,DEPTH",
            {"pitch_rad": math.radians(-2.5), "roll_rad": math.radians(1.5), "depth_m": 33.0},
        ),
        (
            "PASHR,120000.50,90.0,T,1.0,-2.0,0.1,0.01,0.01,0.02,1,0",
            {
                "time_s": 43200.5,
                "heading_rad": math.radians(90.0),
                "roll_rad": math.radians(1.0),
                "pitch_rad": math.radians(-2.0),
            },
        ),
        (
            "PRDID,-1.0,2.0,180.0",
            {"pitch_rad": -math.radians(1.0), "roll_rad": math.radians(2.0), "heading_rad": math.pi},
        ),
        ("GPZDA,235959.00,14,04,2006,00,00", {"time_s": 86399.0, "date": (2006, 4, 14)}),
        ("GPGGA,120000.00,,,,,0,00,,,M,,M,,", {"time_s": 43200.0}),
        ("GPRMC,120000.00,V,,,,,,,140406,,,N", {"time_s": 43200.0, "date": (2006, 4, 14)}),
        ("GPGSV,3,1,11", {}),
    ],
)
def test_what_each_sentence_says(body, expected):
    said = report(line(body))
    for name in said.__slots__:
        value, want = getattr(said, name), expected.get(name)
        if want is None or isinstance(want, tuple):
            assert value == want, name
        else:
            assert_allclose(value, want, err_msg=name)


@pytest.mark.parametrize(
    "text", ["", "GPGGA", "$GPHDT,1.0,T", "$GPHDT,1.0,T*", "$GPHDT,1.0,T*00", "$" + "A" * 600]
)
def test_what_is_no_whole_sentence_is_refused(text):
    with pytest.raises(ValueError, match=r"checksum|no sentence"):
        report(text)


def sound_or_refused(text: str) -> bool:
    """Whether it raises ValueError, or every number is finite and in the range that its meaning has."""
    try:
        said = report(text)
    except ValueError:
        return True
    numbers = [value for name in said.__slots__ if isinstance(value := getattr(said, name), float)]
    place = said.latitude_deg is None or (abs(said.latitude_deg) <= 90.0 and abs(said.longitude_deg) <= 180.0)
    clock = said.time_s is None or 0.0 <= said.time_s < 86_401.0
    return all(math.isfinite(value) for value in numbers) and place and clock


@given(st.text(max_size=120))
def test_any_text_is_refused_or_says_sound_numbers(text):
    assert sound_or_refused(text)
    assert sound_or_refused(line(text.replace("$", "").replace("*", "")))


@given(
    st.sampled_from(["GPGGA", "GPRMC", "GPZDA", "PASHR", "IIXDR", "GPVTG", "VDVBW", "PRDID", "SDDBT"]),
    st.lists(st.sampled_from(["", "A", "N", "W", "1", "-1", "1e400", "nan", "9999.99", "120000.00", "D"]), max_size=14),
)  # fmt: skip
def test_sentences_with_any_fields_are_refused_or_say_sound_numbers(name, fields):
    assert sound_or_refused(line(",".join([name, *fields])))


@given(st.sampled_from([GGA, RMC]), st.data())
def test_no_changed_character_goes_unseen(good, data):
    """An exclusive or tells any one character that is not the same."""
    place = data.draw(st.integers(1, good.index("*") - 1))
    other = data.draw(st.characters(min_codepoint=32, max_codepoint=126, exclude_characters=good[place]))
    with pytest.raises(ValueError, match=r"checksum|no sentence"):
        report(good[:place] + other + good[place + 1 :])


@given(st.floats(-89.9, 89.9), st.floats(-179.9, 179.9), st.floats(0.0, 359.9), st.floats(0.0, 30.0))
def test_what_was_written_is_read_back(latitude, longitude, course, knots):
    parts = [(int(abs(a)), 60.0 * (abs(a) % 1.0)) for a in (latitude, longitude)]
    place = f"{parts[0][0]:02d}{parts[0][1]:010.7f},{'NS'[latitude < 0]}"
    place += f",{parts[1][0]:03d}{parts[1][1]:010.7f},{'EW'[longitude < 0]}"
    said = report(line(f"GPRMC,235959.25,A,{place},{knots:.6f},{course:.6f},311299,,,A"))
    assert_allclose((said.latitude_deg, said.longitude_deg), (latitude, longitude), atol=2e-9)
    assert_allclose((said.speed_mps, said.course_rad), (knots * KNOT, math.radians(course)), atol=1e-6)
    assert (said.time_s, said.date) == (86399.25, (1999, 12, 31))


def test_a_sentence_cut_off_by_another_does_not_harm_it():
    assert report(GGA[:30] + RMC) == report(RMC)


def test_a_file_gives_positions_velocity_and_attitude(tmp_path):
    path = file_of(
        tmp_path,
        RMC,
        line("HEHDT,90.0,T"),
        line("SDDBT,,f,12.5,M,,F"),
        line("GPGGA,120001.00,4823.0000,N,00429.9900,W,1,08,0.9,10.0,M,0.0,M,,"),
        line("PASHR,120001.50,91.0,T,1.0,-2.0,0.1,0.01,0.01,0.02,1,0"),
        line("GPVTG,91.0,T,,M,4.0,N,,K,A"),
    )
    one, two, three = NmeaNav(path)()
    assert [s.seq for s in (one, two, three)] == [0, 1, 2]
    assert one.stamp_ns == 1_145_016_000 * 10**9
    assert_allclose(one.position_m[:2], (0.0, 0.0))
    assert_allclose(one.velocity_mps[:2], (10.0 * KNOT, 0.0), atol=1e-12)
    assert one.altitude_m == 12.5
    assert_allclose(one.attitude_rad[2], np.pi / 2)
    assert two.stamp_ns - one.stamp_ns == 10**9
    assert_allclose(two.position_m[:2], (0.0, 0.01 / 60 * 74_120), atol=0.02)  # a degree there: 74.1 km
    assert np.isnan(two.velocity_mps).all()
    assert three.stamp_ns - two.stamp_ns == 5 * 10**8
    assert_allclose(np.degrees(three.attitude_rad), (1.0, -2.0, 91.0))
    assert_allclose(three.velocity_mps[:2], (4.0 * KNOT, 0.0), atol=1e-12)


def test_a_degree_of_latitude_has_its_length_on_the_ellipsoid(tmp_path):
    far = line("GPGGA,120001.00,4824.0000,N,00430.0000,W,1,08,0.9,10.0,M,0.0,M,,")
    _, there = NmeaNav(file_of(tmp_path, RMC, far))()
    assert_allclose(there.position_m[0], 111_200.0 / 60.0, rtol=2e-4)
    (here, _) = NmeaNav(file_of(tmp_path, RMC, far), origin_deg=(48.0, -4.5))()
    assert_allclose(here.position_m[0], 111_190.0 * 23.0 / 60.0, rtol=3e-4)


def test_midnight_passes_and_stamps_go_on_increasing(tmp_path):
    lines = [
        line(f"GPGGA,{t},4823.0,N,00430.0,W,1,08,0.9,1.0,M,0,M,,")
        for t in ("235959.50", "000000.00", "000000.50")
    ]
    samples = list(NmeaNav(file_of(tmp_path, *lines), date="2006-04-14")())
    assert np.diff([s.stamp_ns for s in samples]).tolist() == [5 * 10**8] * 2


def test_without_a_date_the_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="set date"):
        list(NmeaNav(file_of(tmp_path, GGA))())
    assert len(list(NmeaNav(file_of(tmp_path, GGA), date="2006-04-14")())) == 1


def test_damaged_lines_are_passed_over_and_counted_in_the_log(tmp_path, caplog):
    bad = [GGA.replace("08", "09"), "garbage", "$GPHDT,1", "\x00\xff"]
    samples = list(NmeaNav(file_of(tmp_path, *bad, RMC, *bad))())
    assert len(samples) == 1
    assert len(caplog.records) == 5
    assert "no more is said" in caplog.records[-1].message


def test_a_file_without_sentences_or_no_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="no NMEA 0183 sentence"):
        list(NmeaNav(file_of(tmp_path, ""))())
    with pytest.raises(InputError, match="check the path"):
        list(NmeaNav(tmp_path / "none")())


def test_a_line_without_end_does_not_fill_the_memory(tmp_path):
    path = tmp_path / "long"
    path.write_bytes(b"A" * 3_000_000 + b"\r\n" + RMC.encode())
    assert len(list(NmeaNav(path)())) == 1


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def test_a_real_udp_stream_on_loopback():
    node = NmeaNav(port=free_port())
    assert node.live
    samples: list = []
    reader = threading.Thread(target=lambda: samples.extend(node()))
    reader.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        deadline = time.monotonic() + 20.0
        while len(samples) < 10 and time.monotonic() < deadline:
            sender.sendto(f"{RMC}\r\n{line('HEHDT,90.0,T')}\r\n".encode(), ("127.0.0.1", node.port))
            sender.sendto(b"noise", ("127.0.0.1", node.port))
            time.sleep(0.02)
    began = time.monotonic()
    node.close()
    reader.join(5.0)
    assert not reader.is_alive()
    assert time.monotonic() - began < 1.0
    stamps = [one.stamp_ns for one in samples]
    assert len(samples) >= 10
    assert (np.diff(stamps) > 0).all()
    assert abs(stamps[-1] - time.time_ns()) < 60 * 10**9
    assert_allclose(samples[0].velocity_mps[0], 10.0 * KNOT)
    assert_allclose(samples[0].attitude_rad[2], np.pi / 2)


def test_a_port_that_is_taken_is_an_input_error():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="check host and port"):
            next(NmeaNav(port=one.getsockname()[1])())


def test_by_default_only_this_machine_can_send():
    assert NmeaNav().host == "127.0.0.1"


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"port": 0}, "port is 0"),
        ({"date": "14.4.2006"}, "date is '14.4.2006'"),
        ({"origin_deg": (95.0, 0.0)}, r"origin_deg is \(95.0, 0.0\)"),
    ],
)
def test_bad_parameters_are_named(parameters, text):
    with pytest.raises(ValueError, match=text):
        NmeaNav(**parameters)


def test_the_source_keeps_the_contract(tmp_path):
    check_node(NmeaNav(file_of(tmp_path, RMC, GGA.replace("120000", "120001"), line("HEHDT,1.0,T"))))
