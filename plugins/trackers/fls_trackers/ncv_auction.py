"""Track blobs by nearly constant velocity and global assignment, confirmed by count."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Ping, Tracks, TrackStatus, hookimpl
from fls_flow.geometry import Pose, to_polar
from fls_flow.messages import Frame
from fls_trackers.ncv_bank import ROW, NcvBank
from fls_trackers.ncv_choice import Choice
from fls_trackers.ncv_conversion import Debiased, Polar
from fls_trackers.ncv_life import Life
from fls_trackers.ncv_lobes import Lobes
from fls_trackers.ncv_memory import ClutterMemory, Recall
from fls_trackers.ncv_scan import BlobDensity, Scan, pose_of, scan_of
from fls_trackers.ncv_score import in_memory
from fls_trackers.ncv_steps import log_likelihoods

__all__ = ["NcvAuction"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
log = logging.getLogger(__name__)

SETTLED = 3  # blobs after which a track's range rate is known well enough to compare it


@dataclass
class NcvAuction:
    """Tracks of blobs, at the stamp of the ping, each updated by the one blob that the assignment gives it.

    Blobs become Cartesian by debiased conversion with `range_sd_m` and `bearing_sd_deg`, which leaves ranges
    as vague as r times the bearing's variance; with `conversion: polar` innovations are those of range and
    bearing, corrections follow the arc, and bearings far off, such as lobes give, count less. A track's state
    stands at the time of its last blob, stamp + range / c, and is predicted over the blobs' own times. A blob
    must lie within `gate_range_m` and `gate_bearing_deg` of a predicted track and have
    exp(-d2 / 2) >= `gate_threshold`, d2 the statistical distance. Of the gated pairs the assignment takes as
    many as possible, then the least sum of d2; with `cost: likelihood` the largest sum of the log
    likelihood ratios below, of pairs that say more for a target than a miss does, so that vague tracks are
    not favoured; with `priority: confirmed` confirmed tracks choose first, with `score` then those of high
    score. Blobs left over begin tentative tracks at rest, with P0 = blkdiag(R, v_max^2 I).

    A track is confirmed with more than `confirm_hits` blobs and a log likelihood ratio of `confirm_score`
    against clutter: each blob adds ln(p_d N(nu; S) / lambda), each miss ln(1 - p_d (1 - gate_threshold)),
    with lambda the mean number of blobs per ping (over 20 pings) per metre and radian, over the range. If the
    detector gives amplitudes a as ratios to the clutter's root mean square, `snr_db` adds what they tell:
    with e = a^2 - (least a^2 of the ping) and the ratio s, s e / (1 + s) - ln(1 + s). A track ends when fewer
    than `keep_hits` of its last `keep_pings` pings gave it a blob; a younger one, with more than
    keep_pings - keep_hits misses. A tentative one also ends when its score falls below `drop_score`;
    below `report_score` it is kept without being reported.

    With the pings themselves as `ping`, clutter that persists is no new evidence: its correlation from ping
    to ping is measured, and of a score is taken how much likelier the last ping made the power in the blob's
    cell (`ncv_memory`). A target that stands in its cell must then persist better than clutter does, and
    takes longer to be confirmed.

    A sparse array shows a target at several bearings. Of two tracks whose ranges differ by at most
    `lobe_range_m` (0: never compared) and whose range rates by `lobe_speed_mps`, the one with the lower mean
    log amplitude is not confirmed, and ends once this has held for `lobe_pings` pings. With the hydrophones'
    positions in the sensor frame, `hydrophones_m`, and the band of the pulse, only a track up to 3 dB above
    what the array shows of the stronger one at that bearing counts as its lobe.

    With `frame: ned` tracks are in north and east; without position or heading they go unseen for the ping.
    Beyond `max_tracks` only the strongest blobs begin tracks.

    Raises ValueError when a stamp does not increase or a blob is not finite; the state stays as it was.

    Source: Abu 2024, section V, with sigma_v in m/s^2 and the assignment of most pairs first; the time of
    reflection instead of arrival, priority, likelihood, memory, polar innovations and lobes are ours.
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
    priority: Literal["none", "confirmed", "score"] = "none"
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
    conversion: Literal["debiased", "polar"] = "debiased"

    _bank: NcvBank = field(default_factory=NcvBank, init=False, repr=False)
    _next_id: int = field(default=1, init=False, repr=False)
    _stamp_ns: int | None = field(default=None, init=False, repr=False)
    _density: BlobDensity = field(default=BlobDensity(), init=False, repr=False)
    _memory: ClutterMemory = field(default_factory=ClutterMemory, init=False, repr=False)
    _conversion: Debiased | Polar = field(init=False, repr=False)
    _choice: Choice = field(init=False, repr=False)
    _life: Life = field(init=False, repr=False)
    _lobes: Lobes = field(init=False, repr=False)
    _warned: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        positive = ("range_sd_m", "bearing_sd_deg", "sigma_v_mps2", "v_max_mps", "gate_range_m")
        for name in (*positive, "gate_bearing_deg"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive and finite, not {getattr(self, name)}")
        for name in ("gate_threshold", "p_d"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must lie between 0 and 1, not {getattr(self, name)}")
        if self.max_tracks < 1:
            raise ValueError(f"max_tracks must be at least 1, not {self.max_tracks}")
        words = {
            "conversion": ("debiased", "polar"),
            "assignment": ("auction", "hungarian"),
            "cost": ("distance", "likelihood"),
            "priority": ("none", "confirmed", "score"),
            "frame": ("sensor", "ned"),
        }
        for name, allowed in words.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be {' or '.join(allowed)}, not {getattr(self, name)!r}")
        conversion = Polar if self.conversion == "polar" else Debiased
        self._conversion = conversion(self.range_sd_m, float(np.radians(self.bearing_sd_deg)))
        self._choice = Choice(
            self.gate_range_m,
            self.gate_bearing_deg,
            self.gate_threshold,
            self.assignment,
            self.cost,
            self.priority,
            self.p_d,
            self._conversion,
        )
        self._life = Life(
            self.confirm_hits,
            self.confirm_score,
            self.keep_hits,
            self.keep_pings,
            self.drop_score,
            self.lobe_pings,
        )
        self._lobes = Lobes(self.lobe_range_m, self.lobe_speed_mps, self.hydrophones_m, self.band_hz)

    def __call__(self, detections: Detections, ping: Ping | None = None) -> Tracks:
        """The tracks at the stamp of `detections`, after its update."""
        d = detections
        if self._stamp_ns is not None and d.stamp_ns <= self._stamp_ns:
            raise ValueError(
                f"ping seq {d.seq} has stamp {d.stamp_ns} ns, not after the last ping's {self._stamp_ns} ns; "
                "pings must come in the order of their stamps"
            )
        if not (np.isfinite(d.range_m).all() and np.isfinite(d.bearing_rad).all()):
            raise ValueError(f"ping seq {d.seq}: a detection's range or bearing is not finite")
        recalled = Recall.nothing(len(d))
        if ping is not None:
            recalled = self._memory.recall(ping, d.range_m, d.bearing_rad)
        self._stamp_ns = d.stamp_ns
        pose = pose_of(d, self.frame)
        bank = self._bank if pose is None else self._after(d, recalled, pose)
        rows = bank.rows.copy()
        rows["age"][: len(self._bank)] += 1
        bank = NcvBank(bank.state, bank.covariance, rows)
        self._bank = bank.select(bank.alive)
        quiet = (rows["status"] == TrackStatus.TENTATIVE) & (rows["score"] < self.report_score)
        shown = bank.select(~quiet & (bank.alive | (rows["hits"] > 0)))
        return shown.message(d.seq, d.stamp_ns, self.frame, self.sigma_v_mps2)

    def snapshot(self) -> dict[str, Any]:
        """Everything that later outputs depend on, as copies."""
        return {
            **self._bank.snapshot(),
            "next_id": self._next_id,
            "stamp_ns": self._stamp_ns,
            "warned": self._warned,
            "density": self._density.mean,
            "pings": self._density.pings,
            "memory": self._memory.snapshot(),
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot of a node with the same parameters."""
        self._bank = NcvBank.restored(saved)
        self._next_id, self._warned = int(saved["next_id"]), bool(saved["warned"])
        self._density = BlobDensity(float(saved["density"]), int(saved["pings"]))
        self._stamp_ns = None if saved["stamp_ns"] is None else int(saved["stamp_ns"])
        self._memory = ClutterMemory.restored(saved["memory"])

    def _after(self, d: Detections, recalled: Recall, pose: Pose) -> NcvBank:
        """The tracks after a ping, also those that end, then those that begin."""
        scan = scan_of(
            d, recalled, pose, self.range_sd_m, float(np.radians(self.bearing_sd_deg)), self.snr_db
        )
        self._density = self._density.after(d)
        bank, got = self._updated(scan)
        settled = (got >= 0) & (bank.rows["hits"] >= SETTLED)
        state, _ = bank.at(d.stamp_ns, self.sigma_v_mps2)
        lobe = self._lobes.among(state, bank.rows["level"], settled, pose, scan.sound_speed_mps)
        bank = NcvBank(bank.state, bank.covariance, self._life.after(bank.rows, got >= 0, lobe))
        free = np.setdiff1d(np.arange(len(d)), got)
        return bank.joined(self._begun(scan, free, int(np.count_nonzero(bank.alive)), d.seq))

    def _updated(self, scan: Scan) -> tuple[NcvBank, IntArray]:
        """The tracks after their blobs, and the blob of each, -1 for none."""
        bank, rows = self._bank, self._bank.rows
        # The time of a track's echo in this ping, from where it is at about that time.
        stamp_ns = int(self._stamp_ns or 0)
        near, _ = to_polar(scan.pose.to_sensor(bank.at(stamp_ns, self.sigma_v_mps2)[0][:, :2]))
        expected_ns = stamp_ns + np.rint(near / scan.sound_speed_mps * 1e9).astype(np.int64)
        state, covariance = bank.at(np.maximum(expected_ns, rows["time_ns"]), self.sigma_v_mps2)
        gains = self._choice.gains(scan, self._density.mean)
        got = self._choice.blobs(bank, scan, state, covariance, gains)
        seen = np.flatnonzero(got >= 0)
        time_ns = rows["time_ns"].copy()
        time_ns[seen] = np.maximum(scan.time_ns[got[seen]], time_ns[seen])
        x, P = bank.at(time_ns, self.sigma_v_mps2)
        nu = self._conversion.innovations(x[seen], scan, got[seen])
        R = self._conversion.noise(x[seen], scan.pose)
        gain = log_likelihoods(nu, P[seen], R) + gains[got[seen]]
        gain = in_memory(gain, rows[seen], scan, got[seen])
        x[seen], P[seen] = self._conversion.updated(x[seen], P[seen], nu, scan.pose)
        new = rows.copy()
        new["time_ns"] = time_ns
        new["score"][got < 0] += self._choice.miss
        new["score"][seen] += gain
        hits = rows["hits"][seen]
        new["level"][seen] = (rows["level"][seen] * hits + scan.level[got[seen]]) / (hits + 1)
        new["hits"][seen] += 1
        new["range_m"][seen], new["bearing_rad"][seen] = scan.polar[got[seen]].T
        return NcvBank(x, P, new), got

    def _begun(self, scan: Scan, free: IntArray, alive: int, seq: int) -> NcvBank:
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
        rows = np.zeros(free.size, ROW)
        rows["id"] = np.arange(self._next_id, self._next_id + free.size)
        rows["time_ns"], rows["level"] = scan.time_ns[free], scan.level[free]
        rows["score"] = scan.gain[free]
        rows["range_m"], rows["bearing_rad"] = scan.polar[free].T
        rows["hits"] = rows["history"] = rows["span"] = 1
        self._next_id += free.size
        return NcvBank.at_rest(*self._conversion.begun(scan, free), self.v_max_mps, rows)


@hookimpl
def fls_node() -> type[NcvAuction]:
    """The kind `ncv-auction`."""
    return NcvAuction
