"""False-alarm rates from counts of amplitude over threshold, and the scales that meet a wished rate.

Ratios r = x / T are counted in bins of 1 % by block of pings and by beam, so memory does not grow with the
recording, and every rate, scale and spread comes from the same counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = [
    "LEAST_ALARMS",
    "Measured",
    "Tally",
    "beam_scales",
    "exceeded",
    "jackknife_sd",
    "measured",
    "tail_scale",
]

FloatArray = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

STEP = 0.01  # of ln r
LOWEST, HIGHEST = -400, 700  # bins: r from exp(-4) to exp(7)
LEAST_ALARMS = 30  # expected ones that make a rate measurable
BEAM_ALARMS = 12  # by which the beams are set against each other: some 3 % of a scale
TAIL_SHARE = 0.01  # of the cells: the tail that is fitted, if it has enough of them
TAIL_ALARMS = 300


@dataclass(eq=False)
class Tally:
    """How often each ratio came: (n_blocks, n_beams, n_bins)."""

    counts: Counts

    @classmethod
    def of(cls, n_blocks: int, n_beams: int) -> Tally:
        """An empty one."""
        return cls(np.zeros((n_blocks, n_beams, HIGHEST - LOWEST + 2), np.int64))

    def add(self, block: int | npt.NDArray[np.int64], ratio: FloatArray) -> None:
        """Count the ratios (n_ranges, n_beams) of a ping in a block, or one per beam; nan is no decision."""
        _, n_beams, n_bins = self.counts.shape
        _, beam = np.nonzero(~np.isnan(ratio))
        with np.errstate(divide="ignore"):
            steps = np.log(np.maximum(ratio[~np.isnan(ratio)], 0.0)) / STEP
        # the bin k holds e^((k - 1) STEP) < r <= e^(k STEP), so that r > 1 ends at an edge
        index = (np.clip(np.ceil(steps), LOWEST, HIGHEST + 1) - LOWEST).astype(np.int64)
        found = np.bincount(beam * n_bins + index, minlength=n_beams * n_bins).reshape(n_beams, n_bins)
        self.counts[block, np.arange(n_beams)] += found


class Measured(NamedTuple):
    """A rate of false alarms and the interval that holds it with 95 %."""

    rate: float
    low: float
    high: float
    alarms: float
    cells: int


def exceeded(counts: Counts, scale: npt.ArrayLike) -> FloatArray:
    """How many ratios (..., n_bins) lie above `scale`, which is broadcast over the leading axes."""
    above = np.concatenate(
        [np.cumsum(counts[..., ::-1], axis=-1)[..., ::-1], np.zeros_like(counts[..., :1])], axis=-1
    )
    # above[k] counts the bins from k on: the ratios above e^((LOWEST + k - 1) STEP)
    place = np.broadcast_to(np.log(np.asarray(scale, float)) / STEP - LOWEST + 1.0, counts.shape[:-1])
    whole = np.clip(np.floor(place).astype(np.int64), 0, counts.shape[-1] - 1)
    part = np.clip(place - whole, 0.0, 1.0)
    lower = np.take_along_axis(above, whole[..., None], -1)[..., 0]
    upper = np.take_along_axis(above, whole[..., None] + 1, -1)[..., 0]
    found: FloatArray = lower + part * (upper - lower)
    return found


def measured(counts: Counts, scale: FloatArray) -> Measured:
    """The rate of ratios above `scale` (n_beams,) in counts (n_blocks, n_beams, n_bins).

    The interval comes from the scatter of the blocks, since cells and pings are not independent (Student's t
    with n_blocks - 1 degrees of freedom); with fewer than three alarms it reaches up by 3 over the cells.
    """
    cells = counts.sum(axis=(1, 2))
    alarms = exceeded(counts, scale).sum(axis=1)
    total, n = int(cells.sum()), len(counts)
    if not total:
        return Measured(math.nan, math.nan, math.nan, 0.0, 0)
    rate = float(alarms.sum() / total)
    # of a ratio of sums: the blocks need not have the same number of cells
    spread = math.sqrt(float(np.square(alarms - rate * cells).sum()) * n / max(n - 1, 1)) / total
    reach = _student(n - 1) * max(spread, math.sqrt(float(alarms.sum())) / total)
    least = 3.0 / total if alarms.sum() < 3.0 else 0.0
    return Measured(rate, max(rate - reach, 0.0), rate + max(reach, least), float(alarms.sum()), total)


def _student(freedom: int) -> float:
    from scipy.stats import t  # slow to load

    return float(t.ppf(0.975, max(freedom, 1)))


def quantile(counts: Counts, pfa: float) -> float:
    """The scale that a share `pfa` of the ratios (n_bins,) lies above; the lowest if it is lower."""
    total = int(counts.sum())
    if not total:
        return 1.0
    above = np.concatenate([np.cumsum(counts[::-1])[::-1], [0]]).astype(float)
    wanted = pfa * total
    k = int(np.searchsorted(-above, -wanted, side="left"))  # the first edge with no more than that above it
    k = min(max(k, 1), counts.size)
    fell = above[k - 1] - above[k]
    part = (above[k - 1] - wanted) / fell if fell > 0.0 else 0.0
    return math.exp((LOWEST + k - 2 + min(max(part, 0.0), 1.0)) * STEP)


def beam_scales(counts: Counts, pfa: float, *, per_beam: bool) -> FloatArray:
    """(n_beams,) scales with which a share `pfa` of all ratios (n_beams, n_bins) is exceeded.

    Per beam: each beam's own quantile at a share that the beam can tell, times one factor for all, so that
    only the shape of the tail is common to them. A beam with too few cells counts with all others together.
    """
    together = counts.sum(axis=0)
    if not per_beam:
        return np.full(len(counts), quantile(together, pfa))
    cells = counts.sum(axis=1)
    share = min(
        max(pfa, BEAM_ALARMS / max(float(np.median(cells[cells > 0])) if cells.any() else 1.0, 1.0)), 0.1
    )
    own = np.array(
        [
            quantile(one, share) if n * share >= 0.5 * BEAM_ALARMS else math.nan
            for one, n in zip(counts, cells, strict=True)
        ]
    )
    own = np.where(np.isnan(own), quantile(together, share), own)
    return own * _common(counts, own, pfa)


def _common(counts: Counts, own: FloatArray, pfa: float) -> float:
    """The factor c with which a share `pfa` of all ratios lies above c times their beam's scale."""
    total = int(counts.sum())
    low, high = math.exp((LOWEST - 1) * STEP) / own.max(), math.exp(HIGHEST * STEP) / own.min()
    for _ in range(60):
        middle = math.sqrt(low * high)
        if float(exceeded(counts, middle * own).sum()) > pfa * total:
            low = middle
        else:
            high = middle
    return math.sqrt(low * high)


