"""Two hosts of one deployment over loopback: the same bytes, one end, every loss named on both."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import time

import pytest

LONG = ("--set", "sonar.pings=100000", "--set", "slow.sleep_s=0.01")
STOP_S = 2.0 + 2.0  # a loaded machine closes more slowly; nothing waits for longer


def test_two_hosts_give_the_bytes_of_one_process_in_whatever_order_they_start(rig, finish):
    rig.loopback()
    words = ["--set", "sonar.cells=30000"]
    rig.here(*words)
    topside = rig.host("topside", *words)
    time.sleep(1.0)
    vehicle = rig.host("vehicle", *words)
    for process in (vehicle, topside):
        code, out, err = finish(process)
        assert code == 0, err
        assert "pings 40 " in out
    rig.same_bytes()
    assert (rig.status("vehicle"), rig.status("topside")) == ("finished", "finished")


def test_both_hosts_note_one_run(rig, finish):
    rig.loopback()
    started = [rig.host(host) for host in ("vehicle", "topside")]
    for process in started:
        assert finish(process)[0] == 0
    vehicle, topside = rig.about("vehicle"), rig.about("topside")
    assert vehicle["run"] == topside["run"]


def test_a_host_that_waits_for_its_leader_is_stopped_by_ctrl_c(rig, finish):
    rig.loopback()
    topside = rig.host("topside")
    rig.wait_for_folder("topside")
    time.sleep(0.5)
    topside.send_signal(signal.SIGINT)
    code, out, err = finish(topside)
    assert code == 130, err
    assert "interrupted" in out
    assert rig.status("topside") == "interrupted"


def test_the_leader_waits_for_a_host_that_comes_later(rig, finish):
    rig.loopback()
    rig.here()
    vehicle = rig.host("vehicle")
    time.sleep(2.0)
    assert vehicle.poll() is None
    topside = rig.host("topside")
    for process in (topside, vehicle):
        code, _, err = finish(process)
        assert code == 0, err
    rig.same_bytes()


LEADER = """
import json, sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    key = "fls/pair/@run"
    session.declare_queryable(key, lambda query: query.reply(key, sys.argv[2]))
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("answer", ['{"run": "r", "since": "a later version"}', "[]", "no JSON"])
def test_a_leader_of_another_version_is_refused(rig, finish, errors, answer):
    port = rig.loopback("connect_timeout_s: 20")
    rig.beside(["-c", LEADER, f"tcp/127.0.0.1:{port}", answer])
    code, _, err = finish(rig.host("topside"))
    assert code == 2
    (line,) = errors(err)
    assert line.startswith(
        "error: host 'vehicle' answers as another version of fls_flow would; install the same"
    )


@pytest.mark.parametrize("what", ["graph", "deployment"])
def test_another_graph_or_deployment_is_refused(rig, finish, errors, what):
    rig.loopback("connect_timeout_s: 20")
    text = (rig.place / "d.yaml").read_text()
    (rig.place / "other.yaml").write_text(text + ("lost_after_s: 4\n" if what == "deployment" else ""))
    vehicle = rig.host("vehicle")
    words = ["--set", "slow.sleep_s=0.001"] if what == "graph" else []
    topside = rig.host("topside", *words, file="other.yaml")
    code, _, err = finish(topside)
    assert code == 2
    (line,) = errors(err)
    assert f"host 'vehicle' runs another {what}" in line
    assert "Traceback" not in err
    vehicle.send_signal(signal.SIGINT)
    assert finish(vehicle)[0] == 130


def test_a_host_without_its_leader_gives_up_in_time(rig, finish, errors):
    rig.loopback("connect_timeout_s: 1.5")
    code, _, err = finish(rig.host("topside"))
    assert code == 1
    (line,) = errors(err)
    assert "host 'vehicle' did not answer within 1.5 s" in line
    assert rig.status("topside") == "failed"


def test_a_leader_without_the_other_host_names_it(rig, finish, errors):
    rig.loopback("connect_timeout_s: 1.5")
    code, _, err = finish(rig.host("vehicle"))
    assert code == 1
    (line,) = errors(err)
    assert "host 'topside' did not come within 1.5 s" in line


