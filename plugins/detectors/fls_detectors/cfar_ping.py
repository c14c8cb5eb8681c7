"""What all CFAR nodes share: from a ping and what is to be left out to cells, and from hits to detections."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_detectors.exclusion import all_finite, cell_flags, gate_shapes, mark_ellipses, mark_wedges, no_marks
from fls_detectors.reference import NO_FLAGS, Flags, Window
from fls_flow import BeamMask, Detections, Ping, Tracks, TrackStatus, Wakes, geometry
from fls_flow.kernels import frozen

__all__ = ["CfarNode"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
log = logging.getLogger(__name__)


@dataclass
class CfarNode(ABC):
    """The parameters of all CFAR nodes, which `rayleigh-cfar` describes, and what they do alike with a ping.

    A kind adds its statistic: `_hits`, and `_ratio` for those who calibrate it. Both are given the reference
    window and `_options`.
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
    threshold_scale: float | tuple[float, ...] = 1.0
    max_detections: int = 20_000  # the strongest are kept
    _warned: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        _check(self)

    def __call__(
        self,
        ping: Ping,
        noisy: BeamMask | None = None,
        wakes: Wakes | None = None,
        tracks: Tracks | None = None,
    ) -> Detections:
        """The detections of one ping."""
        if _empty(ping):
            return Detections.of(ping, range_m=[], bearing_rad=[], amplitude=[])
        options = self._options(ping, noisy, wakes, tracks)
        scale = _beam_scale(self, ping.bearing_rad.size)
        hits = self._hits(ping.amplitude, _window_of(self, ping.cell_m), scale=scale, **options)
        found, self._warned = _detections_of(ping, hits, self.max_detections, warned=self._warned)
        return found

    def threshold_ratio(
        self,
        ping: Ping,
        noisy: BeamMask | None = None,
        wakes: Wakes | None = None,
        tracks: Tracks | None = None,
    ) -> FloatArray:
        """Amplitude over threshold (n_ranges, n_beams) with scale 1, nan where nothing is decided."""
        if _empty(ping):
            return np.full(ping.amplitude.shape, np.nan)
        options = self._options(ping, noisy, wakes, tracks)
        return self._ratio(ping.amplitude, _window_of(self, ping.cell_m), **options)

    @abstractmethod
    def _hits(self, amplitude: npt.NDArray[Any], window: Window, **options: Any) -> BoolArray:
        """Which cells (n_ranges, n_beams) exceed their threshold."""

    @abstractmethod
    def _ratio(self, amplitude: npt.NDArray[Any], window: Window, **options: Any) -> FloatArray:
        """Amplitude over threshold with scale 1."""

    def _options(
        self, ping: Ping, noisy: BeamMask | None, wakes: Wakes | None, tracks: Tracks | None
    ) -> dict[str, Any]:
        return {
            "pfa": self.pfa,
            "min_ref": self.min_ref,
            "floor": _quantum(self, ping),
            "flags": _cell_flags_of(self, ping, noisy, wakes, tracks),
        }

    def snapshot(self) -> dict[str, Any]:
        """Whether the user has been warned."""
        return {"warned": self._warned}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._warned = bool(state["warned"])


def _check(settings: CfarNode) -> None:
    """Raise ValueError for a value that cannot be meant."""
    if not 0.0 < settings.pfa < 1.0:
        raise ValueError(f"pfa must lie between 0 and 1, not {settings.pfa}")
    for name in ("guard_m", "guard_beams", "reference_m", "widen_m", "gate", "floor"):
        value = getattr(settings, name)
        if value is not None and not 0.0 <= value < np.inf:
            raise ValueError(f"{name} must be finite and not negative, not {value}")
    if not 0.0 < settings.gate_radius_m <= settings.gate_limit_m < np.inf:
        raise ValueError(
            f"gate_radius_m {settings.gate_radius_m} to gate_limit_m {settings.gate_limit_m} is no range"
        )
    if settings.min_ref < 1:
        raise ValueError(f"min_ref must be at least 1, not {settings.min_ref}")
    least = max(settings.min_ref, 2 * (2 * settings.guard_beams + 1))
    if settings.max_ref < least:
        raise ValueError(
            f"max_ref must be at least {least} with this guard and min_ref, not {settings.max_ref}"
        )
    scale = np.atleast_1d(np.asarray(settings.threshold_scale, float))
    wrong = scale[~((scale > 0.0) & (scale < np.inf))]
    if wrong.size or not scale.size:
        found = wrong[0] if wrong.size else "an empty list"
        raise ValueError(f"threshold_scale must be positive and finite, not {found}")
    if settings.max_detections < 1:
        raise ValueError(f"max_detections must be at least 1, not {settings.max_detections}")


