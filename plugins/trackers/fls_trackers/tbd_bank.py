"""The tracks of track before detect: how they begin, live through pings, and end."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import TrackStatus
from fls_flow.geometry import wrap
from fls_trackers.tbd_grid import Grid, Motion
from fls_trackers.tbd_hypotheses import SWITCH, rival, weighed
from fls_trackers.tbd_ratio import Codes, Plane, RatioMap
from fls_trackers.tbd_scouts import (
    BEARING,
    COLUMNS,
    P_RR,
    P_TT,
    RANGE,
    RATE,
    SCORE,
    SIGMA,
    FloatArray,
    followed,
    predicted,
)
from fls_trackers.tbd_tables import Tables
from fls_trackers.tbd_tracks import bearings_of, first_bearings, likeliest_bearing, spread_bearings

__all__ = ["RATE_CELL_MPS", "Bank", "Rules"]

BoolArray = npt.NDArray[np.bool_]

ROW = np.dtype(
    [
        ("id", np.int64),
        ("status", np.int64),
        ("hits", np.int64),
        ("age", np.int64),
        ("level", np.float64),  # of its echoes over the clutter
        ("best", np.float64),  # score that it has had
        ("doubt", np.float64),  # probability of the other hypothesis on its motion
    ]
)
RATE_CELL_MPS = 0.1  # paths closer than this in range rate count as one
HEADROOM = 10.0  # how far a score may rise above that of confirmation
WIDEST = 6.0  # resolution cells of range: a track less certain than that is no track
LEVEL_MEMORY = 0.1  # weight of the newest echo in a track's level
ASTRAY = 4.0  # by which a track's score has fallen when it is looked for around
FOUND = 0.8  # share of `start_score` that a scout there needs to be taken for the track
LEAD = 3.0  # by which a scout must be better than a tentative track that it takes the place of
MARGIN_DB, SURE_DB = 2.0, 7.0  # a track is expected as strong as it was, less this, and up to that
OPEN_ODDS, SETTLED_ODDS = 1.5, 10.0  # how much more probable another lobe must be, before and after
NOW = Motion(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Rules(NamedTuple):
    """What makes a track, and what ends it."""

    start_score: float
    limit: float  # the score that confirms
    keep_score: float
    exclusion_m: float
    max_tracks: int
    level: float  # power over clutter that a track is expected to have
    sigmas_mps2: tuple[float, float]  # of a steady target, and of one that manoeuvres


@dataclass
class Bank:
    """Tracks: paths as scouts have them, and beside each the probabilities of all bearings.

    Each track has two: of a target that goes on steadily and of one that manoeuvres. `path` is the likelier.
    """

    path: FloatArray = field(default_factory=lambda: np.zeros((0, COLUMNS)))
    other: FloatArray = field(default_factory=lambda: np.zeros((0, COLUMNS)))
    belief: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # (n, n_beams)
    row: npt.NDArray[np.void] = field(default_factory=lambda: np.zeros(0, ROW))
    next_id: int = 1

    def __len__(self) -> int:
        return len(self.row)

    @property
    def confirmed(self) -> BoolArray:
        """Which tracks are confirmed, (n,)."""
        which: BoolArray = self.row["status"] == TrackStatus.CONFIRMED
        return which

    def predict(self, motion: Motion) -> FloatArray:
        """Take all tracks to the next ping; by how much their bearings move, (n,)."""
        before = self.path[:, BEARING]
        self.path, self.other = predicted(self.path, motion), predicted(self.other, motion)
        self.row = self.row.copy()
        self.row["age"] += 1
        return wrap(self.path[:, BEARING] - before)

    def on(self, grid: Grid) -> None:
        """Give up what was believed of the beams of another grid."""
        places = [first_bearings(one, np.zeros(1), grid) for one in self.path[:, BEARING, None]]
        self.belief = np.array(places).reshape(len(self), grid.n_beams)

    def follow(
        self,
        ratios: RatioMap,
        half: Codes,
        tables: Tables,
        grid: Grid,
        motion: Motion,
        moved_rad: FloatArray,
        rules: Rules,
    ) -> BoolArray:
        """Take the tracks through a ping; which of them are lost, (n,).

        One that has left the ping is only predicted: if it is confirmed, until its range is not known.
        """
        if not len(self):
            return np.zeros(0, bool)
        path, row, most = self.path, self.row, rules.limit + HEADROOM
        sd = path[:, SIGMA] * motion.dt_s**2 / np.maximum(path[:, RANGE], 1.0)
        belief = spread_bearings(self.belief, moved_rad, sd, grid)
        belief, echo = bearings_of(path, belief, row["level"], ratios.excess, tables.levels, grid)
        stepped = self._stepped(half, tables.decoded, grid, rules)
        outside = np.isneginf(stepped[:, SCORE])
        row["level"] += np.where(outside, 0.0, LEVEL_MEMORY * (echo - row["level"]))
        row["hits"] += stepped[:, SCORE] > path[:, SCORE]
        stepped[:, SCORE] = np.minimum(stepped[:, SCORE], most)
        odds = np.where(self.confirmed, SETTLED_ODDS, OPEN_ODDS)
        moved = likeliest_bearing(stepped, belief, odds, grid)
        over = moved[:, BEARING] != stepped[:, BEARING]
        self.other[over, BEARING : P_TT + 1] = moved[over, BEARING : P_TT + 1]
        stepped = moved
        self.path, self.belief = np.where(outside[:, None], path, stepped), belief
        row["best"] = np.maximum(row["best"], self.path[:, SCORE])
        row["status"][(self.path[:, SCORE] >= rules.limit) & ~outside] = TrackStatus.CONFIRMED
        least = np.where(self.confirmed, most - rules.keep_score, 0.5 * rules.start_score)
        lost = (self.path[:, SCORE] < least) | (outside & ~self.confirmed)
        lost |= np.sqrt(self.path[:, P_RR]) > WIDEST * grid.resolution_m
        return lost | self._repeats(grid)

    def _stepped(self, half: Codes, decoded: Plane, grid: Grid, rules: Rules) -> FloatArray:
        """The paths after a ping, each scored by the ratios of targets about as strong as its own."""
        least_db = 10.0 * math.log10(rules.level)
        level_db = 10.0 * np.log10(np.maximum(self.row["level"], 1.0)) - MARGIN_DB
        level = np.rint(np.clip(level_db, least_db, max(SURE_DB, least_db)))
        level = np.clip(level, 1, len(decoded)).astype(np.int64) - 1
        path, other = self.path.copy(), self.other.copy()
        other[:, SCORE] = path[:, SCORE]
        for one in np.unique(level):
            path[level == one] = followed(path[level == one], half, decoded[one], grid, NOW)
            other[level == one] = followed(other[level == one], half, decoded[one], grid, NOW)
        stepped, self.other, self.row["doubt"] = weighed(self.path[:, SCORE], path, other, self.row["doubt"])
        return stepped

    def _repeats(self, grid: Grid) -> BoolArray:
        """Which tracks have come to be where another one of a higher score is, (n,)."""
        path = self.path
        near = np.abs(path[:, None, RANGE] - path[None, :, RANGE]) < 2.0 * grid.resolution_m
        near &= np.abs(path[:, None, RATE] - path[None, :, RATE]) < RATE_CELL_MPS
        off = wrap(path[:, None, BEARING] - path[None, :, BEARING])
        near &= np.abs(off) < grid.beamwidth_rad
        score, order = path[:, SCORE], np.arange(len(path))
        better = (score[None, :] > score[:, None]) | (
            (score[None, :] == score[:, None]) & (order[None, :] < order[:, None])
        )
        repeats: BoolArray = (near & better).any(axis=1)
        return repeats

    def near(self, scouts: FloatArray, tracks: BoolArray, exclusion_m: float) -> BoolArray:
        """Which scouts lie in the range that one of `tracks` (a mask) excludes, at any bearing, (n,)."""
        taken = np.zeros(len(scouts), bool)
        for range_m in self.path[tracks, RANGE]:
            taken |= np.abs(scouts[:, RANGE] - range_m) < exclusion_m
        return taken

    @property
    def astray(self) -> BoolArray:
        """Which confirmed tracks have lost so much score that they may be off their targets, (n,)."""
        which: BoolArray = self.confirmed & (self.row["best"] - self.path[:, SCORE] > ASTRAY)
        return which

    def recall(self, scouts: FloatArray, grid: Grid, rules: Rules) -> None:
        """Bring tracks that are astray to the best scouts around them.

        Those have begun since: while a track does well, none live there. A scout says where the target is,
        not that it is another one.
        """
        for t in np.flatnonzero(self.astray):
            here = np.abs(scouts[:, RANGE] - self.path[t, RANGE]) < rules.exclusion_m
            here &= np.abs(wrap(scouts[:, BEARING] - self.path[t, BEARING])) < 2.0 * grid.beamwidth_rad
            score = np.where(here, scouts[:, SCORE], -np.inf)
            if score.size and score.max() >= FOUND * rules.start_score:
                kept = max(self.path[t, SCORE], score.max())
                self.path[t] = scouts[score.argmax()]
                self.path[t, SCORE] = self.row["best"][t] = kept
                self.other[t] = rival(self.path[t, None], rules.sigmas_mps2)[0]
                self.row["doubt"][t] = SWITCH

    def begin(self, scouts: FloatArray, grid: Grid, rules: Rules) -> None:
        """Make tracks of the best scouts, in place of tentative ones near that are much worse."""
        good = scouts[scouts[:, SCORE] >= rules.start_score]
        for one in good[np.argsort(-good[:, SCORE], kind="stable")]:
            near = np.abs(self.path[:, RANGE] - one[RANGE]) < rules.exclusion_m
            worse = ~self.confirmed & (self.path[:, SCORE] + LEAD < one[SCORE])
            if (near & ~worse).any():
                continue
            self.keep(~near)
            if len(self) < rules.max_tracks:
                self._add(one, scouts, grid, rules)

    def _add(self, one: FloatArray, scouts: FloatArray, grid: Grid, rules: Rules) -> None:
        """Make a track of a scout; others that move with it say how probable its bearings are."""
        along = np.abs(scouts[:, RANGE] - one[RANGE]) < 4.0 * grid.resolution_m
        along &= np.abs(scouts[:, RATE] - one[RATE]) < 2.0 * RATE_CELL_MPS
        belief = first_bearings(scouts[along, BEARING], scouts[along, SCORE], grid)
        row = np.zeros(1, ROW)
        row["id"], row["hits"], row["age"], row["level"] = self.next_id, 2, 1, rules.level
        row["best"], row["doubt"] = one[SCORE], SWITCH
        row["status"] = TrackStatus.CONFIRMED if one[SCORE] >= rules.limit else TrackStatus.TENTATIVE
        self.next_id += 1
        self.row = np.concatenate([self.row, row])
        self.path = np.concatenate([self.path, one[None]])
        self.other = np.concatenate([self.other, rival(one[None], rules.sigmas_mps2)])
        self.belief = np.concatenate([self.belief.reshape(-1, grid.n_beams), belief[None]])

    def ended(self, lost: BoolArray) -> Bank:
        """Take the lost tracks out; of them, those that were confirmed."""
        gone = lost & self.confirmed
        ended = Bank(self.path[gone], self.other[gone], np.zeros((0, 0)), self.row[gone].copy())
        ended.row["status"] = TrackStatus.LOST
        self.keep(~lost)
        return ended

    def keep(self, which: BoolArray) -> None:
        """Forget all other tracks."""
        if not which.all():
            self.row, self.belief = self.row[which], self.belief[which]
            self.path, self.other = self.path[which], self.other[which]

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        rows = {name: self.row[name].copy() for name in ROW.names or ()}
        paths = {"path": self.path.copy(), "other": self.other.copy()}
        return {**paths, "belief": self.belief.copy(), "next_id": self.next_id, **rows}

    @classmethod
    def restored(cls, saved: dict[str, Any]) -> Bank:
        """The tracks of a snapshot."""
        row = np.zeros(len(saved["id"]), ROW)
        for name in ROW.names or ():
            row[name] = saved[name]
        path, other = (np.array(saved[name], float).reshape(-1, COLUMNS) for name in ("path", "other"))
        return cls(path, other, np.array(saved["belief"], float), row, int(saved["next_id"]))
