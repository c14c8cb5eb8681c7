"""Vehicle, router and topside each in a network of their own, joined by a bridge: as on three machines."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
import uuid

import pytest

HOSTS = "{vehicle: [sonar, judge], router: [], topside: [nav, slow, out, rec]}"
PORT = 7447
PING_BYTES = 10000 * 3 * 4
WORDS = ("--set", "sonar.cells=10000")
LONG = ("--set", "sonar.pings=100000", "--set", "slow.sleep_s=0.01")


def ip(*words: str) -> str:
    return subprocess.run(["ip", *words], check=True, capture_output=True, text=True, timeout=20).stdout


def possible() -> str | None:
    """Why there can be no namespaces here; None if there can."""
    if not sys.platform.startswith("linux"):
        return "network namespaces need Linux"
    if shutil.which("ip") is None:
        return "network namespaces need iproute2: apt-get install iproute2"
    name = f"fls-try-{uuid.uuid4().hex[:8]}"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, timeout=20)
    if made.returncode:
        return f"network namespaces need root: {made.stderr.strip()}"
    ip("netns", "del", name)
    return None


class Network:
    """Namespaces with an address each on one bridge, which lies in a namespace of its own."""

    def __init__(self, *hosts: str) -> None:
        self._id = uuid.uuid4().hex[:8]
        self.address = {host: f"10.77.0.{number}" for number, host in enumerate(hosts, 1)}
        self._made: list[str] = []
        try:
            self._make(self.space("bridge"), hosts)
        except BaseException:
            self.close()
            raise

    def space(self, host: str) -> str:
        return f"fls-{self._id}-{host}"

    def _make(self, bridge: str, hosts: tuple[str, ...]) -> None:
        for one in (bridge, *map(self.space, hosts)):
            ip("netns", "add", one)
            self._made.append(one)
            ip("-n", one, "link", "set", "lo", "up")
        ip("-n", bridge, "link", "add", "bridge", "type", "bridge")
        ip("-n", bridge, "link", "set", "bridge", "up")
        for host in hosts:
            ends = ["type", "veth", "peer", "name", "cable", "netns", self.space(host)]
            ip("-n", bridge, "link", "add", f"to-{host}", *ends)
            ip("-n", bridge, "link", "set", f"to-{host}", "master", "bridge", "up")
            ip("-n", self.space(host), "address", "add", f"{self.address[host]}/24", "dev", "cable")
            ip("-n", self.space(host), "link", "set", "cable", "up")

    def within(self, host: str) -> list[str]:
        return ["ip", "netns", "exec", self.space(host)]

    def pull(self, host: str) -> None:
        """Take the cable of a host out of the bridge."""
        ip("-n", self.space("bridge"), "link", "set", f"to-{host}", "down")

    def sent(self, host: str) -> int:
        """Bytes that a host has put on its cable."""
        words = [*self.within(host), "cat", "/sys/class/net/cable/statistics/tx_bytes"]
        return int(subprocess.run(words, check=True, capture_output=True, text=True, timeout=20).stdout)

    def close(self) -> None:
        for one in self._made:
            subprocess.run(["ip", "netns", "del", one], capture_output=True, timeout=20)


@pytest.fixture
def network():
    reason = possible()
    if reason is not None and os.environ.get("CI") == "true":
        pytest.fail(reason)
    if reason is not None:
        pytest.skip(reason)
    one = Network("vehicle", "router", "topside")
    yield one
    one.close()


@pytest.fixture
def three(rig, network):
    """Start the three hosts, each in its network; vehicle and topside know the router alone."""
    address = f"tcp/{network.address['router']}:{PORT}"
    rig.deploy(
        f"{{connect: [{address}], router: {{listen: [{address}], open: true}}}}",
        "lost_after_s: 2",
        hosts=HOSTS,
    )

    def begin(*words: str):
        return {
            name: rig.host(name, *words, within=network.within(name))
            for name in ("topside", "vehicle", "router")
        }

    return begin


def test_three_networks_give_the_bytes_of_one_process(rig, finish, network, three):
    rig.here(*WORDS)
    for name, process in three(*WORDS).items():
        code, out, err = finish(process)
        assert code == 0, err
        assert "pings 40 " in out, name
    rig.same_bytes()
    assert network.sent("vehicle") > 40 * PING_BYTES, "the images went over the cable"
    assert network.sent("router") > 40 * PING_BYTES


@pytest.mark.parametrize("unplugged", ["topside", "router"])
def test_a_cable_that_is_pulled_is_a_lost_host_on_every_other(rig, finish, errors, network, three, unplugged):
    hosts = three(*LONG)
    rig.wait_until_running()
    network.pull(unplugged)
    began = time.monotonic()
    for name, process in hosts.items():
        code, _, err = finish(process)
        assert code == 1, err
        (line,) = errors(err)
        assert "is lost: silent for 2." in line
        if name != unplugged:
            lost = {unplugged} if unplugged == "topside" else {"vehicle", "router", "topside"} - {name}
            assert any(f"host '{one}' is lost" in line for one in lost)
    assert time.monotonic() - began < 2.0 + 2.0 + 4.0  # to notice, to stop, and for a loaded machine
    read = rig.rows("topside")
    assert all(row["amplitude"] for row in read)


def test_a_node_that_raises_behind_the_router_ends_all_three(finish, errors, three):
    hosts = three("--set", "slow.fail_at=5")
    cause = "node 'slow' failed at ping seq 5 (index 5): ValueError: no echo today"
    for name, process in hosts.items():
        code, _, err = finish(process)
        assert code == 1
        where = "" if name == "topside" else "host 'topside': "
        assert errors(err) == [f"error: {where}{cause}"]
