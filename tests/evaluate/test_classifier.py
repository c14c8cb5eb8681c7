"""Confusion, ROC and the threshold that the costs ask for."""

import math

import numpy as np
import pytest

from fls_flow.errors import UserError
from fls_flow.evaluate.classifier import classifier_scores, grouped, parse_group, roc_of

COSTS = {"positive": None, "miss_cost": 1.0, "false_alarm_cost": 1.0}


def rows_of(points, known, said, probability=None, track=None):
    """One row per ping: class of the target, label of the track that follows it."""
    n = len(known)
    x = points(*((t, 0, 0.0, 0.0) for t in range(n)), word=known)
    y = points(
        *((t, 0 if track is None else track[t], 0.0, 0.0) for t in range(n)),
        word=said,
        probability=probability,
    )
    return x, y, np.arange(n)


def test_confusion_by_hand(points):
    x, y, follows = rows_of(points, ["diver", "diver", "diver", "seal"], ["diver", "seal", "crab", "seal"])
    found = classifier_scores(x, y, follows, **COSTS)
    assert found.classes == ("diver", "seal")
    assert found.labels == ("crab", "diver", "seal")
    assert found.confusion.tolist() == [[1, 1, 1], [0, 0, 1]]
    assert found.class_error == pytest.approx({"diver": 2 / 3, "seal": 0.0})
    assert found.overall["class_error"] == pytest.approx(0.5)


def test_rows_without_class_label_or_target_do_not_count(points):
    x, y, _ = rows_of(points, ["diver", "", "diver", "diver"], ["diver", "diver", "", "seal"])
    found = classifier_scores(x, y, np.array([0, 1, 2, -1]), **COSTS)
    assert found.confusion.tolist() == [[1]]
    assert found.overall["class_labelled"] == pytest.approx(0.5)  # of the followed rows of known class
    assert classifier_scores(x, y, np.full(4, -1), **COSTS) is None


def test_a_track_counts_once_by_its_most_frequent_label(points):
    known, said = ["diver"] * 3 + ["seal"] * 3, ["diver", "seal", "diver", "diver", "diver", "seal"]
    x, y, follows = rows_of(points, known, said, track=[0, 0, 0, 1, 1, 1])
    found = classifier_scores(x, y, follows, **COSTS)
    assert found.track_confusion.tolist() == [[1, 0], [1, 0]]
    assert found.overall["class_error_tracks"] == pytest.approx(0.5)


def test_with_two_classes_the_label_of_the_other_gives_the_probability_too(points):
    x, y, follows = rows_of(points, ["a", "a", "b", "b"], ["a", "b", "a", "b"], [0.9, 0.6, 0.7, 0.8])
    roc = classifier_scores(x, y, follows, **COSTS).roc  # P(a) = 0.9, 0.4, 0.7, 0.2
    assert roc.positive == "a"
    assert roc.threshold.tolist() == pytest.approx([math.inf, 0.9, 0.7, 0.4, 0.2])
    assert roc.hit_rate.tolist() == [0, 0.5, 0.5, 1, 1]
    assert roc.false_alarm_rate.tolist() == [0, 0, 0.5, 0.5, 1]
    assert roc.area == pytest.approx(0.75)
    assert roc.bayes_threshold == 0.5
    assert (roc.hit_rate[roc.at_bayes], roc.false_alarm_rate[roc.at_bayes]) == (0.5, 0.5)


def test_with_three_classes_the_label_of_another_says_nothing_of_the_positive_one(points):
    x, y, follows = rows_of(points, ["a", "a", "b", "c"], ["a", "b", "c", "a"], [0.9, 0.6, 0.7, 0.8])
    roc = classifier_scores(x, y, follows, **COSTS).roc  # P(a) = 0.9, unknown, unknown, 0.8
    assert roc.threshold.tolist() == [math.inf, 0.9, 0.8, 0.0]
    assert roc.hit_rate.tolist() == [0, 0.5, 0.5, 1]
    assert roc.false_alarm_rate.tolist() == [0, 0, 0.5, 1]


def test_costs_move_the_threshold():
    """A miss that costs nine false alarms asks for P > 0.1."""
    value = np.array([0.95, 0.6, 0.3, 0.2, 0.05])
    roc = roc_of("diver", value, np.array([True, True, False, True, False]), 9.0, 1.0)
    assert roc.bayes_threshold == pytest.approx(0.1)
    assert roc.threshold[roc.at_bayes] == 0.2
    assert roc.cost[roc.at_bayes] == pytest.approx(1 / 5)
    assert roc.threshold[roc.cheapest] == 0.2
    dear = roc_of("diver", value, np.array([True, True, False, True, False]), 1.0, 9.0)
    assert dear.threshold[dear.at_bayes] == 0.95
    assert dear.threshold[dear.cheapest] == 0.6


def test_where_probabilities_are_right_no_threshold_is_cheaper_than_the_one_of_the_costs():
    rng = np.random.default_rng(3)
    probability = rng.beta(0.7, 0.7, 40_000)
    is_positive = rng.random(probability.size) < probability
    for miss, false in ((1.0, 1.0), (5.0, 1.0), (1.0, 3.0)):
        roc = roc_of("diver", probability, is_positive, miss, false)
        assert roc.cost[roc.at_bayes] == pytest.approx(roc.cost.min(), rel=0.02)


def test_the_area_is_the_chance_of_the_right_order():
    rng = np.random.default_rng(5)
    value = rng.integers(0, 6, 60) / 5  # with ties
    is_positive = rng.random(60) < 0.4
    gap = value[is_positive][:, None] - value[~is_positive][None]
    roc = roc_of("diver", value, is_positive, 1.0, 1.0)
    assert roc.area == pytest.approx(np.mean((gap > 0) + 0.5 * (gap == 0)))
    assert (roc.hit_rate[-1], roc.false_alarm_rate[-1]) == (1.0, 1.0)


def test_one_class_or_no_probability_has_no_roc(points):
    x, y, follows = rows_of(points, ["a", "a"], ["a", "b"], [0.9, 0.9])
    assert classifier_scores(x, y, follows, **COSTS).roc is None
    x, y, follows = rows_of(points, ["a", "b"], ["a", "b"])
    assert classifier_scores(x, y, follows, **COSTS).roc is None


def test_an_unknown_positive_class_is_refused(points):
    x, y, follows = rows_of(points, ["a", "b"], ["a", "b"], [0.9, 0.9])
    with pytest.raises(UserError, match="--positive whale: is no class here; there are a, b"):
        classifier_scores(x, y, follows, **{**COSTS, "positive": "whale"})


def test_classes_that_count_as_one():
    groups = tuple(map(parse_group, ("diver=diver*", "marine-life=seal, fish-?", "rest=*")))
    words = np.array(["diver-open", "seal", "fish-1", "fish-22", "", "diver"])
    assert grouped(words, groups).tolist() == ["diver", "marine-life", "marine-life", "rest", "", "diver"]
    assert grouped(words, ()).tolist() == words.tolist()
    assert grouped(words[:0], groups).size == 0


@pytest.mark.parametrize("text", ["diver", "=a", "diver=", "diver= , "])
def test_a_group_that_says_nothing_is_refused(text):
    with pytest.raises(UserError, match="write CLASS=A,B"):
        parse_group(text)
