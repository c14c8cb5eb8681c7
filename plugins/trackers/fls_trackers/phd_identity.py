"""Identities for estimates that carry none: each joins the track whose prediction it fits, or starts one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Intensity, Tracks, TrackStatus
from fls_flow.kernels import compiled
from fls_flow.messages import Frame
from fls_trackers.kalman import predict
from fls_trackers.life import Rules, count, settle
from fls_trackers.phd_sector import Sector
from fls_trackers.track_bank import LEDGER, TrackBank

__all__ = ["Identities", "TracksAndIntensity", "elapsed_s", "paired"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class TracksAndIntensity(NamedTuple):
    """What a PHD filter gives for a ping."""

    tracks: Tracks
    intensity: Intensity


def elapsed_s(detections: Detections, last_ns: int | None) -> float:
    """Seconds since the last ping, 0 for the first; raises ValueError when the stamp has not increased."""
    if last_ns is None:
        return 0.0
    elapsed = detections.stamp_ns - last_ns
    if elapsed <= 0:
        raise ValueError(
            f"ping seq {detections.seq} has stamp {detections.stamp_ns} ns, not after the last ping's "
            f"{last_ns} ns; pings must come in the order of their stamps"
        )
    return elapsed * 1e-9


@dataclass
class Identities:
    """Tracks through the estimates of a PHD filter.

    A track takes over the state of its estimate; without one it is predicted. Pings without a view of the
    targets count neither as hit nor as miss.
    """

    rules: Rules
    gamma: float
    sigma_v_mps2: float
    _bank: TrackBank = field(default_factory=TrackBank, init=False, repr=False)
    _next_id: int = field(default=1, init=False, repr=False)

    def predict(self, dt_s: float) -> None:
        """Carry all tracks on by `dt_s`."""
        bank = self._bank
        if len(bank) and dt_s > 0.0:
            state, covariance = predict(bank.state, bank.covariance, dt_s, self.sigma_v_mps2)
            self._bank = TrackBank(state, covariance, bank.ledger)

    @property
    def position_m(self) -> FloatArray:
        """(n, 2): where the tracks are, or are predicted to be."""
        return self._bank.state[:, :2]

    def update(
        self,
        state: FloatArray,
        covariance: FloatArray,
        seq: int,
        stamp_ns: int,
        frame: Frame,
        sector: Sector,
    ) -> Tracks:
        """The tracks after the estimates (k, 4) of a ping; those that end in it are in it, as lost, once.

        A track without an estimate that is outside of the sector has left.
        """
        bank = self._bank
        track_of = paired(bank.state, bank.covariance, state, covariance, self.gamma)
        joined = np.flatnonzero(track_of >= 0)
        updated = np.zeros(len(bank), bool)
        updated[track_of[joined]] = True
        states, covariances = bank.state.copy(), bank.covariance.copy()
        states[track_of[joined]], covariances[track_of[joined]] = state[joined], covariance[joined]
        ledger = count(bank.ledger, updated, np.ones(len(bank)), 1.0)
        new = np.flatnonzero(track_of < 0)
        whole = TrackBank(states, covariances, ledger).joined(self._begun(state[new], covariance[new]))
        left = np.concatenate([~updated & ~sector.holds(bank.state[:, :2]), np.zeros(new.size, bool)])
        return self._settled(whole, left, seq, stamp_ns, frame)

    def unseen(self, seq: int, stamp_ns: int, frame: Frame) -> Tracks:
        """The predicted tracks after a ping that says nothing of them."""
        ledger = self._bank.ledger.copy()
        ledger["age"] += 1
        bank = TrackBank(self._bank.state, self._bank.covariance, ledger)
        return self._settled(bank, np.zeros(len(bank), bool), seq, stamp_ns, frame)

    def _settled(self, bank: TrackBank, left: BoolArray, seq: int, stamp_ns: int, frame: Frame) -> Tracks:
        ledger, keep = settle(bank.ledger, left, bank.covariance, self.rules)
        bank = TrackBank(bank.state, bank.covariance, ledger)
        self._bank = bank.select(keep)
        said = keep | (ledger["status"] == TrackStatus.LOST)
        return bank.select(said).message(seq, stamp_ns, frame)

    def _begun(self, state: FloatArray, covariance: FloatArray) -> TrackBank:
        n = state.shape[0]
        ledger = np.zeros(n, LEDGER)
        ledger["id"] = np.arange(self._next_id, self._next_id + n)
        ledger["status"] = TrackStatus.TENTATIVE
        for name in ("hits", "history", "span"):
            ledger[name] = 1
        self._next_id += n
        return TrackBank(state.copy(), covariance.copy(), ledger)

    def snapshot(self) -> dict[str, Any]:
        """All tracks and the next id, as copies."""
        return {"tracks": self._bank.snapshot(), "next_id": self._next_id}

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._bank = TrackBank.restored(saved["tracks"])
        self._next_id = int(saved["next_id"])


def paired(
    state: FloatArray, covariance: FloatArray, estimate: FloatArray, spread: FloatArray, gamma: float
) -> IntArray:
    """The track of each estimate (k,), -1 for none: pairs by rising distance, each track and estimate once.

    d^2 = e^T (P + P_e)^-1 e over position, at most `gamma`; older tracks first among equals.
    """
    track_of: IntArray = _paired(state, covariance, estimate, spread, gamma)
    return track_of


@compiled
def _paired(
    state: FloatArray, covariance: FloatArray, estimate: FloatArray, spread: FloatArray, gamma: float
) -> IntArray:
    n, k = state.shape[0], estimate.shape[0]
    d2 = np.empty(n * k)
    for t in range(n):
        for e in range(k):
            s11 = covariance[t, 0, 0] + spread[e, 0, 0]
            s12 = covariance[t, 0, 1] + spread[e, 0, 1]
            s22 = covariance[t, 1, 1] + spread[e, 1, 1]
            dx, dy = estimate[e, 0] - state[t, 0], estimate[e, 1] - state[t, 1]
            det = s11 * s22 - s12 * s12
            d2[t * k + e] = (dx * (s22 * dx - s12 * dy) + dy * (s11 * dy - s12 * dx)) / det
    track_of, taken = np.full(k, -1), np.zeros(n, np.bool_)
    for pair in np.argsort(d2, kind="mergesort"):
        t, e = pair // k, pair % k
        if d2[pair] > gamma:
            break
        if not taken[t] and track_of[e] < 0:
            track_of[e] = t
            taken[t] = True
    return track_of
