"""Deployment files: what they say, and every mistake at once with its line."""

import itertools
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fls_flow import deploy, graph
from fls_flow.deploy import Deployment, Group, endpoints
from fls_flow.errors import GraphError, UserError
from fls_flow.graph import Graph

DOCUMENT = Path(__file__).parents[2] / "docs" / "deployments.md"
SHIPPED = sorted(path.stem for path in deploy.shipped().glob("*.yaml"))
TWO = "hosts: {vehicle: [sonar, noise, cfar, wakes, tracker, csv, truth], topside: [picture]}\n"
WAY = "zenoh: {vehicle: {listen: [tcp/10.0.0.1:7447], open: true}, topside: {connect: [tcp/10.0.0.1:7447]}}\n"


@pytest.fixture(scope="module")
def surface() -> Graph:
    return graph.load("surface_obstacle")


@pytest.fixture
def read(surface: Graph, tmp_path: Path) -> Callable[..., Deployment]:
    """The deployment of the surface graph in a text; its first line is `deployment: d`."""

    def call(text: str, host: str | None = None, of: Graph = surface) -> Deployment:
        path = tmp_path / "d.yaml"
        path.write_text("deployment: d\n" + text)
        return deploy.load(path, of, host=host)

    return call


@pytest.fixture
def wrong(read: Callable[..., Deployment]) -> Callable[..., list[str]]:
    """The problems of such a text, as `line: what`."""

    def call(text: str, host: str | None = None) -> list[str]:
        with pytest.raises(GraphError) as error:
            read(text, host)
        for problem in error.value.problems:
            assert "\n" not in problem.what
        return [str(one).rpartition("d.yaml:")[2] for one in error.value.problems]

    return call


def test_nothing_but_a_name_is_a_process_per_node_on_one_host(read: Any, surface: Graph) -> None:
    found = read("")
    assert found.hosts == ("local",)
    assert found.groups("local") == tuple(Group(node.name, (node.name,)) for node in surface.nodes)
    assert found.leader == "local"
    assert (found.window_for(live=False), found.window_for(live=True)) == (8, 2)
    assert (found.control, found.lost_after_s, found.latest) == (False, 3.0, frozenset())
    assert replace(found, name=surface.name, path=None) == deploy.local(surface)


def test_local_takes_a_window(surface: Graph) -> None:
    assert deploy.local(surface, 3).window_for(live=True) == 3
    with pytest.raises(ValueError, match="window is 0"):
        deploy.local(surface, 0)


def test_the_whole_of_a_file(read: Any) -> None:
    found = read(
        TWO
        + WAY
        + "processes: {front: [cfar, sonar]}\nthreads: {front: 2, csv: 1}\nwindow: 5\nlost_after_s: 7\n"
        + "deadline_s: 0.5\nconnect_timeout_s: 9\ncontrol: true\nqos: {'* -> picture': latest}\n"
    )
    assert found.groups("vehicle")[0] == Group("front", ("sonar", "cfar"), threads=2)
    assert [one.name for one in found.groups("vehicle")[1:]] == ["noise", "truth", "wakes", "tracker", "csv"]
    assert found.groups("topside") == (Group("picture", ("picture",)),)
    assert (found.host_of("cfar"), found.process_of("cfar"), found.threads("front")) == (
        "vehicle",
        "front",
        2,
    )
    assert (found.host_of("picture"), found.process_of("picture"), found.threads("csv")) == (
        "topside",
        "picture",
        1,
    )
    assert sorted(found.nodes("vehicle")) == sorted(
        ["sonar", "noise", "cfar", "wakes", "tracker", "csv", "truth"]
    )
    assert found.leader == "vehicle"
    assert (found.window_for(live=True), found.control) == (5, True)
    assert (found.lost_after_s, found.deadline_s, found.connect_timeout_s) == (7.0, 0.5, 9.0)
    assert found.latest == {
        ("sonar", "ping", "picture"),
        ("wakes", "detections", "picture"),
        ("wakes", "wakes", "picture"),
        ("tracker", "tracks", "picture"),
    }
    for missing in (found.groups, found.host_of, found.process_of, found.threads):
        with pytest.raises(KeyError):
            missing("nothing")


