"""Continuity, time to confirm, errors and their consistency."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from fls_flow.evaluate.assignment import pairs_within
from fls_flow.evaluate.clear import matched
from fls_flow.evaluate.scene import Pings
from fls_flow.evaluate.tracking import (
    error_scores,
    errors_of,
    follow_scores,
    nees_bounds,
    target_scores,
    track_counts,
)

NAN = float("nan")


def pings_at(*time_s):
    stamp = (np.array(time_s) * 1e9).astype(np.int64)
    return Pings(np.arange(stamp.size), stamp)


def scored(pings, x, y, gate=5.0):
    pairs = pairs_within(x, y, gate)
    follows = matched(x, y, pairs, gate)
    errors = errors_of(x, y, follows)
    return target_scores(pings, x, y, follows, errors), follows, errors, pairs


def test_continuity_is_tracked_time_over_life_time(points):
    """Pings at 0, 1, 2, 6 s stand for 1, 1, 2.5, 4 s; the target is followed at 1 s and 2 s, by two tracks."""
    x = points(*((t, 0, 0.0, 0.0) for t in range(4)))
    y = points((1, 0, 1.0, 0.0), (2, 1, 1.0, 0.0))
    scores, *_ = scored(pings_at(0, 1, 2, 6), x, y)
    assert scores[0]["continuity"] == pytest.approx(3.5 / 8.5)
    assert scores[0]["continuity_one_track"] == pytest.approx(2.5 / 8.5)
    assert scores[0]["time_to_confirm_s"] == pytest.approx(1.0)
    assert scores[0]["id_switches"] == 1


def test_time_to_confirm_counts_from_the_targets_own_beginning(points):
    """Target 1 appears at 2 s and is followed from 6 s on; before, a track waits where it will come."""
    x = points((0, 0, 50.0, 0.0), *((t, 1, 0.0, 0.0) for t in (2, 3, 4)))
    y = points((0, 0, 0.0, 0.0), (1, 0, 0.0, 0.0), (3, 1, 0.5, 0.0), (4, 1, 0.5, 0.0))
    scores, *_ = scored(pings_at(0, 1, 2, 6, 7), x, y)
    assert scores[1]["time_to_confirm_s"] == pytest.approx(4.0)
    assert math.isnan(scores[0]["time_to_confirm_s"])


def test_means_leave_out_who_was_never_followed_where_there_is_nothing_to_mean(points):
    x = points((0, 0, 0.0, 0.0), (1, 0, 0.0, 0.0), (0, 1, 50.0, 0.0), (1, 1, 50.0, 0.0))
    scores, *_ = scored(pings_at(0, 1), x, points((1, 0, 0.0, 0.0)))
    means = follow_scores(scores)
    assert means["continuity"] == pytest.approx((0.5 + 0.0) / 2)
    assert means["time_to_confirm_s"] == pytest.approx(1.0)
    assert (means["targets"], means["targets_found"]) == (2, 1)
    assert math.isnan(scores[1]["time_to_confirm_s"])


def test_errors_by_hand(points):
    """Errors (3, 4) and (0, 1): RMSE sqrt((25 + 1) / 2); P = diag(4, 1): NEES 9/4 + 16 and 1."""
    x = points((0, 0, 0, 0), (1, 0, 0, 0), velocity=[[1, 0], [NAN, NAN]])
    y = points((0, 0, 3, 4), (1, 0, 0, 1), velocity=[[1, 2], [0, 0]], covariance=[np.diag([4, 1])] * 2)
    *_, errors, _ = scored(pings_at(0, 1), x, y)
    found = error_scores(errors)
    assert found["position_rmse_m"] == pytest.approx(math.sqrt(13))
    assert found["velocity_rmse_mps"] == pytest.approx(2.0)
    assert errors.nees.tolist() == pytest.approx([9 / 4 + 16, 1.0])
    assert found["nees"] == pytest.approx((9 / 4 + 17) / 2)
    assert found["nees_inside"] == 0.5


def test_nees_of_a_full_covariance_is_that_of_linear_algebra(points):
    rng = np.random.default_rng(0)
    n = 40
    roots = rng.normal(size=(n, 2, 2))
    P = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(2)
    e = rng.normal(size=(n, 2))
    x = points(*((t, 0, 0.0, 0.0) for t in range(n)))
    y = points(*((t, 0, *e[t]) for t in range(n)), covariance=P)
    *_, errors, _ = scored(pings_at(*range(n)), x, y, gate=100.0)
    assert errors.nees == pytest.approx(np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e))


@pytest.mark.parametrize(
    "P", [np.zeros((2, 2)), np.diag([-1.0, -1.0]), np.full((2, 2), np.nan), np.ones((2, 2))]
)
def test_what_is_no_covariance_is_left_out(points, P):
    x, y = points((0, 0, 0.0, 0.0)), points((0, 0, 1.0, 0.0), covariance=[P])
    *_, errors, _ = scored(pings_at(0), x, y)
    assert math.isnan(error_scores(errors)["nees"])
    assert math.isnan(error_scores(errors)["nees_low"])


@pytest.mark.parametrize("n", [1, 7, 1000])
def test_bounds_are_those_of_chi_square(n):
    assert nees_bounds(n) == pytest.approx([chi2.ppf(q, 2 * n) / n for q in (0.025, 0.975)])


def test_consistent_errors_stay_inside_the_bounds_as_often_as_they_say(points):
    """200 experiments of 50 errors drawn from P: the mean NEES leaves the bounds in 5 % +- 3.5 %."""
    rng = np.random.default_rng(12)
    P = np.array([[0.5, 0.3], [0.3, 1.0]])
    outside, inside_ellipse = 0, []
    for _ in range(200):
        e = rng.multivariate_normal([0, 0], P, 50)
        x = points(*((t, 0, 0.0, 0.0) for t in range(50)))
        y = points(*((t, 0, *one) for t, one in enumerate(e)), covariance=[P] * 50)
        *_, errors, _ = scored(pings_at(*range(50)), x, y, gate=50.0)
        found = error_scores(errors)
        outside += not found["nees_low"] < found["nees"] < found["nees_high"]
        inside_ellipse.append(found["nees_inside"])
    assert 0.015 < outside / 200 < 0.085
    assert np.mean(inside_ellipse) == pytest.approx(0.95, abs=0.006)


def test_tracks_are_told_apart_by_most_of_their_pings(points):
    x = points(*((t, 0, 0.0, 0.0) for t in range(6)))
    y = points(
        *((t, 0, 1.0, 0.0) for t in range(6)),  # follows
        *((t, 1, 2.0, 0.0) for t in range(5)),  # redundant
        *((t, 2, 40.0, 0.0) for t in range(6)),  # false
        (0, 3, 40.0, 9.0), (1, 3, 40.0, 9.0), (2, 3, 3.0, 0.0),  # false most of the time
    )  # fmt: skip
    _, follows, _, pairs = scored(pings_at(*range(6)), x, y)
    counts = track_counts(x, y, follows, pairs, 5.0)
    assert counts == {"confirmed_tracks": 4, "redundant_tracks": 1, "false_tracks": 2}


def test_a_track_that_does_two_things_equally_often_counts_as_the_better(points):
    """Track 0 follows once and is false once; track 1 is redundant once and false once."""
    x = points((0, 0, 0.0, 0.0), (1, 0, 0.0, 0.0))
    y = points((0, 0, 1.0, 0.0), (1, 0, 40.0, 0.0), (0, 1, 2.0, 0.0), (1, 1, 60.0, 0.0))
    _, follows, _, pairs = scored(pings_at(0, 1), x, y)
    counts = track_counts(x, y, follows, pairs, 5.0)
    assert counts == {"confirmed_tracks": 2, "redundant_tracks": 1, "false_tracks": 0}


def test_one_ping_stands_for_itself(points):
    scores, *_ = scored(pings_at(0), points((0, 0, 0.0, 0.0)), points((0, 0, 1.0, 0.0)))
    assert scores[0]["continuity"] == 1.0


def test_no_tracks_and_no_targets(points):
    x, nothing = points((0, 0, 0.0, 0.0)), points()
    scores, follows, errors, pairs = scored(pings_at(0), x, nothing)
    assert scores[0]["continuity"] == 0.0
    assert math.isnan(error_scores(errors)["position_rmse_m"])
    assert track_counts(x, nothing, follows, pairs, 5.0)["confirmed_tracks"] == 0
    scores, follows, errors, pairs = scored(pings_at(0), nothing, x)
    assert scores == {}
    assert track_counts(nothing, x, follows, pairs, 5.0)["false_tracks"] == 1
    assert math.isnan(follow_scores(scores)["continuity"])
