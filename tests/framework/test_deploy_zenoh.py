"""The configurations that a deployment makes, in real Zenoh sessions: each in a process of its own."""

import json
import queue
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fls_flow import deploy, graph
from fls_flow.deploy import Deployment, Tls, Zenoh
from fls_flow.errors import InputError

SESSION = """
import json, os, sys, threading, time
import zenoh

job = json.loads(sys.stdin.readline())
config = zenoh.Config()
for path, value in job["config"].items():
    config.insert_json5(path, json.dumps(value))
with zenoh.open(config) as session:
    print("open", flush=True)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    def heard(sample):
        print(sample.key_expr, sample.payload.to_string(), flush=True)
    if job["hear"]:
        session.declare_subscriber(job["hear"], zenoh.handlers.Callback(heard, indirect=False))
    if job["serve"]:
        session.declare_queryable(job["serve"] + "/@counters/x", lambda query: query.reply(query.key_expr, "yes"))
        token = session.liveliness().declare_token(job["serve"] + "/@alive/x")
    while not ended.wait(0.05):
        if job["say"]:
            session.put(job["say"], str(job["word"]))
        if job["ask"]:
            for reply in session.get(job["ask"] + "/@counters/x", timeout=1.0):
                print("counters", reply.ok.payload.to_string(), flush=True)
            for reply in session.liveliness().get(job["ask"] + "/@alive/*", timeout=1.0):
                print("alive", reply.ok.key_expr, flush=True)
    os._exit(0)  # closing may wait 10 s for a link that was refused
"""
KEY = "fls/g/run1/tracker/tracks"