def test_a_deployment_comes_back_from_json(read: Any) -> None:
    found = read(TWO + WAY + "processes: {front: [cfar, sonar]}\nqos: {tracker -> csv: latest}\n")
    document = json.loads(json.dumps(found.to_document()))
    assert Deployment.of_document(document) == found
    assert Deployment.of_document(document).digest == found.digest


def test_the_digest_says_whether_two_hosts_agree(read: Any, tmp_path: Path) -> None:
    one = read(TWO + WAY)
    assert replace(one, path=Path("/elsewhere.yaml"), notes=("x",)).digest == one.digest
    for text in ("window: 4\n", "control: true\n", "threads: {csv: 2}\n", "qos: {tracker -> csv: latest}\n"):
        assert read(TWO + WAY + text).digest != one.digest
    assert read(TWO + WAY.replace("7447", "7448")).digest != one.digest
    secret = "zenoh: {{connect: [tcp/r:1], user: u, password_file: {}}}\n"
    assert read(TWO + secret.format("a.txt")).digest == read(TWO + secret.format("b.txt")).digest


# --- mistakes ------------------------------------------------------------------------------------


def test_all_mistakes_come_at_once_in_the_order_of_the_file(wrong: Any) -> None:
    said = wrong(
        "windw: 8\n"
        "window: 0\n"
        "hosts:\n"
        "  vehicle: [sonar, noise, cfra, wakes, tracker, csv, truth]\n"
        "  topside: [sonar]\n"
        "processes: {front: [csv, csv], cfar: [csv], empty: []}\n"
        "qos: {tracker -> wakes: latest, tracker -> cvs: latest, noise -> csv: latest, tracker -> csv: newest}\n"
        "threads: {fornt: 2, front: 0}\n"
        "lost_after_s: 0\n"
        "control: 1\n"
        "zenoh: {liste: [], listen: tcp/1, topsid: {}, connect: [tcp/10.0.0.1]}\n"
    )
    for line, what in [
        (2, "a deployment has no key 'windw'; did you mean 'window'?"),
        (3, "window is 0; it takes a whole number from 1 to 1000"),
        (4, "on no host: cfar, picture; each node of graph 'surface-obstacle' runs on one"),
        (5, "host 'vehicle': graph 'surface-obstacle' has no node \"cfra\"; did you mean 'cfar'?"),
        (6, "host 'topside': node 'sonar' is already in host 'vehicle'"),
        (7, "process 'front': node 'csv' is already in process 'front'"),
        (7, "process 'cfar': node 'csv' is already in process 'front'"),
        (7, "process 'cfar' has the name of a node that it does not hold; take another name"),
        (7, "process 'empty' is empty; list its nodes, or remove it"),
        (
            8,
            "qos 'tracker -> wakes': 'wakes' is no sink; only what ends in a sink may be lost (truth, csv, picture)",
        ),
        (8, "qos 'tracker -> cvs': the graph has no node 'cvs'; did you mean 'csv'?"),
        (8, "qos 'noise -> csv': there is no such edge; 'csv' takes tracker.tracks"),
        (8, "qos of 'tracker -> csv' is \"newest\"; it is latest or lossless"),
        (9, "threads: there is no process 'fornt'; did you mean 'front'?"),
        (9, "threads of 'front' is 0; it takes a whole number from 1 to 256"),
        (10, "lost_after_s is 0; it takes a number of seconds above 0, at most 86400"),
        (11, "control is 1; it takes true or false"),
        (12, "zenoh has no key 'liste'; did you mean 'listen'?"),
        (12, 'zenoh: listen is "tcp/1"; it is a list of texts'),
        (12, "zenoh has no key 'topsid'; did you mean 'topside'?"),
        (
            12,
            "zenoh: connect 'tcp/10.0.0.1': it ends with a port from 0 to 65535, for example tcp/10.0.0.1:7447",
        ),
    ]:
        assert f"{line}: {what}" in said
    lines = [int(one.partition(":")[0]) for one in said]
    assert lines == sorted(lines)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("hosts: [a]\n", "'hosts' is [\"a\"]; it maps names of hosts to lists of nodes"),
        ("hosts: {listen: [sonar]}\n", "host name 'listen': that is a key of zenoh:; take another"),
        ("hosts: {'2': [sonar]}\n", "host name '2': it is of letters, digits, - and _"),
        ("hosts: {a: sonar}\n", "host 'a' is \"sonar\"; it is a list of nodes"),
        ("hosts: {a: [[sonar]]}\n", "has no node [\"sonar\"]"),
        (TWO + WAY + "processes: {p: [sonar, picture]}\n", "process 'p' has nodes of several hosts: 'picture' on topside, 'sonar' on vehicle"),
        ("processes: {sonar: [csv, truth]}\n", "process 'sonar' has the name of a node that it does not hold"),
        ("window: true\n", "window is true; it takes a whole number"),
        ("window: 8.0\n", "window is 8.0; it takes a whole number"),
        ("deadline_s: .inf\n", "deadline_s is Infinity; it takes a number of seconds"),
        ("deadline_s: true\n", "deadline_s is true; it takes a number of seconds"),
        ("qos: {tracker: latest}\n", "qos 'tracker': write NODE -> SINK, NODE.OUTPUT -> SINK or * -> SINK"),
        ("qos: {tracker -> picture: latest}\n", "sink 'picture' takes sonar.ping, wakes.detections, wakes.wakes too, losslessly; write \"* -> picture\": latest for all"),
        ("qos: {tracker.track -> csv: latest}\n", "there is no such edge; 'csv' takes tracker.tracks"),
        ("threads: 2\n", "'threads' is 2; it maps names of processes to numbers of threads"),
        ("zenoh: tcp\n", "'zenoh' is \"tcp\"; it maps settings to values"),
        ("zenoh: {local: tcp}\n", "zenoh: host 'local' is \"tcp\"; it maps settings to values"),
        ("zenoh: {mode: client}\n", 'zenoh: mode is "client"; it is one of router, peer'),
        (TWO + "zenoh: {mode: peer}\n", "zenoh: mode is peer; among several hosts each is a router"),
        (TWO, "these hosts have no way to each other: topside | vehicle"),
        (TWO + "zenoh: {vehicle: {connect: [tcp/r:1]}}\n", "these hosts have no way to each other: topside | vehicle"),
        ("zenoh: {listen: [tcp/0.0.0.0:7447]}\n", "listen 'tcp/0.0.0.0:7447' would let in whoever can reach it"),
        ("zenoh: {listen: ['udp/[fd00::2]:7447']}\n", "would let in whoever can reach it"),
        ("zenoh: {listen: [tls/10.0.0.1:7447]}\n", "tls needs tls: {ca, certificate, key}"),
        ("zenoh: {tls: {ca: a}, connect: [tls/x:1]}\n", "tls needs certificate and key, so that the others know this host; or mutual: false"),
        ("zenoh: {tls: {ca: a, key: b, mutual: false}, connect: [tls/x:1]}\n", "tls needs certificate and key, both or neither"),
        ("zenoh: {tls: {ca: a, mutual: false}, listen: [tls/127.0.0.1:1]}\n", "tls needs certificate and key to listen"),
        ("zenoh: {tls: {certificate: b, key: c}, connect: [tls/x:1]}\n", "tls needs ca"),
        ("zenoh: {tls: {ca: a, certificate: b, key: c, mutual: false}, listen: [tls/0.0.0.0:1]}\n", "would let in whoever can reach it"),
        ("zenoh: {tls: {ca: a, certificate: b, key: c}, connect: [tcp/x:1]}\n", "connect 'tcp/x:1' goes past tls"),
        ("zenoh: {tls: {ca: a, certificate: b, key: c}}\n", "tls is given, but no endpoint uses it"),
        ("zenoh: {tls: {ca: 1}}\n", "ca is 1; it is the path of a file"),
        ("zenoh: {tls: {ca: '~no-such-user/ca.pem'}}\n", "ca is \"~no-such-user/ca.pem\"; there is no such user's folder"),
        ("zenoh: {tls: ca.pem}\n", "tls is \"ca.pem\"; it has ca, certificate, key, mutual"),
        ("zenoh: {tls: {cas: a}}\n", "zenoh: tls has no key 'cas'; did you mean 'ca'?"),
        ("zenoh: {user: a}\n", "user needs password_file"),
        ("zenoh: {password_file: a}\n", "password_file needs user"),
        ("zenoh: {user: 'a:b', password_file: a}\n", "user is \"a:b\"; it is a name without a colon"),
        ("zenoh: {password: rose}\n", "zenoh has no key 'password'; did you mean 'password_file'?"),
        ("zenoh: {access_control: {users: [a]}}\n", "access_control by users needs user and password_file"),
        ("zenoh: {access_control: {certificates: [a]}}\n", "access_control by certificates needs tls, with mutual: true"),
        ("zenoh: {access_control: {}}\n", "access_control lists users or certificates"),
        ("zenoh: {user: a, password_file: b, access_control: {users: [a]}, connect: [tcp/x:1]}\n", "for hosts that only listen"),
        ("zenoh: {open: yes}\n", "open is \"yes\"; it is true or false"),
    ],
)  # fmt: skip
def test_a_mistake(wrong: Any, text: str, says: str) -> None:
    said = wrong(text)
    assert any(says in one for one in said), said


