"""Time per chip of the ten features and of the segmentation, beside scikit-image, OpenCV and scipy.

    python -m benchmarks.features [--rounds 30] [--chips 32]

Needs scikit-image and scikit-learn (extra `bench`). Every method describes the same chips of 64 range cells
x 21 beams with one object each, on one thread. `regionprops` gives area, perimeter, axes, eccentricity, mean
amplitude and Hu moments, and numpy the variance; its perimeter is another one (a chain length), as its users
get it. OpenCV takes what it has: moments, an erosion for the outline, mean and standard deviation. Ours is
`fls_features.shape.in_cells` for all chips of a ping at once and, in a row of its own, one chip at a time.
Segmentation: 3 x 3 dilation until nothing changes (the listing of the thesis), scikit-image's labels,
OpenCV's connected components, and `fls_features.growing.grown`, all on the same smoothed chips; smoothing:
scipy's `wiener` with an odd window and `fls_features.growing.smoothed`. Linear discriminant: scikit-learn's
`predict_proba` of one vector and `fls_flow.discriminants`.

Before anything is timed, the methods must agree where they define the same. Rounds are interleaved: each
times every method in turn, CPU time of the thread. Shown are the median and the median of the ratio to ours.
"""

from __future__ import annotations

import argparse
import statistics
import warnings
from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from scipy.signal import wiener
from skimage.measure import label as label_regions
from skimage.measure import regionprops
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from benchmarks._timing import ratio, timed
from fls_features.growing import central, grown, seeds, smoothed, thresholds
from fls_features.shape import CELL_NAMES, in_cells
from fls_flow.discriminants import fit, linear, posterior

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Samples = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Method = Callable[[], object]

SHAPE = (64, 21)
ODD = (21, 3)
SAME = [CELL_NAMES.index(name) for name in ("area", "mean", "variance", "phi1", "phi2")]
AXES = [CELL_NAMES.index(name) for name in ("major_axis", "minor_axis")]
LEAST_S = 5e-3  # of one method in one round
SQUARE = np.ones((3, 3), np.uint8)
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


def chips_with_objects(n: int, rng: np.random.Generator) -> Samples:
    """Rayleigh noise with an ellipse of some 10 to 25 range cells and 3 to 7 beams in each chip."""
    i, j = np.mgrid[: SHAPE[0], : SHAPE[1]]
    chips = rng.rayleigh(1.0, (n, *SHAPE))
    for chip in chips:
        a, b, turn = rng.uniform(5, 12), rng.uniform(1.5, 3.5), rng.uniform(0, 0.3)
        p, q = i - rng.uniform(26, 38), j - rng.uniform(8, 12)
        u, v = p * np.cos(turn) + q * np.sin(turn), q * np.cos(turn) - p * np.sin(turn)
        chip += 12.0 * ((u / a) ** 2 + (v / b) ** 2 <= 1.0)
    return chips.astype(np.float32)


def by_regionprops(mask: Mask, chip: Samples) -> list[float]:
    """What scikit-image has of the ten."""
    one = regionprops(mask.astype(np.uint8), chip)[0]
    area, outline, hu = float(one.area), float(one.perimeter), one.moments_hu
    variance = float(one.image_intensity[one.image].var())
    axes = float(one.axis_major_length), float(one.axis_minor_length)
    compactness = 4.0 * np.pi * area / outline**2 if outline else np.inf
    mean = float(one.intensity_mean)
    return [area, outline, compactness, mean, variance, *axes, float(one.eccentricity), hu[0], hu[1]]


def by_opencv(mask: npt.NDArray[np.uint8], chip: Samples) -> list[float]:
    """The ten from OpenCV's moments, erosion and statistics."""
    m = cv2.moments(mask, binaryImage=True)
    area = m["m00"]
    inner = cv2.erode(mask, CROSS, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,))
    outline = area - cv2.countNonZero(inner)
    mean, sd = cv2.meanStdDev(chip, mask=mask)
    c_jj, c_ii, c_ij = m["mu20"] / area + 1 / 12, m["mu02"] / area + 1 / 12, m["mu11"] / area
    middle, apart = 0.5 * (c_ii + c_jj), np.hypot(0.5 * (c_ii - c_jj), c_ij)
    major, minor = 4.0 * np.sqrt(middle + apart), 4.0 * np.sqrt(middle - apart)
    phi1 = m["nu20"] + m["nu02"]
    phi2 = (m["nu20"] - m["nu02"]) ** 2 + 4.0 * m["nu11"] ** 2
    eccentricity = np.sqrt(1.0 - (minor / major) ** 2)
    compactness = 4.0 * np.pi * area / outline**2
    found = [area, outline, compactness, mean[0, 0], sd[0, 0] ** 2, major, minor, eccentricity, phi1, phi2]
    return [float(one) for one in found]


def by_dilation(chip: FloatArray, seed: IntArray, threshold: float) -> Mask:
    """The region by dilation until nothing changes."""
    bright = (chip > threshold).astype(np.uint8)
    mask = np.zeros(chip.shape, np.uint8)
    mask[tuple(seed)] = 1
    while True:
        larger = np.asarray(cv2.dilate(mask, SQUARE) * bright, np.uint8)
        if np.array_equal(larger, mask):
            return mask.astype(bool)
        mask = larger


