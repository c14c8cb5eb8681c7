"""Marks on the fan: detections, wakes, noisy beams, tracks with their trails and ellipses, and the truth."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from fls_flow import DetectionKind, TrackStatus
from fls_sinks.fan import Fan
from fls_sinks.scene import Scene

if TYPE_CHECKING:  # matplotlib is loaded when something is drawn
    from matplotlib.axes import Axes

__all__ = ["detections", "ellipse", "noisy_beams", "tracks", "trails", "truth", "wakes", "wedge"]

FloatArray = npt.NDArray[np.float64]

MARKS = {
    DetectionKind.ECHO: ("echo", "o", "#ffb000"),
    DetectionKind.SELF_NOISE: ("self-noise", "s", "#ff6f91"),
    DetectionKind.WAKE_END: ("wake end", "^", "#5ad1ff"),
}
TRACK_COLOURS = ("#00e5c8", "#ff5a5a", "#b4ff3c", "#ff9bff", "#7fb2ff", "#ffd84d", "#ff8a3c", "#c9a6ff")
TENTATIVE_COLOUR = "#d0d0d0"
WAKE_COLOUR = "#5ad1ff"
NOISE_COLOUR = "#ff6f91"
TRUTH_COLOUR = "#ffffff"


def detections(axes: Axes, scene: Scene) -> None:
    """Mark each detection by its kind."""
    for kind, (label, marker, colour) in MARKS.items():
        x, y = scene.detection_m[scene.detection_kind == kind].T
        if x.size:
            axes.plot(y, x, marker, mfc="none", mec=colour, ms=5, mew=0.9, label=label, zorder=4, ls="none")


def wakes(axes: Axes, scene: Scene) -> None:
    """Tint the wedges of all wakes, and mark their ends."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    shown = np.isfinite(scene.wake_apex_m).all(axis=1) & np.isfinite(scene.wake_shape).all(axis=1)
    if not shown.any():
        return
    wedges = [
        wedge(apex, *shape)[:, ::-1]
        for apex, shape in zip(scene.wake_apex_m[shown], scene.wake_shape[shown], strict=True)
    ]
    # one path: where wedges overlap, the tint does not add up and the echoes stay visible
    union = Path.make_compound_path(*(Path(corners, closed=True) for corners in wedges))
    axes.add_patch(
        PathPatch(union, fc=WAKE_COLOUR + "28", ec=WAKE_COLOUR + "70", lw=0.6, label="wake", zorder=2)
    )
    x, y = scene.wake_apex_m[scene.wake_end].T
    axes.plot(y, x, ".", color=WAKE_COLOUR, ms=5, zorder=2)


def wedge(apex_m: FloatArray, orientation_rad: float, length_m: float, half_angle_rad: float) -> FloatArray:
    """The closed polygon [x, y] of a wedge of wake: its apex, the arc, and the apex again."""
    angle = orientation_rad + np.linspace(-half_angle_rad, half_angle_rad, 9)
    arc = apex_m + length_m * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.concatenate([apex_m[None], arc, apex_m[None]])


def noisy_beams(axes: Axes, scene: Scene, image: Fan) -> None:
    """Draw a line along each noisy beam."""
    near, far = image.range_edge_m[0], image.range_edge_m[-1]
    for number, bearing in enumerate(scene.noisy_rad):
        ends = np.array([near, far])
        axes.plot(
            ends * np.sin(bearing),
            ends * np.cos(bearing),
            color=NOISE_COLOUR,
            lw=1.0,
            ls=":",
            label=None if number else "noisy beam",
            zorder=2,
        )


def truth(axes: Axes, scene: Scene) -> None:
    """Mark where the targets are in truth."""
    if len(scene.truth_m):
        x, y = scene.truth_m.T
        axes.plot(y, x, "+", color=TRUTH_COLOUR, ms=11, mew=1.2, label="truth", zorder=3)


def trails(axes: Axes, scene: Scene) -> None:
    """Draw where confirmed tracks were, fainter for those that ended."""
    for track_id in np.unique(scene.trail_id).tolist():
        x, y = scene.trail_m[scene.trail_id == track_id].T
        alive = track_id in scene.track_id[scene.track_status == TrackStatus.CONFIRMED]
        axes.plot(y, x, "-", color=_colour(track_id), lw=1.3, alpha=0.9 if alive else 0.5, zorder=5)
        if not alive and np.isfinite([x[-1], y[-1]]).all():
            _name(axes, track_id, x[-1], y[-1], faint=True)


def tracks(axes: Axes, scene: Scene, gate_probability: float) -> None:
    """Mark tracks with their ellipses, confirmed ones with their ids and labels."""
    from matplotlib.patches import Ellipse

    named: set[str] = set()
    labels = scene.track_label or ("",) * len(scene.track_id)
    for track_id, label, status, (x, y), covariance in zip(
        scene.track_id.tolist(),
        labels,
        scene.track_status,
        scene.track_m,
        scene.track_covariance,
        strict=True,
    ):
        if status == TrackStatus.LOST or not np.isfinite([x, y]).all():
            continue
        confirmed = status == TrackStatus.CONFIRMED
        colour = _colour(track_id) if confirmed else TENTATIVE_COLOUR
        word = "confirmed track" if confirmed else "tentative track"
        axes.plot(
            y, x, "D" if confirmed else "x", color=colour, ms=5, zorder=6, ls="none",
            mec="k" if confirmed else colour, mew=0.6 if confirmed else 1.0,
            label=None if word in named else word,
        )  # fmt: skip
        named.add(word)
        if confirmed:
            _name(axes, track_id, x, y, faint=False, label=label)
        if np.isfinite(covariance).all():
            long, short, angle = ellipse(covariance, gate_probability)
            turned = 90.0 - math.degrees(angle)  # the picture's horizontal axis is y
            axes.add_patch(
                Ellipse((y, x), 2 * long, 2 * short, angle=turned, fill=False, ec=colour, zorder=6)
            )


def ellipse(covariance: FloatArray, gate_probability: float) -> tuple[float, float, float]:
    """Semi-axes (m, the longer first) and angle from x to y (rad) of the ellipse that holds a probability.

    gamma = -2 ln(1 - P) for two degrees of freedom; the axes are sqrt(gamma eigenvalue).
    """
    values, vectors = np.linalg.eigh(covariance)
    gamma = -2.0 * math.log1p(-gate_probability)
    short, long = np.sqrt(gamma * np.maximum(values, 0.0))
    return float(long), float(short), float(np.arctan2(vectors[1, 1], vectors[0, 1]))


def _name(axes: Axes, track_id: int, x: float, y: float, faint: bool, label: str = "") -> None:
    from matplotlib.patheffects import withStroke

    axes.annotate(
        f"{track_id} {label}".rstrip(),
        (y, x),
        xytext=(6, 6),
        textcoords="offset points",
        color=_colour(track_id),
        fontsize=8 if faint else 11,
        fontweight="normal" if faint else "bold",
        alpha=0.7 if faint else 1.0,
        path_effects=[withStroke(linewidth=2.0, foreground="black")],
        annotation_clip=True,
        zorder=7,
    )


def _colour(track_id: int) -> str:
    return TRACK_COLOURS[track_id % len(TRACK_COLOURS)]
