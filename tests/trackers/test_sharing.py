"""How `pda` and `gnn` share measurements out: beside enumeration, and as nodes that stand in for `jpda`."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose

from fls_flow import Detections, Tracks
from fls_flow.testing import check_node
from fls_trackers.association import ASSIGNED, INDEPENDENT, JOINT, associate
from fls_trackers.gating import Gated
from fls_trackers.gnn import Gnn
from fls_trackers.jpda import Jpda
from fls_trackers.life import count, suspect
from fls_trackers.pda import Pda
from fls_trackers.track_bank import new_tracks

P_D, P_G = 0.9, 0.98
FACTOR = P_D / (1.0 - P_D * P_G)
FloatArray = npt.NDArray[np.float64]
Make = Callable[..., Detections]


def gated(likelihood: FloatArray) -> Gated:
    inside = likelihood > 0.0
    start = np.concatenate([[0], np.cumsum(inside.sum(axis=1))]).astype(np.int64)
    return Gated(start, np.nonzero(inside)[1].astype(np.int64), likelihood[inside])


def drawn(seed: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 5), rng.integers(1, 6)
    likelihood = 10.0 ** rng.uniform(-4, 2, (n, m)) * (rng.random((n, m)) < rng.choice([0.3, 0.6, 1.0]))
    return likelihood, 10.0 ** rng.uniform(-3, 1, m)


def table(likelihood: FloatArray, density: FloatArray, sharing: int) -> FloatArray:
    ranks = np.zeros(likelihood.shape[0], np.int64)
    found = associate(gated(likelihood), density, ranks, p_d=P_D, p_g=P_G, sharing=sharing)
    beta = np.zeros((likelihood.shape[0], likelihood.shape[1] + 1))
    beta[:, 0] = found.beta_none
    beta[:, 1:][likelihood > 0.0] = found.beta
    return beta


@pytest.mark.parametrize("seed", range(100))
def test_pda_is_each_tracks_own_events(seed: int) -> None:
    likelihood, density = drawn(seed)
    weights = np.concatenate([np.ones((len(likelihood), 1)), FACTOR * likelihood / density], axis=1)
    expected = weights / weights.sum(axis=1, keepdims=True)
    assert_allclose(table(likelihood, density, INDEPENDENT), expected, rtol=1e-12)


def test_pda_of_one_track_is_jpda() -> None:
    likelihood, density = np.array([[0.3, 2.0, 0.01]]), np.array([0.1, 0.2, 0.1])
    assert_allclose(table(likelihood, density, INDEPENDENT), table(likelihood, density, JOINT), rtol=1e-13)


@pytest.mark.parametrize("seed", range(100))
def test_gnn_is_the_most_probable_joint_event(seed: int) -> None:
    likelihood, density = drawn(seed)
    best, most = None, -1.0
    for event in itertools.product(*[[-1, *np.flatnonzero(row > 0.0)] for row in likelihood]):
        taken = [j for j in event if j >= 0]
        if len(set(taken)) == len(taken):
            weight = np.prod([FACTOR * likelihood[t, j] / density[j] for t, j in enumerate(event) if j >= 0])
            if weight > most:
                best, most = event, weight
    beta = table(likelihood, density, ASSIGNED)
    assert beta.argmax(axis=1).tolist() == [j + 1 for j in best or ()]
    assert set(np.unique(beta)) <= {0.0, 1.0}


def test_independent_tracks_on_one_echo_are_suspected_and_on_two_are_not() -> None:
    bank = new_tracks(np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)), (1.0, 1.0), 1)
    bank.ledger["id"] = [1, 2]
    start, beta, none = np.array([0, 1, 2]), np.array([0.95, 0.95]), np.array([0.05, 0.05])
    for places, expected in (([0, 0], True), ([0, 1], False)):
        rows = count(bank.ledger, np.ones(2, bool), none, 0.1)
        for _ in range(10):
            shared = (start, np.array(places), beta)
            repeats = suspect(rows, bank.state, bank.covariance, none, 10, shared)
        assert repeats.tolist() == [False, expected]


# --- as nodes -----------------------------------------------------------------------------------------------


def scene(observe: Make, seed: int, pings: int = 60, false: float = 6.0) -> list[Detections]:
    rng = np.random.default_rng(seed)
    start = np.array([[20.0, -6.0], [30.0, 5.0], [41.0, 0.0]])
    velocity = np.array([[0.1, 0.3], [0.0, 0.0], [-0.3, 0.1]])
    return [observe(rng, k, start + velocity * 0.5 * k, false=false) for k in range(pings)]


def same(a: Tracks, b: Tracks) -> bool:
    names = ("id", "status", "state", "covariance", "hits", "age")
    return all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in names)


@pytest.mark.parametrize("kind", [Pda, Gnn])
def test_parameters_are_those_of_jpda(kind: type[Any]) -> None:
    def parameters(cls: type[Any]) -> dict[str, Any]:
        return {one.name: (one.type, one.default) for one in fields(cls) if one.init}

    expected = parameters(Jpda)
    expected.pop("max_shared")
    assert parameters(kind) == expected
    assert kind.__call__.__annotations__ == Jpda.__call__.__annotations__


@pytest.mark.parametrize("kind", [Pda, Gnn])
@pytest.mark.parametrize("settings", [{}, {"preset": "paper"}, {"preset": "points"}, {"frame": "ned"}])
def test_the_contract_of_nodes(observe: Make, kind: type[Any], settings: dict[str, Any]) -> None:
    check_node(kind(**settings), [{"detections": ping} for ping in scene(observe, 1)])


@pytest.mark.parametrize("kind", [Pda, Gnn])
@pytest.mark.parametrize("at", [0, 1, 25])
def test_snapshot_and_restore_go_on_bit_for_bit(observe: Make, kind: type[Any], at: int) -> None:
    pings = scene(observe, 5)
    first, second = kind(), kind()
    for ping in pings[:at]:
        first(ping)
    second.restore(first.snapshot())
    assert all(same(first(ping), second(ping)) for ping in pings[at:])


@pytest.mark.parametrize("kind", [Pda, Gnn])
@pytest.mark.parametrize(("name", "value"), [("p_d", 1.0), ("frame", "enu"), ("max_tracks", 0), ("n1", 9)])
def test_bad_parameters_are_named_with_their_value(kind: type[Any], name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name} = '?{value}"):
        kind(**{name: value})


@pytest.mark.parametrize("kind", [Pda, Gnn])
def test_order_does_not_matter(observe: Make, kind: type[Any]) -> None:
    rng = np.random.default_rng(3)
    straight, shuffled = kind(), kind()
    for ping in scene(observe, 2):
        a, b = straight(ping), shuffled(ping.select(rng.permutation(len(ping))))
        assert a.id.tolist() == b.id.tolist()
        assert_allclose(a.state, b.state, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("kind", [Jpda, Pda, Gnn])
def test_five_targets_in_ten_false_detections_are_five_tracks(observe: Make, kind: type[Any]) -> None:
    start = np.array([[15.0, 3.0], [22.0, -5.0], [30.0, 8.0], [36.0, -12.0], [44.0, 2.0]])
    velocity = np.array([[0.05, 0.02], [0.1, 0.0], [-0.05, -0.05], [0.0, 0.1], [-0.1, 0.02]])
    for seed in range(4):
        rng, tracker = np.random.default_rng(seed), kind(preset="points")
        ids = set[int]()
        for k in range(250):
            tracks = tracker(observe(rng, k, start + 0.5 * k * velocity, false=10.0))
            ids |= set(tracks.id[tracks.status == 1].tolist())
        on = tracks.select(tracks.status == 1)
        gap = np.linalg.norm(on.state[:, None, :2] - (start + 124.5 * velocity)[None], axis=2)
        assert len(ids) == len(on) == 5
        assert sorted(gap.argmin(axis=1)) == list(range(5))
        assert gap.min(axis=1).max() < 2.0


@pytest.mark.parametrize("kind", [Pda, Gnn])
def test_two_tracks_of_one_echo_become_one(detections: Make, kind: type[Any]) -> None:
    tracker = kind(hit="gated")
    for k in range(10):  # two echoes 1.5 m apart that become one
        tracker(detections(k, [30.0, 30.9], [0.1, 0.1]))
    for k in range(10, 70):
        tracks = tracker(detections(k, 30.4, 0.1))
    assert tracks.id[tracks.status == 1].tolist() == [1]


@pytest.mark.parametrize("kind", [Pda, Gnn])
def test_a_huge_ping_is_answered(observe: Make, kind: type[Any]) -> None:
    rng, tracker = np.random.default_rng(9), kind(max_tracks=100)
    for k in range(4):
        tracks = tracker(observe(rng, k, np.zeros((0, 2)), false=2000.0))
        assert len(tracks) <= 100 + np.count_nonzero(tracks.status == 2)
        assert np.isfinite(tracks.state).all()
