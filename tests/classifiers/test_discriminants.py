"""Gaussian discriminants beside scikit-learn's, and where they are singular."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis

from fls_flow.discriminants import Gaussians, Scaling, fit, linear, posterior, quadratic


@pytest.mark.parametrize("counts", [(50, 50), (200, 15), (60, 90, 40)])
def test_the_linear_one_is_that_of_scikit_learn(labelled, rng, counts):
    values, label = labelled(counts)
    ours, peer = (
        linear(fit(values, label, len(counts))),
        LinearDiscriminantAnalysis(solver="lsqr").fit(values, label),
    )
    there = rng.normal(size=(500, 3)) * 4
    assert_allclose(posterior(ours.scores(there)), peer.predict_proba(there), atol=1e-12)
    if len(counts) == 2:
        g = np.diff(ours.scores(there), axis=1)[:, 0]
        assert_allclose(g, peer.decision_function(there), rtol=1e-9, atol=1e-9)
    assert (ours.scores(there).argmax(axis=1) == peer.predict(there)).all()


def test_the_quadratic_one_is_that_of_scikit_learn(labelled, rng):
    """With its covariances, which are over n or n - 1 by its version."""
    values, label = labelled((60, 90, 40))
    found = fit(values, label, 3)
    peer = QuadraticDiscriminantAnalysis(store_covariance=True).fit(values, label)
    assert_allclose(np.stack(peer.covariance_), found.covariance, rtol=0.03)
    same = Gaussians(found.prior, found.mean, np.stack(peer.covariance_))
    there = rng.normal(size=(500, 3)) * 4
    assert_allclose(posterior(quadratic(same).scores(there)), peer.predict_proba(there), atol=1e-10)


def test_the_quadratic_one_needs_the_logarithm_of_the_determinant(rng):
    """Two classes with one mean: only ln|Sigma| tells a wide one from a narrow one near it."""
    classes = Gaussians(np.array([0.5, 0.5]), np.zeros((2, 1)), np.array([[[1.0]], [[100.0]]]))
    scores = quadratic(classes).scores(np.array([[0.0], [50.0]]))
    assert scores.argmax(axis=1).tolist() == [0, 1]
    assert_allclose(scores[0, 0] - scores[0, 1], np.log(10.0))
    exact = np.log(0.5) - 0.5 * 50.0**2 / 100.0 - 0.5 * np.log(100.0)
    assert_allclose(scores[1, 1], exact)


def test_covariances_and_priors_are_those_of_maximum_likelihood(labelled):
    values, label = labelled((60, 90))
    found = fit(values, label, 2)
    assert_allclose(found.prior, [60 / 150, 90 / 150])
    assert_allclose(found.covariance[1], np.cov(values[label == 1].T, bias=True))


def test_equal_covariances_make_both_kinds_one(labelled, rng):
    values, label = labelled((60, 90))
    found = fit(values, label, 2)
    same = Gaussians(found.prior, found.mean, np.stack([found.covariance[0]] * 2))
    there = rng.normal(size=(100, 3))
    assert_allclose(
        posterior(linear(same).scores(there)), posterior(quadratic(same).scores(there)), atol=1e-10
    )


def test_bayes_error_of_two_gaussians_by_monte_carlo(rng):
    """Equal covariances at a Mahalanobis distance of 2: the error is Phi(-1) = 15.87 %."""
    n = 40_000
    label = np.arange(2 * n) % 2
    mixing = np.array([[2.0, 0.0], [1.5, 0.5]])
    values = (rng.normal(size=(2 * n, 2)) + np.outer(label, [2.0, 0.0])) @ mixing.T
    rule = linear(fit(values[:n], label[:n], 2))
    wrong = np.mean(rule.scores(values[n:]).argmax(axis=1) != label[n:])
    assert abs(wrong - 0.15866) < 4 * np.sqrt(0.15866 * 0.84134 / n)


def test_posteriors_are_calibrated_by_monte_carlo(rng):
    n = 60_000
    label = (rng.random(n) < 0.3).astype(int)
    values = rng.normal(size=(n, 1)) + 1.5 * label[:, None]
    chance = posterior(linear(fit(values, label, 2)).scores(values))[:, 1]
    for low in np.arange(0.1, 0.9, 0.1):
        inside = (chance >= low) & (chance < low + 0.1)
        spread = 4 * np.sqrt(0.25 / inside.sum())
        assert abs(label[inside].mean() - chance[inside].mean()) < spread


@pytest.mark.parametrize("broken", ["constant", "twice", "sum", "fewer vectors than features"])
def test_dependent_features_are_refused_and_a_ridge_mends_them(rng, broken):
    n = 3 if broken.startswith("fewer") else 50
    values = rng.normal(size=(2 * n, 8))
    if broken == "constant":
        values[:, 3] = 4.0
    elif broken == "twice":
        values[:, 3] = values[:, 5]
    elif broken == "sum":
        values[:, 3] = values[:, 0] + 2.0 * values[:, 1]
    found = fit(values, np.repeat([0, 1], n), 2)
    for made in (linear, quadratic):
        with pytest.raises(ValueError, match="covariance of 8 features is singular"):
            made(found)
        assert np.isfinite(made(found, 1e-3).scores(values)).all()


def test_a_class_without_vectors_is_refused(rng):
    with pytest.raises(ValueError, match=r"\[5, 0\] vectors"):
        fit(rng.normal(size=(5, 2)), np.zeros(5, np.int64), 2)


def test_far_vectors_have_finite_posteriors(labelled):
    values, label = labelled((60, 90))
    chance = posterior(linear(fit(values, label, 2)).scores(1e6 * values))
    assert np.isfinite(chance).all()
    assert_allclose(chance.sum(axis=1), 1.0)
    assert posterior(np.zeros((0, 2))).shape == (0, 2)


def test_scaling_takes_logarithms_of_what_is_less_skew_so(rng):
    """A size that spreads by factors, a normal one far from zero, a rate of both signs, and a constant."""
    n = 4000
    values = np.stack(
        [rng.lognormal(1.0, 1.0, n), rng.normal(50, 1, n), rng.normal(0, 1, n), np.full(n, 2.0)], 1
    )
    found = Scaling.of(values, log=True)
    assert np.isfinite(found.offset[0])
    assert np.isnan(found.offset[2])
    scaled = found(values)
    assert_allclose(scaled[:, :3].mean(axis=0), 0.0, atol=1e-9)
    assert_allclose(scaled[:, :3].std(axis=0), 1.0)
    assert abs(np.mean(scaled[:, 0] ** 3)) < 0.5
    assert np.isnan(Scaling.of(values).offset).all()


def test_zeros_have_logarithms_too(rng):
    values = np.abs(rng.normal(size=(100, 1))) ** 3
    values[:40] = 0.0
    assert np.isfinite(Scaling.of(values, log=True)(values)).all()