def by_labels(chip: FloatArray, seed: IntArray, threshold: float) -> Mask:
    """The region among the labels of scikit-image."""
    label = label_regions(chip > threshold, connectivity=2)
    return np.asarray(label == label[tuple(seed)])


def by_components(chip: FloatArray, seed: IntArray, threshold: float) -> Mask:
    """The region among the components of OpenCV."""
    _, label = cv2.connectedComponents((chip > threshold).astype(np.uint8), connectivity=8)
    return np.asarray(label == label[tuple(seed)])


def described(chips: Samples, mask: Mask) -> dict[str, Method]:
    """The ten features by several hands."""
    whole = mask.astype(np.uint8)
    return {
        "ours": lambda: in_cells(mask, chips),
        "ours, chip by chip": lambda: [
            in_cells(mask[n : n + 1], chips[n : n + 1]) for n in range(len(chips))
        ],
        "OpenCV": lambda: [by_opencv(*one) for one in zip(whole, chips, strict=True)],
        "scikit-image regionprops": lambda: [by_regionprops(*one) for one in zip(mask, chips, strict=True)],
    }


def segmented(filtered: FloatArray, seed: IntArray, threshold: FloatArray) -> dict[str, Method]:
    """Regions by several hands."""
    chips = list(zip(filtered, seed, threshold.tolist(), strict=True))
    return {
        "ours": lambda: grown(filtered, seed, threshold),
        "OpenCV components": lambda: [by_components(*one) for one in chips],
        "scikit-image labels": lambda: [by_labels(*one) for one in chips],
        "dilation until it ends": lambda: [by_dilation(*one) for one in chips],
    }


def filtered_by(chips: Samples) -> dict[str, Method]:
    """The adaptive filter by two hands."""
    doubles = chips.astype(float)
    return {
        "ours": lambda: smoothed(chips, ODD),
        "scipy wiener": lambda: [wiener(one, ODD) for one in doubles],
    }


def labelled(n: int, rng: np.random.Generator) -> dict[str, Method]:
    """Posteriors of single vectors in ten features by two hands."""
    values, label = rng.standard_normal((200, 10)), np.arange(200) % 2
    values[label == 1] += 1.0
    rule, peer = linear(fit(values, label, 2)), LinearDiscriminantAnalysis(solver="lsqr").fit(values, label)
    ones = [values[k : k + 1] for k in range(n)]
    if not np.allclose(posterior(rule.scores(values)), peer.predict_proba(values)):
        raise SystemExit("the discriminants differ from those of scikit-learn")
    return {
        "ours": lambda: [posterior(rule.scores(one)) for one in ones],
        "scikit-learn LDA": lambda: [peer.predict_proba(one) for one in ones],
    }


def alike(features: dict[str, Method], regions: dict[str, Method], filters: dict[str, Method]) -> None:
    """Fail unless the methods agree where they define the same."""
    ours = np.asarray(features["ours"]())
    peer = np.asarray(features["scikit-image regionprops"]())
    axes = np.sqrt(peer[:, AXES] ** 2 + 16.0 / 12.0)  # it leaves out the 1/12 of each cell
    if not (np.allclose(peer[:, SAME], ours[:, SAME]) and np.allclose(axes, ours[:, AXES])):
        raise SystemExit("the features of scikit-image differ from ours")
    if not np.allclose(np.asarray(features["OpenCV"]()), ours):
        raise SystemExit("the features of OpenCV differ from ours")
    for name, method in regions.items():
        if not np.array_equal(np.asarray(method()), np.asarray(regions["ours"]())):
            raise SystemExit(f"the regions of {name} differ from ours")
    if not np.allclose(np.asarray(filters["scipy wiener"]()), np.asarray(filters["ours"]())):
        raise SystemExit("the filter differs from scipy's")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--chips", type=int, default=32)
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # of peers, about the names of their own properties
    cv2.setNumThreads(1)
    rng = np.random.default_rng(1)
    chips = chips_with_objects(options.chips, rng)
    filtered = smoothed(chips, (20, 2))
    seed = seeds(filtered, np.broadcast_to(central(SHAPE), filtered.shape))
    threshold = thresholds(filtered, seed, "seed", 0.5)
    mask = grown(filtered, seed, threshold)
    parts = {
        "ten features": described(chips, mask),
        "adaptive filter": filtered_by(chips),
        "region": segmented(filtered, seed, threshold),
        "posterior of one vector": labelled(options.chips, rng),
    }
    alike(parts["ten features"], parts["region"], parts["adaptive filter"])
    table = Table(
        title=f"{options.chips} chips of {SHAPE[0]} x {SHAPE[1]}, {mask.sum() / len(mask):.0f} cells each"
    )
    for name, side in (("", "left"), ("us per chip", "right"), ("over ours", "right")):
        table.add_column(name, justify=side)  # type: ignore[arg-type]  # one of rich's words
    for part, methods in parts.items():
        table.add_section()
        times = timed(methods, options.rounds, least_s=LEAST_S)
        for name, values in times.items():
            per_chip = 1e6 * statistics.median(values) / options.chips
            table.add_row(f"{part}: {name}", f"{per_chip:.2f}", f"{ratio(times, name):.1f}")
    Console().print(table)


if __name__ == "__main__":
    main()
