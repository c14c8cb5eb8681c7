"""Hosts of one deployment, each with its own runtime folder, in one network or several; nothing may be left."""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

FLS_FLOW = [sys.executable, "-m", "fls_flow.cli"]

SITE = Path(__file__).parents[1] / "site"  # a distribution with kinds for tests
# with vehicle: [sonar, judge] every sort of wire crosses hosts: data both ways, feedback, a stream, sinks
GRAPH = """
graph: toy
nodes:
  sonar: {use: acme-pings}
  nav: {use: acme-nav}
  slow: {use: acme-slow, in: {ping: sonar, nav: nav@time, before: judge@previous}}
  judge: {use: acme-judge, in: {ping: sonar, detections: slow}}
  out: {use: detection-csv, in: {detections: judge}}
  rec: {use: acme-recorder, in: {ping: sonar, slow: slow, judge: judge}}
"""
HOSTS = "{vehicle: [sonar, judge], topside: [nav, slow, out, rec]}"
OUTPUTS = ("detections.csv", "messages.bin")

ROUTER = """
import socket, sys, zenoh
with socket.socket() as one:
    one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    one.bind(("127.0.0.1", int(sys.argv[1])))
    port = one.getsockname()[1]
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print("ready", port, sep="\\n", flush=True)
    sys.stdin.read()
"""