def test_no_password_is_ever_shown(wrong: Any) -> None:
    assert "rose" not in str(wrong("zenoh: {password: rose}\n"))


def test_a_file_that_is_no_mapping_or_has_no_name(surface: Graph, tmp_path: Path) -> None:
    path = tmp_path / "d.yaml"
    for text, says in [
        ("", "d.yaml:1: a deployment file is a mapping"),
        ("[1]", "a mapping"),
        ("window: 8", "'deployment' is missing; name it"),
        ("deployment: 3", "deployment is 3; its name is of letters"),
        ("deployment: a\ndeployment: b", "duplicate key 'deployment'"),
        ("deployment: a b", 'deployment is "a b"'),
    ]:
        path.write_text(text)
        with pytest.raises(GraphError) as error:
            deploy.load(path, surface)
        assert says in str(error.value)


def test_files_and_hosts_that_are_not_there_are_named(surface: Graph, read: Any) -> None:
    with pytest.raises(UserError, match=r"one_bx: no such deployment file; did you mean 'one_box'\?"):
        deploy.load("one_bx", surface)
    with pytest.raises(UserError, match=r"x+: no such deployment file; known deployments: .*one_box"):
        deploy.load("x" * 5000, surface)
    with pytest.raises(UserError, match=r"has no host 'vehicl'; did you mean 'vehicle'\?"):
        read(TWO + WAY, host="vehicl")


