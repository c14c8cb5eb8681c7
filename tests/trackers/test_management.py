"""The pieces around the filter: clutter density, box starts, counting, settling, duplicates, settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_flow import View
from fls_trackers.clutter import ClutterDensity, cell_density
from fls_trackers.initiation import BoxInitiator, distinct, several_in_a_beam, strongest
from fls_trackers.life import Rules, count, settle, suspect
from fls_trackers.settings import PAPER, RECOMMENDED, grain_of, settings_of
from fls_trackers.track_bank import TrackBank, new_tracks

DB = np.deg2rad(1.5)
RULES = Rules(m1=8, n1=6, min_score=-np.inf, m2=20, n2=8, max_sd_m=20.0)
TENTATIVE, CONFIRMED, LOST = 0, 1, 2
NO_PAIRS = (np.zeros(3, np.int64), np.zeros(0, np.int64), np.zeros(0))


def near(x: float, y: float) -> np.ndarray:
    return np.array([[x, y]])


# --- clutter ------------------------------------------------------------------------------------------------


def test_cell_density_is_that_of_the_page() -> None:
    density = cell_density(np.array([10.0, 50.0, 200.0]), 1e-6, 0.05, DB)
    assert_allclose(density, [7.6e-5, 1.5e-5, 3.8e-6], rtol=0.02)
    assert np.isfinite(cell_density(np.zeros(1), 1e-6, 0.05, DB)).all()


def test_adaptive_density_counts_the_last_20_pings() -> None:
    learnt = ClutterDensity("adaptive", 1e-6, 20)
    r, b = np.array([10.0, 50.0]), np.zeros(2)
    for n in [100] * 5 + [15] * 20:
        learnt.count(n)
    assert_allclose(learnt.at(r, b, 0.05, DB, 1309.0), 15 / 1309.0)
    assert_allclose(
        ClutterDensity("adaptive", 1e-6, 20).at(r, b, 0.05, DB, 1309.0), cell_density(r, 1e-6, 0.05, DB)
    )


def test_density_by_cells_and_as_printed() -> None:
    r, b = np.array([10.0, 50.0]), np.zeros(2)
    for kind, expected in (("cell", cell_density(r, 1e-5, 0.05, DB)), ("paper", [1e-5, 1e-5])):
        density = ClutterDensity(kind, 1e-5, 20)
        density.count(50)
        assert_allclose(density.at(r, b, 0.05, DB, 1309.0), expected)


def test_without_an_area_the_sector_seen_so_far_counts() -> None:
    density = ClutterDensity("adaptive", 1e-6, 20)
    density.at(np.array([40.0, 20.0]), np.array([-0.5, 0.5]), 0.05, DB, 0.0)
    density.count(8)
    assert_allclose(density.at(np.array([10.0]), np.zeros(1), 0.05, DB, 0.0), 8 / (0.5 * 40.0**2))


# --- starts -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("offset", "starts"), [(4.9, 1), (5.0, 0), (5.1, 0)])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_box_is_open_and_around_the_current_detection(offset: float, starts: int, axis: int) -> None:
    box, last = BoxInitiator(20, 16), np.array([[30.0, 2.0]])
    for k in range(19):
        box(np.array([[30.0, 2.0]]), k * 10**9, 5.0, 5.0)
    last[0, axis] += offset
    found = box(last, 19 * 10**9, 5.0, 5.0)
    assert found.which.size == starts
    assert found.span == 20
    assert found.window_s == pytest.approx(20.0)


def test_box_counts_pings_and_forgets_old_ones() -> None:
    box = BoxInitiator(4, 3)
    assert box(np.zeros((9, 2)), 0, 5.0, 5.0).which.size == 0
    assert box(np.zeros((9, 2)), 1, 5.0, 5.0).which.size == 0
    assert box(np.zeros((0, 2)), 2, 5.0, 5.0).which.size == 0
    found = box(near(0.0, 0.0), 3, 5.0, 5.0)
    assert found.history.tolist() == [0b1101]
    assert box(near(0.0, 0.0), 4, 5.0, 5.0).history.tolist() == [0b1011]
    assert box(np.zeros((0, 2)), 5, 5.0, 5.0).which.size == 0
    assert box(near(0.0, 0.0), 6, 5.0, 5.0).history.tolist() == [0b1101]
    assert BoxInitiator(4, 3)(near(0.0, 0.0), 0, 5.0, 5.0).which.size == 0


def test_box_starts_come_with_the_most_seen_first() -> None:
    box = BoxInitiator(3, 2)
    box(near(50.0, 0.0), 0, 5.0, 5.0)
    box(np.array([[50.0, 0.0], [10.0, 0.0]]), 1, 5.0, 5.0)
    assert box(np.array([[10.0, 0.0], [90.0, 0.0], [50.0, 0.0]]), 2, 5.0, 5.0).which.tolist() == [2, 0]


def test_starts_within_each_others_gate_are_one() -> None:
    R = np.tile(np.eye(2), (4, 1, 1))
    y = np.array([[0.0, 0.0], [7.0, 0.0], [8.0, 0.0], [0.0, -7.4]])
    # The gate of a start reaches sqrt(9 (5 + 1)) = 7.35 m; what a rejected one would gate counts nothing.
    assert distinct(y, R, 9.0).tolist() == [True, False, True, True]


def test_several_candidates_in_a_beam_are_found() -> None:
    bearing = np.array([0.1, 0.1, 0.3, 0.1, 0.1 + 0.5 * DB])
    candidate = np.array([True, True, True, False, True])
    assert several_in_a_beam(bearing, candidate, DB).tolist() == [True, True, False, False, True]


def test_the_strongest_and_ties_by_order() -> None:
    amplitude = np.array([1.0, np.nan, 3.0, 2.0, 3.0])
    assert strongest(np.array([0, 1, 2, 3, 4]), amplitude, 3).tolist() == [2, 4, 3]
    assert strongest(np.array([1, 0]), amplitude, 1).tolist() == [0]


# --- counting and settling ----------------------------------------------------------------------------------


def lived(updates: list[bool], status: int = TENTATIVE) -> TrackBank:
    bank = new_tracks(np.zeros((1, 2)), np.eye(2)[None], (1.0, 1.0), status)
    rows = bank.ledger
    for updated in updates:
        rows = count(rows, np.array([updated]), np.array([0.1 if updated else 1.0]), 0.11)
    return TrackBank(bank.state, bank.covariance, rows)


def settled(bank: TrackBank, rules: Rules = RULES) -> tuple[int, bool]:
    rows, keep = settle(bank.ledger, np.zeros(1, bool), bank.covariance, rules)
    return int(rows["status"][0]), bool(keep[0])


def test_counts_of_a_life() -> None:
    row = lived([True, False, True]).ledger[0]
    assert (row["age"], row["hits"], row["span"], row["history"]) == (3, 3, 4, 0b1101)
    assert row["score"] == pytest.approx(2 * np.log(1.1) + np.log(0.11))


def test_history_holds_62_pings() -> None:
    row = lived([True] * 200).ledger[0]
    assert (row["history"], row["span"], row["hits"], row["age"]) == (2**62 - 1, 62, 201, 200)


def test_m_of_n_confirms_and_drops() -> None:
    assert settled(lived([True] * 4)) == (TENTATIVE, True)
    assert settled(lived([True] * 5)) == (CONFIRMED, True)
    assert settled(lived([False, False] + [True] * 5)) == (CONFIRMED, True)
    assert settled(lived([False, False])) == (TENTATIVE, True)
    assert settled(lived([False, False, False])) == (TENTATIVE, False)
    strict = RULES._replace(min_score=100.0)
    assert settled(lived([True] * 20), strict) == (TENTATIVE, True)


def test_a_score_that_speaks_against_a_tentative_track_ends_it_if_there_is_one_to_reach() -> None:
    for status in (TENTATIVE, CONFIRMED):
        bank = lived([True] * 4, status)
        for score, hopeless in ((-6.9, False), (-7.1, True)):
            bank.ledger["score"] = score
            kept = settled(bank, RULES._replace(min_score=8.0))[1]
            assert kept is not (hopeless and status == TENTATIVE)
            assert settled(bank)[1] is True


def test_only_full_windows_are_judged() -> None:
    assert settled(lived([False] * 18, CONFIRMED)) == (CONFIRMED, True)
    assert settled(lived([False] * 19, CONFIRMED)) == (LOST, False)
    assert settled(lived([True] * 8 + [False] * 12, CONFIRMED)) == (CONFIRMED, True)
    assert settled(lived([True] * 8 + [False] * 13, CONFIRMED)) == (LOST, False)


def test_the_largest_axis_of_the_ellipse_counts() -> None:
    bank = lived([True] * 9, CONFIRMED)
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    for sd, kept in ((19.9, True), (20.1, False)):
        bank.covariance[0, :2, :2] = turn @ np.diag([sd**2, 1.0]) @ turn.T
        assert settled(bank)[1] is kept


def pair(offset: float, dv: float = 0.0) -> TrackBank:
    state = np.array([[0.0, 0.0, 0.0, 0.0], [offset, 0.0, dv, 0.0]])
    P = np.diag([0.04, 0.04, 0.01, 0.01])
    bank = new_tracks(state[:, :2], P[None, :2, :2], (1.0, 1.0), CONFIRMED)
    bank.ledger["id"] = [1, 2]
    return TrackBank(state, np.tile(P, (2, 1, 1)), bank.ledger)


def repeats_after(bank: TrackBank, none: tuple[float, float], pings: int) -> list[bool]:
    for _ in range(pings):
        repeats = suspect(bank.ledger, bank.state, bank.covariance, np.array(none), 10, NO_PAIRS)
    return [bool(r) for r in repeats]


def test_suspicion_needs_one_place_one_velocity_and_one_echo_for_ten_pings() -> None:
    assert repeats_after(pair(0.3), (0.5, 0.5), 9) == [False, False]
    assert repeats_after(pair(0.3), (0.5, 0.5), 10) == [False, True]
    assert repeats_after(pair(1.0), (0.5, 0.5), 50) == [False, False]
    assert repeats_after(pair(0.3, dv=0.4), (0.5, 0.5), 50) == [False, False]
    assert repeats_after(pair(0.3), (0.1, 0.1), 50) == [False, False]  # two echoes
    assert repeats_after(pair(0.3), (1.0, 1.0), 50) == [False, False]  # none


def test_a_resolved_ping_takes_suspicion_back() -> None:
    bank = pair(0.3)
    repeats_after(bank, (0.5, 0.5), 8)
    repeats_after(bank, (0.05, 0.05), 1)
    assert bank.ledger["rival_pings"].tolist() == [0, 6]
    assert repeats_after(bank, (0.5, 0.5), 3) == [False, False]
    assert repeats_after(bank, (0.5, 0.5), 1) == [False, True]


# --- bank and settings --------------------------------------------------------------------------------------


def test_bank_round_trip() -> None:
    bank = pair(0.3)
    again = TrackBank.restored(bank.snapshot())
    assert again.ledger.tobytes() == bank.ledger.tobytes()
    assert again.state.tobytes() == bank.state.tobytes()
    assert again.covariance.tobytes() == bank.covariance.tobytes()


def test_the_paper_preset_has_the_printed_values(view: View) -> None:
    assert (PAPER.sigma_v_mps2, PAPER.p_d, PAPER.gate_probability, PAPER.clutter) == (1e-3, 0.9, 1.0, "paper")
    assert (PAPER.m1, PAPER.n1, PAPER.m2, PAPER.n2, PAPER.max_sd_m) == (20, 16, 20, 8, 20.0)
    assert (PAPER.box_m(50.0), PAPER.box_m(200.0)) == ((5.0, 5.0), (10.0, 10.0))
    grain = grain_of(view, PAPER)
    assert (grain.range_sd_m, grain.bearing_sd_rad) == (0.05, pytest.approx(DB))


def test_recommended_noise_follows_the_view(view: View) -> None:
    assert RECOMMENDED.gate_probability == pytest.approx(1 - np.exp(-4.5))
    assert grain_of(view, RECOMMENDED).range_sd_m == 0.3
    coarse = replace(view, cell_m=0.8, beamwidth_rad=0.1)
    assert (grain_of(coarse, RECOMMENDED).range_sd_m, grain_of(coarse, RECOMMENDED).bearing_sd_rad) == (
        0.8,
        0.1,
    )
    given = grain_of(view, replace(RECOMMENDED, sigma_d_m=0.02, sigma_delta_deg=0.5))
    assert (given.range_sd_m, given.bearing_sd_rad) == (0.02, pytest.approx(np.deg2rad(0.5)))
    assert grain_of(view, RECOMMENDED).area_m2 == pytest.approx(0.5 * 39 * DB * (2500.0 - 1.0))
    unknown = grain_of(View(), RECOMMENDED)
    assert (unknown.range_sd_m, unknown.bearing_sd_rad, unknown.area_m2) == (0.3, pytest.approx(DB), 0.0)


def test_the_start_window_follows_the_initiation_unless_set() -> None:
    def window(preset: str, **given: Any) -> tuple[int, int]:
        settings = settings_of(preset, given)
        return settings.m1, settings.n1

    assert window("recommended") == window("paper", initiation="gate") == (8, 5)
    assert window("paper") == window("recommended", initiation="box") == (20, 16)
    assert window("paper", initiation="gate", m1=10) == (10, 5)
    with pytest.raises(ValueError, match="n1 = 16 of m1 = 5"):
        window("paper", m1=5)
