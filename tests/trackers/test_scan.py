"""The scan as a whole gives the bits of its steps, one after the other."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fls_flow import Detections
from fls_flow.geometry import Pose
from fls_trackers.association import ASSIGNED, INDEPENDENT, JOINT, LINEAR, associate, evidence
from fls_trackers.clutter import cell_density
from fls_trackers.conversion import convert, noise_at
from fls_trackers.exchanges import exchanged
from fls_trackers.existence import chances, given_existence, weighted
from fls_trackers.gating import gate
from fls_trackers.initiation import by_place
from fls_trackers.kalman import predict, update
from fls_trackers.life import LOST, Rules, judge
from fls_trackers.linear import against_others
from fls_trackers.scan import Method, Scanned, Starts, fixed_of, scan
from fls_trackers.settings import Grain, settings_of
from fls_trackers.track_bank import TrackBank, new_tracks

GRAIN = Grain(0.05, 0.03, 0.05, 0.03, 1000.0)
POSE = Pose(1.0, -2.0, 0.3)
CLUTTER = (1e-6, 0.01)


def bank_of(rng: np.random.Generator, n: int) -> TrackBank:
    position = rng.uniform(10.0, 30.0, (n, 2))
    bank = new_tracks(position, np.tile(np.diag([0.5, 0.8]), (n, 1, 1)), (1.0, 0.5), 0)
    bank.ledger["status"] = rng.integers(0, 2, n)
    bank.ledger["id"] = np.arange(1, n + 1)
    bank.ledger["score"] = rng.uniform(0.0, 12.0, n)
    return bank


def pings(rng: np.random.Generator, bank: TrackBank, m: int) -> Detections:
    near = POSE.to_sensor(bank.state[: m // 2, :2] + 0.2)
    far = rng.uniform(10.0, 30.0, (m - len(near), 2))
    xy = np.concatenate([near.reshape(-1, 2), far])
    return Detections(
        0,
        0,
        np.hypot(*xy.T),
        np.arctan2(xy[:, 1], xy[:, 0]),
        rng.random(m),
        np.zeros((m, 2)),
        np.zeros((m, 2, 2)),
        np.zeros(m, np.uint8),
    )


def rules_of(s: object) -> Rules:
    return Rules(*(getattr(s, name) for name in ("m1", "n1", "start_score", "m2", "n2", "max_sd_m")))


def whole(bank: TrackBank, ping: Detections, dt_s: float, sharing: int = JOINT, room: int = 100) -> Scanned:
    s = settings_of("recommended", {})
    fixed = fixed_of(s, Method(sharing, 12))
    return scan(bank, ping, None, dt_s, GRAIN, POSE, fixed, CLUTTER, Starts(room, 50))


@pytest.mark.parametrize("sharing", [JOINT, INDEPENDENT, ASSIGNED, LINEAR])
@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0), (1, 1), (12, 40)])
@pytest.mark.parametrize("dt_s", [0.0, 0.5])
def test_a_scan_is_its_steps(n: int, m: int, dt_s: float, sharing: int) -> None:
    rng = np.random.default_rng(n + m)
    s, bank = settings_of("recommended", {}), bank_of(rng, n)
    ping = pings(rng, bank, m)
    y, R0 = convert(ping.range_m, ping.bearing_rad, GRAIN.range_sd_m, GRAIN.bearing_sd_rad, POSE)
    density = cell_density(ping.range_m, CLUTTER[0], GRAIN.cell_m, GRAIN.spacing_rad, CLUTTER[1])
    x, P = (
        predict(bank.state, bank.covariance, dt_s, s.sigma_v_mps2) if dt_s else (bank.state, bank.covariance)
    )
    R = noise_at(x, GRAIN.range_sd_m, GRAIN.bearing_sd_rad, POSE)
    gated = gate(x, P, R, y, s.gamma)
    rank = (bank.ledger["status"] == 0).astype(np.int64)
    miss = 1.0 - s.p_d * s.gate_probability
    chance = chances(bank.ledger, s.start_score)
    weighed, way = gated, sharing
    if sharing == JOINT:
        weighed = gated._replace(likelihood=weighted(gated.start, gated.likelihood, chance, miss))
    if sharing == LINEAR:
        likelihood = against_others(*gated, density, rank, chance, 1.0 - miss)
        weighed, way = gated._replace(likelihood=likelihood), INDEPENDENT
    found = associate(weighed, density, rank, p_d=s.p_d, p_g=s.gate_probability, sharing=way)
    if sharing == JOINT:
        given_existence(gated.start, gated.places, found.beta, found.beta_none, found.taken, chance, miss)
    shares, rest, score = found.beta, found.beta_none, found.beta_none
    if sharing == ASSIGNED:
        shares, rest = exchanged(*gated, density, s.p_d / miss, rank, found.beta, found.beta_none)
        score = evidence(*gated, density, s.p_d / miss, found.beta, found.beta_none)
    x, P = update(x, P, R, y, gated.start, gated.places, shares, rest)
    unsure = np.repeat(rank, np.diff(gated.start)) > 0
    both = np.where(unsure | (sharing == INDEPENDENT), found.beta, 0.0)
    pairs = (gated.start, gated.places, both)
    rows, keep = judge(
        bank.ledger,
        x,
        P,
        found.in_gate,
        found.beta_none,
        score,
        miss,
        True,
        s.merge_pings,
        rules_of(s),
        pairs,
    )
    which = by_place(found.taken <= 0.5, ping.range_m, ping.bearing_rad)
    new = new_tracks(y, R0, (s.speed_sd_mps,) * 2, 0, which)
    new.ledger["id"] = 50 + np.arange(len(new))
    expected = TrackBank(x, P, rows).renewed(keep | (rows["status"] == LOST), new)
    got = whole(bank, ping, dt_s, sharing)
    assert_array_equal(got.bank.state, expected.state)
    assert_array_equal(got.bank.covariance, expected.covariance)
    assert_array_equal(got.bank.ledger, expected.ledger)
    assert_array_equal(got.unclaimed, ~found.claimed)
    assert got.free == np.count_nonzero(~found.claimed)
    assert (got.begun, got.finite, got.cut) == (len(new), True, False)


def test_a_scan_writes_none_of_its_inputs() -> None:
    rng = np.random.default_rng(1)
    bank = bank_of(rng, 6)
    before = (bank.state.copy(), bank.covariance.copy(), bank.ledger.copy())
    after = whole(bank, pings(rng, bank, 20), 0.5).bank
    for old, kept, new in zip(
        before,
        (bank.state, bank.covariance, bank.ledger),
        (after.state, after.covariance, after.ledger),
        strict=True,
    ):
        assert_array_equal(old, kept)
        assert not np.shares_memory(kept, new)


def test_strided_detections_give_the_same_bits() -> None:
    rng = np.random.default_rng(3)
    bank = bank_of(rng, 6)
    ping = pings(rng, bank, 20)
    pairs = [np.stack([row, row], axis=1) for row in (ping.range_m, ping.bearing_rad, ping.amplitude)]
    strided = Detections(0, 0, *(pair[:, 1] for pair in pairs), ping.extent, ping.covariance, ping.kind)
    assert not strided.range_m.flags.c_contiguous
    assert_array_equal(whole(bank, ping, 0.5).bank.state, whole(bank, strided, 0.5).bank.state)


def test_no_room_starts_the_strongest() -> None:
    rng = np.random.default_rng(4)
    ping = pings(rng, TrackBank(), 20)
    found = whole(TrackBank(), ping, 0.5, room=4)
    assert (found.begun, found.cut) == (4, True)
    strongest = np.argsort(-ping.amplitude)[:4]
    y, _ = convert(ping.range_m, ping.bearing_rad, GRAIN.range_sd_m, GRAIN.bearing_sd_rad, POSE)
    assert sorted(found.bank.state[:, 0]) == sorted(y[strongest, 0])


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
