"""Packets between processes of one host arrive whole, in order, or their giver is gone."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Empty, SimpleQueue

import pytest

from fls_flow.errors import LinkError
from fls_flow.links.near import HEAD, Door, Line, Take

Packet = tuple[str, int, int, int, bytes]  # greeting, kind, route, number, payload


class Hall:
    """A door, what has come through it, and what failed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.packets: SimpleQueue[Packet] = SimpleQueue()
        self.failures: SimpleQueue[Exception] = SimpleQueue()
        self.refuse: Exception | None = None
        self.door = Door(path, self._enter, self.failures.put)

    def _enter(self, greeting: str) -> Take:
        def take(kind: int, route: int, number: int, payload: bytes) -> None:
            if self.refuse is not None:
                raise self.refuse
            self.packets.put((greeting, kind, route, number, payload))

        return take

    def next(self, count: int = 1) -> list[Packet]:
        """The next packets, which have to come soon."""
        return [self.packets.get(timeout=10.0) for _ in range(count)]


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    made = Hall(tmp_path / "hall.in")
    yield made
    made.door.close()


def packet(number: int, payload: bytes = b"", route: int = 0, kind: int = 0) -> bytes:
    return HEAD.pack(number, len(payload), route, kind) + payload


def until(true: Callable[[], bool]) -> None:
    """Wait for something that has to happen soon."""
    deadline = time.monotonic() + 10.0
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_packets_arrive_as_they_were_sent(hall: Hall) -> None:
    line = Line(hall.path, "arena-1")
    assert line.connected()
    payloads = [b"", b"x", os.urandom(64 << 10), os.urandom(3 << 20), b"last"]
    for number, payload in enumerate(payloads):
        line.send(packet(number - 1, payload, route=number, kind=7))
    assert hall.next(5) == [("arena-1", 7, i, i - 1, payload) for i, payload in enumerate(payloads)]
    line.close()


def test_nobody_is_there_before_the_door(tmp_path: Path) -> None:
    line = Line(tmp_path / "late.in", "early")
    assert not line.connected()
    with pytest.raises(LinkError, match=r"no process listens at .*late\.in"):
        line.send(packet(0))
    hall = Hall(tmp_path / "late.in")
    assert line.connected()
    line.send(packet(5))
    assert hall.next()[0][3] == 5
    line.close()
    hall.door.close()


def test_what_was_sent_before_hanging_up_arrives(hall: Hall) -> None:
    line = Line(hall.path, "short")
    for number in range(1000):
        line.send(packet(number, b"y" * 500))  # the first one connects
    line.close()
    assert [one[3] for one in hall.next(1000)] == list(range(1000))
    assert hall.failures.empty()


def test_threads_share_a_line_and_packets_stay_whole(hall: Hall) -> None:
    line = Line(hall.path, "shared")
    assert line.connected()

    def send(route: int) -> None:
        for number in range(200):
            line.send(packet(number, bytes([route]) * (1 + 37 * number), route))

    threads = [threading.Thread(target=send, args=(route,)) for route in range(4)]
    for thread in threads:
        thread.start()
    found = hall.next(800)
    for thread in threads:
        thread.join()
    for route in range(4):
        of_route = [(number, payload) for _, _, r, number, payload in found if r == route]
        assert of_route == [(n, bytes([route]) * (1 + 37 * n)) for n in range(200)]
    line.close()


def test_each_line_is_known_by_its_greeting(hall: Hall) -> None:
    lines = [Line(hall.path, f"arena-{i}") for i in range(20)]
    for number, line in enumerate(lines):
        assert line.connected()
        line.send(packet(number))
    assert {(one[0], one[3]) for one in hall.next(20)} == {(f"arena-{i}", i) for i in range(20)}
    for line in lines:
        line.close()


def test_a_taker_that_is_gone_swallows_what_comes(tmp_path: Path) -> None:
    hall = Hall(tmp_path / "gone.in")
    line = Line(hall.path, "lonely")
    assert line.connected()
    line.send(packet(0))
    hall.next()
    hall.door.close()
    for number in range(50):  # neither raises nor blocks
        line.send(packet(number, bytes(1 << 20)))
    line.close()


GIVER = """
import sys, time
from pathlib import Path
from fls_flow.links.near import HEAD, Line
line = Line(Path(sys.argv[1]), "victim")
assert line.connected()
line.send(HEAD.pack(1, 3, 0, 0) + b"abc")
line.send(HEAD.pack(2, 1000, 0, 0) + b"only the begin")
print("sent", flush=True)
time.sleep(60)
"""


def test_a_giver_killed_in_the_middle_of_a_packet_leaves_no_half_of_it(hall: Hall) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", GIVER, str(hall.path)], stdout=subprocess.PIPE, text=True
    ) as giver:
        assert giver.stdout is not None
        assert giver.stdout.readline() == "sent\n"
        giver.send_signal(signal.SIGKILL)
    assert [one[3:] for one in hall.next()] == [(1, b"abc")]
    with pytest.raises(Empty):
        hall.packets.get(timeout=0.2)
    assert hall.failures.empty()


def test_what_cannot_be_taken_is_told_once_and_ends_the_line(hall: Hall) -> None:
    hall.refuse = LinkError("more than 17 messages wait")
    line = Line(hall.path, "")
    assert line.connected()
    line.send(packet(0))
    assert str(hall.failures.get(timeout=10.0)) == "more than 17 messages wait"

    def hung_up() -> bool:
        line.send(packet(1))
        return not line._open

    until(hung_up)
    assert hall.failures.empty()
    line.close()


def test_a_greeting_that_is_no_text_fails_with_one_line(hall: Hall) -> None:
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.connect(str(hall.path))
        stranger.sendall(b"\x02\x00\xff\xfe")
        failure = hall.failures.get(timeout=10.0)
    assert isinstance(failure, LinkError)
    assert "\n" not in str(failure)
    assert str(hall.path) in str(failure)


def test_a_stranger_who_says_nothing_harms_nobody(hall: Hall) -> None:
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.connect(str(hall.path))
    line = Line(hall.path, "")
    assert line.connected()
    line.send(packet(3))
    assert hall.next()[0][3] == 3
    assert hall.failures.empty()
    line.close()


def test_a_closed_door_is_no_longer_there(tmp_path: Path) -> None:
    hall = Hall(tmp_path / "closed.in")
    hall.door.close()
    assert not (tmp_path / "closed.in").exists()
    assert not Line(tmp_path / "closed.in", "").connected()
