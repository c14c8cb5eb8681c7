"""Images at the ends of the numbers: huge cells spoil no place far off, ones among zeros are nothing."""

from __future__ import annotations

import numpy as np
import pytest

from fls_detectors.mean_energy import MeanEnergy, ring_energy
from fls_detectors.rayleigh_ratio import RayleighRatio
from fls_detectors.snippets import snippets
from fls_detectors.threshold_centroids import ThresholdCentroids
from fls_flow import Detections, Ping

HUGE = [1e6, 1e9, 1e15, 1e30]


def ping(amplitude: np.ndarray) -> Ping:
    n_ranges, n_beams = amplitude.shape
    bearing = np.linspace(0.0, 1.0, n_beams)
    return Ping(
        0, 1, amplitude.astype(np.float32), np.linspace(5.0, 5.0 + 0.1 * (n_ranges - 1), n_ranges), bearing
    )


def speckle(seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).rayleigh(2.0, (300, 39)).astype(np.float32)


@pytest.mark.parametrize("size", HUGE)
def test_snippets_elsewhere_keep_their_bits(size: float) -> None:
    image = speckle()
    spoilt = image.copy()
    spoilt[3, 3] = size
    before, after = (snippets(one, None, (15, 10), 0.5) for one in (image, spoilt))
    elsewhere = (before.row > 3)[:, None] | (before.beam > 3)
    assert np.array_equal(before.ratio[elsewhere], after.ratio[elsewhere])
    assert np.array_equal(before.mean[elsewhere], after.mean[elsewhere])


@pytest.mark.parametrize("size", HUGE)
def test_a_glint_makes_no_obstacles_on_the_floor_behind_it(size: float) -> None:
    image = speckle()
    image[3, 3] = size
    found = RayleighRatio()(ping(image))
    assert len(found.shadows) == 0
    assert len(found.detections) == 1
    assert found.detections.range_m[0] == pytest.approx(5.3, abs=0.01)


@pytest.mark.parametrize("half", [0, 1, 7, 60, 400])
def test_the_mean_energy_equals_a_slow_reference(half: int) -> None:
    rng = np.random.default_rng(half)
    count = rng.integers(0, 5, 150)
    total = np.where(count > 0, rng.exponential(size=150) * 10.0 ** rng.integers(0, 30, 150), 0.0)
    windows = [slice(max(0, m - half), m + half + 1) for m in range(150)]
    slow = [total[w].sum() / max(1, count[w].sum()) for w in windows]
    np.testing.assert_allclose(ring_energy(total, count, half), slow, rtol=1e-12)


def test_a_glint_hides_and_makes_no_target_far_behind_it() -> None:
    image = speckle()
    image[200, 20] = 40.0

    def far(found: Detections) -> list[float]:
        return [float(distance) for distance in found.range_m if distance > 20.0]

    without = far(MeanEnergy(window_m=5.0)(ping(image)))
    image[3, 3] = 1e12
    assert far(MeanEnergy(window_m=5.0)(ping(image))) == without
    assert without == pytest.approx([25.0])


@pytest.mark.parametrize("value", [1e30, float(np.finfo(np.float32).max), np.inf])
@pytest.mark.parametrize(
    "node", [MeanEnergy(), RayleighRatio(), ThresholdCentroids()], ids=lambda n: type(n).__name__
)
def test_images_at_the_end_of_the_numbers_are_answered(node: object, value: float) -> None:
    answer = node(ping(np.full((60, 20), value)))  # type: ignore[operator]  # it is a node
    found = answer if isinstance(answer, Detections) else answer[0]
    assert np.isfinite(found.range_m).all()


def test_mean_energy_in_integers_takes_zeros_and_ones_for_no_targets() -> None:
    bearing = np.linspace(-0.4, 0.4, 39)
    distance = np.linspace(5.0, 34.9, 300)
    image = np.rint(np.random.default_rng(2).rayleigh(0.2, (300, 39))).astype(np.uint8)
    assert 0 < np.count_nonzero(image) < 0.1 * image.size
    assert len(MeanEnergy()(Ping(0, 1, image, distance, bearing))) == 0
    image[150, 20] = 9
    assert MeanEnergy()(Ping(0, 1, image, distance, bearing)).range_m == pytest.approx([distance[150]])
