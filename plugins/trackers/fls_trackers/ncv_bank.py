"""Tracks whose states stand each at the time of its own last echo, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import Tracks, TrackStatus
from fls_flow.messages import Frame
from fls_trackers.ncv_steps import predict_each

__all__ = ["ROW", "NcvBank", "Rows"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Rows = npt.NDArray[np.void]

ROW = np.dtype(
    [
        ("id", np.int64),
        ("status", np.int64),  # TrackStatus
        ("time_ns", np.int64),  # when the sound met the last echo: the time of the state
        ("hits", np.int64),  # blobs assigned to it
        ("age", np.int64),  # pings since it began
        ("history", np.int64),  # bit k: assigned a blob k pings ago
        ("span", np.int64),  # pings that the history covers
        ("score", np.float64),  # log likelihood ratio of a target against clutter, since it began
        ("level", np.float64),  # mean log amplitude of its blobs
        ("range_m", np.float64),  # of its last blob
        ("bearing_rad", np.float64),
        ("mirrored", np.int64),  # pings for which it has seemed to be a lobe of a stronger one, net
    ]
)


def _no_rows() -> Rows:
    return np.zeros(0, ROW)


@dataclass
class NcvBank:
    """States, covariances and rows of n tracks, in the order of their ids; never written once made."""

    state: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))  # x, y (m), vx, vy (m/s)
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    rows: Rows = field(default_factory=_no_rows)

    @classmethod
    def at_rest(cls, position_m: FloatArray, covariance: FloatArray, v_max_mps: float, rows: Rows) -> NcvBank:
        """Tracks that begin at positions (n, 2) with covariances (n, 2, 2), velocities of sd `v_max_mps`."""
        state, whole = np.zeros((rows.size, 4)), np.zeros((rows.size, 4, 4))
        state[:, :2], whole[:, :2, :2] = position_m, covariance
        whole[:, 2, 2] = whole[:, 3, 3] = v_max_mps**2
        return cls(state, whole, rows)

    @property
    def alive(self) -> npt.NDArray[np.bool_]:
        """Which tracks have not ended."""
        alive: npt.NDArray[np.bool_] = self.rows["status"] != TrackStatus.LOST
        return alive

    def __len__(self) -> int:
        return self.rows.size

    def select(self, which: npt.NDArray[Any]) -> NcvBank:
        """The tracks that a mask or an index array selects, as copies."""
        return NcvBank(self.state[which], self.covariance[which], self.rows[which])

    def joined(self, other: NcvBank) -> NcvBank:
        """These tracks, then the younger ones of `other`."""
        return NcvBank(
            np.concatenate([self.state, other.state]),
            np.concatenate([self.covariance, other.covariance]),
            np.concatenate([self.rows, other.rows]),
        )

    def at(self, time_ns: IntArray | int, sigma_v_mps2: float) -> tuple[FloatArray, FloatArray]:
        """States (n, 4) and covariances (n, 4, 4) at other times, (n,) or one for all."""
        dt_s = (np.broadcast_to(time_ns, len(self)) - self.rows["time_ns"]) * 1e-9
        state, covariance = predict_each(self.state, self.covariance, dt_s, sigma_v_mps2)
        return state, covariance

    def message(self, seq: int, stamp_ns: int, frame: Frame, sigma_v_mps2: float) -> Tracks:
        """The tracks at the stamp of a ping."""
        state, covariance = self.at(stamp_ns, sigma_v_mps2)
        rows = self.rows
        return Tracks(
            seq,
            stamp_ns,
            rows["id"].copy(),
            rows["status"].astype(np.uint8),
            state,
            covariance,
            rows["hits"].copy(),
            rows["age"].copy(),
            frame,
        )

    def snapshot(self) -> dict[str, Any]:
        """Copies of all arrays, the rows column by column."""
        columns = {name: self.rows[name].copy() for name in ROW.names or ()}
        return {"state": self.state.copy(), "covariance": self.covariance.copy(), **columns}

    @classmethod
    def restored(cls, saved: dict[str, Any]) -> NcvBank:
        """The bank that gave the snapshot `saved`."""
        rows = np.zeros(len(saved["id"]), ROW)
        for name in ROW.names or ():
            rows[name] = saved[name]
        state = np.array(saved["state"], float).reshape(-1, 4)
        return cls(state, np.array(saved["covariance"], float).reshape(-1, 4, 4), rows)