def test_a_deployment_beside_you_comes_before_a_shipped_one(
    surface: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "deployments").mkdir()
    (tmp_path / "deployments" / "one_box.yaml").write_text("deployment: mine\n")
    monkeypatch.chdir(tmp_path)
    assert deploy.load("one-box", surface).name == "mine"


# --- zenoh ---------------------------------------------------------------------------------------


def test_settings_of_a_host_lie_over_those_of_all_and_tls_is_merged(read: Any, tmp_path: Path) -> None:
    found = read(
        TWO
        + "zenoh:\n"
        + "  tls: {ca: ca.pem}\n"
        + "  connect: [tls/10.0.0.1:7447]\n"
        + "  vehicle: {listen: [tls/10.0.0.1:7447], tls: {certificate: v.pem, key: /etc/v.key}}\n"
        + "  topside: {tls: {certificate: t.pem, key: t.key}}\n"
    )
    vehicle, topside = found.zenoh["vehicle"], found.zenoh["topside"]
    assert vehicle.tls
    assert topside.tls
    assert vehicle.tls.ca == topside.tls.ca == tmp_path / "ca.pem"
    assert (vehicle.tls.key, topside.tls.key) == (Path("/etc/v.key"), tmp_path / "t.key")
    assert found.zenoh_config("vehicle")["connect/endpoints"] == []
    assert found.zenoh_config("topside")["connect/endpoints"] == ["tls/10.0.0.1:7447"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (TWO + WAY, ["host 'vehicle' listens on 'tcp/10.0.0.1:7447' and lets in whoever can reach it"]),
        ("zenoh: {listen: [tcp/127.0.0.1:7447, tcp/localhost:1, 'tcp/[::1]:2', unixsock-stream//run/s]}\n", []),
        ("zenoh: {connect: [udp/127.0.0.1:7447]}\n", ["host 'local' uses 'udp/127.0.0.1:7447': udp loses most large messages; tcp, tls and quic do not"]),
        (TWO + "zenoh: {connect: [tcp/r:1]}\n", []),
        (TWO + "zenoh: {vehicle: {connect: [tcp/r:1]}, topside: {connect: [tcp/r:2]}}\n", ["hosts reach each other only if these addresses are one router's: tcp/r:1, tcp/r:2"]),
        (TWO.replace("tracker, csv", "csv").replace("picture]", "picture, tracker]") + WAY, [
            "host 'vehicle' listens on 'tcp/10.0.0.1:7447' and lets in whoever can reach it",
            "the feedback tracker.tracks@previous -> cfar crosses hosts (topside, vehicle): each ping waits for the network before the next can be done; keep the loop on one host if you can",
        ]),
    ],
)  # fmt: skip
def test_notes(read: Any, text: str, says: list[str]) -> None:
    assert sorted(read(text).notes) == sorted(says)


