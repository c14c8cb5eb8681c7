"""`fls-flow run` as a user meets it: a process, files, exit codes, one line per error."""

from __future__ import annotations

import csv
import json
import logging
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fls_flow.errors import UserError
from fls_flow.graph import load
from fls_flow.runtime import RunFolder

FLS_FLOW = [sys.executable, "-m", "fls_flow.cli"]
QUICK = ("--set", "sonar.pings=6")
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def plugins(tmp_path: Path) -> Callable[[str, str], None]:
    """Install a distribution with one kind for the commands of this test."""

    def install(kind: str, code: str) -> None:
        module = kind.replace("-", "_")
        place = tmp_path / "site"
        info = place / f"{module}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {kind}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[fls_flow]\n{kind} = {module}\n")
        (place / f"{module}.py").write_text(code)

    return install


@pytest.fixture
def command(tmp_path: Path) -> Command:
    """Run `fls-flow` in an empty folder."""

    def call(*words: str, **settings: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*FLS_FLOW, *words],
            cwd=tmp_path,
            env=environment(tmp_path),
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
            **settings,  # type: ignore[call-overload]
        )

    return call


def environment(tmp_path: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(tmp_path / "site"), "COLUMNS": "160"}


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_prints_its_figures_and_writes_its_files(command, tmp_path):
    done = command("run", "surface_obstacle", "--in-process", *QUICK, "--out", "here")
    assert done.returncode == 0, done.stderr
    assert "writing to here" in done.stderr
    assert "pings 6" in done.stdout
    assert "confirmed tracks" in done.stdout
    assert "finished; wrote run.json, tracks.csv, tracks.png, truth.csv in here" in done.stdout
    assert {row["seq"] for row in rows(tmp_path / "here" / "tracks.csv")} == {str(n) for n in range(6)}
    assert (tmp_path / "here" / "tracks.png").read_bytes().startswith(b"\x89PNG")


def test_run_json_says_what_ran(command, tmp_path):
    command("run", "surface_obstacle", *QUICK, "--out", "here", "--set", "cfar.pfa=1e-5")
    said = json.loads((tmp_path / "here" / "run.json").read_text())
    assert said["status"] == "finished"
    assert said["graph"] == "surface-obstacle"
    assert said["nodes"]["cfar"]["with"]["pfa"] == 1e-5
    assert said["nodes"]["sonar"]["with"]["seed"] == 7
    assert said["nodes"]["cfar"]["in"]["tracks"] == "tracker.tracks@previous"
    assert said["counts"]["sonar"]["fired"] == said["pings"] == 6
    assert {"python", "numpy", "fls-flow"} <= set(said["versions"])
    assert said["began"] < said["ended"]


def test_by_default_a_run_gets_a_folder_of_its_own(command, tmp_path):
    for _ in range(2):
        assert command("run", "surface_obstacle", *QUICK).returncode == 0
    folders = list((tmp_path / "runs" / "surface-obstacle").iterdir())
    assert len(folders) == 2
    assert all((folder / "tracks.csv").is_file() for folder in folders)


def test_a_run_never_overwrites(command, tmp_path):
    assert command("run", "surface_obstacle", *QUICK, "--out", "here").returncode == 0
    before = (tmp_path / "here" / "tracks.csv").read_bytes()
    again = command("run", "surface_obstacle", *QUICK, "--out", "here")
    assert again.returncode == 2
    assert again.stderr.splitlines() == ["error: --out here: holds another run; name a new folder"]
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "tracks.csv").write_text("mine")
    other = command("run", "surface_obstacle", *QUICK, "--out", "there")
    assert other.returncode == 2
    assert "there/tracks.csv: is there already; name another --out folder" in other.stderr
    assert (tmp_path / "here" / "tracks.csv").read_bytes() == before
    assert (tmp_path / "there" / "tracks.csv").read_text() == "mine"
    assert not (tmp_path / "there" / "run.json").exists()