class Party:
    """A process with one session that says a word again and again, or prints what it hears."""

    def __init__(self, config: dict[str, Any], **job: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", SESSION],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdin
        words = dict.fromkeys(("say", "word", "hear", "serve", "ask"))
        self.process.stdin.write(json.dumps({"config": config, **words, **job}) + "\n")
        self.process.stdin.flush()
        self.lines: queue.Queue[str] = queue.Queue()
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()
        assert self.line() == "open"

    def _read(self) -> None:
        assert self.process.stdout
        for line in self.process.stdout:
            self.lines.put(line.strip())

    def line(self, timeout_s: float = 20.0) -> str:
        return self.lines.get(timeout=timeout_s)

    def heard(self, count: int) -> set[str]:
        """The words among the next `count` messages."""
        return {self.line().split()[1] for _ in range(count)}

    def end(self) -> None:
        try:
            _, errors = self.process.communicate(timeout=10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
            raise
        self.reader.join()
        assert self.process.returncode == 0, errors


@pytest.fixture
def party() -> Iterator[Callable[..., Party]]:
    started: list[Party] = []

    def start(config: dict[str, Any], **words: Any) -> Party:
        started.append(Party(config, **words))
        return started[-1]

    yield start
    for one in started:
        one.process.stdin.close()
        one.process.stdin = None
    for one in started:
        one.end()


@pytest.fixture
def address() -> str:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{one.getsockname()[1]}"


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ca.pem, and NAME.pem and NAME.key with the name NAME.local, made as docs/deployments.md says.

    That of `forger` is signed by another authority, other-ca.pem.
    """
    page = (Path(__file__).parents[2] / "docs" / "deployments.md").read_text()
    (commands,) = re.findall(r"```sh\n(openssl.*?)```", page, re.DOTALL)
    commands = commands.replace("DNS:$host.local", "IP:127.0.0.1")
    folder, other = tmp_path_factory.mktemp("tls"), tmp_path_factory.mktemp("other")
    for place, hosts in ((folder, "vehicle topside stranger"), (other, "forger")):
        script = commands.replace("vehicle topside", hosts)
        subprocess.run(["sh", "-e", "-c", script], cwd=place, check=True, capture_output=True)
    for name in ("forger.pem", "forger.key"):
        (other / name).rename(folder / name)
    (other / "ca.pem").rename(folder / "other-ca.pem")
    return folder


def made(**hosts: Zenoh) -> Deployment:
    return Deployment("test", "vehicle", dict.fromkeys(hosts, ()), zenoh=hosts)


def accepted(config: dict[str, Any]) -> None:
    """Zenoh refuses keys that it does not know and values of another type."""
    whole = zenoh.Config()
    for path, value in config.items():
        whole.insert_json5(path, json.dumps(value))


def tls(folder: Path, name: str, *, mutual: bool = True) -> Tls:
    return Tls(folder / "ca.pem", folder / f"{name}.pem", folder / f"{name}.key", mutual)


def test_a_message_passes_between_hosts(party: Any, address: str) -> None:
    both = made(vehicle=Zenoh(listen=(f"tcp/{address}",)), topside=Zenoh(connect=(f"tcp/{address}",)))
    listener = party(both.zenoh_config("vehicle"), hear=KEY)
    party(both.zenoh_config("topside"), say=KEY, word="hello")
    assert listener.heard(3) == {"hello"}


def test_hosts_may_start_in_any_order(party: Any, address: str) -> None:
    both = made(vehicle=Zenoh(listen=(f"tcp/{address}",)), topside=Zenoh(connect=(f"tcp/{address}",)))
    party(both.zenoh_config("topside"), say=KEY, word="hello")
    listener = party(both.zenoh_config("vehicle"), hear=KEY)
    assert listener.heard(3) == {"hello"}


def test_processes_of_hosts_talk_through_their_hosts_and_a_router_between(
    party: Any, address: str, tmp_path: Path
) -> None:
    door = {host: f"unixsock-stream/{tmp_path}/{host}" for host in ("vehicle", "topside")}
    away = Zenoh(connect=(f"tcp/{address}",))
    chain = made(vehicle=away, pier=Zenoh(listen=(f"tcp/{address}",)), topside=away)
    party(chain.zenoh_config("pier"))
    for host, path in door.items():
        party(chain.zenoh_config(host, listen=[path]))
    listener = party(chain.worker_config("topside", connect=[door["topside"]]), hear=KEY)
    party(chain.worker_config("vehicle", connect=[door["vehicle"]]), say=KEY, word="hello")
    assert listener.heard(3) == {"hello"}


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_mutual_tls_lets_in_who_the_authority_signed_and_nobody_else(
    party: Any, address: str, certificates: Path, protocol: str
) -> None:
    there = (f"{protocol}/{address}",)
    forger = Tls(certificates / "ca.pem", certificates / "forger.pem", certificates / "forger.key")
    hosts = made(
        vehicle=Zenoh(listen=there, tls=tls(certificates, "vehicle")),
        topside=Zenoh(connect=there, tls=tls(certificates, "topside")),
        forger=Zenoh(connect=there, tls=forger),
        nobody=Zenoh(connect=there, tls=Tls(certificates / "ca.pem", mutual=False)),
    )
    listener = party(hosts.zenoh_config("vehicle"), hear=KEY)
    for bad in ("forger", "nobody"):
        party(hosts.zenoh_config(bad), say=KEY, word=bad)
    time.sleep(1.0)  # they try
    party(hosts.zenoh_config("topside"), say=KEY, word="hello")
    assert listener.heard(20) == {"hello"}


def test_a_listener_of_another_authority_is_not_trusted(party: Any, address: str, certificates: Path) -> None:
    there = (f"tls/{address}",)
    forger = Tls(
        certificates / "other-ca.pem", certificates / "forger.pem", certificates / "forger.key", False
    )
    hosts = made(
        forger=Zenoh(listen=there, tls=forger),
        vehicle=Zenoh(connect=there, tls=tls(certificates, "vehicle")),
    )
    listener = party(hosts.zenoh_config("forger"), hear=KEY)
    party(hosts.zenoh_config("vehicle"), say=KEY, word="secret")
    with pytest.raises(queue.Empty):
        listener.line(timeout_s=2.0)


def test_only_listed_certificates_exchange_messages(party: Any, address: str, certificates: Path) -> None:
    there = (f"tls/{address}",)
    listed = ("vehicle.local", "topside.local")
    hosts = made(
        vehicle=Zenoh(listen=there, tls=tls(certificates, "vehicle"), certificates=listed),
        topside=Zenoh(connect=there, tls=tls(certificates, "topside"), certificates=listed),
        stranger=Zenoh(connect=there, tls=tls(certificates, "stranger")),
    )
    listener = party(hosts.zenoh_config("vehicle"), hear="fls/**")
    party(hosts.zenoh_config("stranger"), say=KEY, word="stranger")
    time.sleep(1.0)
    party(hosts.zenoh_config("topside"), say=KEY, word="hello")
    assert listener.heard(20) == {"hello"}


def test_questions_and_signs_of_life_pass_access_control(
    party: Any, address: str, certificates: Path
) -> None:
    there = (f"tls/{address}",)
    hosts = made(
        vehicle=Zenoh(listen=there, tls=tls(certificates, "vehicle"), certificates=("topside.local",)),
        topside=Zenoh(connect=there, tls=tls(certificates, "topside"), certificates=("vehicle.local",)),
    )
    party(hosts.zenoh_config("vehicle"), serve="fls/g/run1")
    asker = party(hosts.zenoh_config("topside"), ask="fls/g/run1")
    said = {asker.line() for _ in range(6)}
    assert said == {"counters yes", "alive fls/g/run1/@alive/x"}


@pytest.mark.parametrize("word", deploy.session.CONTROL_WORDS)
def test_access_control_lets_every_verbatim_chunk_pass(word: str, tmp_path: Path) -> None:
    config = secret(tmp_path, "vehicle", users=("vehicle",))
    keys = config["access_control/rules"][0]["key_exprs"]
    for key in (f"fls/g/{word}", f"fls/g/run1/{word}/x", f"fls/g/run1/a/b/{word}/c"):
        assert any(zenoh.KeyExpr(one).includes(zenoh.KeyExpr(key)) for one in keys)


def secret(
    folder: Path, user: str, lines: str = "vehicle:rose\ntopside:thorn\n", **more: Any
) -> dict[str, Any]:
    path = folder / "passwords.txt"
    path.write_text(lines)
    path.chmod(0o600)
    return made(vehicle=Zenoh(user=user, password_file=path, **more)).zenoh_config("vehicle")


@pytest.fixture
def users(tmp_path: Path, address: str) -> Callable[..., dict[str, Any]]:
    """The configuration of a session that listens, or connects, with its own file of passwords."""

    def config(name: str, lines: str, *, listen: bool = False, allow: Any = None) -> dict[str, Any]:
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        ends = {"listen" if listen else "connect": (f"tcp/{address}",)}
        return secret(folder, name, lines, users=allow, **ends)

    return config


ALL = "vehicle:rose\ntopside:thorn\nother:reed\n"


def test_the_right_password_opens_and_a_wrong_or_missing_one_does_not(
    party: Any, users: Any, address: str
) -> None:
    listener = party(users("vehicle", ALL, listen=True), hear=KEY)
    party(users("topside", "topside:wrong\n"), say=KEY, word="wrong")
    party(made(nobody=Zenoh(connect=(f"tcp/{address}",))).zenoh_config("nobody"), say=KEY, word="nobody")
    time.sleep(1.0)
    party(users("topside", "topside:thorn\n"), say=KEY, word="hello")
    assert listener.heard(20) == {"hello"}


def test_only_listed_users_exchange_messages(party: Any, users: Any) -> None:
    listener = party(users("vehicle", ALL, listen=True, allow=("vehicle", "topside")), hear="fls/**")
    party(users("other", "other:reed\n"), say=KEY, word="other")
    time.sleep(1.0)
    party(users("topside", "topside:thorn\n"), say=KEY, word="hello")
    assert listener.heard(20) == {"hello"}


@pytest.mark.parametrize("door", ["unixsock-stream/{folder}/door", "tcp/{address}"])
def test_a_hosts_own_processes_pass_its_access_control(
    party: Any, tmp_path: Path, address: str, certificates: Path, door: str
) -> None:
    there = door.format(folder=tmp_path, address=address)
    only = Zenoh(tls=tls(certificates, "vehicle"), certificates=("topside.local",))
    vehicle = made(vehicle=only)
    party(vehicle.zenoh_config("vehicle", listen=[there]))
    listener = party(vehicle.worker_config("vehicle", connect=[there]), hear=f"{KEY}/@host/vehicle")
    party(vehicle.worker_config("vehicle", connect=[there]), say=f"{KEY}/@host/vehicle", word="hello")
    assert listener.heard(3) == {"hello"}


def test_own_processes_show_the_password_of_their_host(party: Any, tmp_path: Path) -> None:
    path = tmp_path / "passwords.txt"
    path.write_text("vehicle:rose\n")
    path.chmod(0o600)
    vehicle = made(vehicle=Zenoh(user="vehicle", password_file=path, users=("vehicle",)))
    door = f"unixsock-stream/{tmp_path}/door"
    party(vehicle.zenoh_config("vehicle", listen=[door]))
    # as the processes of a run do: past the host's session, to those that were there before
    own = {"listen": [f"{door}-listener"]}
    listener = party(vehicle.worker_config("vehicle", connect=[door], **own), hear=KEY)
    earlier = [door, *own["listen"]]
    party(vehicle.worker_config("vehicle", connect=earlier, listen=[f"{door}-other"]), say=KEY, word="hello")
    assert listener.heard(3) == {"hello"}


@pytest.mark.parametrize("name", sorted(path.stem for path in deploy.shipped().glob("*.yaml")))
def test_zenoh_takes_the_configuration_of_every_shipped_host(name: str, tmp_path: Path) -> None:
    found = deploy.load(name, graph.load("surface_obstacle"))
    path = tmp_path / "passwords.txt"
    path.write_text("vehicle:a\npier:b\ntopside:c\n")
    path.chmod(0o600)
    document = found.to_document()
    for one in document["zenoh"].values():
        one["password_file"] = one["password_file"] and str(path)
    found = Deployment.of_document(document)
    for host in found.hosts:
        for mode in ("peer", "client", "router"):
            accepted(found.zenoh_config(host, mode=mode))
        accepted(found.worker_config(host, connect=["tcp/127.0.0.1:7000"]))


def test_a_session_that_is_told_nothing_listens_nowhere_and_looks_for_nobody() -> None:
    config = deploy.local(graph.load("surface_obstacle")).zenoh_config("local")
    assert config["listen/endpoints"] == config["connect/endpoints"] == []
    assert config["scouting/multicast/enabled"] is False
    accepted(config)


def test_nobody_connects_to_itself() -> None:
    there = ("tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447")
    config = made(vehicle=Zenoh(listen=there[:1], connect=there)).zenoh_config("vehicle")
    assert config["connect/endpoints"] == ["tcp/10.0.0.2:7447"]


def test_the_password_is_in_the_configuration_alone(tmp_path: Path) -> None:
    config = secret(tmp_path, "vehicle")
    assert config["transport/auth/usrpwd/password"] == "rose"
    settings = Zenoh(user="vehicle", password_file=tmp_path / "passwords.txt")
    assert "rose" not in json.dumps(made(vehicle=settings).to_document())


@pytest.mark.parametrize(
    ("lines", "mode", "says"),
    [
        ("vehicle:rose\n", 0o604, "everybody on this machine can read it; chmod o-rwx"),
        ("vehicle rose\n", 0o600, "passwords.txt:1: write user:password"),
        ("vehicle:\n", 0o600, "passwords.txt:1: write user:password"),
        ("vehicle:rose\nvehicle:reed\n", 0o600, "passwords.txt:2: user 'vehicle' stands twice"),
        ("topside:thorn\n", 0o600, "has no line for user 'vehicle'; add vehicle:PASSWORD"),
    ],
)
def test_a_password_file_that_is_no_good(tmp_path: Path, lines: str, mode: int, says: str) -> None:
    path = tmp_path / "passwords.txt"
    path.write_text(lines)
    path.chmod(mode)
    with pytest.raises(InputError) as error:
        made(vehicle=Zenoh(user="vehicle", password_file=path)).zenoh_config("vehicle")
    assert says in str(error.value)
    assert "rose" not in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_password_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none: cannot be read: No such file"):
        made(vehicle=Zenoh(user="vehicle", password_file=tmp_path / "none")).zenoh_config("vehicle")


def test_every_verbatim_chunk_that_the_framework_uses_is_in_the_list() -> None:
    package = Path(deploy.__file__).parents[1]
    modules = [path for path in package.rglob("*.py") if package / "deploy" not in path.parents]
    used = {word for path in modules for word in re.findall(r"/(@[a-z]+)[/\"]", path.read_text())}
    assert used <= set(deploy.session.CONTROL_WORDS)