def test_hosts_find_each_other_by_any_listener_of_the_port(read: Any) -> None:
    anywhere = WAY.replace("listen: [tcp/10.0.0.1", "listen: [tcp/0.0.0.0")
    assert read(TWO + anywhere).hosts == ("vehicle", "topside")


def test_a_host_without_nodes_relays(read: Any) -> None:
    hosts = TWO.replace("}", ", pier: []}")
    found = read(hosts + "zenoh: {connect: [tcp/10.0.0.5:1], pier: {listen: [tcp/10.0.0.5:1], open: true}}\n")
    assert (found.groups("pier"), found.nodes("pier")) == ((), ())


def test_the_files_of_one_host_are_looked_at(wrong: Any, read: Any, tmp_path: Path) -> None:
    text = TWO + (
        "zenoh:\n"
        "  connect: [tcp/10.0.0.5:1]\n"
        "  password_file: passwords.txt\n"
        "  vehicle: {user: vehicle}\n"
        "  topside: {user: topside}\n"
    )
    assert read(text).notes == (
        "files of certificates and passwords are looked at only for one host: name it",
    )
    assert "cannot be read: No such file" in wrong(text, "vehicle")[0]
    (tmp_path / "passwords.txt").write_text("vehicle:rose\n")
    (tmp_path / "passwords.txt").chmod(0o600)
    assert read(text, "vehicle").notes == ()
    assert "has no line for user 'topside'; add topside:PASSWORD" in wrong(text, "topside")[0]


def openssl(folder: Path, *words: str) -> None:
    subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)


