"""Clutter that persists from ping to ping: how far the last ping announced what this one shows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow import Ping
from fls_flow.geometry import wrap
from fls_flow.kernels import compiled, frozen

__all__ = ["ClutterMemory", "Recall", "place_powers", "row_powers"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Image = npt.NDArray[Any]

GUARD, STRIDE, REFERENCES = 4, 2, 32  # cells; references on either side
SAMPLED_ROWS = 64  # from which the correlation is estimated
MEMORY = 20  # pings over which it is averaged
BOUND = 8.0  # of the powers that are correlated, so that echoes do not count as clutter
MOST = 0.95  # of the correlation of powers
ALL_VALID: BoolArray = np.zeros((0, 0), bool)


class Recall(NamedTuple):
    """Normalised powers of clutter or targets at places, and how much of clutter's power persists."""

    now: FloatArray  # (m,) z
    before: FloatArray  # (m,) z', in the last ping
    correlation: float  # rho^2

    @classmethod
    def nothing(cls, m: int) -> Recall:
        """Of places that were not seen before."""
        return cls(np.ones(m), np.ones(m), 0.0)

    def take(self, which: IntArray) -> Recall:
        """Of some of the places."""
        return Recall(self.now[which], self.before[which], self.correlation)

    def announced(self) -> FloatArray:
        """max(0, ln p(z | z') - ln p(z)) of clutter, (m,): how much likelier the last ping made it.

        Of jointly complex Gaussian amplitudes with |correlation|^2 = rho^2 between pings, p(z) = exp(-z) and
        p(z | z') = exp(-(z + rho^2 z') / c) I0(2 rho sqrt(z z') / c) / c, c = 1 - rho^2.

        Source: Middleton 1960, the joint density of two Rayleigh amplitudes; the bound is ours.
        """
        if self.correlation <= 0.0:
            return np.zeros(self.now.size)
        centre = np.sqrt(self.correlation * self.before)
        extra: FloatArray = np.maximum(self._log_density(centre) + self.now, 0.0)
        return extra

    def standing(self, amplitude: FloatArray) -> FloatArray:
        """ln p(z | z', target) - ln p(z | z', clutter) of a target that stands in its cell, (m,).

        With its `amplitude` (m,) A above clutter's, the amplitude is expected at (1 - rho) A + rho sqrt(z').
        """
        rho = np.sqrt(self.correlation)
        centre = rho * np.sqrt(self.before)
        return self._log_density(centre + (1.0 - rho) * amplitude) - self._log_density(centre)

    def _log_density(self, centre: FloatArray) -> FloatArray:
        """ln of the density of the power z of a complex Gaussian of variance c about an amplitude."""
        c = 1.0 - self.correlation
        density: FloatArray = (
            _log_i0(2.0 * np.sqrt(self.now) * centre / c) - (self.now + centre * centre) / c - np.log(c)
        )
        return density


@dataclass
class ClutterMemory:
    """What is remembered of the last ping: its image, and how much of clutter's power persists."""

    image: Image = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    range_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    bearing_rad: FloatArray = field(default_factory=lambda: np.zeros(0))
    sampled: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # powers of the sampled rows
    correlation: float = 0.0  # rho^2, of powers in neighbouring pings
    pings: int = 0  # that it is the mean of

    def recall(self, ping: Ping, range_m: FloatArray, bearing_rad: FloatArray) -> Recall:
        """What places (m,) of this ping show and showed in the last one; remembers this ping.

        The power of a place is that of the highest cell beside it, over the mean of its reference. Without a
        last ping of the same cells and beams nothing correlates.
        """
        valid = frozen(ALL_VALID if ping.valid is None else ping.valid)
        sampled = row_powers(frozen(ping.amplitude), valid, _sampled_rows(ping.range_m.size))
        recalled = Recall.nothing(range_m.size)
        if self._covers(ping):
            pings = min(self.pings + 1, MEMORY)
            self.correlation += (_power_correlation(sampled, self.sampled) - self.correlation) / pings
            self.pings = pings
            row, beam = _cells(ping, range_m, bearing_rad)
            closed = _closes_circle(ping.bearing_rad)
            powers = place_powers(frozen(ping.amplitude), frozen(self.image), valid, row, beam, closed)
            recalled = Recall(*powers, min(max(self.correlation, 0.0), MOST))
        self.image, self.sampled = ping.amplitude.copy(), sampled
        self.range_m, self.bearing_rad = ping.range_m.copy(), ping.bearing_rad.copy()
        return recalled

    def _covers(self, ping: Ping) -> bool:
        return (
            ping.amplitude.size > 0
            and self.image.dtype == ping.amplitude.dtype
            and np.array_equal(self.range_m, ping.range_m)
            and np.array_equal(self.bearing_rad, ping.bearing_rad)
        )

    def snapshot(self) -> dict[str, Any]:
        """Copies of all that is remembered."""
        return {
            "image": self.image.copy(),
            "range_m": self.range_m.copy(),
            "bearing_rad": self.bearing_rad.copy(),
            "sampled": self.sampled.copy(),
            "correlation": self.correlation,
            "pings": self.pings,
        }

    @classmethod
    def restored(cls, saved: dict[str, Any]) -> ClutterMemory:
        """The memory that gave the snapshot `saved`."""
        arrays = {name: np.array(saved[name]) for name in ("image", "range_m", "bearing_rad", "sampled")}
        return cls(**arrays, correlation=float(saved["correlation"]), pings=int(saved["pings"]))


