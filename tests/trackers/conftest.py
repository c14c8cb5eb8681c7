"""Scenes for the trackers: detections of a 39-beam sonar that sees 50 m, two pings a second."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from fls_flow import Detections, View

FloatArray = npt.NDArray[np.float64]
MakeDetections = Callable[..., Detections]

VIEW = View(1.0, 50.0, 0.05, np.deg2rad((np.arange(39) - 19) * 1.5), np.deg2rad(1.5))
PING_NS = 500_000_000


def _detections(
    k: int,
    range_m: npt.ArrayLike,
    bearing_rad: npt.ArrayLike,
    *,
    view: View = VIEW,
    kind: npt.ArrayLike = 0,
    stamp_ns: int | None = None,
    amplitude: npt.ArrayLike = 1.0,
) -> Detections:
    r = np.atleast_1d(np.asarray(range_m, float))
    return Detections(
        k,
        1_000_000_000 + k * PING_NS if stamp_ns is None else stamp_ns,
        r,
        np.atleast_1d(np.asarray(bearing_rad, float)),
        np.broadcast_to(np.asarray(amplitude, float), r.shape),
        np.zeros((r.size, 2)),
        np.zeros((r.size, 2, 2)),
        np.broadcast_to(np.asarray(kind, np.uint8), r.shape),
        view,
    )


@pytest.fixture
def view() -> View:
    return VIEW


@pytest.fixture
def detections() -> MakeDetections:
    """Makes the detections of ping k at the given polar positions."""
    return _detections


@pytest.fixture
def clutter() -> Callable[[np.random.Generator, float], tuple[FloatArray, FloatArray]]:
    """Draws a Poisson number of false detections, uniform over the sector."""

    def draw(rng: np.random.Generator, mean: float, view: View = VIEW) -> tuple[FloatArray, FloatArray]:
        n = int(rng.poisson(mean))
        r = np.sqrt(rng.uniform(view.range_min_m**2, view.range_max_m**2, n))
        return r, rng.uniform(view.bearing_rad[0], view.bearing_rad[-1], n)

    return draw


@pytest.fixture
def observe(
    clutter: Callable[[np.random.Generator, float], tuple[FloatArray, FloatArray]],
) -> Callable[..., Detections]:
    """Draws the detections of ping k: of targets at `xy` (n, 2), and false ones, in any order."""

    def draw(
        rng: np.random.Generator,
        k: int,
        xy: npt.ArrayLike,
        *,
        p_d: float = 0.9,
        sd: tuple[float, float] = (0.05, float(np.deg2rad(1.5))),
        false: float = 0.0,
        view: View = VIEW,
        stamp_ns: int | None = None,
    ) -> Detections:
        xy = np.asarray(xy, float).reshape(-1, 2)
        xy = xy[rng.random(len(xy)) < p_d]
        r = np.hypot(xy[:, 0], xy[:, 1]) + sd[0] * rng.standard_normal(len(xy))
        b = np.arctan2(xy[:, 1], xy[:, 0]) + sd[1] * rng.standard_normal(len(xy))
        clutter_r, clutter_b = clutter(rng, false)
        order = rng.permutation(r.size + clutter_r.size)
        r, b = np.concatenate([r, clutter_r])[order], np.concatenate([b, clutter_b])[order]
        return _detections(k, r, b, view=view, stamp_ns=stamp_ns)

    return draw
