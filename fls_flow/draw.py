"""Pictures of a graph: Mermaid text, and SVG laid out in layers without any program besides."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from xml.etree import ElementTree

from fls_flow.graph import Graph, Input, Node

__all__ = ["mermaid", "svg"]

SHAPES = {"source": ("([", "])"), "sink": ("[/", "/]")}
COLOURS = {"source": "#d7ecff", "sink": "#e6e6e6", "tracker": "#ffe9c7", "detector": "#dff3df"}
CHAR, LABEL, LINE, PAD, GAP_X, GAP_Y, LANE = 7.4, 5.6, 17.0, 12.0, 40.0, 26.0, 14.0


def mermaid(graph: Graph) -> str:
    """The graph as a Mermaid flowchart; wires to the previous ping are dotted."""
    lines = ["flowchart LR"]
    for node in graph.nodes:
        opening, closing = SHAPES.get(node.kind.role, ("[", "]"))
        lines.append(f'  {_id(node.name)}{opening}"{node.name}<br/><i>{node.kind.name}</i>"{closing}')
    for node in graph.nodes:
        for wire in node.inputs:
            arrow = "-->" if wire.mode == "now" else "-.->"
            lines.append(f'  {_id(wire.node)} {arrow}|"{_label(wire)}"| {_id(node.name)}')
    return "\n".join(lines) + "\n"


def _id(name: str) -> str:
    return "n_" + name.replace("-", "__")  # `end` and the like are words of Mermaid's own


def _label(wire: Input) -> str:
    named = wire.output if wire.output == wire.port else f"{wire.output} → {wire.port}"
    return named if wire.mode == "now" else f"{named} @{wire.mode}"


@dataclass
class _Box:
    """A node, or the place where a long wire passes a layer."""

    name: str
    layer: int
    node: Node | None = None
    x: float = 0.0
    y: float = 0.0
    width: float = 0.0
    height: float = LANE
    before: list[str] = field(default_factory=list)

    @property
    def middle(self) -> float:
        return self.y + self.height / 2.0


def svg(graph: Graph) -> str:
    """The graph as an SVG document, read from left to right."""
    boxes, ways = _layers(graph)
    depth = 1 + max(box.layer for box in boxes.values())
    columns = [[box for box in boxes.values() if box.layer == layer] for layer in range(depth)]
    for column in columns[1:]:
        places = {box.name: n for one in columns for n, box in enumerate(one)}
        column.sort(key=lambda box: sum(places[b] for b in box.before) / max(1, len(box.before)))
    _place(columns, _gaps(graph, ways, boxes, depth))
    ends = _ends(graph, ways, boxes)
    bottom = max(box.y + box.height for box in boxes.values())
    root = ElementTree.Element("svg", xmlns="http://www.w3.org/2000/svg")
    _arrow_head(root)
    feedback = 0
    for node in graph.nodes:
        for wire in node.inputs:
            if wire.mode == "previous":
                feedback += 1
                _feedback(root, boxes[wire.node], boxes[node.name], wire, bottom + 22.0 * feedback, feedback)
            else:
                way = [boxes[name] for name in ways[node.name, wire.port]]
                _wire(root, way, wire, ends[node.name, wire.port])
    for box in boxes.values():
        if box.node is not None:
            _draw_box(root, box, box.node)
    width = max(box.x + box.width for box in boxes.values()) + 20.0
    height = bottom + 22.0 * feedback + 24.0
    root.set("viewBox", f"0 0 {width:.0f} {height:.0f}")
    root.set("width", f"{width:.0f}")
    root.set("height", f"{height:.0f}")
    root.set("font-family", "DejaVu Sans, Arial, sans-serif")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _layers(graph: Graph) -> tuple[dict[str, _Box], dict[tuple[str, str], list[str]]]:
    """Boxes by name, with lanes where wires pass, and the boxes that each wire goes through."""
    boxes: dict[str, _Box] = {}
    ways: dict[tuple[str, str], list[str]] = {}
    for node in graph.nodes:  # in order: givers come first
        givers = [boxes[wire.node].layer for wire in node.inputs if wire.mode != "previous"]
        text = max(len(node.name), len(node.kind.name))
        box = _Box(node.name, max(givers, default=-1) + 1, node, width=text * CHAR + 2 * PAD)
        box.height = 2 * LINE + PAD
        boxes[node.name] = box
    for node in graph.nodes:
        for wire in node.inputs:
            if wire.mode != "previous":
                ways[node.name, wire.port] = _way(boxes, wire, node.name)
    return boxes, ways


def _way(boxes: dict[str, _Box], wire: Input, taker: str) -> list[str]:
    way = [wire.node]
    for layer in range(boxes[wire.node].layer + 1, boxes[taker].layer):
        lane = _Box(f"{wire.node}.{wire.output}|{taker}.{wire.port}|{layer}", layer, before=[way[-1]])
        boxes[lane.name] = lane
        way.append(lane.name)
    boxes[taker].before.append(way[-1])
    return [*way, taker]


def _gaps(
    graph: Graph, ways: dict[tuple[str, str], list[str]], boxes: dict[str, _Box], depth: int
) -> list[float]:
    """The room between layers: that of the longest label written there."""
    gaps = [GAP_X] * depth
    for node in graph.nodes:
        for wire in node.inputs:
            if wire.mode != "previous":
                layer = boxes[ways[node.name, wire.port][-2]].layer
                gaps[layer] = max(gaps[layer], len(_label(wire)) * LABEL + GAP_X)
    return gaps


def _ends(
    graph: Graph, ways: dict[tuple[str, str], list[str]], boxes: dict[str, _Box]
) -> dict[tuple[str, str], float]:
    """Where each wire meets its box: spread over the box's side, in the order in which they come."""
    ends: dict[tuple[str, str], float] = {}
    for node in graph.nodes:
        coming = [(node.name, wire.port) for wire in node.inputs if wire.mode != "previous"]
        coming.sort(key=lambda key: boxes[ways[key][-2]].middle)
        box = boxes[node.name]
        for n, key in enumerate(coming, start=1):
            ends[key] = box.y + box.height * n / (len(coming) + 1)
    return ends


