"""Pings with objects in them, and tracks on these."""

from __future__ import annotations

import numpy as np
import pytest

from fls_flow import Ping, Tracks


@pytest.fixture
def make_ping():
    """A ping of amplitudes (n_ranges, n_beams): 0.1 m cells from 2 m on, beams 0.5 deg apart."""

    def made(amplitude, seq=0, *, cell_m=0.1, spacing_deg=0.5, valid=None, bearing_rad=None, nav=None):
        amplitude = np.asarray(amplitude)
        n_ranges, n_beams = amplitude.shape
        if bearing_rad is None:
            bearing_rad = np.radians(spacing_deg) * (np.arange(n_beams) - (n_beams - 1) / 2)
        range_m = 2.0 + cell_m * np.arange(n_ranges)
        return Ping(seq, seq * 100_000_000, amplitude, range_m, bearing_rad, valid=valid, nav=nav)

    return made


@pytest.fixture
def make_tracks():
    """Confirmed tracks at polar positions, with their hits so far."""

    def made(seq=0, ids=(), range_m=(), bearing_rad=(), hits=None, status=None, frame="sensor"):
        n = len(ids)
        state = np.zeros((n, 4))
        state[:, 0] = np.asarray(range_m, float) * np.cos(bearing_rad)
        state[:, 1] = np.asarray(range_m, float) * np.sin(bearing_rad)
        return Tracks(
            seq,
            seq * 100_000_000,
            np.asarray(ids, np.int64).reshape(n),
            np.ones(n, np.uint8) if status is None else np.asarray(status, np.uint8),
            state,
            np.tile(np.eye(4), (n, 1, 1)),
            np.full(n, seq + 1) if hits is None else np.asarray(hits),
            np.full(n, seq + 1),
            frame,
        )

    return made


@pytest.fixture
def blank():
    """A chip without region, `rows` x `columns`."""

    def made(rows=40, columns=30):
        return np.zeros((rows, columns), bool)

    return made


@pytest.fixture
def rng():
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20261122)