class Rig:
    """A folder with the graph toy.yaml and its kinds; hosts are started in it and tidied up after."""

    def __init__(self, place: Path, run: Path) -> None:
        self.place, self._run = place, run
        self._started: list[subprocess.Popen[str]] = []
        self._others: list[subprocess.Popen[str]] = []
        (place / "toy.yaml").write_text(GRAPH)

    def deploy(
        self, zenoh: str, *more: str, hosts: str = HOSTS, file: str = "d.yaml", name: str = "pair"
    ) -> None:
        """Write a deployment: the value of `zenoh:`, and further lines."""
        lines = [f"deployment: {name}", f"hosts: {hosts}", f"zenoh: {zenoh}", *more]
        (self.place / file).write_text("\n".join(lines) + "\n")

    def loopback(self, *more: str, **options: str) -> int:
        """Write a deployment of vehicle, which listens on a free port, and topside; give the port."""
        port = free_port()
        address = f"tcp/127.0.0.1:{port}"
        self.deploy(
            f"{{vehicle: {{listen: [{address}]}}, topside: {{connect: [{address}]}}}}", *more, **options
        )
        return port

    def environment(self, host: str) -> dict[str, str]:
        folder = self._run / host
        folder.mkdir(exist_ok=True)
        paths = {"PYTHONPATH": str(SITE), "XDG_RUNTIME_DIR": str(folder)}
        return {**os.environ, **paths, "COLUMNS": "160"}

    def host(
        self,
        host: str,
        *words: str,
        graph: str = "toy.yaml",
        file: str = "d.yaml",
        within: Sequence[str] = (),
        out: str | None = None,
    ) -> subprocess.Popen[str]:
        """Start a host's share, `within` a command such as `ip netns exec NAME`."""
        deployment = ["--deploy", file, "--host", host, "--out", out or host]
        return self._start([*within, *FLS_FLOW, "run", graph, *deployment, *words], host)

    def here(self, *words: str, graph: str = "toy.yaml", out: str = "here") -> None:
        """The same in one process, to compare with."""
        code, _, err = ended(
            self._start([*FLS_FLOW, "run", graph, "--in-process", "--out", out, *words], "here")
        )
        assert code == 0, err

    def alone(self, *words: str, out: str = "alone") -> subprocess.Popen[str]:
        """Start the graph as processes of this machine, without a deployment."""
        return self._start([*FLS_FLOW, "run", "toy.yaml", "--out", out, *words], "alone")

    def _start(self, words: Sequence[str], host: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            words,
            cwd=self.place,
            env=self.environment(host),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._started.append(process)
        return process

    def beside(self, words: Sequence[str], within: Sequence[str] = ()) -> subprocess.Popen[str]:
        """Start a process that runs until the end of the test, and wait for its first line."""
        process = subprocess.Popen(
            [*within, sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._others.append(process)
        assert process.stdout is not None
        assert process.stdout.readline()
        return process

    def router(self, port: int = 0) -> int:
        """Start a router that is no host of any deployment; its port."""
        process = self.beside(["-c", ROUTER, str(port)])
        assert process.stdout is not None
        return int(process.stdout.readline())

    def kill_router(self) -> None:
        """Kill what was started last beside the hosts."""
        self._others[-1].kill()
        self._others[-1].wait()

    def processes(self, host: str) -> list[int]:
        """All living processes of a host, its supervisor among them."""
        mark = f"XDG_RUNTIME_DIR={self._run / host}\0".encode()
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if mark in (folder / "environ").read_bytes() and (folder / "cmdline").read_bytes():
                    found.append(int(folder.name))
            except OSError:
                continue
        return sorted(found)

    def worker(self, host: str, name: str) -> int:
        """The process of a group of nodes, found by the socket on which it listens."""
        for pid in self.processes(host):
            folder = Path("/proc") / str(pid)
            lines = (folder / "net" / "unix").read_text().splitlines()  # of its own network
            inodes = {line.split()[-2] for line in lines if line.endswith(f"/{name}")}
            links = {os.readlink(one) for one in (folder / "fd").iterdir()}
            if links & {f"socket:[{inode}]" for inode in inodes}:
                return pid
        raise AssertionError(f"no process of {name} on {host}")

    def rows(self, host: str) -> list[dict[str, str]]:
        with (self.place / host / "detections.csv").open(newline="") as file:
            return list(csv.DictReader(file))

    def wait_for_folder(self, host: str, timeout_s: float = 60.0) -> None:
        """Wait until a host has begun to write about its run."""
        wait_for((self.place / host / "run.json").is_file, timeout_s)

    def wait_until_running(self, host: str = "topside", size: int = 5000, timeout_s: float = 60.0) -> None:
        path = self.place / host / "detections.csv"
        wait_for(lambda: path.is_file() and path.stat().st_size > size, timeout_s)

    def same_bytes(self, host: str = "topside", reference: str = "here") -> None:
        for name in OUTPUTS:
            whole = (self.place / reference / name).read_bytes()
            assert whole
            assert (self.place / host / name).read_bytes() == whole, name

    def about(self, host: str) -> dict[str, Any]:
        """What the host's run.json says."""
        said: dict[str, Any] = json.loads((self.place / host / "run.json").read_text())
        return said

    def status(self, host: str) -> str:
        return str(self.about(host)["status"])

    def left_over(self, wait_s: float = 5.0) -> list[str]:
        """Processes and files of runs, after a moment in which they may end."""
        deadline = time.monotonic() + wait_s
        hosts = [folder.name for folder in self._run.iterdir()]
        while found := [*(str(pid) for one in hosts for pid in self.processes(one)), *self.files()]:
            if time.monotonic() > deadline:
                break
            time.sleep(0.05)
        return found

    def files(self) -> list[str]:
        """Sockets and shared memory of these runs."""
        runs = {json.loads(path.read_text()).get("run") for path in self.place.glob("*/run.json")}
        shared = [path for run in runs for path in Path("/dev/shm").glob(f"fls-{run}-*")]
        return [str(path) for path in [*self._run.glob("*/fls-flow/*"), *shared]]

    def end(self) -> None:
        """Kill what still lives, whatever happened before."""
        hosts = [folder.name for folder in self._run.iterdir()]
        for pid in [pid for host in hosts for pid in self.processes(host)]:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        for process in [*self._started, *self._others]:
            process.kill()
            process.communicate()


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


def ended(process: subprocess.Popen[str], timeout_s: float = 90.0) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=timeout_s)
    return process.returncode, out, err


def wait_for(what: Callable[[], object], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with tempfile.TemporaryDirectory(prefix="fls") as short:  # names of sockets have to be short
        one = Rig(tmp_path, Path(short))
        try:
            yield one
            assert not one.left_over()
        finally:
            one.end()


@pytest.fixture
def finish() -> Callable[..., tuple[int, str, str]]:
    """Wait for a process: exit code, output, errors."""
    return ended


@pytest.fixture
def errors() -> Callable[[str], list[str]]:
    """The lines that tell of an error."""
    return lambda text: [line for line in text.splitlines() if line.startswith("error:")]
