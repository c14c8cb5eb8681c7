"""Simulated divers beside real ones: stays, turns and sizes over time are of one order."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def both():
    spec = importlib.util.spec_from_file_location("diver_motion", ROOT / "benchmarks" / "diver_motion.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    simulated = module.simulated_tracks(range(10, 12))
    return module.measured(module.real_tracks()), module.measured(simulated)


@pytest.mark.parametrize(
    ("name", "factor"), [("stay", 1.5), ("turn", 2.0), ("size", 1.6), ("aspect", 1.5), ("speed", 2.2)]
)
def test_medians_are_of_one_order(both, name, factor):
    real, simulated = (np.median(one[name]) for one in both)
    assert 1 / factor < simulated / real < factor


def test_simulated_divers_are_not_slower_than_real_ones(both):
    """The real ones search in tanks; the scene's 0.3 to 0.6 m/s are those of a diver under way."""
    real, simulated = both
    assert np.median(simulated["speed"]) > np.median(real["speed"])
    assert np.percentile(simulated["speed"], 95) < 2.0 * np.percentile(real["speed"], 95)
