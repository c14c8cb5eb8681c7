from collections.abc import Callable

import numpy as np
import pytest

from fls_flow import Ping, Tracks

STEP_NS = 500_000_000


@pytest.fixture
def make_ping() -> Callable[..., Ping]:
    def make(seq=0, shape=(60, 21), seed=0, dtype=np.float32, **fields):
        rng = np.random.default_rng([seed, seq])
        n_ranges, n_beams = shape
        fields.setdefault("amplitude", rng.rayleigh(20.0, shape).astype(dtype))
        fields.setdefault("range_m", (np.arange(n_ranges) + 0.5) * 0.5)
        fields.setdefault("bearing_rad", np.radians(np.linspace(-30, 30, n_beams)))
        return Ping(seq, seq * STEP_NS, beamwidth_rad=np.radians(3.0), **fields)

    return make


@pytest.fixture
def make_tracks() -> Callable[..., Tracks]:
    def make(seq=0, ids=(1, 2), status=None, state=None, frame="sensor", seed=0):
        rng = np.random.default_rng([seed, seq])
        n = len(ids)
        root = rng.normal(size=(n, 4, 4))
        return Tracks(
            seq,
            seq * STEP_NS,
            np.array(ids, np.int64),
            np.ones(n, np.uint8) if status is None else np.array(status, np.uint8),
            rng.normal(10.0, 3.0, (n, 4)) if state is None else np.array(state, float).reshape(n, 4),
            root @ root.transpose(0, 2, 1),
            np.ones(n, np.int64),
            np.ones(n, np.int64),
            frame,
        )

    return make