def test_a_wrong_password_is_what_both_are_told_to_look_at(rig, finish, errors):
    port = rig.loopback()
    secrets = {"vehicle": "vehicle:one\ntopside:two\n", "topside": "topside:three\n"}
    for host, lines in secrets.items():
        (rig.place / f"{host}.txt").write_text(lines)
        (rig.place / f"{host}.txt").chmod(0o600)
    address = f"tcp/127.0.0.1:{port}"
    parts = {"vehicle": f"listen: [{address}]", "topside": f"connect: [{address}]"}
    own = [f"{host}: {{{way}, user: {host}, password_file: {host}.txt}}" for host, way in parts.items()]
    rig.deploy(f"{{{', '.join(own)}}}", "connect_timeout_s: 2")
    started = {name: rig.host(name) for name in parts}
    for process in started.values():
        code, _, err = finish(process)
        assert code == 1
        (line,) = errors(err)
        assert line.endswith(", and do the passwords fit?")
        assert "three" not in err


def test_an_address_that_is_taken_is_one_line(rig, finish, errors):
    port = rig.loopback()
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", port))
        other.listen()
        code, _, err = finish(rig.host("vehicle"))
    assert code == 1
    (line,) = errors(err)
    assert (
        f"tcp/127.0.0.1:{port}: [127.0.0.1:{port}: Address already in use (os error 98)]; look at 'listen'"
        in line
    )
    assert ".rs" not in line
    assert rig.status("vehicle") == "failed"


def test_a_node_that_raises_ends_both_with_the_same_cause(rig, finish, errors):
    rig.loopback()
    words = ["--set", "slow.fail_at=25"]
    vehicle, topside = rig.host("vehicle", *words), rig.host("topside", *words)
    cause = "node 'slow' failed at ping seq 25 (index 25): ValueError: no echo today"
    code, _, err = finish(topside)
    assert (code, errors(err)) == (1, [f"error: {cause}"])
    code, _, err = finish(vehicle)
    assert (code, errors(err)) == (1, [f"error: host 'topside': {cause}"])
    assert list(dict.fromkeys(row["seq"] for row in rig.rows("topside"))) == [str(n) for n in range(25)]


def test_a_worker_that_is_killed_is_named_on_both(rig, finish, errors):
    rig.loopback()
    vehicle, topside = rig.host("vehicle", *LONG), rig.host("topside", *LONG)
    rig.wait_until_running()
    os.kill(rig.worker("vehicle", "judge"), signal.SIGKILL)
    for process, host in ((vehicle, ""), (topside, "host 'vehicle': ")):
        code, _, err = finish(process)
        assert code == 1
        (line,) = errors(err)
        assert line.startswith(f"error: {host}process 'judge' with node 'judge'")
        assert line.endswith("died (signal 9: SIGKILL)")
    assert_whole(rig)


@pytest.mark.parametrize("victim", ["vehicle", "topside"])
def test_a_supervisor_that_is_killed_is_a_lost_host(rig, finish, errors, victim):
    rig.loopback("lost_after_s: 2")
    hosts = {name: rig.host(name, *LONG) for name in ("vehicle", "topside")}
    rig.wait_until_running()
    hosts[victim].kill()
    hosts[victim].wait()
    began = time.monotonic()
    (other,) = set(hosts) - {victim}
    code, _, err = finish(hosts[other])
    assert time.monotonic() - began < 2.0 + STOP_S
    assert code == 1
    (line,) = errors(err)
    assert f"host '{victim}' is lost" in line
    assert not rig.left_over()
    assert_whole(rig)


def test_a_host_that_vanishes_whole_is_lost(rig, finish, errors):
    rig.loopback("lost_after_s: 2")
    words = [*LONG, "--set", "sonar.cells=10000"]  # large enough for shared memory
    vehicle, topside = rig.host("vehicle", *words), rig.host("topside", *words)
    rig.wait_until_running(size=2000)
    before = set(rig.files())
    for pid in rig.processes("vehicle"):
        os.kill(pid, signal.SIGKILL)
    vehicle.wait()
    code, _, err = finish(topside)
    assert code == 1
    (line,) = errors(err)
    assert "host 'vehicle' is lost: silent for 2." in line
    assert_whole(rig)
    left = set(rig.left_over(0.0))
    assert left <= before, "the survivor leaves nothing, and nobody could tidy up for the dead"
    assert all("vehicle" in one for one in left)
    code, _, err = finish(rig.alone("--set", "sonar.pings=2"))
    assert code == 0, err
    (folder,) = rig.left_over(0.0)  # the next run has removed the shared memory
    shutil.rmtree(folder)


