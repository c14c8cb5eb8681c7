"""Track before detect: integrate likelihood ratios over pings along all paths that a target may take."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fls_flow import Ping, Tracks, hookimpl
from fls_flow.geometry import Pose, sensor_pose, turn
from fls_flow.messages import Frame
from fls_trackers.tbd_bank import RATE_CELL_MPS, Bank, Rules
from fls_trackers.tbd_births import Past, Peaks, fresh_scouts
from fls_trackers.tbd_evidence import halves
from fls_trackers.tbd_grid import Grid, Motion, Place, grid_from, grid_of, own_motion, place_from
from fls_trackers.tbd_ratio import NO_PLANE, Codes, Plane, RatioMap, candidates, power_correlation, ratio_map
from fls_trackers.tbd_scouts import (
    COLUMNS,
    RANGE,
    FloatArray,
    best_of_cells,
    by_range,
    followed,
    predicted,
    with_agile,
)
from fls_trackers.tbd_tables import Tables, tables_of
from fls_trackers.tbd_tracks import cartesian

__all__ = ["MultiPingIntegration"]

MEMORY = 0.1  # weight of the newest ping in the clutter's correlation
CAUTION = 0.95  # share of the correlation that is trusted: too much would make false tracks
AGILE_SCORE = 5.0  # of a scout whose target may manoeuvre
AGILE_ODDS = 8.0  # against that
KINDS = 4  # of pairs, by how long ago and how high the older peak was, that share `max_scouts`
CORRELATION_STEP = 1.0 / 32.0  # in which it is used


def _no_scouts() -> FloatArray:
    return np.zeros((0, COLUMNS))


@dataclass
class MultiPingIntegration:
    """Tracks of echoes too weak to be detected in one ping, from the pings themselves.

    Each cell becomes a likelihood ratio of target plus clutter, for a target of `snr_db`, against Rayleigh
    clutter whose mean is that of `reference_m` before and behind a guard of `guard_m` in the same beam; where
    clutter persists from ping to ping, against what the cell's last power lets expect of it.

    Two peaks of `peak_power` times the clutter, of now and of one of the last two pings, within `v_max_mps`
    (and 2.5 `cross_mps` across), begin a path of nearly constant velocity. It is followed back through the
    last `look_back` pings; the likely ones become scouts, whose log ratios add up ping by ping and which the
    ratios around them steer. At most `max_scouts` of the best live on. Targets accelerate by `sigma_v_mps2`,
    white between pings, or by `agile_mps2` while they manoeuvre, as scouts of some score may too.

    A scout of score `start_score` becomes a tentative track, which weighs both kinds of motion ping by ping.
    It keeps the probabilities of all bearings, so that the lobes of a sparse array compete inside it; within
    `exclusion_m` of range no other track begins at any bearing, but in place of a much less likely tentative
    one. The track is confirmed at ln(cells / false_per_ping): by Ville's inequality, at most `false_per_ping`
    false tracks per ping are confirmed in clutter as assumed; as scouts begin at peaks only, they are some
    hundred times fewer. A track ends when its score, at most 10 above that, has fallen by `keep_score`, or
    when its range is not known.

    Ranges and bearings must be even; a pulse of bandwidth B has `resolution_m` c / (2 B). With `frame: ned`
    own motion is taken out by `ping.nav`; without position or heading tracks are only predicted.

    Raises ValueError when a stamp does not increase or cells are not even; the state stays as it was.

    Source: recursive Bayesian track before detect (Ristic, Arulampalam & Gordon 2004, chapter 11), with
    paths kept as a list instead of a grid.
    """

    snr_db: float = 3.0
    v_max_mps: float = 2.0
    sigma_v_mps2: float = 0.005
    agile_mps2: float = 0.03
    cross_mps: float = 0.5
    resolution_m: float = 0.076
    beamwidth_deg: float = 2.2
    guard_m: float = 0.16
    reference_m: float = 2.4
    peak_power: float = 4.0
    max_scouts: int = 40_000
    look_back: int = 6
    start_score: float = 10.0
    false_per_ping: float = 0.1
    keep_score: float = 15.0
    exclusion_m: float = 1.5
    max_gain: float = 7.0
    max_tracks: int = 60
    frame: Frame = "sensor"

    _scouts: FloatArray = field(default_factory=_no_scouts, init=False, repr=False)
    _bank: Bank = field(default_factory=Bank, init=False, repr=False)
    _past: list[Past] = field(default_factory=list, init=False, repr=False)  # the newest first
    _power: Plane = field(default_factory=NO_PLANE.copy, init=False, repr=False)
    _tables: Tables | None = field(default=None, init=False, repr=False)
    _correlation: float = field(default=0.0, init=False, repr=False)
    _grid: Grid | None = field(default=None, init=False, repr=False)
    _pose: Place | None = field(default=None, init=False, repr=False)
    _stamp_ns: int | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        positive = (
            "v_max_mps",
            "sigma_v_mps2",
            "agile_mps2",
            "cross_mps",
            "resolution_m",
            "beamwidth_deg",
            "reference_m",
        )
        for name in (*positive, "peak_power", "max_gain", "keep_score", "false_per_ping"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive and finite, not {getattr(self, name)}")
        for name in ("guard_m", "exclusion_m"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and not negative, not {getattr(self, name)}")
        for name in ("snr_db", "start_score"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, not {getattr(self, name)}")
        for name in ("max_scouts", "max_tracks", "look_back"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.frame not in ("sensor", "ned"):
            raise ValueError(f"frame must be sensor or ned, not {self.frame!r}")

    def __call__(self, ping: Ping) -> Tracks:
        """The tracks at the stamp of the ping."""
        if self._stamp_ns is not None and ping.stamp_ns <= self._stamp_ns:
            raise ValueError(
                f"ping seq {ping.seq} has stamp {ping.stamp_ns} ns, not after the last ping's "
                f"{self._stamp_ns} ns; pings must come in the order of their stamps"
            )
        grid = grid_of(ping, self.resolution_m, float(np.radians(self.beamwidth_deg)))
        pose = self._pose_of(ping)
        motion = self._motion(self._stamp_ns, self._pose, ping.stamp_ns, pose)
        self._stamp_ns = ping.stamp_ns
        moved_rad = self._bank.predict(motion)
        self._scouts = predicted(self._scouts, motion)
        if grid is None or pose is None:
            self._past, self._power = [], NO_PLANE.copy()
            return self._message(ping, Bank())
        if grid != self._grid:
            self._changed(grid)
        self._pose = pose
        tables, rules = self._tables_for(grid), self._rules(grid)
        ratios = self._ratios(ping, grid, tables)
        half = halves(ratios.code, grid.closed)
        lost = self._bank.follow(ratios, half, tables, grid, motion, moved_rad, rules)
        ended = self._bank.ended(lost)
        self._search(ratios, half, grid, rules, pose, ping.stamp_ns)
        return self._message(ping, ended)

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            **self._bank.snapshot(),
            "scouts": self._scouts.copy(),
            "past": [one.saved() for one in self._past],
            "power": self._power.copy(),
            "correlation": self._correlation,
            "grid": None if self._grid is None else np.array(self._grid, float),
            "pose": None if self._pose is None else np.array(self._pose),
            "stamp_ns": self._stamp_ns,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._bank = Bank.restored(saved)
        self._scouts = np.array(saved["scouts"], float).reshape(-1, COLUMNS)
        self._power = np.array(saved["power"], np.float32)
        self._correlation = float(saved["correlation"])
        self._grid = None if saved["grid"] is None else grid_from(saved["grid"])
        closed = self._grid is not None and self._grid.closed
        self._past = [Past.restored(one, closed) for one in saved["past"]]
        self._pose = None if saved["pose"] is None else place_from(saved["pose"])
        self._stamp_ns = None if saved["stamp_ns"] is None else int(saved["stamp_ns"])

    def _pose_of(self, ping: Ping) -> Place | None:
        if self.frame == "sensor":
            return 0.0, 0.0, 0.0
        nav = ping.nav
        if nav is None or not np.isfinite([*nav.position_m[:2], nav.attitude_rad[2]]).all():
            return None
        pose = sensor_pose(nav, ping.mount)
        return pose.north_m, pose.east_m, pose.heading_rad

    def _motion(self, old_ns: int | None, old: Place | None, stamp_ns: int, pose: Place | None) -> Motion:
        """How things may have moved from a stamp and pose to another."""
        dt_s = 0.0 if old_ns is None else (stamp_ns - old_ns) * 1e-9
        own = own_motion(Pose(*old), Pose(*pose)) if old is not None and pose is not None else (0.0, 0.0, 0.0)
        return Motion(dt_s, self.v_max_mps, self.sigma_v_mps2, self.cross_mps, *own)

    def _changed(self, grid: Grid) -> None:
        """Begin anew on another grid: only the tracks and scouts stay."""
        self._past, self._power = [], NO_PLANE.copy()
        if self._grid is None or grid.n_beams != self._grid.n_beams or grid.first_rad != self._grid.first_rad:
            self._bank.on(grid)
        self._grid = grid

    def _reach(self, grid: Grid) -> int:
        return max(int(self.reference_m / grid.cell_m + 0.5), 8)

    def _tables_for(self, grid: Grid) -> Tables:
        references = max(2.0 * self._reach(grid) * min(grid.cell_m / self.resolution_m, 1.0), 4.0)
        correlation = math.floor(CAUTION * self._correlation / CORRELATION_STEP) * CORRELATION_STEP
        tables = self._tables
        if tables is None or (tables.references, tables.correlation) != (references, correlation):
            tables = self._tables = tables_of(self.snr_db, references, self.max_gain, correlation)
        return tables

    def _ratios(self, ping: Ping, grid: Grid, tables: Tables) -> RatioMap:
        guard, reach = int(self.guard_m / grid.cell_m + 0.5), self._reach(grid)
        ratios = ratio_map(
            ping.amplitude, ping.valid, self._power, tables.expected, guard, reach, tables.weakest
        )
        if self._power.size:
            measured = power_correlation(ratios.power, self._power)
            weight = MEMORY if self._correlation else 1.0
            self._correlation += weight * (measured - self._correlation)
        self._power = ratios.power
        return ratios

    def _rules(self, grid: Grid) -> Rules:
        limit = float(np.log(grid.resolution_cells / self.false_per_ping))
        level = 10.0 ** (self.snr_db / 10.0)
        sigmas = (self.sigma_v_mps2, self.agile_mps2)
        return Rules(
            self.start_score, limit, self.keep_score, self.exclusion_m, self.max_tracks, level, sigmas
        )

    def _search(
        self, ratios: RatioMap, half: Codes, grid: Grid, rules: Rules, pose: Place, stamp_ns: int
    ) -> None:
        """Take the scouts through the ping, begin new ones, and make tracks of the best."""
        row, beam = candidates(ratios.power, self.peak_power, grid.closed, 2 * self.max_scouts)
        peaks = Peaks(row, beam, np.log(ratios.decoded[ratios.code[row, beam]]).astype(float))
        since = [self._motion(one.stamp_ns, one.pose, stamp_ns, pose) for one in self._past]
        most = self.max_scouts // KINDS
        fresh = fresh_scouts(peaks, self._past, since, ratios.decoded, grid, most)
        now = Motion(0.0, self.v_max_mps, self.sigma_v_mps2, self.cross_mps, 0.0, 0.0, 0.0)
        scouts = followed(self._scouts, half, ratios.decoded, grid, now)
        scouts = with_agile(scouts, self.agile_mps2, AGILE_SCORE, AGILE_ODDS)
        scouts = np.concatenate([scouts, fresh])
        settled = self._bank.confirmed & ~self._bank.astray
        scouts = scouts[~self._bank.near(scouts, settled, self.exclusion_m)]
        scouts = best_of_cells(scouts, grid, RATE_CELL_MPS, 0.0, self.max_scouts)
        scouts = by_range(scouts)
        self._bank.recall(scouts, grid, rules)
        self._bank.begin(scouts, grid, rules)
        self._scouts = scouts
        self._past = [Past(stamp_ns, pose, half, peaks), *self._past[: self.look_back - 1]]

    def _message(self, ping: Ping, ended: Bank) -> Tracks:
        """All tracks at the ping's stamp, and the confirmed ones that it has ended as lost."""
        bank = self._bank
        path = np.concatenate([ended.path, bank.path])
        row = np.concatenate([ended.row, bank.row])
        state, covariance = cartesian(path, path[:, RANGE] / ping.sound_speed_mps)
        if self.frame == "ned":
            pose = Pose(*self._pose) if self._pose is not None else Pose()
            state[:, :2] = pose.to_ned(state[:, :2])
            state[:, 2:] = state[:, 2:] @ turn(pose.heading_rad).T
            both = np.kron(np.eye(2), turn(pose.heading_rad))
            covariance = both @ covariance @ both.T
        return Tracks(
            ping.seq,
            ping.stamp_ns,
            row["id"].copy(),
            row["status"].astype(np.uint8),
            state,
            covariance,
            row["hits"].copy(),
            row["age"].copy(),
            self.frame,
        )


@hookimpl
def fls_node() -> type[MultiPingIntegration]:
    """The kind `multi-ping-integration`."""
    return MultiPingIntegration
