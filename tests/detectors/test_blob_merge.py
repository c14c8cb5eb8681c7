"""The merging rule: chains and stars against brute force, circular means, order."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fls_detectors.blob_groups import circular_mean, components, stars
from fls_detectors.blob_merge import BlobMerge
from fls_flow import Detections
from fls_flow.geometry import wrap
from fls_flow.testing import check_node

Values = npt.ArrayLike


def blobs(range_m: Values, bearing_deg: Values, amplitude: Values | None = None) -> Detections:
    r = np.asarray(range_m, float)
    a = np.ones(r.size) if amplitude is None else np.asarray(amplitude, float)
    n = r.size
    cov = np.arange(1.0, n + 1.0)[:, None, None] * np.eye(2)
    return Detections(
        1, 2, r, np.radians(np.asarray(bearing_deg, float)), a, np.zeros((n, 2)), cov, np.zeros(n, np.uint8)
    )


def drawn(seed: int, n: int = 40) -> tuple[npt.NDArray[np.float64], ...]:
    rng = np.random.default_rng(seed)
    return rng.uniform(10.0, 60.0, n), rng.uniform(-np.pi, np.pi, n), rng.random(n)


def near(
    r: npt.NDArray[np.float64], b: npt.NDArray[np.float64], m: float, rad: float
) -> npt.NDArray[np.bool_]:
    return (np.abs(r[:, None] - r) <= m) & (np.abs(wrap(b[:, None] - b)) <= rad)


@pytest.mark.parametrize("seed", range(10))
def test_components_are_the_closure_of_the_rule(seed: int):
    r, b, _ = drawn(seed)
    reach = near(r, b, 3.0, 0.5)
    for _ in range(r.size):
        reach = reach @ reach
    of, n = components(r, b, 3.0, 0.5)
    assert np.array_equal(of[:, None] == of, reach)
    assert sorted(set(of.tolist())) == list(range(n))


@pytest.mark.parametrize("seed", range(10))
def test_stars_are_led_by_the_strongest_that_is_left(seed: int):
    r, b, a = drawn(seed)
    reach, free, expected = near(r, b, 5.0, 0.8), np.ones(r.size, bool), np.full(r.size, -1)
    count = 0
    for i in np.argsort(-a):
        if free[i]:
            members = free & reach[i]
            expected[members], free[members] = count, False
            count += 1
    of, n = stars(r, b, a, 5.0, 0.8)
    assert np.array_equal(of, expected)
    assert n == count


def test_a_chain_is_one_component_and_several_stars():
    d = blobs([10.0, 19.0, 28.0, 37.0], [0.0] * 4, [1.0, 3.0, 2.0, 1.5])
    assert BlobMerge()(d).range_m.tolist() == [23.5]
    led = BlobMerge(group="strongest", place="strongest")(d)
    assert led.range_m.tolist() == [19.0, 37.0]


def test_bearings_are_averaged_round_the_circle():
    merged = BlobMerge(merge_range_m=1.0)(blobs([50.0, 50.2], [179.0, -175.0], [1.0, 2.0]))
    assert np.degrees(merged.bearing_rad[0]) == pytest.approx(-178.0)
    assert merged.range_m[0] == pytest.approx(50.1)
    assert merged.amplitude[0] == 2.0
    assert merged.covariance[0, 0, 0] == 2.0  # of the stronger
    assert np.degrees(merged.extent[0]) == pytest.approx([np.degrees(0.2), 6.0])
    assert np.degrees(circular_mean(np.radians([10.0, 350.0]), np.array([0, 0]), 1)) == pytest.approx(
        [0.0], abs=1e-9
    )


def test_limits_count_as_near_and_nothing_beyond():
    d = blobs([10.0, 20.0, 20.0], [0.0, 0.0, 30.000001])
    assert len(BlobMerge()(d)) == 2
    assert len(BlobMerge(merge_bearing_deg=31.0)(d)) == 1
    assert len(BlobMerge(merge_range_m=9.999)(d)) == 3


@pytest.mark.parametrize("group", ["components", "strongest"])
@pytest.mark.parametrize("place", ["mean", "strongest"])
def test_the_order_of_blobs_does_not_matter(group: str, place: str):
    r, b, a = drawn(3)
    order = np.random.default_rng(4).permutation(r.size)
    node = BlobMerge(merge_range_m=3.0, group=group, place=place)  # type: ignore[arg-type]  # one of its words
    one, other = node(blobs(r, np.degrees(b), a)), node(blobs(r[order], np.degrees(b)[order], a[order]))
    assert len(one) < r.size
    np.testing.assert_allclose(one.range_m, other.range_m, rtol=1e-12)
    np.testing.assert_allclose(one.bearing_rad, other.bearing_rad, atol=1e-12)
    assert np.array_equal(one.amplitude, other.amplitude)


def test_nothing_comes_out_of_nothing_and_the_contract_is_kept():
    assert len(BlobMerge()(blobs([], []))) == 0
    for group in ("components", "strongest"):
        check_node(BlobMerge(group=group), [{"detections": blobs(*(drawn(s)[:2]))} for s in range(3)])  # type: ignore[arg-type]  # one of its words
    check_node(BlobMerge)


@pytest.mark.parametrize(
    "bad", [{"merge_range_m": -1.0}, {"merge_bearing_deg": 200.0}, {"group": "x"}, {"place": "y"}]
)
def test_bad_parameters_are_refused(bad: dict[str, object]):
    with pytest.raises(ValueError, match=str(next(iter(bad.values())))):
        BlobMerge(**bad)  # type: ignore[arg-type]  # they are wrong