def tail_scale(counts: Counts, pfa: float, *, per_beam: bool) -> FloatArray:
    """As `beam_scales`, for a rate below what was counted: from a generalised Pareto tail.

    Fitted, by maximum likelihood, to the excess of (r / own)^2 over its highest hundredth (or more, if that
    holds few): exponential for Rayleigh amplitudes, a power for heavier tails.

    Source: Pickands 1975 (excesses over a high threshold).
    """
    total = int(counts.sum())
    share = min(max(TAIL_SHARE, TAIL_ALARMS / total), 0.2)
    if pfa >= share:
        return beam_scales(counts, pfa, per_beam=per_beam)
    start = beam_scales(counts, share, per_beam=per_beam)
    sigma, xi = _pareto(*_excess(counts, start))
    ratio = math.log(share / pfa)
    grown = sigma * (math.expm1(xi * ratio) / xi if abs(xi) > 1e-9 else ratio)
    return start * math.sqrt(1.0 + grown)


def _excess(counts: Counts, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(r / start)^2 - 1 of the bins above `start`, and how many ratios each holds."""
    centre = (np.arange(counts.shape[-1]) + LOWEST - 0.5) * STEP
    height = np.expm1(2.0 * (centre - np.log(start)[:, None]))
    inside = (height > 0.0) & (counts > 0)
    return height[inside], counts[inside].astype(float)


def _pareto(excess: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Scale and shape of the generalised Pareto distribution that makes `excess` most likely."""
    from scipy.optimize import minimize  # slow to load

    mean = float(np.average(excess, weights=weight)) if excess.size else 1.0

    def cost(parameters: FloatArray) -> float:
        sigma, xi = math.exp(parameters[0]), parameters[1]
        inner = 1.0 + xi * excess / sigma
        if (inner <= 0.0).any():
            return math.inf
        term = np.log(inner) * (1.0 + 1.0 / xi) if abs(xi) > 1e-6 else excess / sigma
        return float((weight * (parameters[0] + term)).sum())

    found = minimize(
        cost,
        [math.log(max(mean, 1e-9)), 0.05],
        method="Nelder-Mead",
        options={"xatol": 1e-5, "fatol": 1e-6, "maxiter": 2000},
    )
    return math.exp(found.x[0]), float(found.x[1])


def jackknife_sd(counts: Counts, fit: Callable[[Counts], FloatArray]) -> float:
    """Standard deviation of the mean of ln(scale) that `fit` finds, from leaving out a block at a time.

    Source: Quenouille 1956, Tukey 1958.
    """
    everything = counts.sum(axis=0)
    left = np.array([np.log(fit(everything - block)).mean() for block in counts])
    n = len(left)
    return math.sqrt((n - 1) / n * float(np.square(left - left.mean()).sum()))
