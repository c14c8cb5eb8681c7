"""Folders, wheel packages and entry points say the same; documents keep their promises."""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
from pathlib import Path

import pytest

from fls_flow import graph as graphs

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PLUGINS = sorted(path for path in (ROOT / "plugins").glob("*/fls_*") if path.is_dir())


def entry_points() -> dict[str, str]:
    return PROJECT["project"]["entry-points"]["fls_flow"]


def test_every_plugin_folder_is_in_the_wheel():
    packages = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert sorted(packages) == sorted(["fls_flow", *(str(path.relative_to(ROOT)) for path in PLUGINS)])


def test_every_plugin_package_stands_in_the_layer_contracts():
    names = sorted(path.name for path in PLUGINS)
    tool = PROJECT["tool"]["importlinter"]
    assert sorted(tool["root_packages"]) == sorted(["fls_flow", *names])
    for contract in tool["contracts"]:
        if contract["type"] == "independence":
            assert sorted(contract["modules"]) == names


def test_no_package_marks_where_only_folders_are():
    assert not (ROOT / "plugins" / "__init__.py").exists()
    assert not list((ROOT / "plugins").glob("*/__init__.py"))


def test_every_module_with_a_kind_has_its_entry_point_and_the_other_way_round():
    announced = set(entry_points().values())
    modules = {
        f"{path.parent.name}.{path.stem}"
        for package in PLUGINS
        for path in package.glob("*.py")
        if "def fls_node(" in path.read_text()
    }
    assert modules == announced


def test_the_installed_entry_points_are_those_of_the_project():
    installed = importlib.metadata.distribution("fls-flow").entry_points
    found = {entry.name: entry.value for entry in installed if entry.group == "fls_flow"}
    assert found == entry_points(), "run `pip install -e .` again"


@pytest.mark.parametrize("path", sorted((ROOT / "graphs").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_graph_is_sound(path):
    assert graphs.load(path).clock


def test_an_editable_install_serves_the_graphs_of_the_checkout():
    assert graphs.shipped() == ROOT / "graphs"


def test_every_link_in_the_documents_leads_somewhere():
    documents = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    assert documents
    for document in documents:
        text = re.sub(r"`[^`]*`", "", document.read_text())  # code is no link
        for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", text):
            assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_every_dependency_is_named_with_its_reason():
    text = (ROOT / "ARCHITECTURE.md").read_text()
    for requirement in PROJECT["project"]["dependencies"]:
        assert re.split(r"[<>=\[]", requirement)[0] in text


def test_the_readme_shows_the_example_as_it_is():
    example = (ROOT / "examples" / "acme_sonar" / "src" / "acme_sonar" / "peaks.py").read_text()
    assert f"```python\n{example.rstrip()}\n```" in (ROOT / "README.md").read_text()
