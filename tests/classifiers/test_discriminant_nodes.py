"""The nodes `linear-discriminant` and `quadratic-discriminant`."""

import itertools
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fls_classifiers.labels import Costs
from fls_classifiers.linear_discriminant import LinearDiscriminant
from fls_classifiers.quadratic_discriminant import QuadraticDiscriminant
from fls_flow import InputError
from fls_flow import model_files as files
from fls_flow.discriminants import linear, posterior, quadratic
from fls_flow.testing import check_node

NODES = {LinearDiscriminant: linear, QuadraticDiscriminant: quadratic}
NAMES = ("area", "mean", "phi1")


@pytest.fixture
def one_feature(make_model, tmp_path):
    """Two classes at -1 and 1 with equal spread 1 and priors: g(x) = -2 x."""

    def made(**options):
        values = np.concatenate([[-1 - 1.0, -1 + 1.0], [1 - 1.0, 1 + 1.0]])[:, None]
        model = make_model(
            counts=(2, 2), values=values, label=np.array([0, 0, 1, 1]), features=("x",), **options
        )
        files.save(tmp_path / "one.json", model)
        return tmp_path / "one.json"

    return made


def labels_of(classes):
    return {
        track: classes.names[label]
        for track, label in zip(classes.track_id.tolist(), classes.label.tolist(), strict=True)
    }


@pytest.mark.parametrize("cls", NODES)
@pytest.mark.parametrize("counts", [(60, 90), (60, 90, 40)])
def test_posteriors_are_those_of_the_model(cls, counts, make_model, described, tmp_path, rng):
    model = make_model(counts=counts)
    files.save(tmp_path / "m.json", model)
    values = rng.normal(size=(7, 3))
    found = cls(tmp_path / "m.json")(described(0, dict(enumerate(values))))
    expected = posterior(NODES[cls](model.gaussians).scores(model.scaling(values)))
    assert found.names == model.class_names
    assert_allclose(found.posterior, expected, rtol=1e-10)
    others = 1 + expected[:, 1:].argmax(axis=1)
    assert found.label.tolist() == np.where(expected[:, 0] >= 0.5, 0, others).tolist()


def test_features_are_taken_by_name(model_file, described, rng):
    node = LinearDiscriminant(model_file())
    values = rng.normal(size=(3, 3))
    plain = node(described(0, dict(enumerate(values))))
    mixed = np.column_stack([values[:, 2], [9.0, 9.0, 9.0], values[:, 0], values[:, 1]])
    names = ("phi1", "area_m2", "area", "mean")
    other = LinearDiscriminant(node.model)(described(0, dict(enumerate(mixed)), names))
    assert_allclose(other.posterior, plain.posterior)


@pytest.mark.parametrize("cls", NODES)
def test_a_model_of_other_features_is_refused_in_one_line(cls, model_file, described):
    node = cls(model_file())
    with pytest.raises(InputError) as caught:
        node(described(0, {}, ("area", "mean", "metric_phi1")))  # even without a row
    text = str(caught.value)
    assert "the model needs phi1; the features that come are area, mean, metric_phi1" in text
    assert "\n" not in text


def test_costs_move_the_threshold_to_the_logarithm_of_their_ratio(one_feature, described):
    """g = ln P(diver) / P(seal) = -2 x: diver iff -2 x > ln(false alarm / miss)."""
    for miss, false_alarm in ((1.0, 1.0), (20.0, 1.0), (1.0, 7.0)):
        edge = -0.5 * math.log(false_alarm / miss)
        node = LinearDiscriminant(one_feature(), miss_cost=miss, false_alarm_cost=false_alarm)
        found = node(described(0, {1: [edge - 1e-6], 2: [edge + 1e-6]}, ("x",)))
        assert labels_of(found) == {1: "diver", 2: "seal"}
        assert_allclose(found.posterior[0, 0], 1 / (1 + math.exp(2 * edge)), rtol=1e-5)  # costs are not in it
        node.model.unlink()


def test_costs_of_the_model_hold_where_none_is_given(one_feature, described):
    path = one_feature(miss_cost=20.0)
    edge = 0.5 * math.log(20.0)
    found = LinearDiscriminant(path)(described(0, {1: [edge - 0.01]}, ("x",)))
    assert labels_of(found) == {1: "diver"}
    found = LinearDiscriminant(path, miss_cost=1.0)(described(0, {1: [edge - 0.01]}, ("x",)))
    assert labels_of(found) == {1: "seal"}
    found = LinearDiscriminant(path, positive="seal")(described(0, {1: [-edge + 0.01]}, ("x",)))
    assert labels_of(found) == {1: "seal"}