def test_certificates_are_looked_at(wrong: Any, read: Any, tmp_path: Path) -> None:
    text = "zenoh: {tls: {ca: a.pem, certificate: a.pem, key: a.key}, listen: [tls/0.0.0.0:7447]}\n"
    assert "ca " in wrong(text)[0]
    assert "cannot be read" in wrong(text)[0]
    for name in "ab":
        files = ["-keyout", f"{name}.key", "-out", f"{name}.pem"]
        openssl(tmp_path, "req", "-x509", "-newkey", "ed25519", "-nodes", *files, "-subj", f"/CN={name}")
        (tmp_path / f"{name}.key").chmod(0o600)
    (tmp_path / "b.pem").chmod(0o600)
    assert read(text).notes == ()
    assert "do not belong together" in wrong(text.replace("a.key", "b.key"))[0]
    assert "are not two PEM files" in wrong(text.replace("a.key", "b.pem"))[0]
    assert "is no certificate in PEM" in wrong(text.replace("ca: a.pem", "ca: a.key"))[0]
    (tmp_path / "a.key").chmod(0o604)
    assert "everybody on this machine can read it; chmod o-rwx" in wrong(text)[0]


@pytest.mark.parametrize(
    ("text", "protocol", "host", "port", "loopback"),
    [
        ("tcp/10.0.0.1:7447", "tcp", "10.0.0.1", 7447, False),
        ("tls/vehicle.local:1", "tls", "vehicle.local", 1, False),
        ("quic/[fd00::2]:7447", "quic", "fd00::2", 7447, False),
        ("ws/127.3.2.1:80", "ws", "127.3.2.1", 80, True),
        ("tcp/[::1]:0", "tcp", "::1", 0, True),
        ("tcp/[::]:0#iface=eth0", "tcp", "::", 0, False),
        ("udp/localhost:5", "udp", "localhost", 5, True),
        ("unixsock-stream//run/fls.sock", "unixsock-stream", "/run/fls.sock", 0, True),
    ],
)
def test_endpoints(text: str, protocol: str, host: str, port: int, loopback: bool) -> None:
    one = endpoints.parse(text)
    assert (one.protocol, one.host, one.port, one.loopback) == (protocol, host, port, loopback)


@pytest.mark.parametrize(
    "text",
    [
        "", "tcp", "10.0.0.1:7447", "tcp/", "tcp/10.0.0.1", "tcp/10.0.0.1:", "tcp/10.0.0.1:65536", "tcp/10.0.0.1:-1",
        "tcp/10.0.0.1:x", "tcp/10.0.0.256:1", "tcp/10.0.1:1", "tcp/:1", "tcp/a b:1", "tcp/fd00::2:1", "tcp/[fd00::x]:1",
        "tcp/[10.0.0.1]:1", "TCP/a:1", "serial//dev/tty:1", "vsock/1:1", "unixsock-stream/run", "tcp/a:1?prio=1",
        "tls/a:1#enable_mtls=false", "tls/a:1#iface=eth0;verify_name_on_connect=false", "tcp/a:\u0661",
    ],
)  # fmt: skip
def test_endpoints_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        endpoints.parse(text)


# --- holders -------------------------------------------------------------------------------------


def test_the_window_is_held_by_the_ends_of_what_is_lossless(read: Any, surface: Graph) -> None:
    assert set(read("").holders(surface)) == {"csv", "truth", "picture"}
    assert set(read("qos: {'* -> picture': latest}\n").holders(surface)) == {"csv", "truth"}
    freed = read("qos: {'* -> picture': latest, tracker -> csv: latest}\n")
    assert set(freed.holders(surface)) == {"tracker", "truth"}
    kept = read(
        "qos: {'* -> picture': latest, tracker -> picture: lossless, sonar -> picture: lossless, wakes -> picture: lossless}\n"
    )
    assert kept.latest == frozenset()


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_deployments_are_sound(name: str, surface: Graph) -> None:
    found = deploy.load(name, surface)
    assert found.name.replace("-", "_") in (name, name.replace("vehicle_", "vehicle_and_"))
    placed = list(itertools.chain.from_iterable(found.nodes(host) for host in found.hosts))
    assert sorted(placed) == sorted(node.name for node in surface.nodes)
    assert Deployment.of_document(json.loads(json.dumps(found.to_document()))) == found
    assert not any("feedback" in note for note in found.notes)


