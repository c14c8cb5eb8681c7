from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fls_flow import document
from fls_flow.errors import GraphError, UserError
from fls_flow.tools.grid import MAX_CELLS, Axis, Grid, axes_of, split


def values(text: str) -> tuple[str, ...]:
    return axes_of([f"a.b={text}"]).axes[0].values


@pytest.mark.parametrize(
    ("written", "pieces"),
    [
        ("1e-4,1e-5", ["1e-4", "1e-5"]),
        ("a, b ,c", ["a", "b", "c"]),
        ("'a,b',c", ["'a,b'", "c"]),
        ('"a,b"', ['"a,b"']),
        ("[1, 2],[3, 4]", ["[1, 2]", "[3, 4]"]),
        ("{x: 1, y: [2, 3]},{x: 4, y: []}", ["{x: 1, y: [2, 3]}", "{x: 4, y: []}"]),
        ("['],', 2],3", ["['],', 2]", "3"]),
        ("it's,that's", ["it's", "that's"]),
        ("", [""]),
    ],
)
def test_commas_outside_quotes_and_brackets_separate(written, pieces):
    assert split(written) == pieces


@pytest.mark.parametrize(
    ("written", "numbers"),
    [
        ("0:4", [0, 1, 2, 3]),
        ("2:9:3", [2, 5, 8]),
        ("5:2:-1", [5, 4, 3]),
        ("0.1:0.5:0.1", [0.1, 0.2, 0.3, 0.4]),
        ("-1:1:.5", [-1.0, -0.5, 0.0, 0.5]),
        ("1e-3:3e-3:1e-3", [0.001, 0.002]),
        ("7,0:2,9", [7, 0, 1, 9]),
    ],
)
def test_ranges_stop_before_their_end(written, numbers):
    read = [document.plain(document.parse(text, "", [], lines=False)) for text in values(written)]
    assert read == numbers


def test_a_seed_stays_a_whole_number():
    assert values("0:3") == ("0", "1", "2")


def test_what_is_quoted_is_no_range():
    assert values("'0:3'") == ("'0:3'",)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("5:5", "has no values"),
        ("0:5:-1", "has no values"),
        ("0:5:0", "has no values"),
        ("1,,2", "is empty"),
        ("1,2,1", "listed twice"),
        ("0:3,2", "listed twice"),
        (f"0:{MAX_CELLS + 1}", "at most"),
    ],
)
def test_what_cannot_be_a_list_of_values(written, said):
    with pytest.raises(GraphError, match=said):
        values(written)


def test_every_mistake_is_told_at_once():
    with pytest.raises(GraphError) as caught:
        axes_of(["a.b=5:5", "nonsense", "a.c=1", "a.c=2", "b=3"])
    assert len(caught.value.problems) == 4


def test_a_grid_has_its_bound():
    with pytest.raises(UserError, match="cells"):
        axes_of(["a.b=0:2000", "a.c=0:2000"])


def test_the_last_axis_runs_fastest():
    grid = axes_of(["a.x=1,2", "a.y=p,q,r"])
    assert len(grid) == 6
    assert grid.settings(0) == ("a.x=1", "a.y=p")
    assert grid.settings(1) == ("a.x=1", "a.y=q")
    assert grid.settings(5) == ("a.x=2", "a.y=r")
    assert grid.labels(3) == {"a.x": "2", "a.y": "p"}


@given(st.lists(st.integers(1, 5), max_size=4))
def test_crossing_cells_show_every_value(lengths):
    axes = tuple(Axis(f"a.{i}", tuple(map(str, range(n)))) for i, n in enumerate(lengths))
    grid = Grid(axes)
    assert len({grid.places(i) for i in range(len(grid))}) == len(grid)
    crossed = [grid.places(i) for i in grid.crosses()]
    assert len(crossed) == 1 + sum(n - 1 for n in lengths)
    for place, n in enumerate(lengths):
        assert {cell[place] for cell in crossed} == set(range(n))


def test_patterns_name_files_absolutely_and_sorted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("b: #2.npz", "a.npz", "c.txt"):
        Path(name).touch()
    axis = axes_of(["sonar.path=*.npz"], lambda name: name == "sonar.path").axes[0]
    assert [json.loads(value) for value in axis.values] == [
        str(tmp_path / name) for name in ("a.npz", "b: #2.npz")
    ]
    assert axis.labels == ("a.npz", "b: #2.npz")


def test_a_folder_names_the_files_in_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("rec/b.npz", "rec/a.npz", "rec/.hidden", "rec/deeper/c.npz", "empty/deeper/d.npz"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    for written in ("rec", "rec/", '"rec"', "./empty/../rec"):
        assert axes_of([f"sonar.path={written}"], lambda name: True).axes[0].labels == ("a.npz", "b.npz")
    both = axes_of(["sonar.path=rec,rec/deeper"], lambda name: True).axes[0]
    assert both.labels == ("a.npz", "b.npz", "c.npz")
    assert axes_of(["sonar.path=rec/d*"], lambda name: True).axes[0].labels == ("deeper",)  # as it is
    with pytest.raises(GraphError, match="the folder empty holds no file"):
        axes_of(["sonar.path=empty"], lambda name: True)


def test_labels_are_whole_paths_where_names_are_not_enough(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.npz").touch()
    axis = axes_of(["sonar.path=**/a.npz"], lambda name: True).axes[0]
    assert axis.labels == (str(tmp_path / "x" / "a.npz"), str(tmp_path / "y" / "a.npz"))


def test_a_pattern_that_matches_nothing_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(GraphError, match="no file matches"):
        axes_of(["sonar.path=*.npz"], lambda name: True)


def test_a_pattern_for_another_parameter_stays_text():
    assert values("*.npz") == ("*.npz",)


def test_seeds_are_repetitions():
    assert Axis("sonar.seed", ("1",)).is_repeat
    assert not Axis("sonar.seeds", ("1",)).is_repeat
