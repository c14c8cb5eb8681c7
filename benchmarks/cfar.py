"""Time per frame of the Rayleigh CFAR beside scipy, OpenCV, a straight loop, and one pass over the memory.

    python -m benchmarks.cfar [--rounds 40]

All decide every cell of the same Rayleigh image, on one thread. The others sum 5 beams x 13 ranges less a
guard of 3 x 5 around the cell (J = 50), exact at the edges: with zeros outside and the factor a(J) of the
cells that exist, worked out beforehand per shape, and per frame where cells are excluded. Ours is
`fls_detectors.cfar.rayleigh_hits` with 3 beams x 8 ranges on each side beyond a guard of 2 (J = 48), and the
window that the node `rayleigh-cfar` takes for 5 cm cells; then, with the first of these windows, the kernels
of `os-cfar` and `log-cfar`. Excluded is a tenth of the cells, in rectangles.
The memory limit is one comparison per cell, the image read and a mask written, over so many images that none
is in a cache any more, as when a ping has just arrived; the other methods find theirs there.

Rounds are interleaved: each times every method in turn, CPU time of the thread. Shown are the median and, in
brackets, the median over the rounds of the ratio to ours.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from scipy.ndimage import uniform_filter

from benchmarks._timing import cell, timed
from fls_detectors.cfar import NO_FLAGS, REFERENCE, TEST, Window, rayleigh_factors, rayleigh_hits
from fls_detectors.log_statistic import log_hits
from fls_detectors.ordered_statistic import ordered_hits
from fls_flow.kernels import compiled

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Method = Callable[[], npt.NDArray[Any]]

SHAPES = {"39x1000": (1000, 39), "39x4000": (4000, 39), "512x2048": (2048, 512)}  # (n_ranges, n_beams)
PFA, MIN_REF = 1e-4, 8
OUTER, GUARD = (13, 5), (5, 3)  # ranges, beams
J = OUTER[0] * OUTER[1] - GUARD[0] * GUARD[1]
OURS = Window(guard=2, stride=1, levels=3, beams=1, widest=0)
NODE = Window.of(0.05, guard_m=1.0, guard_beams=1, reference_m=2.0, max_ref=48, widen_m=20.0)
FACTORS = rayleigh_factors(PFA, MIN_REF, J + 1).astype(np.float32)
COLD_BYTES = 1 << 27  # more than the caches hold


def opencv_sum(image: Image) -> Image:
    """The sum over the reference window, zeros outside."""
    boxes = [
        cv2.boxFilter(image, -1, (beams, ranges), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for ranges, beams in (OUTER, GUARD)
    ]
    return np.asarray(boxes[0] - boxes[1], np.float32)


def scipy_sum(image: Image) -> Image:
    """The same by `uniform_filter`."""
    boxes = [
        uniform_filter(image, size, mode="constant") * np.float32(size[0] * size[1])
        for size in (OUTER, GUARD)
    ]
    return np.asarray(boxes[0] - boxes[1], np.float32)


def by_boxes(image: Image, total: Callable[[Image], Image], usable: Mask | None, factor: Image) -> Mask:
    """Hits from box sums; `factor` is a(J) of each cell as long as nothing is excluded."""
    power = image * image
    if usable is None:
        return power > factor * total(power)
    reference = np.where(usable, power, np.float32(0.0))
    count = np.rint(total(usable.astype(np.float32))).astype(np.int64)
    with np.errstate(invalid="ignore"):  # too few cells and a sum of zero: no hit
        return power > FACTORS[count] * total(reference)


@compiled
def by_loops(image: Image, usable: Mask, factors: Image, hits: Mask) -> None:
    """The definition, straight: four loops."""
    n_ranges, n_beams = image.shape
    for m in range(n_ranges):
        for n in range(n_beams):
            total, count = np.float32(0.0), 0
            for i in range(max(m - 6, 0), min(m + 7, n_ranges)):
                for j in range(max(n - 2, 0), min(n + 3, n_beams)):
                    if (abs(i - m) > 2 or abs(j - n) > 1) and (usable.size == 0 or usable[i, j]):
                        total += image[i, j] * image[i, j]
                        count += 1
            hits[m, n] = image[m, n] * image[m, n] > factors[count] * total


def excluded(shape: tuple[int, int], rng: np.random.Generator) -> Mask:
    """Rectangles that cover a tenth of the cells."""
    mask = np.zeros(shape, bool)
    while mask.mean() < 0.1:
        m, n = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        mask[m : m + shape[0] // 20, n : n + max(shape[1] // 20, 2)] = True
    return mask


def methods(image: Image, usable: Mask | None) -> dict[str, Method]:
    """What is timed: each gives its hits."""
    flags = NO_FLAGS
    if usable is not None:
        flags = np.where(usable, REFERENCE | TEST, TEST).astype(np.uint8)
    everywhere = np.ones(image.shape, np.float32)
    factor = FACTORS[np.rint(opencv_sum(everywhere)).astype(np.int64)]
    hits, looked = np.zeros(image.shape, bool), np.zeros(image.shape, bool)
    cold = itertools.cycle([image.copy() for _ in range(-(-COLD_BYTES // image.nbytes))])
    none = np.zeros((0, 0), bool)

    def loops() -> Mask:
        by_loops(image, none if usable is None else usable, FACTORS, hits)
        return hits

    return {
        "ours": lambda: rayleigh_hits(image, OURS, pfa=PFA, min_ref=MIN_REF, flags=flags),
        "ours, the node's window": lambda: rayleigh_hits(image, NODE, pfa=PFA, min_ref=MIN_REF, flags=flags),
        "ours, ordered statistic": lambda: ordered_hits(image, OURS, pfa=PFA, min_ref=MIN_REF, flags=flags),
        "ours, log domain": lambda: log_hits(image, OURS, pfa=PFA, min_ref=MIN_REF, flags=flags),
        "OpenCV boxFilter": lambda: by_boxes(image, opencv_sum, usable, factor),
        "scipy uniform_filter": lambda: by_boxes(image, scipy_sum, usable, factor),
        "numba, straight loops": loops,
        "memory limit": lambda: np.greater(next(cold), np.float32(3.0), out=looked),
    }


def alike(found: dict[str, Method], cells: int) -> None:
    """Fail unless the box methods agree with the loops, and ours has their false-alarm rate."""
    reference = found["numba, straight loops"]().copy()
    for name in ("OpenCV boxFilter", "scipy uniform_filter"):
        differing = int(np.count_nonzero(found[name]() != reference))
        if differing > 1e-5 * cells + 2:
            raise SystemExit(f"{name} differs from the loops in {differing} of {cells} cells")
    expected = PFA * cells
    for name in (name for name in found if name.startswith("ours")):
        count = int(np.count_nonzero(found[name]()))
        if abs(count - expected) > 6.0 * np.sqrt(expected) + 3:
            raise SystemExit(f"{name} gives {count} false alarms, {expected:.0f} are expected")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=40)
    rounds = parser.parse_args().rounds
    cv2.setNumThreads(1)
    rng = np.random.default_rng(1)
    for title, excluding in (("nothing excluded", False), ("a tenth of the cells excluded", True)):
        columns = {}
        for size, shape in SHAPES.items():
            image = rng.rayleigh(1.0, shape).astype(np.float32)
            found = methods(image, ~excluded(shape, rng) if excluding else None)
            alike(found, image.size)
            columns[size] = timed(found, rounds)
        table = Table(title=f"ms per frame (times ours), {title}, median of {rounds} rounds")
        table.add_column("method")
        for size in SHAPES:
            table.add_column(size, justify="right")
        for name in next(iter(columns.values())):
            table.add_row(name, *(cell(times, name) for times in columns.values()))
        Console(width=100).print(table)


if __name__ == "__main__":
    main()
