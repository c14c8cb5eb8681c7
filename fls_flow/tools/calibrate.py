"""Measure the false-alarm rate of a detector on a stretch without targets, and find what meets a wished one.

The detector says by how much each cell exceeds its threshold (`threshold_ratio`); a factor on the threshold
(`threshold_scale`) then turns any measured rate into the wished one. The scale is found on the first half of
the stretch and the rate it gives is measured on the second; with fewer than twenty pings, each half is every
other twentieth of the beams.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow.catalog import InPort
from fls_flow.errors import InputError, UserError
from fls_flow.graph import Graph, Node
from fls_flow.runtime import Options, Run
from fls_flow.tools.calibrate_rates import (
    LEAST_ALARMS,
    Measured,
    Tally,
    beam_scales,
    jackknife_sd,
    measured,
    tail_scale,
)
from fls_flow.tools.calibrate_stretch import Stretch

__all__ = ["Calibration", "Point", "calibratable", "calibrate"]

FloatArray = npt.NDArray[np.float64]

ABLE = "threshold_ratio() and the parameters pfa and threshold_scale"
BLOCKS = 10  # of pings, in each half
FARTHEST = 1000.0  # a tail fit reaches down to this part of what is measurable


@dataclass(frozen=True)
class Point:
    """One wished rate: what the detector gives as it is, and with the scale found for it."""

    pfa: float
    before: Measured
    after: Measured
    scale: FloatArray = field(repr=False)  # (n_beams,)


@dataclass(frozen=True)
class Calibration:
    """What was found for one detector."""

    node: str
    kind: str
    pings: int
    now: Measured  # as the graph has it, with its own pfa and threshold_scale
    point: Point
    per_beam: bool
    scale_sd: float  # of ln(scale), from leaving out a tenth of the first half at a time
    extrapolated: bool
    curve: tuple[Point, ...] = ()  # other rates, for the picture

    @property
    def threshold_scale(self) -> float | tuple[float, ...]:
        """The parameter to write, in four digits."""
        scale = [float(f"{one:.4g}") for one in self.point.scale]
        return tuple(scale) if self.per_beam else scale[0]


def calibratable(graph: Graph, name: str | None = None) -> Node:
    """The node called `name`, or the only one that can be calibrated; raises UserError."""
    able = [node for node in graph.nodes if _is_able(node)]
    known = ", ".join(node.name for node in able) or "none"
    if name is None:
        if not able:
            raise UserError(f"graph '{graph.name}' has no detector that can be calibrated, with {ABLE}")
        if len(able) > 1:
            raise UserError(f"--node: the graph has {len(able)} detectors to calibrate ({known}); name one")
        return able[0]
    found = next((node for node in graph.nodes if node.name == name), None)
    if found is None:
        raise UserError(f"--node {name}: the graph has no such node; it can calibrate {known}")
    if found not in able:
        raise UserError(
            f"--node {name}: kind '{found.kind.name}' lacks {ABLE}; the graph can calibrate {known}"
        )
    return found


def _is_able(node: Node) -> bool:
    parameters = {one.name for one in node.kind.parameters}
    return {"pfa", "threshold_scale"} <= parameters and callable(
        getattr(node.kind.cls, "threshold_ratio", None)
    )


def calibrate(
    graph: Graph,
    name: str | None = None,
    *,
    pfa: float,
    per_beam: bool = False,
    extrapolate: bool = False,
    stretch: Stretch | None = None,
    curve: Sequence[float] = (),
    on_ping: Callable[[int, int], None] = lambda done, total: None,
) -> Calibration:
    """Play the pings through the graph up to the detector, and find the scale with which `pfa` is met.

    `curve` names further rates to measure. Feedback into the detector (`@previous`) is taken as absent:
    nothing is tracked where there is no target. Raises UserError when the stretch is too short for `pfa`.
    """
    if not 0.0 < pfa < 1.0:
        raise UserError(f"--pfa {pfa:g}: a rate of false alarms lies between 0 and 1")
    node = calibratable(graph, name)
    stretch = stretch or Stretch()
    first, stop = _limits(graph, stretch)
    if per_beam and stop - first < 2 * BLOCKS:
        raise UserError(f"--per-beam: takes at least {2 * BLOCKS} pings, not {stop - first}")
    given = node.parameters()
    rates = list(dict.fromkeys([pfa, given["pfa"], *curve]))
    probe = _Probe(node, rates, stretch, first, stop, on_ping)
    _play(graph, node, probe, stop)
    if probe.index < stop:
        raise UserError(f"--pings {first}:{stop}: the recording ends after {probe.index} pings")
    tallies = dict(zip(rates, probe.tallies, strict=True))
    fit = tallies[pfa].counts[:BLOCKS]
    cells = int(fit.sum())
    extrapolated = _measurable(pfa, cells, stop - first, extrapolate=extrapolate)
    find = tail_scale if extrapolated else beam_scales
    points = {
        p: _point(p, tallies[p], tail_scale if p == pfa and extrapolated else beam_scales, per_beam)
        for p in (pfa, *curve)
        if p == pfa or p * cells >= LEAST_ALARMS
    }
    return Calibration(
        node.name,
        node.kind.name,
        stop - first,
        _now(tallies[given["pfa"]], given["threshold_scale"]),
        points.pop(pfa),
        per_beam,
        jackknife_sd(fit, lambda counts: find(counts, pfa, per_beam=per_beam)),
        extrapolated,
        tuple(points[p] for p in sorted(points)),
    )


def _now(tally: Tally, scale: float | tuple[float, ...]) -> Measured:
    held_out = tally.counts[BLOCKS:]
    return measured(held_out, np.broadcast_to(np.asarray(scale, float), held_out.shape[1:2]))


def _point(pfa: float, tally: Tally, find: Callable[..., FloatArray], per_beam: bool) -> Point:
    fit, held_out = tally.counts[:BLOCKS], tally.counts[BLOCKS:]
    scale = find(fit.sum(axis=0), pfa, per_beam=per_beam)
    return Point(pfa, measured(held_out, np.ones_like(scale)), measured(held_out, scale), scale)


def _measurable(pfa: float, cells: int, pings: int, *, extrapolate: bool) -> bool:
    """False if the rate can be counted, True if only a tail fit tells; raises UserError if neither does."""
    if not cells:
        raise UserError("the detector decides no cell of the stretch; is all of it masked?")
    if pfa * cells >= LEAST_ALARMS:
        return False
    needed = math.ceil(LEAST_ALARMS / pfa)
    per_ping = 2.0 * cells / pings
    what = (
        f"--pfa {pfa:g}: cannot be counted in {cells} cells, half of the stretch: {LEAST_ALARMS} "
        f"false alarms take {needed:.3g} cells, some "
        f"{math.ceil(2.0 * needed / per_ping)} pings instead of {pings}"
    )
    if pfa * cells * FARTHEST < LEAST_ALARMS:
        raise UserError(
            f"{what}; that is too far for a tail fit too "
            f"(--pfa {1.05 * LEAST_ALARMS / cells / FARTHEST:.2g} is not)"
        )
    if not extrapolate:
        raise UserError(
            f"{what}; play more, wish for {1.05 * LEAST_ALARMS / cells:.2g}, or fit the tail: --extrapolate"
        )
    return True


def _limits(graph: Graph, stretch: Stretch) -> tuple[int, int]:
    """First and last (excluded) ping of the stretch."""
    first, stop = stretch.pings or (0, None)
    if stop is None:
        clock = graph.node(graph.clock)
        source = clock.kind.cls(**clock.arguments)
        if getattr(source, "live", False) or not hasattr(source, "__len__"):
            raise UserError(
                f"--pings: source '{clock.name}' ({clock.kind.name}) does not know how many pings will come; "
                "say which to measure, for example --pings 0:500"
            )
        stop = len(source)
    if stop <= first:
        raise UserError(f"--pings {first}:{stop}: holds no ping")
    return first, stop


def _play(graph: Graph, node: Node, probe: _Probe, stop: int) -> None:
    """Run the nodes that the detector depends on, and the probe in its place."""
    fresh = dataclasses.replace(node, inputs=tuple(wire for wire in node.inputs if wire.mode != "previous"))
    needed, waiting = {node.name: fresh}, [wire.node for wire in fresh.inputs]
    while waiting:
        other = graph.node(waiting.pop())
        if other.name not in needed:
            needed[other.name] = other
            waiting += [wire.node for wire in other.inputs]
    part = dataclasses.replace(
        graph, nodes=tuple(needed[one.name] for one in graph.nodes if one.name in needed)
    )
    clock = graph.node(graph.clock)
    source = _First(clock.kind.cls(**clock.arguments), stop)
    report = Run(part, Options(in_order=True), instances={node.name: probe, clock.name: source}).start()
    if report.error is not None:
        raise report.error


@dataclass
class _First:
    """The first pings of a source."""

    source: Any
    pings: int

    def __call__(self) -> Iterator[Any]:
        return itertools.islice(self.source(), self.pings)


class _Probe:
    """Stands in for the detector: answers as it does, and counts its ratios."""

    def __init__(
        self,
        node: Node,
        rates: Sequence[float],
        stretch: Stretch,
        first: int,
        stop: int,
        on_ping: Callable[[int, int], None],
    ) -> None:
        make = node.kind.cls
        self.index = 0
        self.tallies: list[Tally] = []
        self._detector = make(**node.arguments)
        self._counted = [make(**{**node.arguments, "pfa": p, "threshold_scale": 1.0}) for p in rates]
        self._absent = {port.name: None for port in _nullable(node)}
        self._stretch, self._first, self._stop, self._on_ping = stretch, first, stop, on_ping

    def __call__(self, **inputs: Any) -> Any:
        inputs = {**self._absent, **inputs}
        answer = self._detector(**inputs)
        if self.index >= self._first:
            self._count({name: self._stretch.cleared(value) for name, value in inputs.items()})
        self.index += 1
        self._on_ping(self.index, self._stop)
        return answer

    def _count(self, inputs: dict[str, Any]) -> None:
        for number, detector in enumerate(self._counted):
            ratio = detector.threshold_ratio(**inputs)
            if len(self.tallies) <= number:
                self.tallies.append(Tally.of(2 * BLOCKS, ratio.shape[1]))
            if self.tallies[number].counts.shape[1] != ratio.shape[1]:
                raise InputError(
                    f"ping {self.index} has {ratio.shape[1]} beams, those before have "
                    f"{self.tallies[number].counts.shape[1]}; calibrate each setting of the sonar by itself"
                )
            self.tallies[number].add(self._block(ratio.shape[1]), ratio)

    def _block(self, n_beams: int) -> int | npt.NDArray[np.int64]:
        """The block of this ping; with few pings, of each beam."""
        if self._stop - self._first >= 2 * BLOCKS:
            return (self.index - self._first) * 2 * BLOCKS // (self._stop - self._first)
        sector = np.arange(n_beams) * 2 * BLOCKS // max(n_beams, 1)
        return np.where(sector % 2, BLOCKS + sector // 2, sector // 2)


def _nullable(node: Node) -> list[InPort]:
    wired = {wire.port for wire in node.inputs if wire.mode != "previous"}
    return [port for port in node.kind.inputs if port.nullable and port.name not in wired]