def test_with_three_classes_the_positive_one_stands_against_the_others_together():
    costs = Costs(("a", "b", "c"), "c", 4.0, 1.0)  # c from 20 % on
    chance = np.array(
        [[0.6, 0.3, 0.1], [0.5, 0.25, 0.25], [0.2, 0.75, 0.05], [0.41, 0.4, 0.19], [0.5, 0.3, 0.2]]
    )
    assert costs.label(chance).tolist() == [0, 2, 1, 0, 2]
    assert Costs(("a", "b", "c"), "a", 1.0, 1.0).label(chance).tolist() == [0, 0, 1, 1, 0]


def test_a_track_keeps_its_label_between_descriptions_and_has_none_before(one_feature, described):
    node = LinearDiscriminant(one_feature(), hold_pings=3)
    got = [
        labels_of(node(described(seq, rows, ("x",))))
        for seq, rows in enumerate([{}, {1: [-5.0]}, {2: [5.0]}, {}, {2: [-5.0]}, {}, {}, {}])
    ]
    assert got == [
        {}, {1: "diver"}, {1: "diver", 2: "seal"}, {1: "diver", 2: "seal"}, {2: "diver"}, {2: "diver"},
        {2: "diver"}, {},
    ]  # fmt: skip


def test_with_tracks_labels_live_as_long_as_these(one_feature, described, alive):
    node = LinearDiscriminant(one_feature(), hold_pings=1)
    firings = [({1: [-5.0]}, [1, 2]), ({}, [1, 2]), ({}, [1]), ({}, [2]), ({}, [1])]
    got = [
        labels_of(node(described(seq, rows, ("x",)), alive(seq, ids)))
        for seq, (rows, ids) in enumerate(firings)
    ]
    assert got == [{1: "diver"}, {1: "diver"}, {1: "diver"}, {}, {}]


def test_memory_joins_the_evidence(one_feature, described):
    """g of 0.4 and 0.6: alone, joined in full, and by half."""
    for memory, total in ((0.0, 0.6), (1.0, 1.0), (0.5, 0.8)):
        node = LinearDiscriminant(one_feature(), memory=memory)
        node(described(0, {1: [-0.2]}, ("x",)))
        found = node(described(1, {1: [-0.3]}, ("x",)))
        assert_allclose(found.posterior[0, 0], 1 / (1 + math.exp(-total)))
        node.model.unlink()


def test_with_handover_labels_are_those_of_a_hidden_markov_model(one_feature, described):
    """P(diver) after x_1, x_2, ...: every path of classes through the pings, weighed."""
    h, x = 0.1, [-2.0, -1.5, 0.2, 1.8, 1.9]
    node = LinearDiscriminant(one_feature(), memory=1.0, handover=h)
    for n, one in enumerate(x):
        found = node(described(n, {1: [one]}, ("x",)))
        total = np.zeros(2)
        for path in itertools.product((0, 1), repeat=n + 1):
            chance = 0.5
            for k, c in enumerate(path):
                step = 1.0 if k == 0 else (1 - h) * (c == path[k - 1]) + h / 2
                chance *= step * math.exp(-((x[k] - (-1.0, 1.0)[c]) ** 2) / 2.0)
            total[path[-1]] += chance
        assert_allclose(found.posterior[0], total / total.sum())


def test_a_track_that_changes_hands_is_soon_called_by_what_it_follows_now(one_feature, described):
    sure = [{1: [-4.0]}] * 50 + [{1: [4.0]}]
    stubborn = LinearDiscriminant(one_feature(), memory=1.0)
    supple = LinearDiscriminant(stubborn.model, memory=1.0, handover=0.01)
    for n, rows in enumerate(sure):
        old, new = (labels_of(node(described(n, rows, ("x",)))) for node in (stubborn, supple))
    assert (old, new) == ({1: "diver"}, {1: "seal"})


def test_a_track_has_no_label_before_it_was_described_often_enough(one_feature, described):
    node = LinearDiscriminant(one_feature(), memory=1.0, min_descriptions=2)
    rows = [{1: [0.3], 2: [-5.0]}, {}, {1: [-0.5]}, {2: [-5.0]}]
    got = [labels_of(node(described(seq, one, ("x",)))) for seq, one in enumerate(rows)]
    assert got == [{}, {}, {1: "diver"}, {1: "diver", 2: "diver"}]  # the first description counts too


