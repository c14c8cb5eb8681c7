"""Analysis of variance, rankings and splits, against theory and scikit-learn."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from fls_flow.discriminants import linear, quadratic
from fls_flow.errors import UserError
from fls_flow.tools.train_ranking import Judge, alone, anova, forward
from fls_flow.tools.train_samples import Samples, only
from fls_flow.tools.train_scores import Sides, confusion, interval
from fls_flow.tools.train_splits import fold_count, folds, halves

EACH = Judge(Sides.each("ab"))


@pytest.fixture
def rng():
    return np.random.default_rng(20261122)


@pytest.fixture
def make_samples(rng):
    """Two classes, `groups` targets each of `pings` vectors; feature n lies `shift[n]` apart between classes."""

    def made(shift=(3.0, 1.0, 0.0), groups=10, pings=20, between=0.0, classes=2):
        n = classes * groups * pings
        label = np.repeat(np.arange(classes), groups * pings)
        group = np.arange(n) // pings
        own = between * rng.normal(size=(classes * groups, len(shift)))
        values = rng.normal(size=(n, len(shift))) + np.outer(label, shift) + own[group]
        names = tuple(f"f{one}" for one in range(len(shift)))
        return Samples("static", names, values, tuple("abcdef"[:classes]), label, group)

    return made


def test_f_numbers_against_their_definition(make_samples):
    samples = make_samples(classes=3)
    found = anova(samples)
    parts = [samples.values[samples.label == one] for one in range(3)]
    total = samples.values.mean(axis=0)
    between = sum(len(p) * (p.mean(axis=0) - total) ** 2 for p in parts) / 2
    within = sum(((p - p.mean(axis=0)) ** 2).sum(axis=0) for p in parts) / (len(samples) - 3)
    assert_allclose(found.f_number, between / within)
    assert found.probability[0] < 1e-10


def test_without_a_difference_the_probability_is_uniform(rng):
    found = []
    for _ in range(300):
        values = rng.normal(size=(40, 2))
        samples = Samples("s", ("a", "b"), values, ("x", "y"), np.arange(40) % 2, np.arange(40))
        found += anova(samples).probability.tolist()
    assert abs(np.mean(np.array(found) < 0.05) - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 600)


def test_a_constant_feature_has_no_f_number(make_samples):
    samples = make_samples()
    samples.values[:, 1] = 4.0
    assert np.isnan(anova(samples).f_number[1])


def test_a_feature_alone_has_the_bayes_error_of_its_distance(make_samples):
    """Phi(-d / 2) for d = 3, 1, 0."""
    error = alone(make_samples(groups=40), EACH, repeats=20, share=0.5, seed=1)
    assert_allclose(error, [0.0668, 0.3085, 0.5], atol=0.02)


def test_a_feature_alone_is_judged_as_scikit_learn_would(make_samples):
    samples = make_samples(classes=3)
    rng = np.random.default_rng(7)
    train = np.isin(samples.group, halves([samples], 0.5, rng))
    peer = LinearDiscriminantAnalysis(solver="lsqr")
    expected = []
    for n in range(3):
        column = samples.values[:, [n]]
        peer.fit(column[train], samples.label[train])
        expected.append(np.mean(peer.predict(column[~train]) != samples.label[~train]))
    assert_allclose(
        alone(samples, Judge(Sides.each(samples.classes)), repeats=1, share=0.5, seed=7), expected
    )


def test_no_group_is_on_both_sides_and_each_class_is_on_each(make_samples):
    samples = make_samples(groups=5, classes=3)
    for seed in range(20):
        chosen = halves([samples], 0.5, np.random.default_rng(seed))
        train = np.isin(samples.group, chosen)
        assert not set(samples.group[train]) & set(samples.group[~train])
        assert set(samples.label[train]) == set(samples.label[~train]) == {0, 1, 2}
    for share in (1e-9, 1 - 1e-9):
        train = np.isin(samples.group, halves([samples], share, np.random.default_rng(0)))
        assert set(samples.label[train]) == set(samples.label[~train]) == {0, 1, 2}


def test_a_class_with_one_target_cannot_be_split(make_samples):
    with pytest.raises(UserError, match="class 'a' comes from 1 target"):
        halves([make_samples(groups=1)], 0.5, np.random.default_rng(0))


def test_folds_part_no_group_and_hold_out_each_class(make_samples):
    samples = make_samples(groups=7, classes=3)
    count = fold_count(samples, 5)
    fold = folds(samples, count, np.random.default_rng(1))
    assert count == 5
    for group in np.unique(samples.group):
        assert np.unique(fold[samples.group == group]).size == 1
    for number in range(count):
        assert set(samples.label[fold == number]) == {0, 1, 2}
    assert fold_count(make_samples(groups=3), 5) == 3
    assert fold_count(make_samples(groups=1), 5) == 0


def search(samples, sides=None, rule=linear, ridge=0.0, **options):
    judge = Judge(sides or Sides.each(samples.classes), rule, ridge)
    return forward(samples, judge, **{"most": len(samples.features), "fold_limit": 5, "seed": 0} | options)


def test_the_best_feature_comes_first(make_samples):
    found = search(make_samples(shift=(0.0, 1.0, 3.0, 0.0, 0.0, 0.0), groups=20))
    assert found.order[:2] == (2, 1)
    assert found.error[found.best - 1] <= found.error.min()
    assert found.cross_validated


def test_where_all_part_the_classes_the_fewest_that_are_sure_are_taken(make_samples):
    found = search(make_samples(shift=(12.0, 12.0, 12.0, 0.0, 0.0), groups=20))
    assert found.error[0] == 0.0
    assert found.best <= 3


def test_features_that_help_only_together_are_found(rng):
    """b is noise alone; a - b is nearly without noise."""
    label = np.repeat([0, 1], 300)
    noise = rng.normal(size=600)
    values = np.stack([label + noise, noise + 0.05 * rng.normal(size=600), rng.normal(size=600)], 1)
    found = search(Samples("s", ("a", "b", "c"), values, ("x", "y"), label, np.arange(600) // 20))
    assert found.order[:2] == (0, 1)
    assert found.error[0] > 0.2
    assert found.error[1] == 0.0


def test_cross_validation_by_target_sees_what_splitting_by_ping_hides(make_samples):
    """Targets that differ more from each other than from ping to ping: 100 pings of 4 targets are not 400."""
    samples = make_samples(shift=(0.5,) * 8, groups=4, pings=100, between=3.0)
    by_ping = Samples(
        samples.name,
        samples.features,
        samples.values,
        samples.classes,
        samples.label,
        np.arange(len(samples)),
    )
    assert search(samples).error[-1] > search(by_ping).error[-1] + 0.1


def test_a_feature_twice_joins_once(make_samples):
    samples = make_samples(shift=(1.0, 0.5))
    twice = Samples(
        "s",
        ("a", "b", "a again"),
        samples.values[:, [0, 1, 0]],
        samples.classes,
        samples.label,
        samples.group,
    )
    assert len(search(twice).order) == 2
    assert len(search(twice, ridge=1e-3).order) == 3


def test_with_one_target_per_class_errors_are_those_of_the_training(make_samples):
    found = search(make_samples(groups=1, pings=200))
    assert not found.cross_validated
    assert found.error[0] == pytest.approx(0.0668, abs=0.03)
    assert np.isnan(alone(make_samples(groups=1), EACH, 3, 0.5, 0)).all()


def test_classes_that_differ_in_spread_alone_need_the_quadratic_one(rng):
    label = np.repeat([0, 1], 400)
    values = rng.normal(size=(800, 2)) * np.where(label[:, None] == 1, [5.0, 1.0], 1.0)
    samples = Samples("s", ("a", "b"), values, ("x", "y"), label, np.arange(800) // 20)
    straight, curved = search(samples), search(samples, rule=quadratic)
    assert straight.error.min() > 0.35
    assert curved.order[0] == 0
    assert curved.error.min() < 0.25


def test_mistakes_among_the_others_may_count_nothing(rng):
    """a lies between b and c in one feature; the other parts b from c alone."""
    label = np.arange(900) % 3
    values = rng.normal(size=(900, 2)) + np.stack([np.array([0.0, -6.0, 6.0])[label], 3.0 * (label == 1)], 1)
    samples = Samples("s", ("x", "y"), values, ("a", "b", "c"), label, np.arange(900) // 9 * 3 + label)
    found = search(samples, sides=Sides.against_rest("abc", "a"))
    assert found.order[0] == 0
    assert found.error[0] < 0.01
    two = Samples("s", ("x", "y"), values, ("a", "r"), np.minimum(label, 1), samples.group)
    assert search(two).error[0] > 0.25  # one Gaussian for b and c together


def test_sides_join_probabilities():
    sides = Sides.against_rest(("a", "b", "c"), "b")
    assert sides.names == ("b", "others")
    assert_allclose(sides.chance(np.array([[0.2, 0.5, 0.3]])), [[0.5, 0.5]])
    assert_allclose(Sides.each("ab").chance(np.array([[0.2, 0.8]])), [[0.2, 0.8]])


def test_progress_and_the_limit(make_samples):
    heard = []
    found = search(make_samples(), most=2, told=heard.append)
    assert heard == [1, 2]
    assert len(found.order) == 2


def test_only_keeps_what_matches(make_samples):
    assert only(make_samples(), "f2,f0").features == ("f0", "f2")
    assert only(make_samples(), "*").features == ("f0", "f1", "f2")
    with pytest.raises(UserError, match="--only g"):
        only(make_samples(), "g*")


def test_intervals_are_those_of_clopper_and_pearson():
    assert interval(0, 48) == pytest.approx((0.0, 1 - 0.025 ** (1 / 48)))
    assert interval(48, 48) == pytest.approx((0.025 ** (1 / 48), 1.0))
    assert interval(6, 341) == pytest.approx((0.00648, 0.03791), abs=2e-5)
    assert interval(0, 0) == (0.0, 1.0)


def test_intervals_hold_the_truth_by_monte_carlo(rng):
    wrong = rng.binomial(60, 0.07, 2000)
    held = np.mean([low <= 0.07 <= high for low, high in (interval(int(one), 60) for one in wrong)])
    assert held >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 2000)


def test_confusion_counts_vectors_and_targets():
    true = np.array([0, 0, 0, 0, 1, 1, 1])
    said = np.array([0, 0, 1, 1, 1, 1, 0])
    found = confusion(("a", "b"), true, said, np.array([1, 1, 1, 2, 5, 5, 5]))
    assert found.count.tolist() == [[2, 2], [1, 2]]
    assert found.group_count.tolist() == [[1, 1], [0, 1]]
    assert found.wrong == (3, 7)
    assert found.group_wrong == (1, 3)
    assert_allclose(found.class_error, [0.5, 1 / 3])
    assert (found.missed("a"), found.called("a")) == ((2, 4), (1, 3))
    assert (found.missed("b", group=True), found.called("b", group=True)) == ((0, 1), (1, 2))