def test_json_output_is_for_programs(command):
    done = command("run", "surface_obstacle", *QUICK, "--json")
    said = json.loads(done.stdout)
    assert said["figures"]["pings"] == 6
    assert said["status"] == "finished"
    assert done.stderr == ""


def test_in_order_gives_the_same_bytes(command, tmp_path):
    command("run", "surface_obstacle", *QUICK, "--out", "threads")
    command("run", "surface_obstacle", *QUICK, "--out", "order", "--in-order")
    for name in ("tracks.csv", "truth.csv"):
        assert (tmp_path / "threads" / name).read_bytes() == (tmp_path / "order" / name).read_bytes()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["run", "nosuch"], "error: nosuch: no such graph file"),
        (["run", "surface_obstacl"], "did you mean 'surface_obstacle'?"),
        (
            ["run", "surface_obstacle", "--set", "cfar.pfa=lots"],
            "parameter 'pfa' is \"lots\"; it takes float",
        ),
        (["run", "surface_obstacle", "--use", "cfar=rayleig-cfar"], "did you mean 'rayleigh-cfar'?"),
        (["run", "surface_obstacle", "--rate", "0"], "rate is 0; it lies between 0.001 and 1e+06"),
        (["run", "surface_obstacle", "--rate", "1e-300"], "rate is 1e-300; it lies between"),
        (["run", "surface_obstacle", "--set", "csv.path=../../x.csv"], "lies outside the run's folder"),
        (["runn"], "Did you mean 'run'?"),
        (["run", "surface_obstacle", "--window", "0"], "0 is not in the range"),
        (["run"], "Missing argument 'GRAPH'"),
        (["rum"], "No such command 'rum'"),
        (["run", "--window"], "error: Option '--window' requires an argument; see fls-flow"),
        (["--nosuch"], "error: No such option"),
        (["top", "--connect", "nonsense"], "error: --connect nonsense: write PROTOCOL/HOST:PORT"),
        (["top", "--every", "0"], "0.0 is not in the range"),
        (["run", "surface_obstacle", "--repeat", "none.json"], "is no run.json of a run that ended"),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(command, words, line):
    done = command(*words)
    assert done.returncode == 2
    assert line in done.stderr
    assert [text[:7] for text in done.stderr.splitlines()] == ["error: "]


FAILS = """
from dataclasses import dataclass, field
from fls_flow import Detections, Ping, hookimpl

@dataclass
class Fails:
    at: int = 20
    count: int = field(default=0, init=False)

    def __call__(self, ping: Ping) -> Detections:
        self.count += 1
        if self.count > self.at:
            raise ZeroDivisionError("one over nothing")
        return Detections.of(ping, range_m=[10.0], bearing_rad=[0.0], amplitude=[1.0])

@hookimpl
def fls_node():
    return Fails
"""


def test_a_node_that_raises_ends_the_run_with_one_line(command, plugins, tmp_path):
    plugins("acme-fails", FAILS)
    done = command(
        "run", "surface_obstacle", "--use", "cfar=acme-fails", "--set", "sonar.pings=40", "--out", "o"
    )
    assert done.returncode == 1
    errors = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert errors == [
        "error: node 'cfar' failed at ping seq 20 (index 20): ZeroDivisionError: one over nothing"
    ]
    assert "Traceback" not in done.stderr + done.stdout
    assert "note: node 'cfar': parameter 'pfa' falls away; 'acme-fails' has none" in done.stderr
    assert {row["seq"] for row in rows(tmp_path / "o" / "tracks.csv")} == {str(n) for n in range(20)}
    assert (tmp_path / "o" / "tracks.png").is_file()
    said = json.loads((tmp_path / "o" / "run.json").read_text())
    assert said["status"] == "failed"
    assert "ZeroDivisionError" in said["error"]
    assert "Traceback" in (tmp_path / "o" / "run.log").read_text()


def test_a_full_output_is_one_line(tmp_path):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*FLS_FLOW, "plugins"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 1
    assert done.stderr.splitlines() == ["error: output: No space left on device"]


