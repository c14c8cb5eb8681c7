"""The intensity as a sum of identities, each one target with a probability of existence.

A plain PHD filter takes the number of targets for Poisson: a target that is missed once keeps 1 - pD of its
mass, and a second one may be expected where one is. Here every component or particle bears the label of the
measurement that it was born at, and the mass r of a label is the probability that its target exists. With
C_i the sum over all labels of what they say of measurement i, and c_i the label's own part of it,

    L = 1 - pD + sum_i c_i / r / (kappa_i + C_i - c_i),    r' = r L / (1 - r + r L),

where 1 - pD and c_i / r are means over the label's density: the update of one target among clutter and the
other targets.

Source: Musicki & La Scala 2008, "Multi-target tracking in clutter without measurement assignment" (linear
multi-target IPDA); for the intensity as a multi-Bernoulli one, Williams 2015, "Marginal multi-Bernoulli
filters".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled
from fls_trackers.phd_gaussian import Explained, Mixture
from fls_trackers.phd_reduction import reduced

__all__ = ["MOST_CERTAIN", "Labelled", "existing", "moments", "reduced_by_label", "strongest"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MOST_CERTAIN = 1.0 - 1e-4  # of an existence: who is certain never ends


class Labelled(NamedTuple):
    """A mixture whose components bear labels; the weights of one label sum to its existence."""

    mixture: Mixture
    label: IntArray  # (n,)

    @classmethod
    def empty(cls) -> Labelled:
        """No component at all."""
        return cls(Mixture.empty(), np.zeros(0, np.int64))


def _labels_of(found: Explained, label: IntArray, first_new: int) -> IntArray:
    """The labels (pairs,) of updated components: their parent's, or `first_new` + i born at measurement i."""
    old = label[np.maximum(found.parent, 0)] if label.size else found.parent
    return np.where(found.parent >= 0, old, first_new + found.measurement)


def existing(predicted: Labelled, found: Explained, kappa: float, first_new: int) -> Labelled:
    """All components after a ping: the missed ones, the updated ones, those born; not reduced.

    `kappa`: density of clutter per (m rad). A birth is one of the pairs, with a label of its own.
    """
    mixture, label = predicted
    pair_label = _labels_of(found, label, first_new)
    names, place = np.unique(np.concatenate([label, pair_label]), return_inverse=True)
    missed = mixture.weight * found.missed
    weight = _existing(
        missed, found.pairs.weight, mixture.weight, place.astype(np.int64), found.measurement, found.total,
        kappa, names.size,
    )  # fmt: skip
    whole = Mixture(missed, mixture.state, mixture.covariance).joined(found.pairs)._replace(weight=weight)
    return Labelled(whole, names[place].astype(np.int64))


@compiled
def _existing(
    missed: FloatArray,
    pair: FloatArray,
    before: FloatArray,
    place: IntArray,
    measurement: IntArray,
    total: FloatArray,
    kappa: float,
    labels: int,
) -> FloatArray:
    n, m = missed.size, total.size
    own, r, after = np.zeros((labels, m)), np.zeros(labels), np.zeros(labels)
    for k in range(pair.size):
        own[place[n + k], measurement[k]] += pair[k]
    weight = np.empty(n + pair.size)
    for t in range(n):
        weight[t] = missed[t]
        r[place[t]] += before[t]
        after[place[t]] += missed[t]
    for k in range(pair.size):
        i, name = measurement[k], place[n + k]
        weight[n + k] = pair[k] / (kappa + max(total[i] - own[name, i], 0.0))
        after[name] += weight[n + k]
    for t in range(weight.size):
        name = place[t]
        weight[t] /= max(1.0 - r[name], 1.0 - MOST_CERTAIN) + after[name]
    return weight


def reduced_by_label(whole: Labelled, prune: float, merge: float, most: int) -> Labelled:
    """Fewer components, and labels joined that follow one target; none exists with more than certainty.

    As `reduced`, but a component takes in those of other labels only as long as they are one target together.
    """
    mixture, label = reduced(whole.mixture, prune, merge, most, whole.label)
    names, place = np.unique(label, return_inverse=True)
    r = np.bincount(place, mixture.weight, names.size)
    weight = mixture.weight * np.minimum(1.0, MOST_CERTAIN / r)[place]
    return Labelled(mixture._replace(weight=weight), label)


def strongest(labelled: Labelled, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States (k, 4), covariances and existences of the `n` likeliest labels, k <= n, the likeliest first.

    Moments over all components of a label; among equals the older label goes first.
    """
    names, place = np.unique(labelled.label, return_inverse=True)
    r, state, covariance = moments(*labelled.mixture, place.astype(np.int64), names.size)
    order = np.argsort(-r, kind="stable")[:n]
    return state[order], covariance[order], r[order]


@compiled
def moments(
    weight: FloatArray, state: FloatArray, covariance: FloatArray, place: IntArray, groups: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums of weights (groups,), means (groups, 4) and covariances of the components of each group."""
    total, mean, spread = np.zeros(groups), np.zeros((groups, 4)), np.zeros((groups, 4, 4))
    for j in range(weight.size):
        total[place[j]] += weight[j]
    for j in range(weight.size):
        part = weight[j] / total[place[j]]
        for a in range(4):
            mean[place[j], a] += part * state[j, a]
    for j in range(weight.size):
        g = place[j]
        part = weight[j] / total[g]
        for a in range(4):
            for o in range(4):
                apart = (state[j, a] - mean[g, a]) * (state[j, o] - mean[g, o])
                spread[g, a, o] += part * (covariance[j, a, o] + apart)
    return total, mean, spread
