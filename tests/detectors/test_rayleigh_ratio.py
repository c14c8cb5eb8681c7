"""The std / mean test on snippets: theory, a slow reference, echoes and shadows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import ndimage

from fls_detectors.rayleigh_ratio import RayleighRatio
from fls_detectors.snippets import RATIO_SD, RAYLEIGH_RATIO, areas, painted, snippets, starts
from fls_flow import Ping
from fls_flow.testing import check_node
from fls_sources.ground_scene import GroundScene


def speckle(seed: int, shape: tuple[int, int] = (600, 40), scale: float = 30.0) -> np.ndarray:
    return np.random.default_rng(seed).rayleigh(scale, shape).astype(np.float32)


@pytest.mark.parametrize("scale", [0.01, 1.0, 4000.0])
def test_the_ratio_of_rayleigh_amplitudes_and_its_spread(scale):
    """sqrt(4 / pi - 1) for any scale, sd 0.3713 / sqrt(n)."""
    grid = snippets(speckle(1, (6000, 40), scale), None, (15, 10), 0.0)
    assert grid.ratio.size == 1600
    assert_allclose(grid.ratio.mean(), RAYLEIGH_RATIO, atol=4 * RATIO_SD / np.sqrt(150 * 1600))
    assert_allclose(grid.ratio.std(), RATIO_SD / np.sqrt(150), rtol=0.08)
    assert_allclose(RAYLEIGH_RATIO, 0.52272, atol=1e-5)


def test_speckle_alone_makes_few_detections(make_ping):
    """5 sigma: of some 560 snippets per ping hardly one is flagged in 100 pings (the law has a heavier tail)."""
    node = RayleighRatio()
    found = [node(make_ping(speckle(seed))) for seed in range(100)]
    assert sum(len(one.detections) + len(one.shadows) for one in found) <= 5


@pytest.mark.parametrize("dtype", [np.float32, np.uint16, np.uint8])
def test_an_echo_is_found_at_its_place(make_ping, dtype):
    image = speckle(3)
    image[300:312, 18:22] += 180.0
    found = RayleighRatio()(make_ping(np.clip(image, 0, 255).astype(dtype)))
    assert len(found.detections) == 1
    assert_allclose(found.detections.range_m, 2.0 + 0.05 * 305.5, atol=0.2)
    assert_allclose(found.detections.bearing_rad, 0.0, atol=np.deg2rad(1.5))
    assert found.detections.amplitude[0] > 45.0  # the floor has 37.6
    assert found.detections.extent[0, 0] > 0.5


@pytest.mark.parametrize("stored", [np.rint, np.floor], ids=["rounded", "cut off"])
def test_faint_speckle_in_integers_makes_no_areas(make_ping, stored):
    """From a fiftieth of a step to thirty: what is mostly zeros and ones is no speckle by its ratio.

    Between 2 and 4 steps amplitudes that are cut off leave some unless `floor` is 4, as it is here.
    """
    node, found = RayleighRatio(floor=None if stored is np.rint else 4.0), 0
    for seed, scale in enumerate([0.02, 0.1, 0.25, 0.5, 1.0, 1.5, 1.8, 2.0, 2.2, 3.0, 5.0, 10.0, 30.0]):
        one = node(make_ping(stored(speckle(seed, scale=scale)).astype(np.uint8)))
        found += len(one.detections) + len(one.shadows)
    assert found <= 2
    faint = stored(speckle(1, scale=0.3)).astype(np.uint8)
    assert len(RayleighRatio(floor=0.0)(make_ping(faint)).detections) > 0


def test_an_echo_over_nothing_is_found_in_integers(make_ping):
    image = np.zeros((600, 40), np.uint8)
    image[300:312, 18:22] = 60
    found = RayleighRatio()(make_ping(image))
    assert len(found.detections) == 1
    assert_allclose(found.detections.range_m, 2.0 + 0.05 * 305.5, atol=0.2)


def test_a_shadow_is_found_apart(make_ping):
    image = speckle(4)
    image[200:300, 10:26] *= 0.1
    found = RayleighRatio()(make_ping(image))
    assert len(found.detections) == 0
    whole = found.shadows.select(found.shadows.extent[:, 0] > 4.0)
    assert len(whole) == 1
    assert_allclose(whole.range_m, 2.0 + 0.05 * 249.5, atol=0.7)
    assert abs(whole.bearing_rad[0] - np.deg2rad(1.5) * (17.5 - 19.5)) < np.deg2rad(1.5)
    assert whole.amplitude[0] < 30.0


def test_only_ratios_above_with_side_upper(make_ping):
    """A steady area has a ratio far below that of speckle."""
    image = speckle(5)
    image[300:330, 10:30] = 60.0
    whole, upper = RayleighRatio()(make_ping(image)), RayleighRatio(side="upper")(make_ping(image))
    assert len(whole.detections) == 1
    assert whole.detections.extent[0].prod() > upper.detections.extent.prod(axis=1).sum()


@pytest.mark.parametrize("overlap", [0.0, 0.5, 0.75])
def test_snippets_equal_a_slow_reference(overlap):
    image = speckle(6, (47, 23))
    valid = np.random.default_rng(0).random((47, 23)) < 0.8
    for mask in (None, valid):
        grid = snippets(image, mask, (9, 6), overlap)
        for i, row in enumerate(grid.row):
            for j, beam in enumerate(grid.beam):
                box = np.s_[row : row + 9, beam : beam + 6]
                cells = (
                    image[box].astype(float).ravel() if mask is None else image[box][mask[box]].astype(float)
                )
                assert grid.cells[i, j] == cells.size
                assert_allclose(grid.mean[i, j], cells.mean(), rtol=1e-9)
                assert_allclose(grid.ratio[i, j], cells.std() / cells.mean(), rtol=1e-6)


@pytest.mark.parametrize(
    ("size", "snippet", "overlap"), [(100, 15, 0.5), (15, 15, 0.5), (7, 15, 0.5), (101, 10, 0.9)]
)
def test_snippets_cover_every_cell(size, snippet, overlap):
    first = starts(size, snippet, overlap)
    covered = np.zeros(size, bool)
    for one in first:
        covered[one : one + snippet] = True
    assert covered.all()
    assert first[-1] + min(snippet, size) == size
    assert starts(0, snippet, overlap).size == 0


def test_painted_areas_equal_a_slow_reference():
    rng = np.random.default_rng(2)
    image = speckle(7, (60, 30))
    grid = snippets(image, None, (8, 5), 0.5)
    flagged = rng.random(grid.ratio.shape) < 0.08
    slow = np.zeros(image.shape, bool)
    for i, j in np.argwhere(flagged):
        slow[grid.row[i] : grid.row[i] + 8, grid.beam[j] : grid.beam[j] + 5] = True
    mask = painted(grid, flagged, image.shape)
    assert (mask == slow).all()
    found = areas(mask, image)
    labels, count = ndimage.label(slow, np.ones((3, 3)))
    assert found.cells.size == count
    centres = np.array(ndimage.center_of_mass(image, labels, range(1, count + 1)))
    centres = centres[np.lexsort(centres.T[::-1])]
    assert_allclose(np.stack([found.row, found.beam], axis=-1), centres, atol=1e-3)


def test_the_shift_of_a_scene_shifts_the_detections(make_ping):
    image = speckle(8)
    image[300:312, 18:22] += 300.0
    a = RayleighRatio()(make_ping(image)).detections
    b = RayleighRatio()(make_ping(np.roll(image, 40, axis=0))).detections
    assert_allclose(b.range_m - a.range_m, 2.0, atol=0.1)


def test_cells_without_data_do_not_count(make_ping):
    image = speckle(9)
    image[100:200, 5:15] = np.nan
    image[300:400, :] = 1e6
    valid = np.ones(image.shape, bool)
    valid[300:400] = False
    found = RayleighRatio()(make_ping(image, valid=valid))
    assert len(found.detections) + len(found.shadows) == 0


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0), (1, 1), (1, 40), (600, 1), (3, 3)])
@pytest.mark.parametrize("value", [0.0, 1.0, np.nan])
def test_small_and_dull_images_are_answered(shape, value):
    n_ranges, n_beams = shape
    ping = Ping(
        4, 5, np.full(shape, value, np.float32), np.arange(1.0, n_ranges + 1), 0.02 * np.arange(n_beams)
    )
    for one in RayleighRatio(snippet_ranges=2, snippet_beams=2)(ping):
        assert one.seq == 4
        assert np.isfinite(one.range_m).all()


def test_small_areas_are_left_out_and_the_largest_kept(make_ping):
    image = speckle(10)
    image[100:110, 5:9] += 400.0
    image[400:440, 20:34] += 400.0
    assert len(RayleighRatio()(make_ping(image)).detections) == 2
    assert len(RayleighRatio(min_cells=600)(make_ping(image)).detections) == 1
    kept = RayleighRatio(max_detections=1)(make_ping(image)).detections
    assert_allclose(kept.range_m, 2.0 + 0.05 * 420, atol=0.5)


def test_the_wreck_shows_its_highlight_and_its_shadow():
    """In every ping: one large echo at the wreck, one large shadow behind it."""
    node = RayleighRatio(min_cells=200)
    for view in list(GroundScene(sequence="wreck", seed=3)())[10::12]:
        found = node(view.ping)
        wreck_m = np.hypot(*view.truth.state[0, :2])
        echo = found.detections.select(np.argsort(-found.detections.extent.prod(axis=1))[:1])
        shadow = found.shadows.select(np.argsort(-found.shadows.extent.prod(axis=1))[:1])
        assert abs(echo.range_m[0] - wreck_m) < 3.0
        assert shadow.range_m[0] > echo.range_m[0] + 2.0
        assert shadow.amplitude[0] < 0.7 * echo.amplitude[0]


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"snippet_ranges": 0}, "snippet_ranges must be at least 1, not 0"),
        ({"snippet_ranges": 1, "snippet_beams": 3}, "1 x 3"),
        ({"overlap": 1.0}, "overlap must lie from 0 to below 1, not 1.0"),
        ({"sigmas": -1.0}, "sigmas must be positive and finite, not -1.0"),
        ({"tolerance": float("nan")}, "tolerance must be positive and finite, not nan"),
        ({"side": "lower"}, "not 'lower'"),
        ({"floor": -1.0}, "floor must be finite and not negative, not -1.0"),
        ({"max_detections": 0}, "max_detections must be at least 1, not 0"),
    ],
)
def test_bad_parameters_are_named(parameters, text):
    with pytest.raises(ValueError, match=text):
        RayleighRatio(**parameters)


def test_the_node_keeps_the_contract():
    check_node("rayleigh-ratio")
