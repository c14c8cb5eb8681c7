"""Pings and detections that the tests of the detectors share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from fls_flow import Detections, Ping


@pytest.fixture
def make_ping() -> Callable[..., Ping]:
    """A ping of the given amplitudes: cells of 0.05 m, beams of 1.5 degrees, in the middle straight ahead."""

    def make(amplitude: npt.ArrayLike, first_m: float = 2.0, **fields: object) -> Ping:
        amplitude = np.asarray(amplitude)
        n_ranges, n_beams = amplitude.shape
        given = {
            "range_m": first_m + 0.05 * np.arange(n_ranges),
            "bearing_rad": np.deg2rad(1.5) * (np.arange(n_beams) - (n_beams - 1) / 2),
            "beamwidth_rad": np.deg2rad(1.5),
        }
        return Ping(7, 1_000, amplitude, **(given | fields))  # type: ignore[arg-type]  # the fields of a ping

    return make


@pytest.fixture
def make_echoes() -> Callable[..., Detections]:
    """Detections at Cartesian positions, of amplitudes that all differ."""

    def make(position_m: npt.ArrayLike, amplitude: npt.ArrayLike | None = None) -> Detections:
        xy = np.asarray(position_m, float).reshape(-1, 2)
        ping = Ping(
            7,
            1_000,
            np.zeros((2000, 39), np.float32),
            0.05 * np.arange(1, 2001),
            np.deg2rad(1.5) * (np.arange(39) - 19),
            beamwidth_rad=np.deg2rad(1.5),
        )
        if amplitude is None:
            amplitude = 100.0 + np.random.default_rng(5).permutation(len(xy))
        return Detections.of(
            ping,
            range_m=np.hypot(xy[:, 0], xy[:, 1]),
            bearing_rad=np.arctan2(xy[:, 1], xy[:, 0]),
            amplitude=amplitude,
        )

    return make
