"""Probability of detection and false alarms over the threshold."""

import math

import numpy as np
import pytest

from fls_flow.errors import UserError
from fls_flow.evaluate.detector import detector_scores
from fls_flow.evaluate.table import read

TRUTH = "seq,stamp_ns,target_id,x_m,y_m,frame"
DETECTIONS = "seq,stamp_ns,range_m,bearing_rad,amplitude"


@pytest.fixture
def scored(write):
    def of(truth, detections, gate_m=1.0, header=DETECTIONS):
        known = read(write("truth.csv", TRUTH, *truth), "truth")
        return detector_scores(
            known, read(write("detections.csv", header, *detections), "detections"), gate_m
        )

    return of


def test_the_curve_by_hand(scored):
    """Target at x = 10 in pings 0 and 1; echoes of 5 and 3 on it, of 4 and 1 elsewhere; ping 2 is empty."""
    found = scored(
        ["0,0,7,10,0,sensor", "1,1,7,10,0,sensor", "2,2,,,,"],
        ["0,0,10.5,0,5", "0,0,20,0,4", "1,1,9.5,0.01,3", "1,1,10.1,0,2", "2,2,30,1,1"],
    )
    assert found.threshold.tolist() == [5, 4, 3, 2, 1]
    assert found.pd.tolist() == [0.5, 0.5, 1.0, 1.0, 1.0]
    assert found.false_alarms.tolist() == pytest.approx([0, 1 / 3, 1 / 3, 1 / 3, 2 / 3])
    assert found.overall == pytest.approx(
        {"pd": 1.0, "false_alarms_per_ping": 2 / 3, "detections_per_ping": 5 / 3}
    )
    assert found.target_pd == {7: 1.0}


def test_each_threshold_counts_what_reaches_it(scored):
    """The fast curve beside a count for each threshold, with ties and missing amplitudes."""
    rng = np.random.default_rng(7)
    truth, detections = [], []
    for ping in range(20):
        truth += [f"{ping},{ping},{n},{10 + 10 * n},0,sensor" for n in range(2)]
        for _ in range(6):
            amplitude = "" if rng.random() < 0.1 else int(rng.integers(0, 5))
            detections.append((ping, float(rng.uniform(8, 22)), amplitude))
    found = scored(truth, [f"{ping},{ping},{r!r},0,{a}" for ping, r, a in detections])
    assert found.threshold[-1] == -math.inf
    for threshold, pd, false in zip(found.threshold, found.pd, found.false_alarms, strict=True):
        loud = [(t, r) for t, r, a in detections if (-math.inf if a == "" else a) >= threshold]
        hits = sum(
            any(t == ping and abs(r - x) <= 1 for t, r in loud) for ping in range(20) for x in (10, 20)
        )
        assert pd == pytest.approx(hits / 40)
        assert false == pytest.approx(sum(all(abs(r - x) > 1 for x in (10, 20)) for _, r in loud) / 20)


def test_false_alarms_of_rayleigh_noise_follow_theory(scored):
    """P(A > T) = exp(-T^2 / 2): cells of unit Rayleigh noise, kept above 2."""
    rng = np.random.default_rng(1)
    rows = []
    for ping in range(50):
        amplitude = rng.rayleigh(1.0, 1000)
        rows += [
            f"{ping},{ping},{20 + n * 0.01!r},0.5,{a!r}" for n, a in enumerate(amplitude.tolist()) if a > 2
        ]
    found = scored([f"{ping},{ping},1,5,0,sensor" for ping in range(50)], rows)
    for threshold in (2.0, 2.5, 3.0):
        measured = found.false_alarms[np.flatnonzero(found.threshold >= threshold)[-1]]
        expected = 1000 * math.exp(-(threshold**2) / 2)
        assert measured == pytest.approx(expected, abs=4 * math.sqrt(expected / 50))


def test_without_amplitudes_there_is_one_operating_point(scored):
    found = scored(["0,0,1,10,0,sensor"], ["0,0,10,0", "0,0,30,0"], header="seq,stamp_ns,range_m,bearing_rad")
    assert found.threshold.tolist() == [-math.inf]
    assert (found.pd.tolist(), found.false_alarms.tolist()) == ([1.0], [1.0])


def test_a_target_without_detections_is_missed(scored):
    found = scored(["0,0,1,10,0,sensor"], ["0,0,,,"])
    assert found.overall["pd"] == 0.0
    assert found.threshold.size == 0


def test_no_target_has_no_pd(scored):
    found = scored(["0,0,,,,"], ["0,0,10,0,1"])
    assert math.isnan(found.overall["pd"])
    assert found.overall["false_alarms_per_ping"] == 1.0


def test_truth_must_stand_in_the_sensors_frame(scored):
    with pytest.raises(UserError, match="frame is 'ned'"):
        scored(["0,0,1,10,0,ned"], ["0,0,10,0,1"])
