"""`fls-flow check` and `fls-flow plugins` as a user meets them: a process, its two streams, its exit code."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

FLS_FLOW = [sys.executable, "-m", "fls_flow.cli"]
GRAPH = """\
graph: small
nodes:
  sonar: {use: surface-scene, with: {seed: 7}}
  cfar: {use: rayleigh-cfar, in: {ping: sonar.ping}}
  out: {use: detection-csv, in: {detections: cfar}}
"""
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def command(tmp_path: Path) -> Command:
    """Run `fls-flow` in an empty folder."""

    def call(*words: str, **settings: Any) -> subprocess.CompletedProcess[str]:
        env = {**os.environ, "PYTHONPATH": str(tmp_path / "site"), "COLUMNS": "160"}
        return subprocess.run(
            [*FLS_FLOW, *words],
            cwd=tmp_path,
            env=env,
            capture_output=True,
            text=True,
            timeout=120,
            **settings,
        )

    return call


def test_a_good_graph_is_ok(command: Command, tmp_path: Path) -> None:
    (tmp_path / "g.yaml").write_text(GRAPH)
    done = command("check", "g.yaml")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "g.yaml: ok: 3 nodes (sonar, cfar, out), clock sonar\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["g.yaml"]  # a check writes nothing


def test_the_shipped_graph_is_found_by_name(command: Command) -> None:
    done = command("check", "surface_obstacle")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("surface_obstacle: ok: ")


def test_every_mistake_is_a_line_and_the_exit_code_is_2(command: Command, tmp_path: Path) -> None:
    (tmp_path / "g.yaml").write_text(GRAPH.replace("seed", "sede").replace("cfar}", "cfra}"))
    done = command("check", "g.yaml", "--set", "cfar.pfa=x")
    assert (done.returncode, done.stdout) == (2, "")
    lines = done.stderr.splitlines()
    assert [line.split(": node")[0] for line in lines] == [
        "error: --set cfar.pfa=x",
        "error: g.yaml:3",
        "error: g.yaml:5",
    ]
    assert "did you mean 'seed'?" in lines[1]
    assert "did you mean 'cfar'?" in lines[2]


def test_checking_goes_on_after_bad_and_missing_files(command: Command, tmp_path: Path) -> None:
    (tmp_path / "good.yaml").write_text(GRAPH)
    (tmp_path / "bad.yaml").write_text("nodes: [\n")
    (tmp_path / "folder").mkdir()
    done = command("check", "none.yaml", "bad.yaml", "folder", "x" * 5000, "good.yaml")
    assert done.returncode == 2
    assert done.stdout.startswith("good.yaml: ok: ")
    wheres = [line.split(": ")[1] for line in done.stderr.splitlines()]
    assert wheres == ["none.yaml", "bad.yaml:2", "folder", "x" * 5000]


def test_json_of_several_files(command: Command, tmp_path: Path) -> None:
    (tmp_path / "good.yaml").write_text(GRAPH)
    (tmp_path / "bad.yaml").write_text(GRAPH.replace("rayleigh-cfar", "rayleigh-cfra"))
    done = command("check", "good.yaml", "bad.yaml", "none.yaml", "--json")
    assert (done.returncode, done.stderr) == (2, "")
    good, bad, none = json.loads(done.stdout)
    assert good == {"graph": "good.yaml", "ok": True, "problems": [], "notes": []}
    what = "node 'cfar': unknown kind 'rayleigh-cfra'; did you mean 'rayleigh-cfar'?"
    problems = [{"where": "bad.yaml:4", "what": what}]
    assert bad == {"graph": "bad.yaml", "ok": False, "problems": problems, "notes": []}
    assert (none["ok"], none["problems"][0]["where"]) == (False, "none.yaml")
    assert none["problems"][0]["what"].startswith("no such graph file; ")


PEAKS = """
from dataclasses import dataclass
from fls_flow import Detections, Ping, hookimpl

@dataclass
class Peaks:
    def __call__(self, ping: Ping) -> Detections:
        return Detections(ping.seq, ping.stamp_ns)

@hookimpl
def fls_node() -> type[Peaks]:
    return Peaks
