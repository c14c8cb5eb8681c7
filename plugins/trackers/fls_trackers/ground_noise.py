"""How noisy measurements are, learnt from those of all tracks together.

Source: Sarkka & Nummenmaa 2009, "Recursive noise adaptive Kalman filtering by variational Bayesian
approximations", with the variances common to all tracks, and residuals clipped as by Huber 1964.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_trackers.ground_filter import correct

__all__ = ["NoiseEstimate"]

FloatArray = npt.NDArray[np.float64]

GUESS_WORTH = 2.0  # measurements that the first guess is worth
ROUNDS = 3  # of the fixed point of state and noise; more change nothing that counts
FAR_SD = 3.0  # beyond it a measurement counts less, in state and noise


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """The variances of range and bearing in pixels, as what `count` measurements say; immutable.

    Each variance has an inverse gamma distribution, with mean square `total` / `count`.
    """

    count: float
    total_px2: FloatArray  # (2,) sums of squares

    @classmethod
    def guess(cls, sd_px: FloatArray) -> NoiseEstimate:
        """Before the first measurement."""
        return cls(GUESS_WORTH, GUESS_WORTH * sd_px**2)

    @property
    def variance_px2(self) -> FloatArray:
        """(2,)."""
        return self.total_px2 / self.count

    def corrected(
        self,
        x: FloatArray,
        P: FloatArray,
        y_px: FloatArray,
        cell: FloatArray,
        limits_px2: tuple[FloatArray, FloatArray],
        memory: float,
    ) -> tuple[FloatArray, FloatArray, NoiseEstimate]:
        """States and covariances after one measurement (n, 2) each, and the noise as then known.

        In turn: x, P by a Kalman correction with R; R = (T + sum_n e^2 + H P H^T) / (c + n) with the
        residuals e = y - H x, kept within `limits_px2`, low and high. P before the correction comes from
        earlier measurements and is scaled as R is: their noise was no other. A measurement farther than 3 sd
        of its innovation has its R enlarged by |nu| / (3 sd), and an e^2 counts 9 R at most. At most `memory`
        measurements are remembered, older ones less and less.
        """
        before = variance = np.clip(self.variance_px2, *limits_px2)
        first = y_px - x / cell
        moved_x, moved_P, learnt = x, P, self
        for _ in range(ROUNDS):
            scale = np.sqrt(variance / before)
            prior = P * scale[:, None] * scale
            spread = np.diagonal(prior, axis1=1, axis2=2) / cell**2
            far = np.abs(first) / (FAR_SD * np.sqrt(spread + variance))
            moved_x, moved_P = correct(x, prior, y_px, cell, variance * np.maximum(far, 1.0))
            residual = y_px - moved_x / cell
            left = np.diagonal(moved_P, axis1=1, axis2=2) / cell**2
            squares = np.minimum(residual**2 + left, FAR_SD**2 * variance)
            learnt = NoiseEstimate(self.count + len(x), self.total_px2 + squares.sum(axis=0))
            variance = np.clip(learnt.variance_px2, *limits_px2)
        kept = min(1.0, memory / learnt.count)
        return moved_x, moved_P, NoiseEstimate(kept * learnt.count, kept * learnt.count * variance)

    def snapshot(self) -> dict[str, Any]:
        """What was learnt, as copies."""
        return {"count": self.count, "total_px2": self.total_px2.copy()}

    @classmethod
    def restored(cls, saved: dict[str, Any]) -> NoiseEstimate:
        """The estimate that gave the snapshot `saved`."""
        return cls(float(saved["count"]), np.array(saved["total_px2"], float))