@pytest.mark.parametrize(
    ("x", "told"),
    [
        ([-5.0, -5.0, -5.0, -5.0], "..dd"),
        ([-5.0, -5.0, -5.0, 5.0, -5.0, -5.0, -5.0, -5.0], "..d...dd"),  # one description does not turn it
        ([-5.0, -5.0, -5.0, 5.0, 5.0, 5.0], "..d..s"),  # three do
        ([-9.0, -9.0, -9.0, 3.0, -5.0], "..d.d"),  # all evidence holds; the newest alone is against it
    ],
)
def test_a_track_has_a_label_while_its_descriptions_agree(one_feature, described, x, told):
    """Evidence joins in full for the last case; else a track may have changed hands."""
    handover = 0.0 if x[0] == -9.0 else 0.1
    node = LinearDiscriminant(one_feature(), memory=1.0, handover=handover, agreement=3)
    got = ""
    for seq, one in enumerate(x):
        found = labels_of(node(described(3 * seq, {1: [one]}, ("x",))))
        got += found.get(1, ".")[0]
        assert labels_of(node(described(3 * seq + 1, {}, ("x",)))) == found  # as it is until the next
    assert got == told


def test_with_three_classes_sides_agree_not_classes(make_model, described, tmp_path):
    """Seal, fish, seal, fish: never the diver."""
    values = np.array([[-5.0], [-4.0], [0.0], [1.0], [5.0], [6.0]])
    label = np.repeat([0, 1, 2], 2)
    model = make_model(counts=(2, 2, 2), values=values, label=label, features=("x",))
    files.save(tmp_path / "m.json", model)
    node = LinearDiscriminant(tmp_path / "m.json", agreement=2)
    got = [labels_of(node(described(n, {1: [x]}, ("x",)))) for n, x in enumerate([0.5, 5.5, 0.5, -4.5])]
    assert got == [{}, {1: "fish"}, {1: "seal"}, {}]


def test_features_that_are_no_numbers_say_nothing(model_file, described):
    node = LinearDiscriminant(model_file())
    node(described(0, {1: [0.0, 0.0, 0.0]}))
    found = node(described(1, {1: [np.nan, 0.0, 0.0], 2: [0.0, np.inf, 0.0]}))
    assert found.track_id.tolist() == [1]
    assert np.isfinite(found.posterior).all()


def test_a_singular_model_is_refused_when_it_is_loaded(make_model, rng, tmp_path):
    values = rng.normal(size=(20, 3))
    values[:, 2] = values[:, 0]
    files.save(tmp_path / "m.json", make_model(counts=(10, 10), values=values, label=np.repeat([0, 1], 10)))
    with pytest.raises(InputError, match="singular"):
        LinearDiscriminant(tmp_path / "m.json")


@pytest.mark.parametrize("cls", NODES)
def test_nodes_keep_the_contract(cls, model_file, described, alive, rng):
    path = model_file()
    firings = [
        {
            "features": described(
                seq, {n: rng.normal(size=3) for n in range(seq % 3, 4)} if seq % 4 != 2 else {}
            )
        }
        for seq in range(10)
    ]
    check_node(cls(path, memory=0.7, hold_pings=2, min_descriptions=2, handover=0.1), firings)
    check_node(cls(path, memory=1.0, handover=0.1, agreement=2), firings)
    with_tracks = [firing | {"tracks": alive(seq, [seq % 3, 3])} for seq, firing in enumerate(firings)]
    check_node(cls(path), with_tracks)


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"positive": "shark"}, "positive is 'shark'; the classes are diver, seal"),
        ({"miss_cost": 0.0}, "miss_cost is 0.0"),
        ({"false_alarm_cost": math.inf}, "false_alarm_cost is inf"),
        ({"memory": 1.5}, "memory is 1.5"),
        ({"hold_pings": 0}, "hold_pings is 0"),
        ({"handover": 1.5}, "handover is 1.5"),
        ({"min_descriptions": 0}, "min_descriptions is 0"),
        ({"agreement": 0}, "agreement is 0"),
    ],
)
@pytest.mark.parametrize("cls", NODES)
def test_bad_values_are_named(cls, model_file, parameters, says):
    with pytest.raises(ValueError, match=says):
        cls(model_file(), **parameters)


def test_a_graph_with_a_missing_model_is_refused_by_check(tmp_path):
    from fls_flow import graph
    from fls_flow.errors import GraphError

    (tmp_path / "g.yaml").write_text(
        "graph: g\nnodes:\n  s: {use: surface-scene}\n"
        "  c: {use: linear-discriminant, in: {features: f}, with: {model: none.json}}\n"
        "  f: {use: temporal-features, in: {features: d}}\n"
        "  d: {use: static-features, in: {chips: k, regions: r}}\n"
        "  r: {use: region-growing, in: {chips: k}}\n"
        "  k: {use: chips, in: {ping: s.ping, tracks: t}}\n"
        "  t: {use: jpda, in: {detections: e}}\n"
        "  e: {use: rayleigh-cfar, in: {ping: s.ping}}\n"
        "  o: {use: track-csv, in: {tracks: t, classes: c}}\n"
    )
    with pytest.raises(
        GraphError, match=r"none\.json: cannot be read \(No such file or directory\)"
    ) as caught:
        graph.load(tmp_path / "g.yaml")
    assert len(caught.value.problems) == 1
