"""What tracks have been taken for so far: evidence per class, kept between the pings that describe them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import Classes, Features, Tracks
from fls_flow.discriminants import decide, posterior

__all__ = ["Costs", "TrackLabels"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


def _none() -> IntArray:
    return np.zeros(0, np.int64)


def _no() -> BoolArray:
    return np.zeros(0, bool)


@dataclass(frozen=True)
class Costs:
    """What it costs to miss the positive class, and to call another class positive.

    Raises ValueError for a class that is not known and for costs that are not positive.
    """

    classes: tuple[str, ...]
    positive: str
    miss_cost: float
    false_alarm_cost: float

    def __post_init__(self) -> None:
        if self.positive not in self.classes:
            raise ValueError(f"positive is '{self.positive}'; the classes are {', '.join(self.classes)}")
        for name in ("miss_cost", "false_alarm_cost"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")

    def is_positive(self, probability: FloatArray) -> BoolArray:
        """(n,) whether each row of probabilities (n, c) is taken for the positive class."""
        return np.asarray(self.label(probability) == self.classes.index(self.positive))

    def label(self, probability: FloatArray) -> IntArray:
        """(n,) what to take each row of probabilities (n, c) for."""
        positive = self.classes.index(self.positive)
        return decide(probability, positive, self.miss_cost, self.false_alarm_cost)


@dataclass
class TrackLabels:
    """Log evidence of each class for each track that has been described.

    New evidence e joins the old E as e + memory E. With `handover` h, the chance that the track has gone over
    to something else since, the old counts as the forward step of a hidden Markov model has it: P(class)
    becomes (1 - h) P(class) + h prior.

    With `agreement` n > 1, a track has a label only while all evidence spoke for the same side, the positive
    class or the others, after each of its last n descriptions, and the newest one alone does, too.
    """

    classes: tuple[str, ...]
    log_prior: FloatArray  # (c,)
    memory: float
    hold_pings: int
    min_descriptions: int = 1  # before a track has a label
    handover: float = 0.0
    agreement: int = 1
    _firing: int = field(default=0, init=False, repr=False)
    _id: IntArray = field(default_factory=_none, init=False, repr=False)  # increasing
    _last: IntArray = field(default_factory=_none, init=False, repr=False)  # firing of the newest evidence
    _count: IntArray = field(default_factory=_none, init=False, repr=False)  # descriptions so far
    _positive: BoolArray = field(default_factory=_no, init=False, repr=False)  # what all evidence says
    _agreed: IntArray = field(default_factory=_none, init=False, repr=False)  # since how many descriptions
    _doubted: BoolArray = field(default_factory=_no, init=False, repr=False)  # by the newest description
    _evidence: FloatArray = field(init=False, repr=False)  # (n, c)

    def __post_init__(self) -> None:
        if not 0.0 <= self.memory <= 1.0:
            raise ValueError(f"memory is {self.memory}; it lies between 0 and 1")
        if not 0.0 <= self.handover <= 1.0:
            raise ValueError(f"handover is {self.handover}; it lies between 0 and 1")
        for name in ("hold_pings", "min_descriptions", "agreement"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        self._evidence = np.zeros((0, len(self.classes)))

    def step(
        self,
        features: Features,
        track_id: IntArray,
        evidence: FloatArray,
        tracks: Tracks | None,
        costs: Costs,
    ) -> Classes:
        """The classes of one ping, after the evidence (n, c) of the tracks (n,) that it describes."""
        self._firing += 1
        if track_id.size:
            self._join(track_id, evidence, costs)
        if tracks is None:
            self._keep(self._firing - self._last < self.hold_pings)
        else:
            self._keep(np.isin(self._id, tracks.id))
        told = (self._count >= self.min_descriptions) & (self._agreed >= self.agreement)
        if self.agreement > 1:
            told &= ~self._doubted
        probability = posterior(self._evidence[told] + self.log_prior)
        return Classes(
            features.seq,
            features.stamp_ns,
            self._id[told],
            self.classes,
            costs.label(probability),
            probability,
        )

    def _join(self, track_id: IntArray, evidence: FloatArray, costs: Costs) -> None:
        track_id, first = np.unique(track_id, return_index=True)
        evidence = evidence[first]
        self._make_room(track_id)
        new = np.searchsorted(self._id, track_id)
        self._evidence[new] = evidence + self._recalled(self._evidence[new])
        positive = costs.is_positive(posterior(self._evidence[new] + self.log_prior))
        same = (positive == self._positive[new]) & (self._count[new] > 0)
        self._agreed[new] = np.where(same, self._agreed[new] + 1, 1)
        self._positive[new] = positive
        self._doubted[new] = positive != costs.is_positive(posterior(evidence + self.log_prior))
        self._last[new] = self._firing
        self._count[new] += 1

    def _make_room(self, track_id: IntArray) -> None:
        """Take in tracks that are not known yet, in order of id."""
        every = np.union1d(self._id, track_id)
        old, self._id = np.searchsorted(every, self._id), every
        self._last, self._count = _spread(self._last, old, every.size), _spread(self._count, old, every.size)
        self._positive = _spread(self._positive, old, every.size)
        self._agreed = _spread(self._agreed, old, every.size)
        self._doubted = _spread(self._doubted, old, every.size)
        self._evidence = _spread(self._evidence, old, every.size)

    def _recalled(self, evidence: FloatArray) -> FloatArray:
        """What earlier evidence still says."""
        kept = self.memory * evidence
        if not self.handover:
            return kept
        prior = posterior(self.log_prior[None, :])
        chance = (1.0 - self.handover) * posterior(kept + self.log_prior) + self.handover * prior
        return np.asarray(np.log(chance / prior))

    def _keep(self, which: BoolArray) -> None:
        self._id, self._last = self._id[which], self._last[which]
        self._count, self._evidence = self._count[which], self._evidence[which]
        self._positive, self._agreed = self._positive[which], self._agreed[which]
        self._doubted = self._doubted[which]

    def snapshot(self) -> dict[str, Any]:
        """The evidence so far."""
        return {
            "firing": self._firing,
            "id": self._id.copy(),
            "last": self._last.copy(),
            "count": self._count.copy(),
            "positive": self._positive.copy(),
            "agreed": self._agreed.copy(),
            "doubted": self._doubted.copy(),
            "evidence": self._evidence.copy(),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._firing = int(snapshot["firing"])
        self._id, self._last = np.array(snapshot["id"]), np.array(snapshot["last"])
        self._count, self._evidence = np.array(snapshot["count"]), np.array(snapshot["evidence"])
        self._positive, self._agreed = np.array(snapshot["positive"]), np.array(snapshot["agreed"])
        self._doubted = np.array(snapshot["doubted"])


def _spread(values: npt.NDArray[Any], to: IntArray, size: int) -> npt.NDArray[Any]:
    """Rows at places `to` among `size`; the others are 0."""
    wide = np.zeros((size, *values.shape[1:]), values.dtype)
    wide[to] = values
    return wide