"""


def lay(tmp_path: Path, kind: str, code: str) -> None:
    """Install a distribution `acme` with one kind for the commands of this test."""
    info = tmp_path / "site" / "acme-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[fls_flow]\n{kind} = acme_module\n")
    (tmp_path / "site" / "acme_module.py").write_text(code)


def test_what_falls_away_in_a_swap_is_noted_on_the_error_stream(command: Command, tmp_path: Path) -> None:
    lay(tmp_path, "acme-peaks", PEAKS)
    done = command("check", "surface_obstacle", "--json", "--use", "cfar=acme-peaks")
    assert done.returncode == 0
    (said,) = json.loads(done.stdout)
    assert (said["ok"], said["problems"]) == (True, [])
    notes = done.stderr.splitlines()
    assert [f"note: {note}" for note in said["notes"]] == notes
    assert notes == [
        *[
            f"note: node 'cfar': input '{one}' falls away; 'acme-peaks' has none"
            for one in ("noisy", "wakes", "tracks")
        ],
        "note: node 'cfar': parameter 'pfa' falls away; 'acme-peaks' has none",
    ]


def test_no_graph_at_all_is_a_usage_error(command: Command) -> None:
    done = command("check")
    assert (done.returncode, done.stdout) == (2, "")
    assert "Traceback" not in done.stderr


def test_plugins_lists_what_is_installed(command: Command) -> None:
    done = command("plugins")
    assert done.returncode == 0
    rows = [line.split() for line in done.stdout.splitlines()]
    assert rows[0] == ["kind", "distribution", "version", "module"]
    assert ["rayleigh-cfar", "fls-flow"] in [row[:2] for row in rows]

    listed = json.loads(command("plugins", "--json").stdout)
    assert [one["kind"] for one in listed] == [row[0] for row in rows[1:]]
    assert set(listed[0]) == {"kind", "distribution", "version", "module"}


def test_plugins_shows_ports_parameters_and_documentation_of_one(command: Command) -> None:
    text = command("plugins", "rayleigh-cfar")
    assert text.returncode == 0
    for word in ("detector", "input", "ping", "output", "detections", "parameter", "pfa"):
        assert word in text.stdout
    done = command("plugins", "rayleigh-cfar", "--json")
    found = json.loads(done.stdout)
    assert (found["kind"], found["role"]) == ("rayleigh-cfar", "detector")
    assert {"name": "ping", "message": "Ping", "optional": False, "previous": False, "time": False} in found[
        "inputs"
    ]
    assert {"name": "detections", "message": "Detections"} in found["outputs"]
    (pfa,) = [one for one in found["parameters"] if one["name"] == "pfa"]
    assert (pfa["type"], pfa["required"]) == ("float", False)
    assert found["doc"]


def test_json_of_every_installed_kind_is_json(command: Command) -> None:
    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is no JSON")

    for one in json.loads(command("plugins", "--json").stdout):
        done = command("plugins", one["kind"], "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout, parse_constant=refuse)["kind"] == one["kind"]


def test_an_unknown_kind_is_one_line(command: Command) -> None:
    for words in (("plugins", "rayleigh_cfar"), ("plugins", "rayleigh_cfar", "--json")):
        done = command(*words)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr == "error: unknown kind 'rayleigh_cfar'; did you mean 'rayleigh-cfar'?\n"


def test_a_broken_plugin_is_listed_and_hurts_only_its_graphs(command: Command, tmp_path: Path) -> None:
    lay(tmp_path, "acme-boom", "raise RuntimeError('no licence')\n")
    (tmp_path / "g.yaml").write_text(GRAPH)
    assert "acme-boom" in command("plugins").stdout
    assert command("check", "g.yaml").returncode == 0
    done = command("check", "g.yaml", "--use", "cfar=acme-boom")
    assert done.returncode == 2
    assert done.stderr == (
        "error: --use cfar=acme-boom: node 'cfar': kind 'acme-boom' of acme 1.0 (acme_module) cannot be imported: "
        "RuntimeError: no licence; mend or uninstall it\n"
    )


@pytest.mark.parametrize("words", [["plugins"], ["plugins", "--json"], ["check", "surface_obstacle"]])
def test_a_closed_pipe_is_no_crash(words: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed:
        done = subprocess.run(
            [*FLS_FLOW, *words], stdout=closed, stderr=subprocess.PIPE, text=True, timeout=120
        )
    assert "Traceback" not in done.stderr
    assert "error" not in done.stderr
    assert done.returncode == 1
