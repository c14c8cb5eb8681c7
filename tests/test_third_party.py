"""A third party joins: a package of its own, built, installed beside the wheel in a clean environment, and used."""

from __future__ import annotations

import ast
import csv
import json
import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ACME = ROOT / "examples" / "acme_sonar"


def call(*words: object, cwd: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of an environment that holds the two wheels and what they need, nothing else."""
    place = tmp_path_factory.mktemp("clean")
    for project in (ROOT, ACME):
        call(
            sys.executable,
            "-m",
            "build",
            "--wheel",
            "--no-isolation",
            "--outdir",
            place / "dist",
            project,
            cwd=place,
        )
    venv.create(place / "env", with_pip=True)
    programs = place / "env" / "bin"
    wheels = sorted((place / "dist").glob("*.whl"))
    assert len(wheels) == 2
    call(programs / "python", "-m", "pip", "install", "--quiet", *wheels, cwd=place)
    return programs


@pytest.mark.timeout(900)
def test_the_example_is_listed_swapped_in_and_run_from_the_wheels(clean, tmp_path):
    listed = json.loads(call(clean / "fls-flow", "plugins", "--json", cwd=tmp_path))
    assert {"acme-peaks": "acme-sonar"}.items() <= {
        one["kind"]: one["distribution"] for one in listed
    }.items()
    words = ["run", "surface_obstacle", "--use", "cfar=acme-peaks", "--set", "sonar.pings=30", "--out", "o"]
    call(clean / "fls-flow", *words, cwd=tmp_path)
    with (tmp_path / "o" / "tracks.csv").open(newline="") as file:
        assert any(row["status"] == "confirmed" for row in csv.DictReader(file))


@pytest.mark.timeout(900)
def test_the_wheel_carries_graphs_and_the_recording(clean, tmp_path):
    where = call(clean / "python", "-c", "import fls_flow.graph as g; print(g.shipped())", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(clean.parent)
    names = {path.stem for path in (ROOT / "graphs").glob("*.yaml")}
    assert {path.stem for path in Path(where.strip()).glob("*.yaml")} == names
    call(
        clean / "fls-flow",
        "run",
        "surface_on_recording",
        "--set",
        "sonar.pings=5",
        "--out",
        "o",
        cwd=tmp_path,
    )
    assert (tmp_path / "o" / "tracks.png").is_file()


@pytest.mark.timeout(900)
def test_the_example_keeps_the_contract_of_a_node(clean, tmp_path):
    code = "from fls_flow.testing import check_node; check_node('acme-peaks'); print('kept')"
    assert call(clean / "python", "-c", code, cwd=tmp_path) == "kept\n"


def test_the_example_stays_short():
    source = (ACME / "src" / "acme_sonar" / "peaks.py").read_text()
    detector = next(node for node in ast.parse(source).body if isinstance(node, ast.ClassDef))
    assert len([line for line in source.splitlines() if line.strip()]) <= 25
    assert detector.end_lineno is not None