def test_a_full_disk_is_told_by_who_met_it(command, tmp_path):
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))  # noqa: E731 -- of any file
    (tmp_path / "rec.yaml").write_text(
        "graph: rec\nnodes:\n  sonar: {use: surface-scene, with: {pings: 40}}\n"
        "  out: {use: mcap, in: {ping: sonar.ping}}\n"
    )
    done = command("run", "rec.yaml", "--in-process", "--out", "o", preexec_fn=limit)
    assert done.returncode == 1
    errors = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert "node 'out' failed" in errors[0]
    assert "File too large" in errors[0]


def test_the_log_of_a_full_disk_hides_no_error(tmp_path, monkeypatch):
    folder = RunFolder.create(load("surface_obstacle"), tmp_path / "o")
    (tmp_path / "o" / "run.log").symlink_to("/dev/full")

    def fail() -> None:
        logging.getLogger("fls_flow").error("this finds no room")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), folder.logging():
        fail()


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"samples_taken": 5}', '{"samples_taken": {"a": [1]}}', '{"samples_taken": {"a": {"b": [null]}}}']
)  # fmt: skip
def test_what_cannot_be_repeated_is_refused(command, tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    done = command("run", "surface_obstacle", "--in-process", *QUICK, "--repeat", "run.json")
    assert done.returncode == 2
    assert done.stderr == "error: --repeat run.json: is no run.json of a run that ended\n"


def test_runs_that_begin_at_once_get_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    graph = load("surface_obstacle")
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: RunFolder.create(graph), range(40)))
    assert len({folder.path for folder in folders}) == 40
    assert all((folder.path / "run.json").is_file() for folder in folders)


def test_what_stands_in_the_way_of_the_folder_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").write_text("mine")
    with pytest.raises(UserError, match=r"runs.*: cannot be made: Not a directory"):
        RunFolder.create(load("surface_obstacle"))


def test_what_a_terminal_would_obey_is_written_out(command):
    done = command("check", "a\x1b[31m\nb")
    assert done.returncode == 2
    assert done.stderr.startswith("error: a\\x1b[31m\\nb: no such graph file")
    assert len(done.stderr.splitlines()) == 1


def test_debug_shows_the_traceback(command, plugins):
    plugins("acme-fails", FAILS)
    done = command(
        "run", "surface_obstacle", "--use", "cfar=acme-fails", *QUICK, "--set", "cfar.at=2", "--debug"
    )
    assert done.returncode == 1
    assert "Traceback" in done.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 130)])
def test_ctrl_c_closes_the_files_whole(tmp_path, number, code):
    words = ["run", "surface_obstacle", "--set", "sonar.pings=100000", "--out", "o"]
    process = subprocess.Popen(
        [*FLS_FLOW, *words],
        cwd=tmp_path,
        env=environment(tmp_path),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    tracks = tmp_path / "o" / "tracks.csv"
    deadline = time.monotonic() + 60
    while not (tracks.is_file() and tracks.stat().st_size > 20_000) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    began = time.monotonic()
    out, err = process.communicate(timeout=30)
    assert process.returncode == code, err
    assert time.monotonic() - began < 10
    assert "interrupted; wrote" in out
    assert "Traceback" not in err
    read = rows(tracks)
    assert all(row["seq"] and row["stamp_ns"] for row in read)
    assert tracks.read_text().endswith("\n")
    pings = json.loads((tmp_path / "o" / "run.json").read_text())["pings"]
    assert int(read[-1]["seq"]) == pings - 1
    assert (tmp_path / "o" / "tracks.png").is_file()


def test_help_shows_an_example_for_every_verb(command):
    for verb in ("run", "check", "plugins", "draw"):
        assert "Example" in command(verb, "--help").stdout


def test_help_loads_no_numerics():
    code = (
        "import sys; sys.argv = ['fls-flow', '--help']\n"
        "from fls_flow.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print([name for name in ('numba', 'cv2', 'matplotlib', 'scipy', 'pydantic', 'rich') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