@pytest.mark.parametrize("victim", ["vehicle", "topside"])
def test_a_supervisor_that_hangs_is_a_lost_host_and_ends_when_it_wakes(rig, finish, errors, victim):
    rig.loopback("lost_after_s: 2")
    hosts = {name: rig.host(name, *LONG) for name in ("vehicle", "topside")}
    rig.wait_until_running()
    hosts[victim].send_signal(signal.SIGSTOP)
    (other,) = set(hosts) - {victim}
    code, _, err = finish(hosts[other])
    assert code == 1
    (line,) = errors(err)
    assert f"host '{victim}' is lost" in line
    hosts[victim].send_signal(signal.SIGCONT)
    code, _, err = finish(hosts[victim])
    assert code == 1
    assert len(errors(err)) == 1
    assert_whole(rig)


@pytest.mark.parametrize("pressed", ["vehicle", "topside"])
def test_ctrl_c_on_either_host_stops_both(rig, finish, pressed):
    rig.loopback()
    hosts = {name: rig.host(name, *LONG) for name in ("vehicle", "topside")}
    rig.wait_until_running()
    hosts[pressed].send_signal(signal.SIGINT)
    began = time.monotonic()
    for process in hosts.values():
        code, out, err = finish(process)
        assert code == 130, err
        assert "interrupted" in out
    assert time.monotonic() - began < STOP_S
    assert_whole(rig)


def test_a_host_that_is_started_again_in_the_middle_waits_for_the_next_run(rig, finish, errors):
    rig.loopback("lost_after_s: 2")
    words = ["--set", "sonar.pings=250", "--set", "slow.sleep_s=0.01"]
    vehicle, topside = rig.host("vehicle", *words), rig.host("topside", *words)
    rig.wait_until_running(size=2000)
    for pid in rig.processes("topside"):
        os.kill(pid, signal.SIGKILL)
    topside.wait()
    again = rig.host("topside", *words, out="again")  # as a service manager would
    code, _, err = finish(vehicle)
    assert code == 1
    assert errors(err) == [f"error: {rig.about('vehicle')['error']}"]
    assert "host 'topside' is lost: silent for " in err
    assert again.poll() is None
    rig.here(*words)
    code, _, err = finish(rig.host("vehicle", *words, out="vehicle-again"))
    assert code == 0, err
    code, _, err = finish(again)
    assert code == 0, err
    rig.same_bytes("again")


def test_a_run_that_goes_on_lets_nobody_in(rig, finish, errors):
    rig.loopback("connect_timeout_s: 3")
    hosts = [rig.host(name, *LONG) for name in ("vehicle", "topside")]
    rig.wait_until_running()
    code, _, err = finish(rig.host("topside", *LONG, out="second"))
    assert code == 1
    (line,) = errors(err)
    assert (
        f"host 'vehicle' is in the middle of run {rig.about('vehicle')['run']}, which nobody can join" in line
    )
    assert all(process.poll() is None for process in hosts)
    hosts[0].send_signal(signal.SIGINT)
    assert [finish(process)[0] for process in hosts] == [130, 130]
    assert_whole(rig)


def test_two_deployments_through_one_router_do_not_see_each_other(rig, finish):
    port = rig.router()
    hosts = {}
    for name, pings in (("one", 30), ("two", 50)):
        rig.deploy(f"{{connect: [tcp/127.0.0.1:{port}]}}", file=f"{name}.yaml", name=name)
        words = ["--set", f"sonar.pings={pings}"]
        rig.here(*words, out=f"here-{name}")
        for host in ("vehicle", "topside"):
            hosts[name, host] = rig.host(host, *words, file=f"{name}.yaml", out=f"{name}-{host}")
    for process in hosts.values():
        code, _, err = finish(process)
        assert code == 0, err
    for name in ("one", "two"):
        rig.same_bytes(f"{name}-topside", f"here-{name}")


def assert_whole(rig):
    """The files were closed: each line is whole, each ping there up to the last."""
    read = rig.rows("topside")
    assert all(row["amplitude"] for row in read)
    seqs = list(dict.fromkeys(int(row["seq"]) for row in read))
    assert seqs == list(range(len(seqs)))
