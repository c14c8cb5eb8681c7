"""Track before detect: integrate likelihood ratios over pings along all paths that a target may take."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import NavState, Ping, Tracks, TrackStatus, hookimpl
from fls_flow.geometry import Pose, sensor_pose, turn, wrap
from fls_flow.messages import Frame
from fls_trackers.tbd_ratio import NO_PLANE, RatioMap, candidates, power_correlation, ratio_map, ratio_table
from fls_trackers.tbd_scouts import (
    BEARING,
    COLUMNS,
    P_RR,
    RANGE,
    RATE,
    SCORE,
    Grid,
    Motion,
    best_of_cells,
    born,
    followed,
    predicted,
)
from fls_trackers.tbd_tracks import (
    bearings_of,
    cartesian,
    first_bearings,
    likeliest_bearing,
    spread_bearings,
)

__all__ = ["MultiPingIntegration"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

ROW = np.dtype(
    [("id", np.int64), ("status", np.int64), ("hits", np.int64), ("age", np.int64), ("level", np.float64)]
)
RATE_CELL_MPS = 0.1  # scouts closer than this in range rate count as one
STRONGEST_DB = 15  # up to which the ratios of a track follow its own echoes
WIDEST = 6.0  # resolution cells of range: a track less certain than that is no track
LEVEL_MEMORY = 0.1  # weight of the newest echo in a track's level
MEMORY = 0.1  # weight of the newest ping in the clutter's correlation
LEAST_CORRELATION = 0.02  # below it, what is measured is chance
ORIGIN = Pose()


def _no_rows() -> npt.NDArray[np.void]:
    return np.zeros(0, ROW)


def _no_scouts() -> FloatArray:
    return np.zeros((0, COLUMNS))


def _no_peaks() -> tuple[IntArray, IntArray, FloatArray]:
    return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)


@dataclass
class MultiPingIntegration:
    """Tracks of echoes too weak to be detected in one ping, from the pings themselves.

    Each cell becomes a likelihood ratio of target plus clutter, for a target of `snr_db`, against Rayleigh
    clutter whose mean is that of `reference_m` before and behind a guard of `guard_m` in the same beam; a
    clutter that persists from ping to ping is allowed for by its measured correlation. Pairs of peaks of
    `peak_power` times the clutter in consecutive pings, within `v_max_mps`, begin scouts: paths of nearly
    constant velocity, whose log ratios add up ping by ping and which the ratios around them steer. At most
    `max_scouts` of the best live on.

    A scout of score `start_score` becomes a tentative track, which keeps the probabilities of all bearings,
    so that the lobes of a sparse array compete inside it; within `exclusion_m` of range no other track
    begins at any bearing. The track is confirmed at ln(cells / false_per_ping): by Ville's inequality, at
    most `false_per_ping` false tracks per ping are confirmed in clutter as assumed. A track ends when its
    score, at most 10 above that, has fallen by `keep_score`, or when its range is no longer known.

    Ranges and bearings must be even; a pulse of bandwidth B has `resolution_m` c / (2 B). With `frame: ned`
    own motion is taken out by `ping.nav`; without position or heading tracks are only predicted.

    Raises ValueError when a stamp does not increase or cells are not even; the state stays as it was.

    Source: recursive Bayesian track before detect (Ristic, Arulampalam & Gordon 2004, chapter 11), with
    paths kept as a list instead of a grid.
    """

    snr_db: float = 3.0
    v_max_mps: float = 2.0
    sigma_v_mps2: float = 0.01
    cross_mps: float = 0.5
    resolution_m: float = 0.076
    beamwidth_deg: float = 2.2
    guard_m: float = 0.16
    reference_m: float = 2.4
    peak_power: float = 3.5
    max_scouts: int = 40_000
    start_score: float = 10.0
    false_per_ping: float = 1e-2
    keep_score: float = 15.0
    exclusion_m: float = 1.5
    max_gain: float = 7.0
    max_tracks: int = 60
    frame: Frame = "sensor"

    _scouts: FloatArray = field(default_factory=_no_scouts, init=False, repr=False)
    _tracks: FloatArray = field(default_factory=_no_scouts, init=False, repr=False)
    _belief: FloatArray = field(default_factory=lambda: np.zeros((0, 0)), init=False, repr=False)
    _rows: npt.NDArray[np.void] = field(default_factory=_no_rows, init=False, repr=False)
    _peaks: tuple[IntArray, IntArray, FloatArray] = field(default_factory=_no_peaks, init=False, repr=False)
    _power: npt.NDArray[np.float32] = field(default_factory=NO_PLANE.copy, init=False, repr=False)
    _tables: tuple[float, npt.NDArray[np.float32]] | None = field(default=None, init=False, repr=False)
    _correlation: float = field(default=0.0, init=False, repr=False)
    _grid: Grid | None = field(default=None, init=False, repr=False)
    _pose: tuple[float, float, float] | None = field(default=None, init=False, repr=False)
    _stamp_ns: int | None = field(default=None, init=False, repr=False)
    _next_id: int = field(default=1, init=False, repr=False)

    def __post_init__(self) -> None:
        positive = ("v_max_mps", "sigma_v_mps2", "cross_mps", "resolution_m", "beamwidth_deg", "reference_m")
        for name in (*positive, "peak_power", "max_gain", "keep_score", "false_per_ping"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive and finite, not {getattr(self, name)}")
        for name in ("guard_m", "exclusion_m"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and not negative, not {getattr(self, name)}")
        for name in ("snr_db", "start_score"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, not {getattr(self, name)}")
        for name in ("max_scouts", "max_tracks"):
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
        grid = _grid_of(ping, self.resolution_m, float(np.radians(self.beamwidth_deg)))
        pose = self._pose_of(ping.nav, ping)
        motion = self._motion(ping.stamp_ns, pose)
        self._stamp_ns = ping.stamp_ns
        before = self._tracks[:, BEARING]
        self._tracks, self._scouts = predicted(self._tracks, motion), predicted(self._scouts, motion)
        moved_rad = wrap(self._tracks[:, BEARING] - before)
        self._rows = self._rows.copy()
        self._rows["age"] += 1
        if grid is None or pose is None:
            self._peaks, self._power = _no_peaks(), NO_PLANE.copy()
            return self._message(ping, np.zeros(len(self._rows), bool))
        if grid != self._grid:
            self._changed(grid)
        self._pose = pose
        ratios = self._ratios(ping, grid)
        lost = self._follow(ratios, grid, motion, moved_rad)
        self._search(ratios, grid, motion)
        answer = self._message(ping, lost)
        self._drop(lost)
        return answer

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        rows = {name: self._rows[name].copy() for name in ROW.names or ()}
        row, beam, ratio = self._peaks
        return {
            "scouts": self._scouts.copy(),
            "tracks": self._tracks.copy(),
            "belief": self._belief.copy(),
            "peak_row": row.copy(),
            "peak_beam": beam.copy(),
            "peak_ratio": ratio.copy(),
            "power": self._power.copy(),
            "correlation": self._correlation,
            "grid": None if self._grid is None else np.array(self._grid, float),
            "pose": None if self._pose is None else np.array(self._pose),
            "stamp_ns": self._stamp_ns,
            "next_id": self._next_id,
            **rows,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._scouts = np.array(saved["scouts"], float).reshape(-1, COLUMNS)
        self._tracks = np.array(saved["tracks"], float).reshape(-1, COLUMNS)
        self._belief = np.array(saved["belief"], float)
        self._rows = np.zeros(len(saved["id"]), ROW)
        for name in ROW.names or ():
            self._rows[name] = saved[name]
        row, beam = (np.array(saved[f"peak_{name}"], np.int64) for name in ("row", "beam"))
        self._peaks = row, beam, np.array(saved["peak_ratio"], float)
        self._power = np.array(saved["power"], np.float32)
        self._correlation, self._next_id = float(saved["correlation"]), int(saved["next_id"])
        self._grid = None if saved["grid"] is None else _grid_from(saved["grid"])
        self._pose = None if saved["pose"] is None else _three(saved["pose"])
        self._stamp_ns = None if saved["stamp_ns"] is None else int(saved["stamp_ns"])

    def _pose_of(self, nav: NavState | None, ping: Ping) -> tuple[float, float, float] | None:
        if self.frame == "sensor":
            return 0.0, 0.0, 0.0
        if nav is None or not np.isfinite([*nav.position_m[:2], nav.attitude_rad[2]]).all():
            return None
        pose = sensor_pose(nav, ping.mount)
        return pose.north_m, pose.east_m, pose.heading_rad

    def _motion(self, stamp_ns: int, pose: tuple[float, float, float] | None) -> Motion:
        dt_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        way, turned = np.zeros(2), 0.0
        if pose is not None and self._pose is not None:
            old = Pose(*self._pose)
            way = old.to_sensor(np.array(pose[:2]))
            turned = float(wrap(pose[2] - old.heading_rad))
        return Motion(
            dt_s,
            self.v_max_mps,
            self.sigma_v_mps2,
            self.cross_mps,
            float(way[0]),
            float(way[1]),
            turned,
        )

    def _changed(self, grid: Grid) -> None:
        """Begin anew on another grid: only the tracks and scouts stay."""
        self._peaks, self._power = _no_peaks(), NO_PLANE.copy()
        if self._grid is None or grid.n_beams != self._grid.n_beams or grid.first_rad != self._grid.first_rad:
            n = len(self._tracks)
            places = [first_bearings(one, np.zeros(1), grid) for one in self._tracks[:, BEARING, None]]
            self._belief = np.array(places).reshape(n, grid.n_beams)
        self._grid = grid

    def _ratios(self, ping: Ping, grid: Grid) -> RatioMap:
        guard = int(self.guard_m / grid.cell_m + 0.5)
        reach = max(int(self.reference_m / grid.cell_m + 0.5), 8)
        references = max(2.0 * reach * min(grid.cell_m / self.resolution_m, 1.0), 4.0)
        table = ratio_table(10.0 ** (self.snr_db / 10.0), references, self.max_gain)
        if self._tables is None or self._tables[0] != references:
            levels = 10.0 ** (np.arange(1, STRONGEST_DB + 1) / 10.0)
            rows = np.stack([ratio_table(float(one), references, self.max_gain) for one in levels])
            self._tables = references, rows
        known = self._correlation if self._correlation > LEAST_CORRELATION else 0.0
        ratios = ratio_map(ping.amplitude, ping.valid, self._power, known, guard, reach, table)
        if self._power.size:
            measured = power_correlation(ratios.power, self._power)
            weight = MEMORY if self._correlation else 1.0
            self._correlation += weight * (measured - self._correlation)
        self._power = ratios.power
        return ratios

    @property
    def _limit(self) -> float:
        """The score at which a track is confirmed."""
        grid = self._grid
        if grid is None:
            return np.inf
        around = grid.n_beams * min(abs(grid.beam_rad) / grid.beamwidth_rad, 1.0)
        along = grid.n_ranges * min(grid.cell_m / grid.resolution_m, 1.0)
        return float(np.log(max(around * along, 1.0) / self.false_per_ping))

    def _follow(self, ratios: RatioMap, grid: Grid, motion: Motion, moved_rad: FloatArray) -> BoolArray:
        """Take the tracks through the ping; which of them are lost, (n,)."""
        tracks, rows = self._tracks, self._rows
        if not len(tracks):
            return np.zeros(0, bool)
        sd = motion.sigma_v_mps2 * motion.dt_s**2 / np.maximum(tracks[:, RANGE], 1.0)
        belief = spread_bearings(self._belief, moved_rad, sd, grid)
        tables = self._tables[1] if self._tables is not None else ratios.ratio[:0]
        belief, gain, echo = bearings_of(tracks, belief, rows["level"], ratios.excess, tables, grid)
        rows["level"] += LEVEL_MEMORY * (echo - rows["level"])
        rows["hits"] += gain > 0.0
        stepped = followed(tracks, ratios.ratio, grid)
        outside = np.isneginf(stepped[:, SCORE])
        gain[outside] = 0.0
        stepped[:, SCORE] = np.minimum(tracks[:, SCORE] + gain, self._limit + 10.0)
        outside |= np.sqrt(stepped[:, P_RR]) > WIDEST * grid.resolution_m
        self._tracks, self._belief = likeliest_bearing(stepped, belief, grid), belief
        rows["status"][(self._tracks[:, SCORE] >= self._limit) & ~outside] = TrackStatus.CONFIRMED
        confirmed = rows["status"] == TrackStatus.CONFIRMED
        least = np.where(confirmed, self._limit + 10.0 - self.keep_score, 0.5 * self.start_score)
        return (self._tracks[:, SCORE] < least) | outside | self._repeats(grid)

    def _repeats(self, grid: Grid) -> BoolArray:
        """Which tracks have come to be where another one of a higher score is, (n,)."""
        tracks = self._tracks
        near = np.abs(tracks[:, None, RANGE] - tracks[None, :, RANGE]) < 2.0 * grid.resolution_m
        near &= np.abs(tracks[:, None, RATE] - tracks[None, :, RATE]) < RATE_CELL_MPS
        off = wrap(tracks[:, None, BEARING] - tracks[None, :, BEARING])
        near &= np.abs(off) < grid.beamwidth_rad
        score, order = tracks[:, SCORE], np.arange(len(tracks))
        better = (score[None, :] > score[:, None]) | (
            (score[None, :] == score[:, None]) & (order[None, :] < order[:, None])
        )
        repeats: BoolArray = (near & better).any(axis=1)
        return repeats

    def _search(self, ratios: RatioMap, grid: Grid, motion: Motion) -> None:
        """Take the scouts through the ping, begin new ones, and make tracks of the best."""
        row, beam = candidates(ratios.power, self.peak_power, grid.closed, 4 * self.max_scouts)
        gain = np.log(ratios.ratio[row, beam]).astype(float)
        scouts = followed(self._scouts, ratios.ratio, grid)
        if motion.dt_s > 0.0:
            fresh = born(row, beam, *self._peaks[:2], gain, self._peaks[2], grid, motion, 1.0)
            scouts = np.concatenate([scouts, fresh])
        self._peaks = row, beam, gain
        scouts = scouts[~self._near_tracks(scouts)]
        scouts = best_of_cells(scouts, grid, RATE_CELL_MPS, 0.0, self.max_scouts)
        while len(scouts) and len(self._tracks) < self.max_tracks:
            best = int(np.argmax(scouts[:, SCORE]))
            if not scouts[best, SCORE] >= self.start_score:
                break
            self._start(scouts, best, grid)
            scouts = scouts[~self._near_tracks(scouts)]
        self._scouts = scouts

    def _near_tracks(self, scouts: FloatArray) -> BoolArray:
        """Which scouts lie in the range that a track excludes, at any bearing, (n,)."""
        near = np.zeros(len(scouts), bool)
        for range_m in self._tracks[:, RANGE]:
            near |= np.abs(scouts[:, RANGE] - range_m) < self.exclusion_m
        return near

    def _start(self, scouts: FloatArray, best: int, grid: Grid) -> None:
        """Make a track of a scout; others that move with it say how probable its bearings are."""
        one = scouts[best]
        along = np.abs(scouts[:, RANGE] - one[RANGE]) < 4.0 * grid.resolution_m
        along &= np.abs(scouts[:, RATE] - one[RATE]) < 2.0 * RATE_CELL_MPS
        belief = first_bearings(scouts[along, BEARING], scouts[along, SCORE], grid)
        row = np.zeros(1, ROW)
        row["id"], row["hits"], row["age"] = self._next_id, 2, 1
        row["level"] = 10.0 ** (self.snr_db / 10.0)
        row["status"] = TrackStatus.CONFIRMED if one[SCORE] >= self._limit else TrackStatus.TENTATIVE
        self._next_id += 1
        self._rows = np.concatenate([self._rows, row])
        self._tracks = np.concatenate([self._tracks, one[None]])
        self._belief = np.concatenate([self._belief.reshape(-1, grid.n_beams), belief[None]])

    def _message(self, ping: Ping, lost: BoolArray) -> Tracks:
        """All tracks at the ping's stamp; of the lost ones, those that were confirmed."""
        lost = np.concatenate([lost, np.zeros(len(self._rows) - lost.size, bool)])
        status = np.where(lost, int(TrackStatus.LOST), self._rows["status"])
        shown = ~(lost & (self._rows["status"] == TrackStatus.TENTATIVE))
        tracks, rows = self._tracks[shown], self._rows[shown]
        state, covariance = cartesian(tracks, tracks[:, RANGE] / ping.sound_speed_mps)
        if self.frame == "ned":
            pose = Pose(*self._pose) if self._pose is not None else ORIGIN
            state[:, :2] = pose.to_ned(state[:, :2])
            state[:, 2:] = state[:, 2:] @ turn(pose.heading_rad).T
            both = np.kron(np.eye(2), turn(pose.heading_rad))
            covariance = both @ covariance @ both.T
        return Tracks(
            ping.seq,
            ping.stamp_ns,
            rows["id"].copy(),
            status[shown].astype(np.uint8),
            state,
            covariance,
            rows["hits"].copy(),
            rows["age"].copy(),
            self.frame,
        )

    def _drop(self, lost: BoolArray) -> None:
        keep = np.ones(len(self._rows), bool)
        keep[: lost.size] = ~lost
        self._rows, self._tracks, self._belief = self._rows[keep], self._tracks[keep], self._belief[keep]


