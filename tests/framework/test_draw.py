"""Pictures of a graph: every node and wire is in them, and nothing lies over anything else."""

from __future__ import annotations

import subprocess
import sys
from xml.etree import ElementTree

import pytest

from fls_flow import draw
from fls_flow import graph as graphs

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module", params=["surface_obstacle", "surface_on_recording"])
def graph(request):
    return graphs.load(request.param)


def wires(graph):
    return [(wire, node) for node in graph.nodes for wire in node.inputs]


def test_mermaid_has_a_line_for_every_node_and_wire(graph):
    lines = draw.mermaid(graph).splitlines()
    assert lines[0] == "flowchart LR"
    assert len(lines) == 1 + len(graph.nodes) + len(wires(graph))
    assert sum("-.->" in line for line in lines) == sum(wire.mode != "now" for wire, _ in wires(graph))


def test_svg_has_a_box_for_every_node_and_a_path_for_every_wire(graph):
    root = ElementTree.fromstring(draw.svg(graph))
    assert len(root.findall(f"{SVG}rect")) == len(graph.nodes)
    paths = [path for path in root.findall(f"{SVG}path") if path.get("marker-end")]
    assert len(paths) == len(wires(graph))
    texts = {text.text for text in root.iter(f"{SVG}text")}
    assert {node.name for node in graph.nodes} | {node.kind.name for node in graph.nodes} <= texts
    assert any(text.endswith("@previous") for text in texts if text)


def test_svg_boxes_lie_apart_and_inside_the_picture(graph):
    root = ElementTree.fromstring(draw.svg(graph))
    boxes = [
        [float(box.get(key)) for key in ("x", "y", "width", "height")] for box in root.findall(f"{SVG}rect")
    ]
    width, height = float(root.get("width")), float(root.get("height"))
    for n, (x, y, w, h) in enumerate(boxes):
        assert x >= 0
        assert y >= 0
        assert x + w <= width
        assert y + h <= height
        for x2, y2, w2, h2 in boxes[:n]:
            assert x + w <= x2 or x2 + w2 <= x or y + h <= y2 or y2 + h2 <= y


def test_givers_stand_left_of_takers(graph):
    root = ElementTree.fromstring(draw.svg(graph))
    places = {}
    rects = root.findall(f"{SVG}rect")
    titles = [text for text in root.iter(f"{SVG}text") if text.get("font-weight") == "bold"]
    for rect, title in zip(rects, titles, strict=True):
        places[title.text] = float(rect.get("x"))
    for wire, node in wires(graph):
        if wire.mode == "now":
            assert places[wire.node] < places[node.name]


def test_the_command_writes_the_form_that_the_file_name_asks_for(tmp_path):
    command = [sys.executable, "-m", "fls_flow.cli", "draw", "surface_obstacle"]
    subprocess.run([*command, "-o", tmp_path / "g.svg"], check=True)
    assert ElementTree.parse(tmp_path / "g.svg").getroot().tag == f"{SVG}svg"
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert printed.startswith("flowchart LR")
    missing = subprocess.run(
        [*command, "-o", tmp_path / "no" / "g.svg"], capture_output=True, text=True, check=False
    )
    assert missing.returncode == 2
    assert "cannot be written" in missing.stderr
