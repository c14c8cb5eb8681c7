"""`check_node` lets a sound node pass and names the rule that a broken one breaks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from fls_flow import BeamMask, Detections, NavState, Ping, Tracks
from fls_flow.catalog import Catalog
from fls_flow.testing import check_node, run_graph, sample_firings


def first_cell(ping: Ping) -> Detections:
    n = min(1, ping.range_m.size)
    return Detections.of(
        ping, range_m=ping.range_m[:n].copy(), bearing_rad=ping.bearing_rad[:n].copy(), amplitude=np.zeros(n)
    )


@dataclass
class Sound:
    def __call__(
        self, ping: Ping, nav: tuple[NavState, ...] = (), tracks: Tracks | None = None
    ) -> Detections:
        return first_cell(ping)


@dataclass
class Remembers:
    """A running sum, kept and restored."""

    total: float = field(default=0.0, init=False)

    def __call__(self, ping: Ping) -> Detections:
        self.total += float(ping.amplitude.sum())
        return Detections.of(ping, range_m=[1.0], bearing_rad=[0.0], amplitude=[self.total])

    def snapshot(self) -> dict[str, Any]:
        return {"total": self.total}

    def restore(self, state: dict[str, Any]) -> None:
        self.total = state["total"]


class Pair(NamedTuple):
    mask: BeamMask
    detections: Detections


@dataclass
class TwoOutputs:
    def __call__(self, ping: Ping) -> Pair:
        return Pair(BeamMask(ping.seq, ping.stamp_ns), first_cell(ping))


@dataclass
class Swallows:
    def __call__(self, tracks: Tracks) -> None: ...


@dataclass
class Source:
    seed: int = 0

    def __call__(self) -> Iterator[Ping]:
        rng = np.random.default_rng(self.seed)
        for n in range(3):
            yield Ping(n, n, rng.random((2, 2), np.float32), np.arange(2.0), np.arange(2.0))


@pytest.mark.parametrize("node", [Sound, Sound(), Remembers, TwoOutputs, Swallows, Source])
def test_a_sound_node_passes(node):
    check_node(node)


def test_every_shipped_kind_whose_parameters_have_defaults_passes():
    catalog = Catalog()
    checked = []
    for name in catalog.names():
        kind = catalog.load(name)
        if not any(one.required for one in kind.parameters):
            check_node(name)
            checked.append(name)
    assert {
        "rayleigh-cfar",
        "self-noise-beams",
        "wake-ends",
        "clutter-map",
        "jpda",
        "plot",
        "track-csv",
    } <= set(checked)


@dataclass
class Silent(Sound):
    def __call__(self, ping: Ping) -> Detections:  # type: ignore[override]
        return None  # type: ignore[return-value]


@dataclass
class LosesSeq(Sound):
    def __call__(self, ping: Ping) -> Detections:  # type: ignore[override]
        return Detections(0, ping.stamp_ns)


@dataclass
class Unseeded(Sound):
    def __call__(self, ping: Ping) -> Detections:  # type: ignore[override]
        value = np.random.default_rng().random(1)
        return Detections.of(ping, range_m=value, bearing_rad=[0.0], amplitude=[0.0])


@dataclass
class HandsOnItsInput(Sound):
    def __call__(self, ping: Ping) -> Detections:  # type: ignore[override]
        n = min(3, ping.range_m.size)
        found = first_cell(ping)
        zeros = np.zeros(n)
        return replace(
            found,
            range_m=ping.range_m[:n],
            bearing_rad=zeros,
            amplitude=zeros,
            extent=np.zeros((n, 2)),
            covariance=np.zeros((n, 2, 2)),
            kind=np.zeros(n, np.uint8),
        )


@dataclass
class ReusesItsOutput(Sound):
    buffer: Any = field(default_factory=lambda: np.zeros(1), init=False)

    def __call__(self, ping: Ping) -> Detections:  # type: ignore[override]
        self.buffer += 1.0
        return Detections.of(ping, range_m=self.buffer, bearing_rad=[0.0], amplitude=[0.0])


@dataclass
class KeepsAView(Sound):
    """Its state is the memory of the last ping."""

    last: Any = field(default=None, init=False)

    def __call__(self, ping: Ping) -> Detections:  # type: ignore[override]
        level = 0.0 if self.last is None or not self.last.size else float(np.nan_to_num(self.last).max())
        self.last = ping.amplitude
        return Detections.of(ping, range_m=[1.0], bearing_rad=[0.0], amplitude=[level])


@dataclass
class ForgetsState(Remembers):
    def snapshot(self) -> dict[str, Any]:
        return {"total": 0.0}


@dataclass
class SnapshotFollows(Sound):
    seen: Any = field(default_factory=lambda: np.zeros(1), init=False)

    def __call__(self, ping: Ping) -> Detections:  # type: ignore[override]
        self.seen += 1.0
        return Detections.of(ping, range_m=self.seen.copy(), bearing_rad=[0.0], amplitude=[0.0])

    def snapshot(self) -> dict[str, Any]:
        return {"seen": self.seen}

    def restore(self, state: dict[str, Any]) -> None:
        self.seen = state["seen"].copy()


@dataclass
class RestoreKeeps(SnapshotFollows):
    def snapshot(self) -> dict[str, Any]:
        return {"seen": self.seen.copy()}

    def restore(self, state: dict[str, Any]) -> None:
        self.seen = state["seen"]


@dataclass
class SnapshotOfObjects(Remembers):
    def snapshot(self) -> dict[str, Any]:
        return {"tracks": [{"age": 1, "filter": Sound()}]}


@dataclass
class UnseededSource(Source):
    def __call__(self) -> Iterator[Ping]:
        yield Ping(0, 0, np.random.default_rng().random((2, 2), np.float32), np.arange(2.0), np.arange(2.0))


@pytest.mark.parametrize(
    ("node", "rule"),
    [
        (Silent, "it answered None"),
        (LosesSeq, "it answered seq 0 to the ping seq 10"),
        (Unseeded, "a second instance gives other bits"),
        (HandsOnItsInput, "it shares memory with an input"),
        (ReusesItsOutput, "an answer changed after it was given"),
        (KeepsAView, "its state shares memory with an input"),
        (ForgetsState, "some state is missing"),
        (SnapshotFollows, "some state is missing"),
        (RestoreKeeps, r"a second restore\(\) of one snapshot gives other bits"),
        (
            SnapshotOfObjects,
            r"snapshot\(\)\['tracks'\]\[0\]\['filter'\] is a Sound; give arrays and plain values",
        ),
        (UnseededSource, "a second iteration gives other bits"),
    ],
)
def test_a_broken_rule_is_named(node, rule):
    with pytest.raises(AssertionError, match=rule):
        check_node(node)


def test_made_up_inputs_are_read_only_and_one_ping_is_empty():
    firings = sample_firings(Sound)
    assert len(firings[2]["ping"].range_m) == 0
    assert firings[0]["tracks"] is None
    with pytest.raises(ValueError, match="read-only"):
        firings[0]["ping"].amplitude[0, 0] = 1.0


def test_a_graph_runs_on_lists(tmp_path):
    path = tmp_path / "g.yaml"
    path.write_text("graph: g\nnodes:\n  s: {use: source}\n  d: {use: sound, in: {ping: s}}\n")
    pings = [Ping(n, n, np.zeros((1, 1), np.uint8), np.ones(1), np.zeros(1)) for n in (4, 9)]
    catalog = Catalog({"source": Source, "sound": Sound})
    found = run_graph(path, {"s": pings}, ["d.detections", "s.ping"], catalog=catalog)
    assert [message.seq for message in found["d.detections"]] == [4, 9]
    assert found["s.ping"] == pings
    with pytest.raises(KeyError, match=r"d\.tracks: node 'd' gives detections"):
        run_graph(path, {"s": pings}, ["d.tracks"], catalog=catalog)
    with pytest.raises(KeyError, match="graph 'g' has no node 'e'; it has s, d"):
        run_graph(path, {"s": pings}, ["e.tracks"], catalog=catalog)
    with pytest.raises(KeyError, match="inputs: 'd' is no source of graph 'g'; it has s"):
        run_graph(path, {"d": pings}, ["d.detections"], catalog=catalog)
