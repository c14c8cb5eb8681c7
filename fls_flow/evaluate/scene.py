"""Two files on their common pings: what was there, and what was said."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.evaluate.table import Table

__all__ = ["Pings", "Points", "common_pings", "detections_of", "estimates_of", "targets_of", "tracks_of"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Pings:
    """The pings that are scored, in order of time."""

    seq: IntArray  # (n_pings,)
    stamp_ns: IntArray  # (n_pings,)
    notes: tuple[str, ...] = ()  # what the reader of the scores should know of them

    def __len__(self) -> int:
        return self.stamp_ns.size

    @property
    def time_s(self) -> FloatArray:
        """(n_pings,) seconds since the first ping."""
        return np.asarray((self.stamp_ns - self.stamp_ns[:1]) * 1e-9, np.float64)

    @property
    def share_s(self) -> FloatArray:
        """(n_pings,) the time that each ping stands for: half of the gaps on both sides; one ping: 1."""
        if len(self) < 2:
            return np.ones(len(self))
        gap = np.diff(self.time_s)
        return 0.5 * (np.append(gap, gap[-1]) + np.insert(gap, 0, gap[0]))


@dataclass(frozen=True, eq=False)
class Points:
    """Rows of one file, in order of ping; `owner` numbers the tracks or targets from 0."""

    ping: IntArray  # (n,)
    owner: IntArray  # (n,)
    name: IntArray  # (n_owners,) ids as the file gives them
    position_m: FloatArray  # (n, 2)
    velocity_mps: FloatArray  # (n, 2); nan: unknown
    covariance: FloatArray  # (n, 2, 2) of the position; nan: unknown
    word: npt.NDArray[np.str_]  # (n,) class of a target, label of a track; empty: unknown
    probability: FloatArray  # (n,) of the label; nan: unknown

    def __len__(self) -> int:
        return self.ping.size


def common_pings(truth: Table, other: Table) -> Pings:
    """The pings of either file; a ping that one of them lacks has no entries there.

    Raises UserError when the files share no ping, give one ping two stamps, or stand in two frames.
    """
    if truth.frame != other.frame and truth.ping.size and other.ping.size and other.kind != "detections":
        raise UserError(
            f"{other.path}: frame is '{other.frame}', that of {truth.path} '{truth.frame}'; convert one"
        )
    shared = np.intersect1d(truth.stamp_ns, other.stamp_ns)
    _refuse_two_stamps(truth, other)
    if not shared.size and truth.stamp_ns.size and other.stamp_ns.size:
        raise UserError(f"{other.path}: shares no stamp_ns with {truth.path}; are they of one run?")
    notes = []
    for one, lacking in ((other, truth), (truth, other)):
        alone = one.stamp_ns.size - shared.size
        if alone:
            notes.append(f"pings only in {one.path.name}: {alone}; {lacking.path.name} counts as empty there")
    stamp_ns, first = np.unique(np.concatenate([truth.stamp_ns, other.stamp_ns]), return_index=True)
    seq = np.concatenate([truth.seq, other.seq])[first]
    return Pings(seq, stamp_ns, tuple(notes))


def _refuse_two_stamps(truth: Table, other: Table) -> None:
    a, b = _alone(truth.seq), _alone(other.seq)
    seq, i, j = np.intersect1d(truth.seq[a], other.seq[b], assume_unique=True, return_indices=True)
    mine, theirs = truth.stamp_ns[a][i], other.stamp_ns[b][j]
    wrong = np.flatnonzero(mine != theirs)
    if wrong.size:
        n = wrong[0]
        raise UserError(
            f"{other.path}: ping seq {seq[n]} has stamp_ns {theirs[n]}, in {truth.path} it has {mine[n]}; "
            "are they of one run?"
        )


def _alone(values: IntArray) -> npt.NDArray[np.bool_]:
    """Which values occur once: a sensor's ping number may repeat."""
    _, inverse, count = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray(count[inverse] == 1)


def targets_of(truth: Table, pings: Pings) -> Points:
    """The targets of a truth file."""
    return _points(truth, pings, np.ones(truth.ping.size, bool), "target_id", "class")


def tracks_of(tracks: Table, pings: Pings, *, tentative: bool = False) -> Points:
    """The confirmed tracks, and the tentative ones on demand; a row `lost` is no track any more."""
    status = tracks.columns.get("status")
    kept = np.ones(tracks.ping.size, bool)
    if status is not None:
        kept = np.isin(status, ("confirmed", "", *(["tentative"] if tentative else [])))
    return _points(tracks, pings, kept, "track_id", "label")


def estimates_of(estimates: Table, pings: Pings) -> Points:
    """The estimates of a PHD filter, each its own owner."""
    return _points(estimates, pings, np.ones(estimates.ping.size, bool), None, None)


def detections_of(detections: Table, pings: Pings) -> Points:
    """Detections in Cartesian coordinates of the sensor, each its own owner."""
    distance, bearing = detections.columns["range_m"], detections.columns["bearing_rad"]
    places = {"x_m": distance * np.cos(bearing), "y_m": distance * np.sin(bearing)}
    return _points(
        replace(detections, columns=detections.columns | places),
        pings,
        np.ones(detections.ping.size, bool),
        None,
        None,
    )


def _points(
    table: Table, pings: Pings, kept: npt.NDArray[np.bool_], key: str | None, word: str | None
) -> Points:
    n = int(np.count_nonzero(kept))

    def column(name: str) -> FloatArray:
        values: npt.NDArray[Any] | None = table.columns.get(name)
        return np.full(n, np.nan) if values is None else np.asarray(values[kept], np.float64)

    ids = np.arange(n) if key is None else table.columns[key][kept]
    names, owner = np.unique(ids, return_inverse=True)
    covariance = np.stack([column(name) for name in ("var_x", "cov_xy", "cov_xy", "var_y")], axis=1)
    words = table.columns.get(word) if word else None
    return Points(
        np.searchsorted(pings.stamp_ns, table.stamp_ns)[table.ping[kept]],
        owner.astype(np.int64),
        names.astype(np.int64),
        np.stack([column("x_m"), column("y_m")], axis=1),
        np.stack([column("vx_mps"), column("vy_mps")], axis=1),
        covariance.reshape(n, 2, 2),
        np.full(n, "", np.str_) if words is None else words[kept],
        column("probability"),
    )