def _window_of(settings: CfarNode, cell_m: float) -> Window:
    """The reference window for range cells of `cell_m`."""
    return Window.of(
        cell_m,
        guard_m=settings.guard_m,
        guard_beams=settings.guard_beams,
        reference_m=settings.reference_m,
        max_ref=settings.max_ref,
        widen_m=settings.widen_m,
    )


def _beam_scale(settings: CfarNode, n_beams: int) -> FloatArray:
    """(n_beams,) factors of the threshold; ValueError when there are others than the ping's beams."""
    scale = np.asarray(settings.threshold_scale, float)
    if scale.ndim and scale.size != n_beams:
        raise ValueError(f"threshold_scale has {scale.size} entries, the ping has {n_beams} beams")
    return np.broadcast_to(scale, (n_beams,))


def _quantum(settings: CfarNode, ping: Ping) -> float:
    """Amplitudes below it are not told from zero: `floor`, or one step of integers."""
    if settings.floor is not None:
        return settings.floor
    return 1.0 if np.issubdtype(ping.amplitude.dtype, np.integer) else 0.0


def _empty(ping: Ping) -> bool:
    """Whether the ping has too few cells for any decision."""
    return ping.range_m.size < 2 or not ping.bearing_rad.size


def _cell_flags_of(
    settings: CfarNode,
    ping: Ping,
    noisy: BeamMask | None,
    wakes: Wakes | None,
    tracks: Tracks | None,
) -> Flags:
    """The flags of the ping's cells (`exclusion.cell_flags`), `NO_FLAGS` where nothing is left out."""
    n_ranges, n_beams = ping.amplitude.shape
    if noisy is not None and noisy.noisy.size != n_beams:
        raise ValueError(f"noisy has {noisy.noisy.size} beams, the ping has {n_beams}")
    beams = np.zeros(n_beams, bool) if noisy is None else noisy.noisy
    centre_m, shape = _gates(settings, ping, tracks)
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


def _gates(settings: CfarNode, ping: Ping, tracks: Tracks | None) -> tuple[FloatArray, FloatArray]:
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
        innovation[known], settings.gate, settings.gate_radius_m, settings.gate_limit_m
    )


def _knows_pose(ping: Ping) -> bool:
    nav = ping.nav
    return nav is not None and bool(np.isfinite([*nav.position_m[:2], nav.attitude_rad[2]]).all())


def _detections_of(ping: Ping, hits: BoolArray, most: int, *, warned: bool) -> tuple[Detections, bool]:
    """A detection per hit, in order of range, then beam; of more than `most` the strongest.

    Also whether the user has been told by now that some were left out; that is said once.
    """
    rows, beams = np.divmod(np.flatnonzero(hits), max(ping.bearing_rad.size, 1))
    amplitude = ping.amplitude[rows, beams]
    if rows.size > most:
        if not warned:
            log.warning(
                "ping %d has %d detections, the strongest %d are kept (max_detections); said once",
                ping.seq, rows.size, most,
            )  # fmt: skip
        warned = True
        keep = np.sort(np.argsort(-amplitude.astype(float), kind="stable")[:most])
        rows, beams, amplitude = rows[keep], beams[keep], amplitude[keep]
    found = Detections.of(
        ping, range_m=ping.range_m[rows], bearing_rad=ping.bearing_rad[beams], amplitude=amplitude
    )
    return found, warned
