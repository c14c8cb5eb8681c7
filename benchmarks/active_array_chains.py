"""The chains that `benchmarks.active_array` compares: nodes of the shipped graphs, hits that they share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.active_array_images import Place
from fls_detectors.array_cfar import ArrayCfar
from fls_flow import Ping, Tracks
from fls_flow import graph as graphs

__all__ = ["CHAINS", "Chain", "SharedHits", "chains"]

BoolArray = npt.NDArray[np.bool_]

CHAINS: dict[str, tuple[str, tuple[float | None, ...]]] = {
    "blobs": ("active_array", (3e-4, 1e-3, 3e-3)),
    "integration": ("active_array_tbd", (None,)),
    "Karoui": ("active_array_karoui", (1e-4, 3e-4, 1e-3)),
    "Lo": ("active_array_lo", (3e-5, 1e-4, 3e-4)),
}


class GivenHits(ArrayCfar):
    """`array-cfar` that is told which cells are hits."""

    found: BoolArray

    def hits(self, ping: Ping) -> BoolArray:
        """What was told."""
        return self.found


@dataclass
class Chain:
    """The nodes of a graph after its beams, one after the other, and what came out."""

    name: str
    pfa: float | None
    nodes: list[Any]
    sees_image: bool  # its tracker takes the ping too
    tracks: list[Tracks] = field(default_factory=list)

    @classmethod
    def of(cls, name: str, pfa: float | None) -> Chain:
        """The chain of a shipped graph, with its own settings but for pfa."""
        nodes, sees_image = [], False
        for node in _nodes(CHAINS[name][0]):
            if node.name not in ("cfar", "merge", "clusters", "tracker"):
                continue
            given = dict(node.arguments)
            if node.name == "cfar" and pfa is not None:
                given["pfa"] = pfa
            nodes.append((GivenHits if node.kind.cls is ArrayCfar else node.kind.cls)(**given))
            ports = {wire.port for wire in node.inputs}
            sees_image |= node.name == "tracker" and {"detections", "ping"} <= ports
        return cls(name, pfa, nodes, sees_image)

    @property
    def hits(self) -> ArrayCfar | None:
        """The node of which the hits may be shared."""
        return self.nodes[0] if isinstance(self.nodes[0], GivenHits) else None

    def __call__(self, ping: Ping, found: BoolArray | None) -> None:
        """Take one ping through all nodes; `found` are the hits in it, if they are shared."""
        if isinstance(self.nodes[0], GivenHits) and found is not None:
            self.nodes[0].found = found
        message: Any = ping
        for node in self.nodes[:-1]:
            message = node(message)
        tracker = self.nodes[-1]
        self.tracks.append(tracker(message, ping) if self.sees_image else tracker(message))


@cache
def _nodes(graph: str) -> tuple[graphs.Node, ...]:
    return tuple(graphs.load(graph).nodes)


def chains(names: Sequence[str], whole: bool) -> list[Chain]:
    """Fresh chains; with their every pfa only if `whole`, else without the largest."""
    made = []
    for name in names:
        factors = CHAINS[name][1]
        made += [Chain.of(name, pfa) for pfa in (factors if whole or len(factors) == 1 else factors[:-1])]
    return made


@dataclass
class SharedHits:
    """Hits of `array-cfar` in the images of a place, decided again only where the target can change them."""

    node: ArrayCfar

    def of(self, place: Place) -> Iterator[BoolArray]:
        """The hits (n_ranges, n_beams) in each image."""
        whole = ArrayCfar.hits(self.node, place.clutter)
        n = whole.shape[0]
        steps = self.node.references // 2 * max(1, round(self.node.stride_m / place.clutter.cell_m))
        reach = round(self.node.guard_m / place.clutter.cell_m) + steps + 2
        low, high = max(place.rows.start - reach, 0), min(place.rows.stop + reach, n)
        first, last = max(low - reach, 0), min(high + reach, n)
        for image in place.images:
            part = Ping(
                image.seq,
                image.stamp_ns,
                image.amplitude[first:last],
                image.range_m[first:last],
                image.bearing_rad,
            )
            hits = whole.copy()
            hits[low:high] = ArrayCfar.hits(self.node, part)[low - first : high - first]
            yield hits
