"""The PHD trackers as nodes: contract, identities, frames, gaps, bad input, the same bits again."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import Detections, NavState, TrackStatus, View
from fls_flow.geometry import Pose
from fls_flow.testing import check_node
from fls_trackers.gm_cphd import GmCphd
from fls_trackers.gm_cphd import fls_node as cphd_node
from fls_trackers.gm_phd import GmPhd
from fls_trackers.gm_phd import fls_node as gm_node
from fls_trackers.particle_phd import ParticlePhd
from fls_trackers.particle_phd import fls_node as particle_node
from fls_trackers.phd_identity import TracksAndIntensity

KINDS = [ParticlePhd, GmPhd, GmCphd]
RECURSIONS = [
    partial(ParticlePhd, recursion="labelled"),
    partial(ParticlePhd, recursion="phd"),
    partial(GmPhd, recursion="labelled"),
    partial(GmPhd, recursion="phd"),
    GmCphd,
]
SCENE: dict[str, Any] = {"births": "anywhere", "sigma_range_m": 0.1, "sigma_bearing_deg": 0.5, "p_b": 0.05}
CONFIRMED, LOST = TrackStatus.CONFIRMED, TrackStatus.LOST


@pytest.fixture(params=RECURSIONS, ids=["particle", "particle-phd", "gm", "gm-phd", "gm-cphd"])
def kind(request: pytest.FixtureRequest) -> Any:
    return request.param


def target(k: int, start: tuple[float, float], velocity: tuple[float, float]) -> tuple[float, float]:
    return start[0] + 0.5 * k * velocity[0], start[1] + 0.5 * k * velocity[1]


def two_in_clutter(observe: Callable[..., Detections], pings: int = 30, **kw: Any) -> list[Detections]:
    rng = np.random.default_rng(11)
    ways = [((40.0, 3.0), (-1.0, 0.0)), ((20.0, -4.0), (0.3, 0.2))]
    sd = (0.1, math.radians(0.5))
    return [observe(rng, k, [target(k, *way) for way in ways], sd=sd, **kw) for k in range(pings)]


def bits(answer: TracksAndIntensity) -> list[bytes]:
    tracks, intensity = answer
    arrays = [tracks.id, tracks.status, tracks.state, tracks.covariance, tracks.hits, tracks.age]
    arrays += [intensity.state, intensity.weight, intensity.covariance, np.array(intensity.expected_targets)]
    return [np.ascontiguousarray(a).tobytes() for a in arrays]


def test_kinds() -> None:
    assert [particle_node(), gm_node(), cphd_node()] == KINDS


@pytest.mark.parametrize("settings", [{}, SCENE, {"frame": "ned"}, {"clutter_per_ping": None, **SCENE}])
def test_the_contract_of_nodes(
    kind: Any, observe: Callable[..., Detections], settings: dict[str, Any]
) -> None:
    check_node(kind(**settings), [{"detections": d} for d in two_in_clutter(observe, 10, false=5.0)])


def test_the_contract_with_made_up_pings_and_empty_ones(kind: Any) -> None:
    check_node(kind())


def test_two_targets_in_clutter_keep_their_identities(kind: Any, observe: Callable[..., Detections]) -> None:
    node = kind(clutter_per_ping=10.0, **SCENE)
    answers = [node(d) for d in two_in_clutter(observe, 40, false=10.0)]
    confirmed = [a.tracks.select(a.tracks.status == CONFIRMED) for a in answers]
    followers: list[set[int]] = [set(), set()]
    velocities: list[list[Any]] = [[], []]
    for k in range(12, 40):
        for which, way in enumerate([((40.0, 3.0), (-1.0, 0.0)), ((20.0, -4.0), (0.3, 0.2))]):
            apart = np.hypot(*(confirmed[k].state[:, :2] - target(k, *way)).T)
            assert apart.min() < 1.0, f"ping {k}"
            followers[which].add(int(confirmed[k].id[apart.argmin()]))
            velocities[which].append(confirmed[k].state[apart.argmin(), 2:])
    assert [len(ids) for ids in followers] == [1, 1]
    assert_allclose(np.mean([a.intensity.expected_targets for a in answers[10:]]), 2.0, atol=0.3)
    assert_allclose(np.mean(velocities[0], axis=0), [-1.0, 0.0], atol=0.2)
    assert_allclose(np.mean(velocities[1], axis=0), [0.3, 0.2], atol=0.2)


def test_a_track_outlives_one_missed_detection_and_is_lost_once(kind: Any, detections: Any) -> None:
    node = kind(clutter_per_ping=1.0, **SCENE)
    for k in range(8):
        answer = node(detections(k, 30.0, 0.0))
    (identity,) = answer.tracks.id.tolist()
    answer = node(detections(8, [], []))
    assert answer.tracks.id.tolist() == [identity]
    answer = node(detections(9, 30.0, 0.0))
    assert (answer.tracks.id.tolist(), answer.tracks.status.tolist()) == ([identity], [CONFIRMED])
    said = [node(detections(k, [], [])).tracks for k in range(10, 22)]
    lost = [(t.status == LOST).sum() for t in said]
    assert sum(lost) == 1
    assert len(said[-1]) == 0
    assert node(detections(22, [], [])).intensity.expected_targets < 0.2


def test_a_target_that_leaves_the_sector_is_lost_at_its_border(kind: Any, detections: Any) -> None:
    node = kind(clutter_per_ping=1.0, **SCENE)
    for k in range(16):
        r = 6.0 - 0.5 * k
        answer = node(detections(k, [r] if r > 1.0 else [], [0.0] if r > 1.0 else []))
        if k == 8:
            assert (answer.tracks.status == CONFIRMED).sum() == 1
    assert len(answer.tracks) == 0
    assert answer.intensity.expected_targets < 0.3


def test_measurements_outside_of_the_sector_say_nothing(kind: Any, detections: Any) -> None:
    node, other = kind(**SCENE), kind(**SCENE)
    for k in range(6):
        answer = node(detections(k, [30.0, 60.0, 30.0], [0.0, 0.0, 2.0]))
        expected = other(detections(k, [30.0], [0.0]))
    assert bits(answer) == bits(expected)


def test_without_navigation_ned_is_only_predicted(kind: Any, detections: Any) -> None:
    node = kind(frame="ned", **SCENE)
    nav = NavState(0, 0, position_m=(100.0, 50.0, 0.0), attitude_rad=(0.0, 0.0, math.pi / 2.0))

    def seen(k: int, r: list[float], placed: bool) -> Detections:
        made: Detections = detections(k, r, [0.0] * len(r))
        return replace(made, view=replace(made.view, nav=nav if placed else None))

    for k in range(8):
        answer = node(seen(k, [30.0], True))
    assert answer.tracks.frame == answer.intensity.frame == "ned"
    assert_allclose(answer.tracks.state[0, :2], [100.0, 80.0], atol=0.5)
    age, hits = answer.tracks.age[0], answer.tracks.hits[0]
    answer = node(seen(8, [30.0], False))
    assert len(answer.intensity) == 0
    assert answer.intensity.expected_targets > 0.5
    assert (answer.tracks.age[0], answer.tracks.hits[0]) == (age + 1, hits)
    answer = node(seen(9, [30.0], True))
    assert answer.tracks.hits[0] == hits + 1


def test_navigation_straightens_what_own_motion_bends(kind: Any, detections: Any) -> None:
    """A still target seen from a vehicle that yaws by 20 degrees: at rest in ned, swinging in sensor."""

    def speed(frame: str) -> float:
        node, speeds = kind(frame=frame, sigma_v_mps2=1.0, **SCENE), []
        for k in range(40):
            pose = Pose(0.2 * k, 0.0, math.radians(20.0) * math.sin(k / 3.0))
            x, y = pose.to_sensor(np.array([35.0, 1.0]))
            nav = NavState(k, k, (pose.north_m, 0.0, 0.0), (0.0, 0.0, pose.heading_rad))
            made = detections(k, math.hypot(x, y), math.atan2(y, x))
            answer = node(replace(made, view=replace(made.view, nav=nav)))
            if k >= 15 and len(answer.intensity):
                speeds.append(float(np.hypot(*answer.intensity.state[0, 2:])))
        return float(np.mean(speeds))

    assert speed("ned") < 0.3 * speed("sensor")


def test_births_take_the_vehicles_speed_from_navigation(kind: Any, detections: Any) -> None:
    node = kind(speed_sd_mps=0.05, births="anywhere", prior_targets=1.0)
    made = detections(0, 30.0, 0.0)
    nav = NavState(0, 0, velocity_mps=(2.0, 0.0, 0.0))
    answer = node(replace(made, view=replace(made.view, nav=nav)))
    assert_allclose(
        answer.intensity.state[0, 2:] if len(answer.intensity) else [-2.0, 0.0], [-2.0, 0.0], atol=0.1
    )


def test_the_rate_of_clutter_is_learnt(kind: Any, observe: Callable[..., Detections]) -> None:
    node = kind(clutter_per_ping=None, **SCENE)
    for d in two_in_clutter(observe, 60, false=8.0):
        node(d)
    assert_allclose(node.snapshot()["clutter"]["mean"], 8.0, rtol=0.3)


def test_equal_seeds_give_equal_bits_and_others_do_not(observe: Callable[..., Detections]) -> None:
    pings = two_in_clutter(observe, 12, false=5.0)
    runs = []
    for seed in (3, 3, 4):
        node = ParticlePhd(seed=seed, **SCENE)
        runs.append([bits(node(d)) for d in pings])
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


def test_the_order_of_detections_does_not_matter(kind: Any, observe: Callable[..., Detections]) -> None:
    node, other = kind(**SCENE), kind(**SCENE)
    if isinstance(node, ParticlePhd):  # births near measurements are drawn in their order
        settings = {**SCENE, "birth_proposal": "uniform", "recursion": "phd"}
        node, other = ParticlePhd(**settings), ParticlePhd(**settings)
    rng = np.random.default_rng(0)
    for d in two_in_clutter(observe, 15, false=6.0):
        a, b = node(d), other(d.select(rng.permutation(len(d))))
        assert_allclose(a.intensity.expected_targets, b.intensity.expected_targets, rtol=1e-6)
        assert a.tracks.id.tolist() == b.tracks.id.tolist()


def test_bounded_particles_and_components(observe: Callable[..., Detections]) -> None:
    particle = ParticlePhd(max_particles=700, particles=500, birth_particles=100, **SCENE)
    mixture = GmPhd(max_components=5, **SCENE)
    for d in two_in_clutter(observe, 15, false=30.0):
        particle(d)
        mixture(d)
    assert particle.snapshot()["weight"].size <= 700
    assert mixture.snapshot()["weight"].size <= 5


def test_a_view_of_nothing_is_answered(kind: Any) -> None:
    node = kind(**SCENE)
    answer = node(Detections(4, 100))
    assert (answer.tracks.seq, answer.intensity.stamp_ns, len(answer.tracks)) == (4, 100, 0)
    one_beam = View(1.0, 50.0, 0.1, np.zeros(1), math.radians(2.0))
    lone = Detections(5, 200, np.array([30.0]), np.zeros(1), np.ones(1), np.zeros((1, 2)), np.zeros((1, 2, 2)), np.zeros(1, np.uint8), one_beam)  # fmt: skip
    assert node(lone).tracks.seq == 5


def test_bad_pings_are_refused_and_change_nothing(kind: Any, detections: Any) -> None:
    node, other = kind(**SCENE), kind(**SCENE)
    for each in (node, other):
        each(detections(0, 30.0, 0.0))
        each(detections(1, 30.0, 0.0))
    with pytest.raises(ValueError, match="not after the last ping's"):
        node(detections(1, 30.0, 0.0))
    with pytest.raises(ValueError, match=r"1 of 2 detections are not finite; the first \(index 1\)"):
        node(detections(2, [30.0, np.nan], [0.0, 0.0]))
    assert bits(node(detections(2, 30.0, 0.0))) == bits(other(detections(2, 30.0, 0.0)))


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"p_d": 1.0}, "p_d = 1.0"),
        ({"p_s": 0.0}, "p_s = 0.0"),
        ({"p_b": -1.0}, "p_b = -1.0"),
        ({"births": "nowhere"}, "births = 'nowhere'"),
        ({"frame": "enu"}, "frame = 'enu'"),
        ({"clutter_per_ping": 0.0}, "clutter_per_ping = 0.0"),
        ({"closing_mps": math.nan}, "closing_mps = nan"),
        ({"n1": 4}, "n1 = 4 of m1 = 3"),
        ({"prior_targets": 0.0}, "prior_targets = 0.0"),
        ({"sigma_range_m": math.inf}, "sigma_range_m = inf"),
    ],
)
def test_bad_parameters_are_named_with_their_value(kind: Any, settings: dict[str, Any], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        kind(**settings)


@pytest.mark.parametrize(
    ("made", "what"),
    [
        (lambda: ParticlePhd(particles=0), "particles = 0"),
        (lambda: ParticlePhd(seed=-1), "seed = -1"),
        (lambda: ParticlePhd(resampling_power=1.5), "resampling_power = 1.5"),
        (lambda: ParticlePhd(birth_proposal="other"), "birth_proposal = 'other'"),  # type: ignore[arg-type]
        (lambda: ParticlePhd(floor_sd_m=0.0), "floor_sd_m = 0.0"),
        (lambda: ParticlePhd(recursion="other"), "recursion = 'other'"),  # type: ignore[arg-type]
        (
            lambda: ParticlePhd(birth_proposal="uniform"),
            "birth_proposal = 'uniform': needs recursion = 'phd'",
        ),
        (lambda: ParticlePhd(prune_existence=0.5), "prune_existence = 0.5"),
        (lambda: GmPhd(recursion="other"), "recursion = 'other'"),  # type: ignore[arg-type]
        (lambda: GmCphd(recursion="labelled"), "recursion = 'labelled'"),
        (lambda: GmPhd(prune_weight=0.5), "prune_weight = 0.5"),
        (lambda: GmPhd(merge_distance=-1.0), "merge_distance = -1.0"),
        (lambda: GmPhd(max_components=0), "max_components = 0"),
        (lambda: GmCphd(max_targets=0), "max_targets = 0"),
    ],
)
def test_bad_parameters_of_one_kind(made: Callable[[], Any], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        made()


def test_messages_own_their_arrays(kind: Any, detections: Any) -> None:
    node = kind(**SCENE)
    answers = [node(detections(k, [30.0, 20.0], [0.0, 0.1])) for k in range(5)]
    kept = [bits(a) for a in answers]
    for k in range(5, 9):
        node(detections(k, [30.0, 20.0], [0.0, 0.1]))
    assert [bits(a) for a in answers] == kept
    assert_array_equal(answers[-1].tracks.id, [1, 2])
