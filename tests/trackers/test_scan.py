"""The scan as a whole gives the bits of its steps, one after the other."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fls_flow.geometry import Pose
from fls_trackers.association import associate
from fls_trackers.conversion import noise_at
from fls_trackers.gating import gate
from fls_trackers.initiation import by_place
from fls_trackers.kalman import predict, update
from fls_trackers.life import Rules, judge
from fls_trackers.scan import scan
from fls_trackers.settings import Grain, settings_of
from fls_trackers.track_bank import TrackBank, new_tracks

GRAIN = Grain(0.05, 0.03, 0.05, 0.03, 1000.0)
POSE = Pose(1.0, -2.0, 0.3)


def bank_of(rng: np.random.Generator, n: int) -> TrackBank:
    position = rng.uniform(10.0, 30.0, (n, 2))
    bank = new_tracks(position, np.tile(np.diag([0.5, 0.8]), (n, 1, 1)), (1.0, 0.5), 0)
    bank.ledger["status"] = rng.integers(0, 2, n)
    bank.ledger["id"] = np.arange(1, n + 1)
    return bank


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0), (1, 1), (12, 40)])
@pytest.mark.parametrize("dt_s", [0.0, 0.5])
def test_a_scan_is_its_steps(n: int, m: int, dt_s: float) -> None:
    rng = np.random.default_rng(n + m)
    s, bank = settings_of("recommended", {}), bank_of(rng, n)
    rules = Rules(s.m1, s.n1, s.start_score, s.m2, s.n2, s.max_sd_m)
    y = np.concatenate([bank.state[: m // 2, :2] + 0.2, rng.uniform(10.0, 30.0, (m - min(m // 2, n), 2))])
    density = np.full(len(y), 0.01)
    x, P = (
        predict(bank.state, bank.covariance, dt_s, s.sigma_v_mps2) if dt_s else (bank.state, bank.covariance)
    )
    R = noise_at(x, GRAIN.range_sd_m, GRAIN.bearing_sd_rad, POSE)
    gated = gate(x, P, R, y, s.gamma)
    rank = (bank.ledger["status"] == 0).astype(np.int64)
    found = associate(gated, density, rank, p_d=s.p_d, p_g=s.gate_probability)
    x, P = update(x, P, R, y, gated.start, gated.places, found.beta, found.beta_none)
    miss = 1.0 - s.p_d * s.gate_probability
    rows, keep = judge(bank.ledger, x, P, found.in_gate, found.beta_none, miss, True, s.merge_pings, rules)
    whole = scan(bank, y, density, dt_s, GRAIN, POSE, s, rules, 12)
    assert_array_equal(whole.bank.state, x)
    assert_array_equal(whole.bank.covariance, P)
    assert_array_equal(whole.bank.ledger, rows)
    assert_array_equal(whole.keep, keep)
    assert_array_equal(whole.taken, found.taken)
    assert_array_equal(whole.claimed, found.claimed)


def test_a_scan_writes_none_of_its_inputs() -> None:
    rng = np.random.default_rng(1)
    s, bank, y = settings_of("recommended", {}), bank_of(rng, 6), rng.uniform(10.0, 30.0, (20, 2))
    before = (bank.state.copy(), bank.covariance.copy(), bank.ledger.copy())
    rules = Rules(s.m1, s.n1, s.start_score, s.m2, s.n2, s.max_sd_m)
    after = scan(bank, y, np.full(20, 0.01), 0.5, GRAIN, POSE, s, rules, 12).bank
    for old, kept, new in zip(
        before,
        (bank.state, bank.covariance, bank.ledger),
        (after.state, after.covariance, after.ledger),
        strict=True,
    ):
        assert_array_equal(old, kept)
        assert not np.shares_memory(kept, new)


def test_starts_stand_in_order_of_place() -> None:
    r, b = np.array([3.0, 1.0, 3.0, 2.0, 1.0]), np.array([0.2, 0.5, 0.1, 0.0, 0.5])
    free = np.array([True, True, True, False, True])
    assert by_place(free, r, b).tolist() == [1, 4, 2, 0]
    assert by_place(np.zeros(5, bool), r, b).tolist() == []


def test_survivors_come_before_the_new() -> None:
    rng = np.random.default_rng(2)
    old, new = bank_of(rng, 4), bank_of(rng, 2)
    keep = np.array([True, False, False, True])
    joined = old.renewed(keep, new)
    assert joined.ledger["id"].tolist() == [1, 4, 1, 2]
    assert_array_equal(joined.state, np.concatenate([old.state[keep], new.state]))
    assert_array_equal(joined.covariance, np.concatenate([old.covariance[keep], new.covariance]))
