"""Two hypotheses on how a track's target moves: steadily, or with manoeuvres; the likelier is its path."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_trackers.tbd_scouts import SCORE, SIGMA

__all__ = ["SWITCH", "rival", "weighed"]

FloatArray = npt.NDArray[np.float64]

SWITCH = 0.02  # probability that a target changes its way of moving at a ping
RENEW = 0.005  # probability below which a hypothesis is given up and begins anew


def rival(path: FloatArray, sigmas_mps2: tuple[float, float]) -> FloatArray:
    """The tracks (n, COLUMNS) where they are, with the noise of motion that they do not have, of two."""
    steady, agile = sigmas_mps2
    other = path.copy()
    other[:, SIGMA] = np.where(path[:, SIGMA] == agile, steady, agile)
    return other


def weighed(
    score: FloatArray, path: FloatArray, other: FloatArray, doubt: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Path and other hypothesis (n, COLUMNS) after a ping, and the probability (n,) of the other one.

    Both scores were `score` (n,) before it and are ln of the mean ratio under both after it, the means being
    those of `doubt` with changes at a rate of SWITCH. The likelier becomes the path, and one that has become
    improbable begins anew where that is. Where the path has left the ping, all stays.

    Source: interacting multiple models (Blom & Bar-Shalom 1988), without mixing the states.
    """
    path, other = path.copy(), other.copy()
    inside = ~np.isneginf(path[:, SCORE])
    doubt = np.where(inside, doubt + SWITCH * (1.0 - 2.0 * doubt), doubt)
    gain = np.where(inside, path[:, SCORE] - score, 0.0)
    other_gain = np.where(inside, other[:, SCORE] - score, 0.0)
    total = (1.0 - doubt) * np.exp(gain) + doubt * np.exp(other_gain)
    doubt = doubt * np.exp(other_gain) / total
    path[inside, SCORE] += (np.log(total) - gain)[inside]
    swap = inside & (doubt > 0.5)
    path[swap], other[swap] = other[swap], path[swap]
    path[swap, SCORE] = other[swap, SCORE]
    doubt = np.where(swap, 1.0 - doubt, doubt)
    anew = inside & (doubt < RENEW)
    sigma = other[anew, SIGMA]
    other[anew] = path[anew]
    other[anew, SIGMA] = sigma
    return path, other, np.where(anew, SWITCH, doubt)