def _place(columns: list[list[_Box]], gaps: list[float]) -> None:
    heights = [sum(box.height for box in column) + GAP_Y * (len(column) - 1) for column in columns]
    x = 20.0
    for column, height, gap in zip(columns, heights, gaps, strict=True):
        width = max(box.width for box in column)
        y = 20.0 + (max(heights) - height) / 2.0
        for box in column:
            box.width = width
            box.x, box.y = x, y
            y += box.height + GAP_Y
        x += width + gap


def _arrow_head(root: ElementTree.Element) -> None:
    marker = ElementTree.SubElement(
        ElementTree.SubElement(root, "defs"),
        "marker",
        {
            "id": "head",
            "viewBox": "0 0 8 8",
            "refX": "7",
            "refY": "4",
            "markerWidth": "7",
            "markerHeight": "7",
        },
    )
    marker.set("orient", "auto")
    ElementTree.SubElement(marker, "path", d="M0,0 L8,4 L0,8 z", fill="#555")


def _wire(root: ElementTree.Element, way: list[_Box], wire: Input, end: float) -> None:
    start = way[0]
    path = [f"M{start.x + start.width:.1f},{start.middle:.1f}"]
    for left, right in itertools.pairwise(way):
        x0, x1 = left.x + left.width, right.x
        bend, y = (x0 + x1) / 2.0, end if right is way[-1] else right.middle
        path.append(f"C{bend:.1f},{left.middle:.1f} {bend:.1f},{y:.1f} {x1:.1f},{y:.1f}")
        if right is not way[-1]:
            path.append(f"L{x1 + right.width:.1f},{y:.1f}")
    _stroke(root, " ".join(path), "4 3" if wire.mode == "time" else None)
    last = way[-2]
    _text(root, (last.x + last.width + way[-1].x) / 2.0, (last.middle + end) / 2.0 - 4.0, _label(wire), 9.5)


def _feedback(
    root: ElementTree.Element, giver: _Box, taker: _Box, wire: Input, level: float, number: int
) -> None:
    x0, x1 = giver.x + giver.width / 2.0, taker.x + taker.width / 2.0 + 9.0 * (number - 1)
    y0, y1 = giver.y + giver.height, taker.y + taker.height
    path = f"M{x0:.1f},{y0:.1f} V{level - 8:.1f} Q{x0:.1f},{level:.1f} {x0 - 8:.1f},{level:.1f} "
    path += f"H{x1 + 8:.1f} Q{x1:.1f},{level:.1f} {x1:.1f},{level - 8:.1f} V{y1:.1f}"
    _stroke(root, path, "6 4")
    _text(root, (x0 + x1) / 2.0, level - 4.0, _label(wire), 9.5)


def _stroke(root: ElementTree.Element, path: str, dashes: str | None) -> None:
    line = ElementTree.SubElement(root, "path", d=path, fill="none", stroke="#555")
    line.set("stroke-width", "1.3")
    line.set("marker-end", "url(#head)")
    if dashes:
        line.set("stroke-dasharray", dashes)


def _draw_box(root: ElementTree.Element, box: _Box, node: Node) -> None:
    colour = COLOURS.get(node.kind.role, "#f3e6ff")
    shape = {
        "x": f"{box.x:.1f}",
        "y": f"{box.y:.1f}",
        "width": f"{box.width:.1f}",
        "height": f"{box.height:.1f}",
    }
    ElementTree.SubElement(root, "rect", {**shape, "rx": "7", "fill": colour, "stroke": "#333"})
    _text(root, box.x + box.width / 2.0, box.y + PAD / 2.0 + LINE * 0.75, node.name, 13.0, "#111", bold=True)
    _text(root, box.x + box.width / 2.0, box.y + PAD / 2.0 + LINE * 1.75, node.kind.name, 11.0, "#444")


def _text(
    root: ElementTree.Element,
    x: float,
    y: float,
    text: str,
    size: float,
    fill: str = "#444",
    *,
    bold: bool = False,
) -> None:
    attributes = {"x": f"{x:.1f}", "y": f"{y:.1f}", "font-size": f"{size:g}", "fill": fill}
    attributes["text-anchor"] = "middle"
    if bold:
        attributes["font-weight"] = "bold"
    ElementTree.SubElement(root, "text", attributes).text = text
