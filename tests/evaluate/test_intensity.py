"""PHD estimates against truth."""

import math

import pytest

from fls_flow.evaluate.intensity import intensity_scores
from fls_flow.evaluate.table import read

TRUTH = "seq,stamp_ns,target_id,x_m,y_m"
ESTIMATES = "seq,stamp_ns,expected_targets,x_m,y_m,vx_mps,vy_mps,weight,frame"


def test_numbers_and_places_by_hand(write):
    """Two targets, then one; masses 1.5 and 1.5; one estimate 2 m off, then none."""
    truth = read(write("truth.csv", TRUTH, "0,0,1,0,0", "0,0,2,50,0", "1,1,1,0,0"), "truth")
    rows = ("0,0,1.5,2,0,0,0,1.4,sensor", "1,1,1.5,,,,,,")
    found = intensity_scores(truth, read(write("estimates.csv", ESTIMATES, *rows), "estimates"), 10.0, 1.0)
    assert found.expected_targets.tolist() == [1.5, 1.5]
    assert found.overall["phd_expected_error"] == pytest.approx((-0.5 + 0.5) / 2)
    assert found.overall["phd_expected_rmse"] == pytest.approx(0.5)
    assert found.overall["phd_cardinality_error"] == pytest.approx(-1.0)
    assert found.overall["phd_ospa"] == pytest.approx(((2 + 10) / 2 + 10) / 2)
    assert found.overall["phd_gospa"] == pytest.approx(((2 + 5) + 5) / 2)


def test_a_ping_that_the_filter_did_not_see_has_no_expected_number(write):
    truth = read(write("truth.csv", TRUTH, "0,0,1,0,0", "1,1,1,0,0"), "truth")
    estimates = read(write("estimates.csv", ESTIMATES, "0,0,1.25,0,0,0,0,1,sensor"), "estimates")
    found = intensity_scores(truth, estimates, 10.0, 1.0)
    assert math.isnan(found.expected_targets[1])
    assert found.overall["phd_expected_error"] == pytest.approx(0.25)
    assert found.overall["phd_ospa"] == pytest.approx(5.0)
