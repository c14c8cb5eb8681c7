"""The tracks of a tracker as arrays, one row per track."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import Tracks, TrackStatus
from fls_flow.messages import Frame

__all__ = ["LEDGER", "MAX_WINDOW", "TrackBank", "new_tracks"]

FloatArray = npt.NDArray[np.float64]
Ledger = npt.NDArray[np.void]

MAX_WINDOW = 62  # pings that the bits of `history` can hold

LEDGER = np.dtype(
    [
        ("id", np.int64),
        ("status", np.int64),  # TrackStatus
        ("hits", np.int64),  # pings with an update
        ("age", np.int64),  # pings since it began
        ("history", np.int64),  # bit k: updated k judged pings ago
        ("span", np.int64),  # pings that the history covers, the seed included
        ("rival", np.int64),  # id of the older track that this one may repeat; 0: none
        ("rival_pings", np.int64),  # for how many pings it has seemed so
        ("score", np.float64),  # log likelihood ratio of an object against clutter, since it began
    ]
)


def _no_rows() -> Ledger:
    return np.zeros(0, LEDGER)


@dataclass
class TrackBank:
    """States, covariances and ledger of n tracks, in the order of their ids.

    The arrays of a bank in use are never written: a step makes new ones, so that messages may share them.
    """

    state: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))  # x, y (m), vx, vy (m/s)
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    ledger: Ledger = field(default_factory=_no_rows)

    def __len__(self) -> int:
        return self.ledger.size

    @property
    def confirmed(self) -> npt.NDArray[np.bool_]:
        """Which tracks are confirmed, (n,)."""
        mask: npt.NDArray[np.bool_] = self.ledger["status"] == TrackStatus.CONFIRMED
        return mask

    def select(self, which: npt.NDArray[Any]) -> TrackBank:
        """The tracks that a mask or an index array selects, as copies."""
        return TrackBank(self.state[which], self.covariance[which], self.ledger[which])

    def joined(self, other: TrackBank) -> TrackBank:
        """These tracks, then the younger ones of `other`."""
        n = len(self)
        # Filled by hand: numpy takes ten times as long to concatenate records.
        ledger = np.empty(n + len(other), LEDGER)
        ledger[:n], ledger[n:] = self.ledger, other.ledger
        return TrackBank(
            np.concatenate([self.state, other.state]),
            np.concatenate([self.covariance, other.covariance]),
            ledger,
        )

    def message(self, seq: int, stamp_ns: int, frame: Frame) -> Tracks:
        """The tracks as a message; it shares states and covariances, which no one writes again."""
        rows = self.ledger
        return Tracks(
            seq,
            stamp_ns,
            rows["id"].copy(),
            rows["status"].astype(np.uint8),
            self.state,
            self.covariance,
            rows["hits"].copy(),
            rows["age"].copy(),
            frame,
        )

    def snapshot(self) -> dict[str, Any]:
        """Copies of all arrays, the ledger column by column."""
        columns = {name: self.ledger[name].copy() for name in LEDGER.names or ()}
        return {"state": self.state.copy(), "covariance": self.covariance.copy(), **columns}

    @classmethod
    def restored(cls, saved: dict[str, Any]) -> TrackBank:
        """The bank that gave the snapshot `saved`."""
        ledger = np.zeros(len(saved["id"]), LEDGER)
        for name in LEDGER.names or ():
            ledger[name] = saved[name]
        state = np.array(saved["state"], float).reshape(-1, 4)
        return cls(state, np.array(saved["covariance"], float).reshape(-1, 4, 4), ledger)


def new_tracks(
    position: FloatArray, noise: FloatArray, speed_sd_mps: tuple[float, float], status: int
) -> TrackBank:
    """Tracks that begin at rest at positions (n, 2) known with `noise` (n, 2, 2), after one update; no ids.

    P0 = blkdiag(R_0, diag(speed_sd^2)).
    """
    n = position.shape[0]
    state, covariance, ledger = np.zeros((n, 4)), np.zeros((n, 4, 4)), np.zeros(n, LEDGER)
    state[:, :2], covariance[:, :2, :2] = position, noise
    covariance[:, 2, 2], covariance[:, 3, 3] = speed_sd_mps[0] ** 2, speed_sd_mps[1] ** 2
    ledger["status"] = status
    for name in ("hits", "history", "span"):
        ledger[name] = 1
    return TrackBank(state, covariance, ledger)