def _log_i0(x: FloatArray) -> FloatArray:
    """ln I0(x), for x where I0 itself overflows too; to 1e-4."""
    large = np.maximum(x, 20.0)
    value: FloatArray = np.where(
        x < 20.0,
        np.log(np.i0(np.minimum(x, 20.0))),
        large - 0.5 * np.log(2.0 * np.pi * large) + 0.125 / large,
    )
    return value


def _power_correlation(one: FloatArray, other: FloatArray) -> float:
    """Correlation of clutter's normalised powers, the squared modulus of that of its amplitudes."""
    one, other = np.minimum(one.ravel(), BOUND), np.minimum(other.ravel(), BOUND)
    spread = float(one.std() * other.std())
    return float(np.mean(one * other) - one.mean() * other.mean()) / spread if spread > 0.0 else 0.0


def _sampled_rows(n_ranges: int) -> IntArray:
    return np.unique(np.linspace(0, n_ranges - 1, min(SAMPLED_ROWS, n_ranges)).astype(np.int64))


def _cells(ping: Ping, range_m: FloatArray, bearing_rad: FloatArray) -> tuple[IntArray, IntArray]:
    """The nearest row and beam of each place."""
    row = _nearest(ping.range_m, range_m)
    order = np.argsort(ping.bearing_rad)
    table = ping.bearing_rad[order]
    around = np.concatenate([table[-1:] - 2.0 * np.pi, table, table[:1] + 2.0 * np.pi])
    which = np.concatenate([order[-1:], order, order[:1]])
    return row, which[_nearest(around, wrap(bearing_rad))]


def _closes_circle(bearing_rad: FloatArray) -> bool:
    gap = 2.0 * np.pi - float(np.ptp(bearing_rad))
    return bearing_rad.size > 2 and 0.0 < gap < 1.5 * float(np.abs(np.diff(bearing_rad)).max())


def _nearest(table: FloatArray, values: FloatArray) -> IntArray:
    after = np.clip(np.searchsorted(table, values), 1, max(table.size - 1, 1))
    after = np.minimum(after, table.size - 1)
    before = np.maximum(after - 1, 0)
    nearest: IntArray = np.where(values - table[before] <= table[after] - values, before, after)
    return nearest


@compiled
def place_powers(
    image: Image, last: Image, valid: BoolArray, row: IntArray, beam: IntArray, closed: bool
) -> tuple[FloatArray, FloatArray]:
    """Normalised powers (m,) of two images in the cell beside each place where the first is highest."""
    n_ranges, n_beams = image.shape
    now, before = np.ones(row.size), np.ones(row.size)
    for i in range(row.size):
        best, r, b = -1.0, row[i], beam[i]
        for k in range(max(row[i] - 1, 0), min(row[i] + 2, n_ranges)):
            for step in range(-1, 2):
                j = beam[i] + step
                if closed:
                    j %= n_beams
                if 0 <= j < n_beams and image[k, j] > best:  # never for nan
                    best, r, b = float(image[k, j]), k, j
        now[i] = _normalised(image, valid, r, b)
        before[i] = _normalised(last, valid, r, b)
    return now, before


@compiled
def row_powers(image: Image, valid: BoolArray, rows: IntArray) -> FloatArray:
    """Normalised powers of whole rows of an image, (rows, n_beams)."""
    n_ranges, n_beams = image.shape
    powers = np.ones((rows.size, n_beams))
    total, count = np.empty(n_beams), np.empty(n_beams)
    for i in range(rows.size):
        total[:], count[:] = 0.0, 0.0
        for k in range(REFERENCES):
            for side in (-1, 1):
                r = rows[i] + side * (GUARD + 1 + k * STRIDE)
                if 0 <= r < n_ranges:
                    for b in range(n_beams):
                        x = float(image[r, b])
                        if np.isfinite(x) and (valid.size == 0 or valid[r, b]):
                            total[b] += x * x
                            count[b] += 1.0
        for b in range(n_beams):
            x = float(image[rows[i], b])
            if np.isfinite(x) and (valid.size == 0 or valid[rows[i], b]) and total[b] > 0.0:
                powers[i, b] = x * x * count[b] / total[b]
    return powers


@compiled
def _normalised(image: Image, valid: BoolArray, row: int, beam: int) -> float:
    """The power of a cell over the mean of its reference; 1 where it is not known."""
    x = float(image[row, beam])
    if not np.isfinite(x) or (valid.size and not valid[row, beam]):
        return 1.0
    total, count = 0.0, 0.0
    for k in range(REFERENCES):
        for side in (-1, 1):
            r = row + side * (GUARD + 1 + k * STRIDE)
            if 0 <= r < image.shape[0]:
                y = float(image[r, beam])
                if np.isfinite(y) and (valid.size == 0 or valid[r, beam]):
                    total += y * y
                    count += 1.0
    return x * x * count / total if total > 0.0 else 1.0
