"""The node `sklearn-model`: any classifier, no pickle."""

import pickle

import numpy as np
import pandas
import pytest
import skops.io
from numpy.testing import assert_allclose
from sklearn.compose import ColumnTransformer
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression, RidgeClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from fls_classifiers.sklearn_model import SklearnModel
from fls_flow import InputError
from fls_flow.testing import check_node

NAMES = ["area", "mean", "phi1"]
TREE = ("sklearn.tree._tree.Tree",)


@pytest.fixture
def saved(labelled, tmp_path):
    """The path of a fitted estimator, and the estimator."""

    def made(estimator, named=True):
        values, label = labelled((60, 90))
        table = pandas.DataFrame(values, columns=NAMES) if named else values
        estimator.fit(table, np.array(["diver", "seal"])[label])
        skops.io.dump(estimator, tmp_path / "m.skops")
        return tmp_path / "m.skops", estimator

    return made


ESTIMATORS = {
    "logistic": lambda: make_pipeline(StandardScaler(), LogisticRegression()),
    "lda": lambda: LinearDiscriminantAnalysis(solver="lsqr"),
    "forest": lambda: RandomForestClassifier(10, random_state=0),
    "by column": lambda: make_pipeline(
        ColumnTransformer([("s", StandardScaler(), ["mean", "area"])]), LogisticRegression()
    ),
}


@pytest.mark.parametrize("name", ESTIMATORS)
def test_posteriors_are_those_of_the_estimator(name, saved, described, rng):
    path, estimator = saved(ESTIMATORS[name]())
    values = rng.normal(size=(6, 3))
    found = SklearnModel(path, trusted=TREE)(described(0, dict(enumerate(values)), tuple(NAMES)))
    expected = estimator.predict_proba(pandas.DataFrame(values, columns=NAMES))
    assert found.names == ("diver", "seal")
    assert_allclose(found.posterior, expected, atol=1e-9)
    assert found.label.tolist() == expected.argmax(axis=1).tolist()


def test_columns_come_by_name_and_costs_count(saved, described):
    path, estimator = saved(ESTIMATORS["logistic"]())
    row = np.array([[0.3, -0.2, 0.5]])
    chance = estimator.predict_proba(pandas.DataFrame(row, columns=NAMES))[0, 0]
    mixed = described(0, {1: [0.5, 0.3, -0.2]}, ("phi1", "area", "mean"))
    above = SklearnModel(path, miss_cost=1.01 * (1 - chance) / chance)(mixed)
    below = SklearnModel(path, miss_cost=0.99 * (1 - chance) / chance)(mixed)
    assert (above.label.tolist(), below.label.tolist()) == ([0], [1])
    assert_allclose(above.posterior[0, 0], chance)


def test_types_that_nobody_has_trusted_are_not_loaded(saved):
    path, _ = saved(ESTIMATORS["forest"]())
    with pytest.raises(InputError, match=r"not trusted: sklearn\.tree\._tree\.Tree; look at them") as caught:
        SklearnModel(path)
    assert "\n" not in str(caught.value)


class Bomb:
    """Would write a file if it were unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_a_pickle_is_not_read(tmp_path):
    (tmp_path / "m.skops").write_bytes(pickle.dumps(Bomb(tmp_path / "boom")))
    with pytest.raises(InputError, match="is no model of skops"):
        SklearnModel(tmp_path / "m.skops")
    assert not (tmp_path / "boom").exists()


def test_no_file_and_no_probabilities_and_no_names(saved, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        SklearnModel(tmp_path / "none.skops")
    with pytest.raises(InputError, match="RidgeClassifier has no predict_proba"):
        SklearnModel(saved(RidgeClassifier())[0])
    with pytest.raises(InputError, match="LogisticRegression has no feature_names_in_"):
        SklearnModel(saved(LogisticRegression(), named=False)[0])


def test_other_features_are_refused_in_one_line(saved, described):
    node = SklearnModel(saved(ESTIMATORS["logistic"]())[0])
    with pytest.raises(InputError, match=r"the model needs phi1; the features that come are area, mean"):
        node(described(0, {}, ("area", "mean")))


def test_the_node_keeps_the_contract(saved, described, rng):
    path, _ = saved(ESTIMATORS["forest"]())
    firings = [
        {"features": described(seq, {n: rng.normal(size=3) for n in range(seq % 3)}, tuple(NAMES))}
        for seq in range(8)
    ]
    check_node(SklearnModel(path, trusted=TREE, memory=0.5), firings)