def _grid_of(ping: Ping, resolution_m: float, beamwidth_rad: float) -> Grid | None:
    """The grid of a ping; None for one without cells."""
    if ping.range_m.size < 3 or ping.bearing_rad.size < 3:
        return None
    cell_m, beam_rad = float(np.mean(np.diff(ping.range_m))), float(np.mean(np.diff(ping.bearing_rad)))
    for name, table, step in (("range_m", ping.range_m, cell_m), ("bearing_rad", ping.bearing_rad, beam_rad)):
        if not np.allclose(np.diff(table), step, rtol=0.0, atol=0.05 * abs(step)):
            raise ValueError(f"ping seq {ping.seq}: {name} is not evenly spaced, as integration needs it")
    gap = 2.0 * np.pi - abs(float(ping.bearing_rad[-1] - ping.bearing_rad[0]))
    return Grid(
        float(ping.range_m[0]),
        cell_m,
        ping.range_m.size,
        float(ping.bearing_rad[0]),
        beam_rad,
        ping.bearing_rad.size,
        abs(gap - abs(beam_rad)) < 0.5 * abs(beam_rad),
        resolution_m,
        beamwidth_rad,
    )


def _grid_from(values: Any) -> Grid:
    first_m, cell_m, n_ranges, first_rad, beam_rad, n_beams, closed, resolution_m, beamwidth_rad = values
    return Grid(
        float(first_m),
        float(cell_m),
        int(n_ranges),
        float(first_rad),
        float(beam_rad),
        int(n_beams),
        bool(closed),
        float(resolution_m),
        float(beamwidth_rad),
    )


def _three(values: Any) -> tuple[float, float, float]:
    north, east, heading = (float(one) for one in values)
    return north, east, heading


@hookimpl
def fls_node() -> type[MultiPingIntegration]:
    """The kind `multi-ping-integration`."""
    return MultiPingIntegration
