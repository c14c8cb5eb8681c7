"""Which blob each track takes: gates, the evidence of each pair, assignment in turns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import to_polar
from fls_trackers.auction import Pairs, auctioned, solved
from fls_trackers.ncv_bank import NcvBank
from fls_trackers.ncv_conversion import Debiased, Polar
from fls_trackers.ncv_scan import Scan
from fls_trackers.ncv_score import turns
from fls_trackers.ncv_steps import blobs_in_gates

__all__ = ["Choice"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Choice:
    """How blobs are given to tracks; names and meaning are those of the parameters of `ncv-auction`."""

    gate_range_m: float
    gate_bearing_deg: float
    gate_threshold: float
    assignment: Literal["auction", "hungarian"]
    cost: Literal["distance", "likelihood"]
    priority: Literal["none", "confirmed", "score"]
    p_d: float
    conversion: Debiased | Polar

    @property
    def miss(self) -> float:
        """What a ping without a blob adds to a score."""
        return float(np.log(1.0 - self.p_d * (1.0 - self.gate_threshold)))

    def gains(self, scan: Scan, density: float) -> FloatArray:
        """ln(p_d / lambda) of the blobs with what their amplitudes say, (m,); `density` over the range."""
        clutter = density / np.maximum(scan.polar[:, 0], 1.0)
        gains: FloatArray = scan.gain + np.log(self.p_d / clutter)
        return gains

    def blobs(
        self, bank: NcvBank, scan: Scan, state: FloatArray, covariance: FloatArray, gains: FloatArray
    ) -> IntArray:
        """The blob of each track of the bank, -1 for none, with states and covariances as predicted."""
        got = np.full(len(state), -1)
        for turn in turns(bank.rows, self.priority):
            free = np.setdiff1d(np.arange(len(scan.y)), got)
            who = np.flatnonzero(turn)
            if not (who.size and free.size):
                continue
            pairs = self._pairs(scan, free, state[who], covariance[who], gains)
            chosen = (auctioned if self.assignment == "auction" else solved)(pairs, free.size)
            got[who] = np.where(chosen >= 0, free[chosen], -1)
        return got

    def _pairs(
        self, scan: Scan, free: IntArray, state: FloatArray, covariance: FloatArray, gains: FloatArray
    ) -> Pairs:
        R, axis = self.conversion.noise(state, scan.pose), self.conversion.axes(state, scan.pose)
        polar = np.stack(to_polar(scan.pose.to_sensor(state[:, :2])), axis=1)
        coarse = (self.gate_range_m, float(np.radians(self.gate_bearing_deg)))
        gamma = -2.0 * float(np.log(self.gate_threshold))
        gain = gains[free] if self.cost == "likelihood" else np.zeros(0)
        y, places = scan.y[free], scan.polar[free]
        return Pairs(
            *blobs_in_gates(state, covariance, R, y, axis, polar, places, coarse, gamma, gain, self.miss)
        )
