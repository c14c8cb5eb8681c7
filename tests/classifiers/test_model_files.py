"""The model file: what it holds comes back, and what is none is refused in one line."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fls_flow import InputError
from fls_flow import model_files as files


def test_a_model_comes_back_to_the_bit(make_model, tmp_path):
    model = make_model(counts=(60, 90, 40), provenance={"runs": [{"seed": 3}], "why": None})
    files.save(tmp_path / "a" / "m.json", model)
    back = files.load(tmp_path / "a" / "m.json")
    assert back == model
    assert_array_equal(back.gaussians.covariance, model.gaussians.covariance)
    files.save(tmp_path / "again.json", back)
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "a" / "m.json").read_bytes()


def test_a_model_never_replaces_a_file(make_model, tmp_path):
    (tmp_path / "m.json").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        files.save(tmp_path / "m.json", make_model())
    assert (tmp_path / "m.json").read_text() == "mine"


def broken(**changes):
    def change(document):
        for path, value in changes.items():
            *way, last = (int(one) if one.isdigit() else one for one in path.split("__"))
            place = document
            for one in way:
                place = place[one]
            if value is None:
                del place[last]
            else:
                place[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (broken(format="pickle"), "format"),
        (broken(version=2), "version"),
        (broken(features=[]), "features"),
        (broken(features__0__scale=0.0), "features.0.scale"),
        (broken(features__0__scale=float("nan")), "features.0.scale"),
        (broken(features__0__log_offset=0.0), "features.0.log_offset"),
        (broken(features__1__name="area"), "features has area twice"),
        (broken(classes__1__name="diver"), "classes has diver twice"),
        (broken(classes__0__mean=[0.0]), "class 'diver' has not 3 means"),
        (broken(classes__0__covariance__1=[0.0]), "covariance of class 'diver' is not 3 x 3"),
        (broken(classes__0__covariance__1__1=float("inf")), "classes.0.covariance.1.1"),
        (broken(classes__0__prior=0.9), "priors do not sum to 1"),
        (broken(positive="shark"), "positive 'shark' is none of diver, seal"),
        (broken(ridge=-1.0), "ridge"),
        (broken(miss_cost="10"), "miss_cost"),
        (broken(surprise=1), "surprise"),
        (broken(classes=None), "classes"),
    ],
)
def test_a_broken_model_is_refused_in_one_line(model_file, change, says):
    path = model_file()
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        files.load(path)
    text = str(caught.value)
    assert says in text
    assert str(path) in text
    assert "\n" not in text


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"\xff\xfe", b'{"format": "fls-flow-classifier"}', b"null"]
)
def test_what_is_no_model_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "m.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match="is no model") as caught:
        files.load(path)
    assert "\n" not in str(caught.value)


def test_no_file_and_a_folder(tmp_path):
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(InputError, match="fls-flow train"):
            files.load(path)


def test_missing_features_are_listed_shortly():
    assert files.missing_features(("a", "b"), ("b", "a", "c")) == ""
    text = files.missing_features([f"f{n}" for n in range(40)], ("area", "mean"))
    assert text == "the model needs f0, f1, f2, f3 and 36 more; the features that come are area, mean"


def test_features_are_scaled_as_the_file_says(make_model):
    model = make_model()
    first = model.features[0].model_copy(update={"log_offset": 0.5})
    model = model.model_copy(update={"features": (first, *model.features[1:])})
    found = model.scaling(np.array([[2.0, 3.0, 4.0], [-1.0, 3.0, 4.0]]))
    assert_allclose(found[0, 0], (np.log(2.5) - first.mean) / first.scale)
    assert_allclose(found[1, 0], (np.log(0.5) - first.mean) / first.scale)  # less than nothing is nothing
    assert_allclose(found[:, 2], (4.0 - model.features[2].mean) / model.features[2].scale)
