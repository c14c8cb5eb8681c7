"""Detect cells that stand out of Rayleigh clutter, at a constant false-alarm rate."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.cfar import NO_FLAGS, Flags, Window, rayleigh_hits
from fls_detectors.exclusion import all_finite, cell_flags, gate_shapes, mark_ellipses, mark_wedges, no_marks
from fls_flow import BeamMask, Detections, Ping, Tracks, TrackStatus, Wakes, geometry, hookimpl
from fls_flow.kernels import frozen

__all__ = ["RayleighCfar"]

FloatArray = npt.NDArray[np.float64]
log = logging.getLogger(__name__)


@dataclass
class RayleighCfar:
    """One detection per cell with x > sqrt((pfa^(-1/J) - 1) sum_j x_j^2), in order of range, then beam.

    The J reference cells lie in the beam under test and `guard_beams` to each side, before and behind a
    guard of `guard_m`, spread over `reference_m` a side, with the stride that keeps J <= `max_ref`. J counts
    those that exist, are valid, finite and not excluded. Excluded are the noisy beams (not tested either),
    the wedges of `wakes` and the gates of `tracks` predicted to the ping (both tested all the same); world
    tracks need `ping.nav`, else they exclude nothing. Where fewer than `min_ref` are left, the reference goes
    on outwards, with the same stride, as far as `widen_m`; a cell that still has fewer is not decided.
    Amplitudes below `floor` are not told from zero: the root mean square of the reference counts at
    least that much. By default it is one step of integer amplitudes, else 0; a reference of zeros alone, with
    floor 0, decides nothing.

    False alarms come at the rate `pfa` in Rayleigh clutter. A heavier tail gives far more of them, and they
    hide objects by being taken for wakes: then lower `pfa` until few are left. On the simulated surface 1e-12
    does in K clutter of shape 2 what 1e-6 does in Rayleigh clutter, and 1e-20 nearly so in measured clutter.

    Raises ValueError when `noisy` has another number of beams than the ping.

    Source: Karoui 2015, III-B and (4); reference window and widening are ours.
    """

    pfa: float = 1e-6
    guard_m: float = 1.0
    guard_beams: int = 1
    reference_m: float = 2.0
    max_ref: int = 48
    min_ref: int = 8
    widen_m: float = 20.0
    gate: float = 4.0  # squared Mahalanobis distance that bounds the ellipse around a track
    gate_radius_m: float = 2.0  # its half-axes are at least
    gate_limit_m: float = 10.0  # and at most this long: an uncertain track must not blind the detector
    floor: float | None = None
    max_detections: int = 20_000  # the strongest are kept
    _warned: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.pfa < 1.0:
            raise ValueError(f"pfa must lie between 0 and 1, not {self.pfa}")
        for name in ("guard_m", "guard_beams", "reference_m", "widen_m", "gate", "floor"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < np.inf:
                raise ValueError(f"{name} must be finite and not negative, not {value}")
        if not 0.0 < self.gate_radius_m <= self.gate_limit_m < np.inf:
            raise ValueError(
                f"gate_radius_m {self.gate_radius_m} to gate_limit_m {self.gate_limit_m} is no range"
            )
        if self.min_ref < 1:
            raise ValueError(f"min_ref must be at least 1, not {self.min_ref}")
        least = max(self.min_ref, 2 * (2 * self.guard_beams + 1))
        if self.max_ref < least:
            raise ValueError(
                f"max_ref must be at least {least} with this guard and min_ref, not {self.max_ref}"
            )
        if self.max_detections < 1:
            raise ValueError(f"max_detections must be at least 1, not {self.max_detections}")

    def __call__(
        self,
        ping: Ping,
        noisy: BeamMask | None = None,
        wakes: Wakes | None = None,
        tracks: Tracks | None = None,
    ) -> Detections:
        """The detections of one ping."""
        if ping.range_m.size < 2 or not ping.bearing_rad.size:
            return Detections.of(ping, range_m=[], bearing_rad=[], amplitude=[])
        hits = rayleigh_hits(
            ping.amplitude,
            self.window(ping.cell_m),
            pfa=self.pfa,
            min_ref=self.min_ref,
            floor=self._floor(ping),
            flags=self._flags(ping, noisy, wakes, tracks),
        )
        return self._detections(ping, np.flatnonzero(hits))

    def window(self, cell_m: float) -> Window:
        """The reference window for range cells of `cell_m`."""
        return Window.of(
            cell_m,
            guard_m=self.guard_m,
            guard_beams=self.guard_beams,
            reference_m=self.reference_m,
            max_ref=self.max_ref,
            widen_m=self.widen_m,
        )

    def snapshot(self) -> dict[str, Any]:
        """Whether the user has been warned."""
        return {"warned": self._warned}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._warned = bool(state["warned"])

    def _floor(self, ping: Ping) -> float:
        if self.floor is not None:
            return self.floor
        return 1.0 if np.issubdtype(ping.amplitude.dtype, np.integer) else 0.0

    def _flags(self, ping: Ping, noisy: BeamMask | None, wakes: Wakes | None, tracks: Tracks | None) -> Flags:
        n_ranges, n_beams = ping.amplitude.shape
        if noisy is not None and noisy.noisy.size != n_beams:
            raise ValueError(f"noisy has {noisy.noisy.size} beams, the ping has {n_beams}")
        beams = np.zeros(n_beams, bool) if noisy is None else noisy.noisy
        centre_m, shape = self._gates(ping, tracks)
        shapes = len(centre_m) + (0 if wakes is None else len(wakes))
        if not shapes and not beams.any() and ping.valid is None and all_finite(ping.amplitude):
            return NO_FLAGS
        marks = no_marks(n_ranges, n_beams)
        spacing = ping.beam_spacing_rad
        table = (frozen(ping.range_m), frozen(ping.bearing_rad), 0.5 * spacing if spacing > 0.0 else 0.0)
        if len(centre_m):
            mark_ellipses(marks, *table, frozen(centre_m), frozen(shape))
        if wakes is not None and len(wakes):
            wedge = (wakes.apex_m, wakes.orientation_rad, wakes.length_m, wakes.half_angle_rad)
            mark_wedges(marks, *table, *map(frozen, wedge))
        return cell_flags(ping.amplitude, marks, beams, ping.valid)

    def _gates(self, ping: Ping, tracks: Tracks | None) -> tuple[FloatArray, FloatArray]:
        """Centres and shapes of the gates of living tracks, at the time and in the frame of the ping."""
        if tracks is None or not len(tracks):
            return np.zeros((0, 2)), np.zeros((0, 2, 2))
        alive = tracks.status != TrackStatus.LOST
        dt_s = max(ping.stamp_ns - tracks.stamp_ns, 0) * 1e-9
        state, covariance = geometry.predict(tracks.state[alive], tracks.covariance[alive], dt_s)
        position, covariance = state[:, :2], covariance[:, :2, :2]
        if tracks.frame == "ned":
            if not _knows_pose(ping):
                return np.zeros((0, 2)), np.zeros((0, 2, 2))
            pose = geometry.sensor_pose(ping.nav, ping.mount)  # type: ignore[arg-type]  # it is known
            turn = geometry.turn(-pose.heading_rad)
            position, covariance = pose.to_sensor(position), turn @ covariance @ turn.T
        distance, bearing = geometry.to_polar(position)
        noise = geometry.debiased_covariance(distance, bearing, ping.cell_m, abs(ping.beam_spacing_rad))
        innovation = covariance + noise
        known = np.isfinite(position).all(axis=1) & np.isfinite(innovation).all(axis=(1, 2))
        return position[known], gate_shapes(
            innovation[known], self.gate, self.gate_radius_m, self.gate_limit_m
        )

    def _detections(self, ping: Ping, cells: npt.NDArray[np.intp]) -> Detections:
        rows, beams = np.divmod(cells, ping.bearing_rad.size)
        amplitude = ping.amplitude[rows, beams]
        if cells.size > self.max_detections:
            if not self._warned:
                log.warning(
                    "ping %d has %d detections, the strongest %d are kept (max_detections); said once",
                    ping.seq, cells.size, self.max_detections,
                )  # fmt: skip
                self._warned = True
            keep = np.sort(np.argsort(-amplitude.astype(float), kind="stable")[: self.max_detections])
            rows, beams, amplitude = rows[keep], beams[keep], amplitude[keep]
        return Detections.of(
            ping, range_m=ping.range_m[rows], bearing_rad=ping.bearing_rad[beams], amplitude=amplitude
        )


def _knows_pose(ping: Ping) -> bool:
    nav = ping.nav
    return nav is not None and bool(np.isfinite([*nav.position_m[:2], nav.attitude_rad[2]]).all())


@hookimpl
def fls_node() -> type[RayleighCfar]:
    """The kind `rayleigh-cfar`."""
    return RayleighCfar
