"""Two hosts whose only way to each other is slow, late and cut again and again: nothing is lost."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

PROXY = str(Path(__file__).with_name("proxy.py"))


@pytest.fixture
def through_a_proxy(rig):
    """Both hosts reach a router through a bad network; give what it says at its end."""

    def between(*words: str, **limits: float):
        options = [f"--{name.replace('_', '-')}={value}" for name, value in limits.items()]
        proxy = rig.beside([PROXY, str(rig.router()), *options])
        port = proxy.stdout.readline().strip()
        rig.deploy(f"{{connect: [tcp/127.0.0.1:{port}]}}", *words)
        return lambda: json.loads(proxy.communicate("")[0])

    return between


def run_both(rig, finish, *words):
    rig.here(*words)
    vehicle, topside = rig.host("vehicle", *words), rig.host("topside", *words)
    for process in (vehicle, topside):
        code, _, err = finish(process, 120.0)
        assert code == 0, err
    rig.same_bytes()
    return err


def test_a_slow_and_late_link_gives_the_same_bytes(rig, finish, through_a_proxy):
    said = through_a_proxy(delay_s=0.05, mbit=20)
    run_both(rig, finish, "--set", "sonar.cells=20000", "--set", "sonar.pings=15")
    counted = said()
    assert counted["bytes_there"] > 15 * 20000 * 3 * 4, "the images crossed the link"
    assert counted["bytes_back"] > 15 * 20000 * 3 * 4


def test_a_link_that_is_cut_every_second_loses_nothing(rig, finish, through_a_proxy):
    said = through_a_proxy("lost_after_s: 10", delay_s=0.05, mbit=20, cut_s=1.0)
    run_both(rig, finish, "--set", "sonar.cells=5000", "--set", "sonar.pings=30")
    counted = said()
    assert counted["cuts"] >= 3
    assert counted["bytes_back"] > 30 * 5000 * 3 * 4


def test_a_router_that_is_restarted_in_the_middle_loses_nothing(rig, finish):
    port = rig.router()
    rig.deploy(f"{{connect: [tcp/127.0.0.1:{port}]}}", "lost_after_s: 10")
    words = ["--set", "sonar.pings=150", "--set", "slow.sleep_s=0.01"]
    rig.here(*words)
    hosts = [rig.host(name, *words) for name in ("vehicle", "topside")]
    for size in (1000, 6000):
        rig.wait_until_running(size=size)
        rig.kill_router()
        time.sleep(0.3)
        assert rig.router(port) == port
    for process in hosts:
        code, _, err = finish(process)
        assert code == 0, err
    rig.same_bytes()
