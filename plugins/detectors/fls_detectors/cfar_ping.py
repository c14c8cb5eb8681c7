"""What all CFAR nodes share: from a ping and what is to be left out to cells, and from hits to detections."""

from __future__ import annotations

import logging
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fls_detectors.exclusion import all_finite, cell_flags, gate_shapes, mark_ellipses, mark_wedges, no_marks
from fls_detectors.reference import NO_FLAGS, Flags, Window
from fls_flow import BeamMask, Detections, Ping, Tracks, TrackStatus, Wakes, geometry
from fls_flow.kernels import frozen

__all__ = [
    "CfarSettings",
    "beam_scale",
    "cell_flags_of",
    "check_settings",
    "detections_of",
    "empty",
    "quantum",
    "window_of",
]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
log = logging.getLogger(__name__)


class CfarSettings(Protocol):
    """The parameters that all CFAR nodes have; what they mean stands in `rayleigh_cfar.RayleighCfar`."""

    pfa: float
    guard_m: float
    guard_beams: int
    reference_m: float
    max_ref: int
    min_ref: int
    widen_m: float
    gate: float
    gate_radius_m: float
    gate_limit_m: float
    floor: float | None
    threshold_scale: float | tuple[float, ...]
    max_detections: int


def check_settings(settings: CfarSettings) -> None:
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


def window_of(settings: CfarSettings, cell_m: float) -> Window:
    """The reference window for range cells of `cell_m`."""
    return Window.of(
        cell_m,
        guard_m=settings.guard_m,
        guard_beams=settings.guard_beams,
        reference_m=settings.reference_m,
        max_ref=settings.max_ref,
        widen_m=settings.widen_m,
    )


def beam_scale(settings: CfarSettings, n_beams: int) -> FloatArray:
    """(n_beams,) factors of the threshold; ValueError when there are others than the ping's beams."""
    scale = np.asarray(settings.threshold_scale, float)
    if scale.ndim and scale.size != n_beams:
        raise ValueError(f"threshold_scale has {scale.size} entries, the ping has {n_beams} beams")
    return np.broadcast_to(scale, (n_beams,))


def quantum(settings: CfarSettings, ping: Ping) -> float:
    """Amplitudes below it are not told from zero: `floor`, or one step of integers."""
    if settings.floor is not None:
        return settings.floor
    return 1.0 if np.issubdtype(ping.amplitude.dtype, np.integer) else 0.0


def empty(ping: Ping) -> bool:
    """Whether the ping has too few cells for any decision."""
    return ping.range_m.size < 2 or not ping.bearing_rad.size


def cell_flags_of(
    settings: CfarSettings,
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


def _gates(settings: CfarSettings, ping: Ping, tracks: Tracks | None) -> tuple[FloatArray, FloatArray]:
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


def detections_of(ping: Ping, hits: BoolArray, most: int, *, warned: bool) -> tuple[Detections, bool]:
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
