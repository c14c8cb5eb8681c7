"""Track blobs by nearly constant velocity and global assignment, confirmed by count."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Tracks, TrackStatus, hookimpl
from fls_flow.geometry import Pose, sensor_pose, to_polar, wrap
from fls_flow.messages import Frame
from fls_trackers.auction import Pairs, auctioned, solved
from fls_trackers.conversion import convert, noise_at
from fls_trackers.kalman import update
from fls_trackers.ncv_bank import ROW, NcvBank, Rows
from fls_trackers.ncv_lobes import companions, lobe_response
from fls_trackers.ncv_steps import blobs_in_gates

__all__ = ["NcvAuction"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
log = logging.getLogger(__name__)

ORIGIN = Pose()
MEMORY = 20  # pings over which blobs are counted
WINDOW = 62  # bits of a track's history
SETTLED = 3  # blobs after which a track's range rate is known well enough to compare it
LOBE_MARGIN = float(np.log(2.0) / 2.0)  # 3 dB above what the array would show of the stronger one


@dataclass(frozen=True, slots=True)
class _Scan:
    """The blobs of a ping, in order of range."""

    polar: FloatArray  # (m, 2) range (m) and bearing (rad)
    y: FloatArray  # (m, 2) debiased, in the frame of the tracks
    R: FloatArray  # (m, 2, 2)
    time_ns: IntArray  # (m,) when the sound met each
    level: FloatArray  # (m,) log amplitude
    gain: FloatArray  # (m,) what it adds to a score
    pose: Pose
    sound_speed_mps: float


@dataclass
class NcvAuction:
    """Tracks of blobs, at the stamp of the ping, each updated by the one blob that the assignment gives it.

    Blobs become Cartesian by debiased conversion with `range_sd_m` and `bearing_sd_deg`. A track's state
    stands at the time of its last blob, stamp + range / c, and is predicted over the blobs' own times. A blob
    must lie within `gate_range_m` and `gate_bearing_deg` of a predicted track and have
    exp(-d2 / 2) >= `gate_threshold`, d2 the statistical distance. Of the gated pairs the assignment takes as
    many as possible, then the least sum of d2; with `cost: likelihood` the largest sum of the log
    likelihood ratios below, of pairs that say more for a target than a miss does, so that vague tracks are
    not favoured; with `priority: confirmed` confirmed tracks choose first. Blobs left over
    begin tentative tracks at rest, with P0 = blkdiag(R, v_max^2 I).

    A track is confirmed with more than `confirm_hits` blobs and a log likelihood ratio of `confirm_score`
    against clutter: each blob adds ln(p_d N(nu; S) / lambda), each miss ln(1 - p_d (1 - gate_threshold)),
    with lambda the mean number of blobs per ping (over 20 pings) per metre and radian, over the range. If the
    detector gives amplitudes a as ratios to the clutter's root mean square, `snr_db` adds what they tell:
    with e = a^2 - (least a^2 of the ping) and the ratio s, s e / (1 + s) - ln(1 + s). A track ends when fewer
    than `keep_hits` of its last `keep_pings` pings gave it a blob; a younger one, with more than
    keep_pings - keep_hits misses. A tentative one also ends when its score falls below `drop_score`;
    below `report_score` it is kept without being reported.

    A sparse array shows a target at several bearings. Of two tracks whose ranges differ by at most
    `lobe_range_m` (0: never compared) and whose range rates by `lobe_speed_mps`, the one with the lower mean
    log amplitude is not confirmed, and ends once this has held for `lobe_pings` pings. With the hydrophones'
    positions in the sensor frame, `hydrophones_m`, and the band of the pulse, only a track up to 3 dB above
    what the array shows of the stronger one at that bearing counts as its lobe.

    With `frame: ned` tracks are in north and east; without position or heading they go unseen for the ping.
    Beyond `max_tracks` only the strongest blobs begin tracks.

    Raises ValueError when a stamp does not increase or a blob is not finite; the state stays as it was.

    Source: Abu 2024, section V, with sigma_v in m/s^2 and the assignment of most pairs first; the time of
    reflection instead of arrival, priority, likelihood and lobes are ours.
    """

    range_sd_m: float = 0.3
    bearing_sd_deg: float = 5.0
    sigma_v_mps2: float = 0.05
    v_max_mps: float = 2.0
    gate_range_m: float = 10.0
    gate_bearing_deg: float = 30.0
    gate_threshold: float = 0.1
    assignment: Literal["auction", "hungarian"] = "auction"
    cost: Literal["distance", "likelihood"] = "distance"
    priority: Literal["none", "confirmed"] = "none"
    confirm_hits: int = 8
    confirm_score: float = -np.inf
    p_d: float = 0.8
    snr_db: float | None = None
    keep_hits: int = 8
    keep_pings: int = 15
    drop_score: float = -np.inf
    report_score: float = -np.inf
    lobe_range_m: float = 0.5
    lobe_speed_mps: float = 0.3
    lobe_pings: int = 8
    hydrophones_m: tuple[tuple[float, float], ...] = ()
    band_hz: tuple[float, float] = (31_000.0, 41_000.0)
    frame: Frame = "sensor"
    max_tracks: int = 20_000

    _bank: NcvBank = field(default_factory=NcvBank, init=False, repr=False)
    _next_id: int = field(default=1, init=False, repr=False)
    _stamp_ns: int | None = field(default=None, init=False, repr=False)
    _density: tuple[float, int] = field(default=(0.0, 0), init=False, repr=False)  # per m rad, pings it is of
    _warned: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        positive = ("range_sd_m", "bearing_sd_deg", "sigma_v_mps2", "v_max_mps", "gate_range_m")
        for name in (*positive, "gate_bearing_deg", "lobe_speed_mps"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive and finite, not {getattr(self, name)}")
        if not 0.0 < self.gate_threshold < 1.0:
            raise ValueError(f"gate_threshold must lie between 0 and 1, not {self.gate_threshold}")
        if not 0.0 < self.p_d < 1.0 or not max(self.confirm_score, self.drop_score) < np.inf:
            raise ValueError(
                f"p_d {self.p_d} must lie between 0 and 1, "
                f"confirm_score {self.confirm_score} and drop_score {self.drop_score} be numbers or -inf"
            )
        if not 0.0 <= self.lobe_range_m < np.inf:
            raise ValueError(f"lobe_range_m must be finite and not negative, not {self.lobe_range_m}")
        if not 1 <= self.keep_hits <= self.keep_pings <= WINDOW:
            raise ValueError(
                f"keep_hits {self.keep_hits} of keep_pings {self.keep_pings}: needs 1 to {WINDOW}"
            )
        for name, least in (("confirm_hits", 0), ("lobe_pings", 1), ("max_tracks", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}")
        if not 0.0 <= self.band_hz[0] < self.band_hz[1] < np.inf:
            raise ValueError(f"band_hz must be two increasing frequencies, not {self.band_hz}")
        self._check_words()

    def _check_words(self) -> None:
        words = {
            "assignment": ("auction", "hungarian"),
            "cost": ("distance", "likelihood"),
            "priority": ("none", "confirmed"),
            "frame": ("sensor", "ned"),
        }
        for name, allowed in words.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be {' or '.join(allowed)}, not {getattr(self, name)!r}")
        if len(self.hydrophones_m) == 1 or not np.isfinite(np.array(self.hydrophones_m, float)).all():
            raise ValueError(f"hydrophones_m must be two or more places, not {self.hydrophones_m}")

    def __call__(self, detections: Detections) -> Tracks:
        """The tracks at the stamp of `detections`, after its update."""
        d = detections
        if self._stamp_ns is not None and d.stamp_ns <= self._stamp_ns:
            raise ValueError(
                f"ping seq {d.seq} has stamp {d.stamp_ns} ns, not after the last ping's {self._stamp_ns} ns; "
                "pings must come in the order of their stamps"
            )
        if not (np.isfinite(d.range_m).all() and np.isfinite(d.bearing_rad).all()):
            raise ValueError(f"ping seq {d.seq}: a detection's range or bearing is not finite")
        scan = self._scan(d)
        self._stamp_ns = d.stamp_ns
        if scan is None:
            bank, free = self._bank, np.zeros(0, np.int64)
            got = np.full(len(bank), -1)
        else:
            self._density = self._density_after(d)
            bank, got = self._updated(scan)
            free = np.setdiff1d(np.arange(len(d)), got)
        bank = self._counted(bank, got, d.stamp_ns, scan)
        if scan is not None:
            bank = bank.joined(self._begun(scan, free, int(np.count_nonzero(_alive(bank.rows))), d.seq))
        self._bank = bank.select(_alive(bank.rows))
        status = bank.rows["status"]
        quiet = (status == TrackStatus.TENTATIVE) & (bank.rows["score"] < self.report_score)
        shown = bank.select(~quiet & ((status != TrackStatus.LOST) | (bank.rows["hits"] > 0)))
        return shown.message(d.seq, d.stamp_ns, self.frame, self.sigma_v_mps2)

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            **self._bank.snapshot(),
            "next_id": self._next_id,
            "stamp_ns": self._stamp_ns,
            "warned": self._warned,
            "density": self._density[0],
            "pings": self._density[1],
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._bank = NcvBank.restored(saved)
        self._next_id, self._warned = int(saved["next_id"]), bool(saved["warned"])
        self._density = float(saved["density"]), int(saved["pings"])
        self._stamp_ns = None if saved["stamp_ns"] is None else int(saved["stamp_ns"])

    def _scan(self, d: Detections) -> _Scan | None:
        """The blobs in the frame of the tracks; None when the sonar's place in it is not known."""
        pose = ORIGIN
        if self.frame == "ned":
            nav = d.view.nav
            if nav is None or not np.isfinite([*nav.position_m[:2], nav.attitude_rad[2]]).all():
                return None
            pose = sensor_pose(nav, d.view.mount)
        order = np.lexsort((d.bearing_rad, d.range_m))
        range_m, bearing_rad = d.range_m[order], wrap(d.bearing_rad[order])
        y, R = convert(range_m, bearing_rad, self.range_sd_m, float(np.radians(self.bearing_sd_deg)), pose)
        c = d.view.sound_speed_mps
        time_ns = d.stamp_ns + np.rint(range_m / c * 1e9).astype(np.int64)
        level = np.log(np.maximum(np.nan_to_num(d.amplitude[order]), 1e-30))
        gain = np.zeros(level.size)
        if self.snr_db is not None:
            gain = _amplitude_gain(level, 10.0 ** (self.snr_db / 10.0))
        return _Scan(np.stack([range_m, bearing_rad], axis=1), y, R, time_ns, level, gain, pose, c)

    def _density_after(self, d: Detections) -> tuple[float, int]:
        """Mean number of blobs per metre and radian with those of this ping, at least one in 20 pings."""
        depth = d.view.range_max_m - d.view.range_min_m
        width = float(np.ptp(d.view.bearing_rad)) + abs(d.view.beam_spacing_rad) if depth > 0.0 else 0.0
        if not (depth > 0.0 and width > 0.0):
            depth, width = max(float(d.range_m.max(initial=0.0)), 1.0), 2.0 * np.pi
        mean, pings = self._density
        pings = min(pings + 1, MEMORY)
        mean += (len(d) / (depth * width) - mean) / pings
        return max(mean, 1.0 / (MEMORY * depth * width)), pings

    def _updated(self, scan: _Scan) -> tuple[NcvBank, IntArray]:
        """The tracks after their blobs, and the blob of each, -1 for none."""
        bank, rows = self._bank, self._bank.rows
        # The time of a track's echo in this ping, from where it is at about that time.
        stamp_ns = int(self._stamp_ns or 0)
        near, _ = to_polar(scan.pose.to_sensor(bank.at(stamp_ns, self.sigma_v_mps2)[0][:, :2]))
        expected_ns = stamp_ns + np.rint(near / scan.sound_speed_mps * 1e9).astype(np.int64)
        state, covariance = bank.at(np.maximum(expected_ns, rows["time_ns"]), self.sigma_v_mps2)
        got = self._assigned(scan, state, covariance)
        seen = np.flatnonzero(got >= 0)
        time_ns = rows["time_ns"].copy()
        time_ns[seen] = np.maximum(scan.time_ns[got[seen]], time_ns[seen])
        x, P = bank.at(time_ns, self.sigma_v_mps2)
        R = noise_at(x, self.range_sd_m, float(np.radians(self.bearing_sd_deg)), scan.pose)
        start = np.concatenate([[0], np.cumsum(got >= 0)])
        none = (got < 0).astype(float)
        gain = _log_likelihoods(x[seen], P[seen], R[seen], scan.y[got[seen]]) + self._gains(scan)[got[seen]]
        x, P = update(x, P, R, scan.y, start, got[seen], np.ones(seen.size), none)
        new = rows.copy()
        new["time_ns"] = time_ns
        new["score"][got < 0] += self._miss
        new["score"][seen] += gain
        hits = rows["hits"][seen]
        new["level"][seen] = (rows["level"][seen] * hits + scan.level[got[seen]]) / (hits + 1)
        new["hits"][seen] += 1
        return NcvBank(x, P, new), got

    def _assigned(self, scan: _Scan, state: FloatArray, covariance: FloatArray) -> IntArray:
        got = np.full(len(state), -1)
        confirmed = self._bank.rows["status"] == TrackStatus.CONFIRMED
        turns = [confirmed, ~confirmed] if self.priority == "confirmed" else [np.ones(len(state), bool)]
        for turn in turns:
            free = np.setdiff1d(np.arange(len(scan.y)), got)
            who = np.flatnonzero(turn)
            if not (who.size and free.size):
                continue
            pairs = self._pairs(scan, free, state[who], covariance[who])
            chosen = (auctioned if self.assignment == "auction" else solved)(pairs, free.size)
            got[who] = np.where(chosen >= 0, free[chosen], -1)
        return got

    def _pairs(self, scan: _Scan, free: IntArray, state: FloatArray, covariance: FloatArray) -> Pairs:
        R = noise_at(state, self.range_sd_m, float(np.radians(self.bearing_sd_deg)), scan.pose)
        polar = np.stack(to_polar(scan.pose.to_sensor(state[:, :2])), axis=1)
        coarse = (self.gate_range_m, float(np.radians(self.gate_bearing_deg)))
        gamma = -2.0 * float(np.log(self.gate_threshold))
        gain = self._gains(scan)[free] if self.cost == "likelihood" else np.zeros(0)
        return Pairs(
            *blobs_in_gates(
                state, covariance, R, scan.y[free], polar, scan.polar[free], coarse, gamma, gain, self._miss
            )
        )

    def _gains(self, scan: _Scan) -> FloatArray:
        """ln(p_d / lambda) of the blobs with what their amplitudes say, (m,)."""
        density = self._density[0] / np.maximum(scan.polar[:, 0], 1.0)
        gains: FloatArray = scan.gain + np.log(self.p_d / density)
        return gains

    @property
    def _miss(self) -> float:
        return float(np.log(1.0 - self.p_d * (1.0 - self.gate_threshold)))

    def _counted(self, bank: NcvBank, got: IntArray, stamp_ns: int, scan: _Scan | None) -> NcvBank:
        """The bank with counts and statuses after a ping; without a scan it says nothing of the tracks."""
        rows = bank.rows.copy()
        rows["age"] += 1
        if scan is None:
            return NcvBank(bank.state, bank.covariance, rows)
        rows["history"] = ((rows["history"] << 1) & ((1 << WINDOW) - 1)) | (got >= 0)
        rows["span"] = np.minimum(rows["span"] + 1, WINDOW)
        lobe = self._lobes(bank, got, stamp_ns, scan)
        rows["mirrored"] = np.maximum(rows["mirrored"] + np.where(lobe, 1, -(got >= 0).astype(np.int64)), 0)
        judged = np.minimum(rows["span"], self.keep_pings)
        misses = judged - np.bitwise_count(rows["history"] & ((1 << self.keep_pings) - 1))
        ends = (misses > self.keep_pings - self.keep_hits) | (rows["mirrored"] >= self.lobe_pings)
        tentative = rows["status"] == TrackStatus.TENTATIVE
        ends |= tentative & (rows["score"] < self.drop_score)
        confirmed = tentative & ~ends & (rows["hits"] > self.confirm_hits) & (rows["mirrored"] == 0)
        confirmed &= rows["score"] >= self.confirm_score
        rows["status"][confirmed] = TrackStatus.CONFIRMED
        # A tentative track that ends is dropped without a word: hits of 0 say so.
        rows["hits"][ends & tentative] = 0
        rows["status"][ends] = TrackStatus.LOST
        return NcvBank(bank.state, bank.covariance, rows)

    def _lobes(self, bank: NcvBank, got: IntArray, stamp_ns: int, scan: _Scan) -> BoolArray:
        """Which tracks seem to be lobes of stronger ones, (n,)."""
        found = np.zeros(len(bank), bool)
        chosen = (got >= 0) & (bank.rows["hits"] >= SETTLED)
        if self.lobe_range_m == 0.0 or np.count_nonzero(chosen) < 2:
            return found
        state, _ = bank.at(stamp_ns, self.sigma_v_mps2)
        range_m, bearing_rad = to_polar(scan.pose.to_sensor(state[:, :2]))
        along = (state[:, :2] - scan.pose.origin_m) / np.maximum(range_m, 1e-9)[:, None]
        rate = (along * state[:, 2:]).sum(axis=1)
        level = bank.rows["level"]
        weaker, stronger = companions(range_m, rate, level, chosen, self.lobe_range_m, self.lobe_speed_mps)
        if self.hydrophones_m:
            response = lobe_response(
                np.array(self.hydrophones_m, float),
                self.band_hz,
                scan.sound_speed_mps,
                bearing_rad[stronger],
                bearing_rad[weaker],
            )
            weaker = weaker[level[weaker] <= level[stronger] + np.log(response + 1e-12) + LOBE_MARGIN]
        found[weaker] = True
        return found

    def _begun(self, scan: _Scan, free: IntArray, alive: int, seq: int) -> NcvBank:
        """Tentative tracks at the blobs that no track took."""
        room = max(0, self.max_tracks - alive)
        if free.size > room:
            if not self._warned:
                log.warning(
                    "ping %d: only the strongest blobs begin tracks, so that there are at most %d "
                    "(max_tracks); said once",
                    seq, self.max_tracks,
                )  # fmt: skip
                self._warned = True
            free = np.sort(free[np.argsort(-scan.level[free], kind="stable")[:room]])
        n = free.size
        state, covariance, rows = np.zeros((n, 4)), np.zeros((n, 4, 4)), np.zeros(n, ROW)
        state[:, :2], covariance[:, :2, :2] = scan.y[free], scan.R[free]
        covariance[:, 2, 2] = covariance[:, 3, 3] = self.v_max_mps**2
        rows["id"] = np.arange(self._next_id, self._next_id + n)
        rows["time_ns"], rows["level"] = scan.time_ns[free], scan.level[free]
        rows["score"] = scan.gain[free]
        rows["hits"] = rows["history"] = rows["span"] = 1
        self._next_id += n
        return NcvBank(state, covariance, rows)


def _log_likelihoods(x: FloatArray, P: FloatArray, R: FloatArray, y: FloatArray) -> FloatArray:
    """ln N(y; H x, H P H^T + R), (n,)."""
    nu, S = y - x[:, :2], P[:, :2, :2] + R
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
    d2 = S[:, 1, 1] * nu[:, 0] ** 2 - 2.0 * S[:, 0, 1] * nu[:, 0] * nu[:, 1] + S[:, 0, 0] * nu[:, 1] ** 2
    log_likelihood: FloatArray = -0.5 * d2 / det - np.log(2.0 * np.pi * np.sqrt(det))
    return log_likelihood


def _amplitude_gain(level: FloatArray, snr: float) -> FloatArray:
    """Log likelihood ratios (m,) that log amplitudes above the threshold add, for a fluctuating target."""
    power = np.exp(2.0 * level)
    above = power - power.min(initial=np.inf)
    gain: FloatArray = above * snr / (1.0 + snr) - np.log1p(snr)
    return gain


def _alive(rows: Rows) -> BoolArray:
    alive: BoolArray = rows["status"] != TrackStatus.LOST
    return alive


@hookimpl
def fls_node() -> type[NcvAuction]:
    """The kind `ncv-auction`."""
    return NcvAuction
