"""What may be another track's counts as clutter: several tracks at a cost that is linear in their number."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["against_others"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@compiled
def against_others(
    start: IntArray,
    places: IntArray,
    likelihood: FloatArray,
    density: FloatArray,
    rank: IntArray,
    chance: FloatArray,
    p_seen: float,
) -> FloatArray:
    """Likelihoods (pairs,), the less the more their measurements may be other tracks'.

    To track t a measurement j is clutter with the density and that of the others, so that its likelihood
    N_tj goes by density_j / (density_j + sum_s N_sj P_sj / (1 - P_sj)), s running over the other tracks whose
    rank is not higher. P_sj = chance_s p_seen (N_sj / density_j) / sum_i (N_si / density_i) is how probable
    it is beforehand that j is of track s, which exists with `chance` (n,); p_seen = p_d p_g.

    Source: Musicki & La Scala 2008 (linear multitarget method).
    """
    n = chance.size
    claim = np.empty(places.size)  # N P / (1 - P) over the density
    claimed = np.zeros((rank.max() + 1 if n else 0, density.size))
    for t in range(n):
        total = 0.0
        for e in range(start[t], start[t + 1]):
            total += likelihood[e] / density[places[e]]
        for e in range(start[t], start[t + 1]):
            ratio = likelihood[e] / density[places[e]]
            p = chance[t] * p_seen * ratio / total if total > 0.0 else 0.0
            claim[e] = ratio * p / (1.0 - p)
            claimed[rank[t], places[e]] += claim[e]
    weight = np.empty(places.size)
    for t in range(n):
        for e in range(start[t], start[t + 1]):
            others = max(claimed[rank[t], places[e]] - claim[e], 0.0)
            for level in range(rank[t]):
                others += claimed[level, places[e]]
            weight[e] = likelihood[e] / (1.0 + others)
    return weight
