"""Time per ping of the temporal CFAR beside a straight NumPy recursion, and one pass over the memory.

    python -m benchmarks.temporal_cfar [--rounds 40]

All keep the running mean and variance of every cell of Rayleigh images, find the cells that rise more than
tau deviations above their mean, and give the height of all above it, on one thread. Ours is the kernel
`fls_detectors.temporal_background.learn`, and the node `temporal-cfar` around it: one detection per cell, and
with `link_m`, 40 bright objects joined to one detection each; with `reach_m` and `recent_rate`, also weighed
by how lately they came. NumPy is the recursion as it is written down, with its temporary arrays, and again
with arrays kept for them.
The memory limit is one loop that reads the image and the two moments and writes the moments and the height,
and does no more with them than add. Every method gets images that have left the caches, as a ping that has
just arrived.

Rounds are interleaved: each times every method in turn, CPU time of the thread. Shown are the median and, in
brackets, the median over the rounds of the ratio to our kernel.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from benchmarks._timing import cell, timed
from fls_detectors.temporal_background import Rates, learn, rayleigh_threshold
from fls_detectors.temporal_cfar import TemporalCfar
from fls_flow import Ping
from fls_flow.kernels import compiled

Image = npt.NDArray[np.float32]
Found = npt.NDArray[np.int64]
Method = Callable[[], Any]
Recursion = Callable[[Image, Image, Image, Rates], tuple[Found, Image]]

SHAPES = {"39x1000": (1000, 39), "39x4000": (4000, 39), "256x400": (400, 256), "512x2048": (2048, 512)}
RATE, EVENT_RATE, PFA = 0.005, 0.001, 1e-4
RATES = Rates(RATE, RATE, EVENT_RATE, 0.0, rayleigh_threshold(PFA), 0.0)
OBJECTS, OBJECT_CELLS = 40, 8  # of so many cells square
LEARNT_PINGS = 30
COLD_BYTES = 1 << 27  # more than the caches hold


def by_numpy(image: Image, mean: Image, variance: Image, rates: Rates) -> tuple[Found, Image]:
    """The recursion, straight; the moments are renewed in place."""
    d = image - mean
    high = (d > 0.0) & (d * d > np.float32(rates.threshold**2) * variance)
    mean += np.where(high, np.float32(rates.event_mean), np.float32(rates.mean)) * d
    step = np.where(high, np.float32(rates.event_variance), np.float32(rates.variance))
    variance += step * (d * d - variance)
    return np.flatnonzero(high), np.maximum(d, np.float32(0.0))


def in_place(shape: tuple[int, int]) -> Recursion:
    """The same recursion, its temporary arrays kept."""
    d, square, step = (np.empty(shape, np.float32) for _ in range(3))
    high, rises = np.empty(shape, bool), np.empty(shape, bool)

    def recursion(image: Image, mean: Image, variance: Image, rates: Rates) -> tuple[Found, Image]:
        np.subtract(image, mean, out=d)
        np.multiply(d, d, out=square)
        np.multiply(variance, np.float32(rates.threshold**2), out=step)
        np.greater(square, step, out=high)
        np.greater(d, np.float32(0.0), out=rises)
        np.logical_and(high, rises, out=high)
        found = np.flatnonzero(high)
        np.subtract(square, variance, out=square)
        np.multiply(square, np.float32(rates.variance), out=square)
        square.reshape(-1)[found] *= np.float32(rates.event_variance / rates.variance)
        np.add(variance, square, out=variance)
        np.multiply(d, np.float32(rates.mean), out=step)
        step.reshape(-1)[found] *= np.float32(rates.event_mean / rates.mean)
        np.add(mean, step, out=mean)
        return found, np.maximum(d, np.float32(0.0))

    return recursion


def ours(image: Image, mean: Image, variance: Image, rates: Rates) -> tuple[Found, Image]:
    """The kernel."""
    return learn(image, None, mean, variance, rates)


@compiled
def pass_over(image: Image, mean: Image, variance: Image, height: Image) -> None:
    """Touch what the recursion must touch."""
    for i in range(image.size):
        x = image[i]
        mean[i] += x
        variance[i] += x
        height[i] = x


def scenes(shape: tuple[int, int], rng: np.random.Generator) -> list[Image]:
    """Images of speckle with bright objects, so many that none stays in a cache."""
    images = []
    for _ in range(min(-(-COLD_BYTES // (4 * shape[0] * shape[1])), 200)):
        image = rng.rayleigh(1.0, shape).astype(np.float32)
        for _ in range(OBJECTS):
            m, n = rng.integers(0, shape[0] - OBJECT_CELLS), rng.integers(0, shape[1] - OBJECT_CELLS)
            image[m : m + OBJECT_CELLS, n : n + OBJECT_CELLS] *= 6.0
        images.append(image)
    return images


def learnt(recursion: Recursion, shape: tuple[int, int]) -> tuple[Image, Image]:
    """The moments after some pings of speckle."""
    rng = np.random.default_rng(5)
    mean, variance = np.full(shape, 1.25, np.float32), np.full(shape, 0.43, np.float32)
    for _ in range(LEARNT_PINGS):
        recursion(rng.rayleigh(1.0, shape).astype(np.float32), mean, variance, RATES)
    return mean, variance


def alike(shape: tuple[int, int]) -> None:
    """Fail unless all recursions have the same moments, and find the same cells but for rounding."""
    image = np.random.default_rng(6).rayleigh(1.0, shape).astype(np.float32)
    moments = learnt(ours, shape)
    expected = ours(image, moments[0].copy(), moments[1].copy(), RATES)[0]
    for recursion in (by_numpy, in_place(shape)):
        other = learnt(recursion, shape)
        if not all(np.allclose(a, b, rtol=1e-4) for a, b in zip(moments, other, strict=True)):
            raise SystemExit("the recursions learn other moments")
        differing = np.setxor1d(recursion(image, *other, RATES)[0], expected).size
        if differing > 1e-6 * image.size + 1:
            raise SystemExit(f"the recursions differ in {differing} of {image.size} cells")


def methods(shape: tuple[int, int], rng: np.random.Generator) -> dict[str, Method]:
    """What is timed."""
    images = scenes(shape, rng)
    beams_rad = np.asarray(np.deg2rad(0.25) * (np.arange(shape[1]) - (shape[1] - 1) / 2.0), float)
    range_m = np.asarray(8.0 + 0.1 * np.arange(shape[0]))

    def cold() -> Iterator[Image]:
        return itertools.cycle(images)

    def recursive(recursion: Recursion) -> Method:
        moments, image = learnt(recursion, shape), cold()
        return lambda: recursion(next(image), moments[0], moments[1], RATES)

    def node(**settings: float) -> Method:
        cfar = TemporalCfar(pfa=PFA, rate=RATE, event_rate=EVENT_RATE, **settings)  # type: ignore[arg-type]  # numbers all
        pings = itertools.cycle([Ping(k, k, image, range_m, beams_rad) for k, image in enumerate(images)])
        for _ in range(LEARNT_PINGS):
            cfar(next(pings))
        return lambda: cfar(next(pings))

    touched = [np.zeros(shape[0] * shape[1], np.float32) for _ in range(3)]
    flat = itertools.cycle([image.reshape(-1) for image in images])
    return {
        "ours": recursive(ours),
        "ours, the node": node(),
        "ours, the node with objects": node(link_m=1.0, min_cells=4),
        "ours, the node with what moves": node(reach_m=1.5, min_cells=4, recent_rate=0.1),
        "NumPy": recursive(by_numpy),
        "NumPy, in place": recursive(in_place(shape)),
        "memory limit": lambda: pass_over(next(flat), *touched),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=40)
    rounds = parser.parse_args().rounds
    rng = np.random.default_rng(1)
    columns = {}
    for size, shape in SHAPES.items():
        alike(shape)
        columns[size] = timed(methods(shape, rng), rounds)
    table = Table(title=f"ms per ping (times our kernel), median of {rounds} rounds")
    table.add_column("method")
    for size in SHAPES:
        table.add_column(size, justify="right")
    for name in next(iter(columns.values())):
        table.add_row(name, *(cell(times, name) for times in columns.values()))
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
