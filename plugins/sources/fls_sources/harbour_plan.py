"""Who swims in a harbour, when, how large and how fast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_sources.harbour_bodies import Diver, Dolphin, School, Seal, Swimmer
from fls_sources.harbour_bubbles import Circuit, Puffs, breathing
from fls_sources.harbour_motion import STEP_S, Gait, Visits, walks

__all__ = ["KINDS", "SPECIES", "Kind", "Matched", "Planned", "Sector", "Visitor", "plan"]

FloatArray = npt.NDArray[np.float64]
Kind = Literal["open", "semi-closed", "closed", "seal", "dolphin", "fish-school"]
IntArray = npt.NDArray[np.int64]
Species = Literal["diver", "seal", "dolphin", "fish"]
PLAN_STREAM = 1
CIRCUITS: dict[Kind, Circuit] = {"open": "open", "semi-closed": "semi-closed", "closed": "closed"}
KINDS: tuple[Kind, ...] = ("open", "semi-closed", "closed", "seal", "dolphin", "fish-school")
SPECIES: dict[Kind, Species] = {
    "open": "diver",
    "semi-closed": "diver",
    "closed": "diver",
    "seal": "seal",
    "dolphin": "dolphin",
    "fish-school": "fish",
}


class Matched(NamedTuple):
    """What is alike in all kinds: sizes, speeds and turns of one law; the echo of the whole body."""

    motion: bool = False
    echo: bool = False


class GaitLaw(NamedTuple):
    """Mean speeds lie evenly in a range; then speed_log_sd, speed_tau_s, turn_sd, turn_tau_s, turn_max."""

    speed_mps: tuple[float, float]
    wander: tuple[float, float, float, float, float]


GAITS: dict[Species, GaitLaw] = {
    "diver": GaitLaw((0.3, 0.6), (0.6, 4.0, 0.35, 3.0, 0.7)),
    "seal": GaitLaw((0.6, 1.6), (0.4, 3.0, 0.35, 2.0, 1.2)),
    "dolphin": GaitLaw((1.5, 3.0), (0.2, 5.0, 0.15, 4.0, 0.7)),
    "fish": GaitLaw((0.1, 0.5), (0.4, 6.0, 0.15, 5.0, 0.4)),
}
LENGTH_M: dict[Species, tuple[float, float]] = {
    "diver": (2.1, 2.5),  # with fins
    "seal": (1.3, 1.9),
    "dolphin": (1.9, 2.8),
    "fish": (3.0, 6.0),  # of the school
}
MATCHED_GAIT = GaitLaw((0.3, 1.2), (0.4, 4.0, 0.25, 3.0, 0.7))
MATCHED_LENGTH_M = (1.6, 2.6)
MATCHED_ECHO = 10.0  # of a whole body, against a scatterer of gas

# how long divers stay in view: lognormal, of the segments of tests/golden/diver_motion
STAY_MEDIAN_S, STAY_LOG_SD = 15.6, 0.75
AWAY_MEAN_S = 4.0  # until the next of its kind comes


@dataclass(frozen=True, slots=True)
class Sector:
    """What the sonar sees."""

    range_min_m: float
    range_max_m: float
    half_width_rad: float

    def anywhere(self, rng: np.random.Generator) -> FloatArray:
        """A point in it, evenly by area, off its borders."""
        near, far = self.range_min_m + 2.0, max(self.range_max_m - 2.0, self.range_min_m + 2.1)
        r = np.sqrt(rng.uniform(near**2, far**2))
        b = 0.85 * self.half_width_rad * rng.uniform(-1.0, 1.0)
        return np.array([r * np.cos(b), r * np.sin(b)])


@dataclass(frozen=True, eq=False)
class Visitor:
    """One swimmer, from when it comes to when it goes."""

    target_id: int
    kind: Kind
    body: Swimmer
    gait: Gait
    puffs: Puffs | None
    start_s: float
    end_s: float
    start: tuple[float, float, float]
    home_m: tuple[float, float]
    echo_gain: float = 1.0


@dataclass(frozen=True, eq=False)
class Planned:
    """Who is where in a scene, and when."""

    visitors: tuple[Visitor, ...]
    who: IntArray  # (n_steps, n_places) index of the visitor, or -1
    path: FloatArray  # (n_steps, n_places, 5): x, y, vx, vy, heading every STEP_S; nan where nobody is

    def present(self, time_s: float) -> tuple[IntArray, IntArray]:
        """Places that are taken, and by which visitors."""
        who = self.who[self._step(time_s)]
        places = np.flatnonzero(who >= 0)
        return places, who[places]

    def states(self, time_s: float, places: IntArray) -> FloatArray:
        """(k, 6) x, y, vx, vy, heading and its rate of those in `places`, at a time."""
        k = self._step(time_s)
        now, then = self.path[k, places], self.path[min(k + 1, len(self.path) - 1), places]
        turn = (then[:, 4] - now[:, 4] + np.pi) % (2.0 * np.pi) - np.pi
        same = self.who[min(k + 1, len(self.who) - 1), places] == self.who[k, places]
        rate = np.where(same, turn / STEP_S, 0.0)
        state = np.concatenate([now, rate[:, None]], axis=1)
        left_s = time_s - k * STEP_S
        state[:, :2] += left_s * now[:, 2:4]
        state[:, 4] += left_s * rate
        return state

    def ahead(self, place: int, time_s: FloatArray, distance_m: float) -> FloatArray:
        """(n, 2) the points so far ahead of who was in a place, at times (n,)."""
        k = np.clip((time_s / STEP_S).astype(np.int64), 0, len(self.path) - 1)
        x, y, _, _, heading = self.path[k, place].T
        return np.stack([x + distance_m * np.cos(heading), y + distance_m * np.sin(heading)], axis=1)

    def _step(self, time_s: float) -> int:
        return min(max(int(time_s / STEP_S + 1e-6), 0), len(self.who) - 1)


def plan(
    counts: dict[Kind, int],
    sector: Sector,
    end_s: float,
    *,
    stay_s: float | None,
    matched: Matched,
    apart_m: float,
    seed: int,
) -> Planned:
    """The swimmers of a scene that ends at `end_s`; a longer scene begins with the same ones.

    Of each kind there are as many places as `counts` says. Who has one stays `stay_s` (None: as real divers
    did), then another of its kind comes after a while.
    """
    n_steps = int(np.ceil(end_s / STEP_S)) + 2
    places = [(number, kind, k) for number, kind in enumerate(KINDS) for k in range(counts[kind])]
    who = np.full((n_steps, len(places)), -1, np.int64)
    noise = np.zeros((n_steps, len(places), 2))
    visitors: list[Visitor] = []
    for column, (number, kind, k) in enumerate(places):
        stream = (seed, PLAN_STREAM, number, k)
        noise[:, column] = np.random.default_rng((*stream, 0)).standard_normal((n_steps, 2))
        rng = np.random.default_rng((*stream, 1))
        time_s, target_id = 0.0, 1 + column
        while time_s <= end_s:
            visitor = _visitor(target_id, kind, sector, time_s, end_s, stay_s, matched, rng)
            who[round(time_s / STEP_S) : round(min(visitor.end_s, end_s + 1.0) / STEP_S), column] = len(
                visitors
            )
            visitors.append(visitor)
            target_id += len(places)
            time_s = visitor.end_s + 1.0 + AWAY_MEAN_S * rng.standard_exponential()
    visits = Visits(
        tuple(one.gait for one in visitors),
        np.array([one.start for one in visitors]).reshape(-1, 3),
        np.array([one.home_m for one in visitors]).reshape(-1, 2),
    )
    bounds = (sector.range_min_m, sector.range_max_m, sector.half_width_rad)
    return Planned(tuple(visitors), who, walks(visits, who, noise, bounds, apart_m))


def _visitor(
    target_id: int,
    kind: Kind,
    sector: Sector,
    start_s: float,
    scene_end_s: float,
    stay_s: float | None,
    matched: Matched,
    rng: np.random.Generator,
) -> Visitor:
    drawn = max(2.0, float(STAY_MEDIAN_S * np.exp(STAY_LOG_SD * rng.standard_normal())))
    end_s = start_s + (drawn if stay_s is None else stay_s)
    own = rng.spawn(1)[0]
    x, y = sector.anywhere(rng)
    home = sector.anywhere(rng)
    circuit = CIRCUITS.get(kind)
    puffs = None if circuit is None else breathing(circuit, start_s, min(end_s, scene_end_s), own)
    body = _body(kind, matched.motion, rng)
    return Visitor(
        target_id,
        kind,
        body,
        _gait(kind, matched.motion, rng),
        puffs,
        start_s,
        end_s,
        (float(x), float(y), float(np.arctan2(home[1] - y, home[0] - x) + rng.uniform(-1.0, 1.0))),
        (float(home[0]), float(home[1])),
        _echo_gain(body) if matched.echo else 1.0,
    )


def _gait(kind: Kind, matched: bool, rng: np.random.Generator) -> Gait:
    law = MATCHED_GAIT if matched else GAITS[SPECIES[kind]]
    return Gait(float(rng.uniform(*law.speed_mps)), *law.wander)


def _body(kind: Kind, matched: bool, rng: np.random.Generator) -> Swimmer:
    species = SPECIES[kind]
    length_m = float(rng.uniform(*(MATCHED_LENGTH_M if matched else LENGTH_M[species])))
    if species == "diver":
        return Diver(length_m, kind != "closed", rng)
    if species == "seal":
        return Seal(length_m, rng)
    return Dolphin(length_m, rng) if species == "dolphin" else School(length_m, rng)


def _echo_gain(body: Swimmer) -> float:
    return MATCHED_ECHO / float(body.echoes(0.0, 0.0).power.sum())
