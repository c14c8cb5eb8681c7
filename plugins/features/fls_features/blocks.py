"""How features change over a block of pings: mean and variance, of them and of their rate."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["STATISTICS", "block_names", "block_statistics"]

FloatArray = npt.NDArray[np.float64]

STATISTICS = ("mean", "variance", "mean_rate", "rate_variance")


def block_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """`area` becomes `area.mean`, `area.variance`, `area.mean_rate`, `area.rate_variance`."""
    return tuple(f"{name}.{statistic}" for name in names for statistic in STATISTICS)


def block_statistics(block: FloatArray) -> FloatArray:
    """(n, 4 p) statistics of blocks (n, N, p) of N >= 2 pings, in the order of `block_names`.

    mean           sum f / N
    variance       sum (f - mean)^2 / N
    mean_rate      (f_N - f_1) / (N - 1), the mean of the differences d from ping to ping
    rate_variance  sum (d - mean_rate)^2 / (N - 1)

    Source: Brinkmann 2010, (3.47)-(3.50); the variance over N as printed there, not as in the listing.
    """
    n, _, p = block.shape
    rate = np.diff(block, axis=1)
    parts = (block.mean(axis=1), block.var(axis=1), rate.mean(axis=1), rate.var(axis=1))
    return np.stack(parts, axis=2).reshape(n, len(STATISTICS) * p)