def test_the_examples_are_shipped() -> None:
    assert SHIPPED == ["mtls", "one_box", "through_a_router", "vehicle_topside"]


@pytest.mark.parametrize("text", re.findall(r"```yaml\n(deployment:.*?)```", DOCUMENT.read_text(), re.DOTALL))
def test_the_page_on_deployments_shows_sound_ones(text: str, surface: Graph, tmp_path: Path) -> None:
    (tmp_path / "d.yaml").write_text(text)
    assert deploy.load(tmp_path / "d.yaml", surface).name


# --- fls-flow check --deploy ---------------------------------------------------------------------


def check(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fls_flow.cli", "check", "surface_obstacle", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


def test_check_shows_where_nodes_run(tmp_path: Path) -> None:
    done = check(tmp_path, "--deploy", "vehicle_topside")
    assert done.returncode == 0
    assert done.stdout.splitlines()[1:] == [
        "  deployment vehicle-and-topside, led by host vehicle",
        "  vehicle: front: sonar, noise, cfar, wakes, tracker",
        "  vehicle: files: truth, csv",
        "  topside: picture: picture",
    ]
    assert done.stderr.startswith("note: host 'vehicle' listens on")
    assert "\n  pier: router\n" in check(tmp_path, "--deploy", "through_a_router").stdout


def test_check_says_what_is_wrong_with_a_deployment(tmp_path: Path) -> None:
    (tmp_path / "d.yaml").write_text("deployment: d\nwindow: x\nhosts: {}\n")
    done = check(tmp_path, "--deploy", "d.yaml")
    assert (done.returncode, done.stdout) == (2, "")
    assert [line.split(": ")[1] for line in done.stderr.splitlines()] == ["d.yaml:2", "d.yaml:3"]
    as_json = check(tmp_path, "--deploy", "d.yaml", "--json")
    (said,) = json.loads(as_json.stdout)
    assert [one["where"] for one in said["problems"]] == ["d.yaml:2", "d.yaml:3"]


def test_check_of_a_host(tmp_path: Path) -> None:
    missing = check(tmp_path, "--deploy", "mtls", "--host", "vehicle")
    assert missing.returncode == 2
    assert "ca /etc/fls_flow/tls/ca.pem: cannot be read" in missing.stderr
    for words in (["--host", "vehicle"], ["--deploy", "mtls", "--host", "nobody"], ["--deploy", "none"]):
        done = check(tmp_path, *words)
        assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, "", 1)


@pytest.mark.parametrize(
    ("connects", "listens", "reached"),
    [
        ("tcp/10.0.0.1:7447", "tcp/10.0.0.1:7447", True),
        ("tcp/10.0.0.1:7447", "tcp/0.0.0.0:7447", True),
        ("tcp/10.0.0.2:7447", "tcp/10.0.0.1:7447", False),
        ("tcp/10.0.0.1:7448", "tcp/10.0.0.1:7447", False),
        ("tls/10.0.0.1:7447", "tcp/10.0.0.1:7447", False),
        ("tls/vehicle.local:7447", "tls/10.0.0.1:7447", True),  # a certificate is for a name
        ("tls/localhost:7447", "tls/127.0.0.1:7447", True),
        ("tls/vehicle.local:7447", "tls/vehicle.local:7447", True),
        ("tls/vehicle.local:7447", "tls/topside.local:7447", False),
    ],
)
def test_who_connects_where_somebody_may_listen(connects: str, listens: str, reached: bool) -> None:
    assert endpoints.parse(connects).reaches(endpoints.parse(listens)) is reached
