"""The tracks of a tracker as arrays, one row per track."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import Tracks, TrackStatus
from fls_flow.kernels import compiled
from fls_flow.messages import Frame

__all__ = ["LEDGER", "MAX_WINDOW", "TrackBank", "begun", "new_tracks", "renewed"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
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
        return self.renewed(np.ones(len(self), np.bool_), other)

    def renewed(self, keep: BoolArray, other: TrackBank) -> TrackBank:
        """Those of these tracks that `keep` (n,) selects, then the younger ones of `other`."""
        mine, theirs = self, other
        return TrackBank(
            *renewed(
                mine.state,
                mine.covariance,
                mine.ledger,
                keep,
                theirs.state,
                theirs.covariance,
                theirs.ledger,
            )
        )

    def message(self, seq: int, stamp_ns: int, frame: Frame) -> Tracks:
        """The tracks as a message; it shares states and covariances, which no one writes again."""
        rows = self.ledger
        # Arrays of a kernel have dtypes of their own: a message takes numpy's, which are these, sooner.
        return Tracks(
            seq,
            stamp_ns,
            rows["id"].astype(np.int64),
            rows["status"].astype(np.uint8),
            self.state.view(np.float64),
            self.covariance.view(np.float64),
            rows["hits"].astype(np.int64),
            rows["age"].astype(np.int64),
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
    position: FloatArray,
    noise: FloatArray,
    speed_sd_mps: tuple[float, float],
    status: int,
    which: IntArray | None = None,
) -> TrackBank:
    """Tracks that begin at rest at positions (n, 2) known with `noise` (n, 2, 2), after one update; no ids.

    P0 = blkdiag(R_0, diag(speed_sd^2)). `which` (k,) chooses among the positions; without it, all.
    """
    chosen = np.arange(position.shape[0]) if which is None else which
    ledger = np.zeros(chosen.size, LEDGER)
    state, covariance = begun(position, noise, chosen, speed_sd_mps[0], speed_sd_mps[1], status, ledger)
    return TrackBank(state, covariance, ledger)


@compiled
def begun(
    position: FloatArray,
    noise: FloatArray,
    chosen: IntArray,
    sd_x: float,
    sd_y: float,
    status: int,
    ledger: Ledger,
) -> tuple[FloatArray, FloatArray]:
    """States and covariances of `new_tracks`, in machine code; fills their `ledger` (k,), all 0 before."""
    n = chosen.size
    state, covariance = np.zeros((n, 4)), np.zeros((n, 4, 4))
    for t in range(n):
        for a in range(2):
            state[t, a] = position[chosen[t], a]
            for b in range(2):
                covariance[t, a, b] = noise[chosen[t], a, b]
        covariance[t, 2, 2], covariance[t, 3, 3] = sd_x * sd_x, sd_y * sd_y
        row = ledger[t]
        row.status = status
        row.hits = row.history = row.span = 1
    return state, covariance


@compiled
def renewed(
    state: FloatArray,
    covariance: FloatArray,
    ledger: Ledger,
    keep: BoolArray,
    more_state: FloatArray,
    more_covariance: FloatArray,
    more_ledger: Ledger,
) -> tuple[FloatArray, FloatArray, Ledger]:
    """The arrays of `TrackBank.renewed`, in machine code."""
    k, n = 0, more_ledger.size
    for t in range(keep.size):
        k += keep[t]
    x, P = np.empty((k + n, 4)), np.empty((k + n, 4, 4))
    rows = np.empty(k + n, ledger.dtype)
    i = 0
    for t in range(keep.size):
        if keep[t]:
            _put(x, P, i, state, covariance, t)
            rows[i] = ledger[t]
            i += 1
    for t in range(n):
        _put(x, P, k + t, more_state, more_covariance, t)
        rows[k + t] = more_ledger[t]
    return x, P, rows


@compiled
def _put(x: FloatArray, P: FloatArray, i: int, state: FloatArray, covariance: FloatArray, t: int) -> None:
    """Row i of x and P is row t of the others; element by element, as slices cost more than their content."""
    for a in range(4):
        x[i, a] = state[t, a]
        for b in range(4):
            P[i, a, b] = covariance[t, a, b]
