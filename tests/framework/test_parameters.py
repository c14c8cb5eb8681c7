import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fls_flow import Detections, Ping, Tracks
from fls_flow.catalog import describe
from fls_flow.document import Value, parse
from fls_flow.errors import PluginError
from fls_flow.parameters import Checked, check, resolve, type_name


@dataclass
class Gate:
    probability: float
    margin_m: float = 0.5
    table: Path = Path("gate.csv")

    def __post_init__(self) -> None:
        if self.probability > 1.0:
            raise ValueError(f"probability is {self.probability}; it is at most 1")
        if self.margin_m < 0.0:
            raise KeyError("margin_m")


@dataclass
class Every:
    whole: int = 1
    number: float = 1.0
    flag: bool = False
    word: str = ""
    path: Path = Path("x.csv")
    choice: Literal["paper", "robust", 3] = "paper"
    counts: tuple[int, ...] = ()
    pair: tuple[float, float] = (0.0, 0.0)
    maybe: float | None = None
    gate: Gate = field(default_factory=lambda: Gate(0.9))
    gates: tuple[Gate, ...] = ()
    spare: Gate | None = None
    either: int | str = 0
    paths: tuple[Path, ...] = ()
    _state: int = field(default=0, init=False, repr=False)

    def __call__(self, ping: Ping) -> Detections:
        return Detections(ping.seq, ping.stamp_ns)


def checked(cls: type, text: str) -> Checked:
    document = parse(text, "g.yaml", [])
    return check(describe(cls, "every"), document.mapping, "n", "g.yaml:99")


def complaints(cls: type, text: str) -> list[str]:
    return [str(one) for one in checked(cls, text).problems]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("whole: 7", 7),
        ("whole: 123456789012345678901234567890", 123456789012345678901234567890),
        ("number: 1", 1.0),
        ("number: 1e-6", 1e-6),
        ("number: .inf", math.inf),
        ("number: -.inf", -math.inf),
        ("flag: true", True),
        ("word: on", "on"),
        ("word: '7'", "7"),
        ("word: 2024-01-01", "2024-01-01"),
        ("choice: robust", "robust"),
        ("choice: 3", 3),
        ("counts: []", ()),
        ("counts: [1, 2, 3]", (1, 2, 3)),
        ("pair: [1, 2.5]", (1.0, 2.5)),
        ("maybe: null", None),
        ("maybe: 2", 2.0),
        ("gate: {probability: 0.5}", Gate(0.5, 0.5, Path.cwd() / "gate.csv")),
        ("spare: {probability: 1}", Gate(1.0, 0.5, Path.cwd() / "gate.csv")),
        ("either: 3", 3),
        ("either: three", "three"),
    ],
)
def test_a_value_that_fits_is_taken_as_it_is(text: str, value: Any) -> None:
    result = checked(Every, text)
    assert result.problems == ()
    (found,) = result.arguments.values()
    assert found == value
    assert type(found) is type(value)


def test_nan_is_a_float() -> None:
    assert math.isnan(checked(Every, "number: .nan").arguments["number"])


def test_a_huge_text_is_taken_whole() -> None:
    assert checked(Every, "word: " + "x" * 100_000).arguments["word"] == "x" * 100_000


@pytest.mark.parametrize(
    ("text", "shown", "expected"),
    [
        ("whole: '7'", '"7"', "int"),
        ("whole: 1.0", "1.0", "int"),
        ("whole: true", "true", "int"),
        ("whole: null", "null", "int"),
        ("whole: 1_000", '"1_000"', "int"),
        ("whole: .inf", "Infinity", "int"),
        ("whole: []", "[]", "int"),
        ("number: true", "true", "float"),
        ("number: '1'", '"1"', "float"),
        ("number: fast", '"fast"', "float"),
        ("number: 1e400", '"1e400"', "float"),
        ("flag: 1", "1", "bool"),
        ("flag: yes", '"yes"', "bool"),
        ("word: 7", "7", "str"),
        ("word: [a]", '["a"]', "str"),
        ("word: {a: b}", '{"a": "b"}', "str"),
        ("word: null", "null", "str"),
        ("word: true", "true", "str"),
        ("path: 3", "3", "Path"),
        ("path: null", "null", "Path"),
        ("choice: papers", '"papers"', "Literal['paper', 'robust', 3]; did you mean 'paper'?"),
        ("choice: theirs", '"theirs"', "Literal['paper', 'robust', 3]"),
        ("choice: '3'", '"3"', "Literal['paper', 'robust', 3]"),
        ("counts: 1", "1", "tuple[int, ...]"),
        ("counts: [1, 2.5]", "[1, 2.5]", "tuple[int, ...]"),
        ("counts: abc", '"abc"', "tuple[int, ...]"),
        ("pair: [1]", "[1]", "tuple[float, float]"),
        ("pair: []", "[]", "tuple[float, float]"),
        ("pair: [1, 2, 3]", "[1, 2, 3]", "tuple[float, float]"),
        ("pair: [1, x]", '[1, "x"]', "tuple[float, float]"),
        ("maybe: '1'", '"1"', "float | None"),
        ("gate: 3", "3", "Gate"),
        ("gate: [0.5]", "[0.5]", "Gate"),
        ("either: 1.5", "1.5", "int | str"),
    ],
)
def test_nothing_turns_into_something_else(text: str, shown: str, expected: str) -> None:
    name = text.partition(":")[0]
    assert complaints(Every, f"\n\n{text}") == [
        f"g.yaml:3: node 'n': parameter '{name}' is {shown}; it takes {expected}"
    ]


def test_a_huge_number_or_text_is_shown_short() -> None:
    for text in ("whole: 0x" + "f" * 6000, "whole: " + "9" * 4000, "number: " + "x" * 90_000):
        (line,) = complaints(Every, text)
        assert len(line) < 200


def test_a_huge_number_is_no_float_by_accident() -> None:
    assert complaints(Every, "number: " + "9" * 299) == []
    assert len(complaints(Every, "number: " + "9" * 310)) == 1


@pytest.mark.parametrize(
    ("text", "line", "complaint"),
    [
        ("wholly: 1", 1, "kind 'every' has no parameter 'wholly'; did you mean 'whole'?"),
        ("zzz: 1", 1, "kind 'every' has no parameter 'zzz'; it has whole, number, flag, word, "),
        ("_state: 1", 1, "kind 'every' has no parameter '_state'; "),
        (
            "gate: {probability: 1,\n  margin: 1}",
            2,
            "kind 'every' has no parameter 'gate.margin'; did you mean ",
        ),
        (
            "spare: {probability: 1,\n  marg: 1}",
            2,
            "kind 'every' has no parameter 'spare.marg'; did you mean ",
        ),
        ("gates: [\n  {probability: 1, mar: 1}]", 2, "kind 'every' has no parameter 'gates.0.mar'; it has "),
        ("\ngate: {\n margin_m: 1.0}", 2, "parameter 'gate.probability' is missing; kind 'every' needs it"),
        ("\ngate: {}", 2, "parameter 'gate.probability' is missing; kind 'every' needs it"),
        ("gate: {probability: 2,\n margin_m: '1'}", 2, 'parameter \'gate\' is {"probability": 2, "margin_m"'),
        ("gate: {probability: 2}", 1, "parameter 'gate': probability is 2.0; it is at most 1"),
        ("gate: {probability: 1, margin_m: -1}", 99, "'margin_m'"),
    ],
)
def test_mistakes_inside_a_nested_dataclass_are_found_there(text: str, line: int, complaint: str) -> None:
    (found,) = complaints(Every, text)
    assert found.startswith(f"g.yaml:{line}: node 'n': {complaint}")


def test_every_mistake_of_a_node_is_found_at_its_own_line() -> None:
    found = complaints(Every, "whole: x\nnumber: x\nnope: 1\npair:\n  - 1\n  - x\n")
    assert sorted(line.split(": ")[0] for line in found) == ["g.yaml:1", "g.yaml:2", "g.yaml:3", "g.yaml:6"]


def test_a_misspelt_required_parameter_is_one_mistake() -> None:
    @dataclass
    class Reader:
        path: Path
        seed: int

        def __call__(self) -> Iterator[Ping]:
            yield from ()

    assert complaints(Reader, "seed: 1") == [
        "g.yaml:99: node 'n': parameter 'path' is missing; kind 'every' needs it"
    ]
    assert complaints(Reader, "seed: 1\npaht: x") == [
        "g.yaml:2: node 'n': kind 'every' has no parameter 'paht'; did you mean 'path'?"
    ]


def test_what_the_class_refuses_is_found_at_the_parameter_that_it_names() -> None:
    @dataclass
    class Band:
        low: float = 0.0
        low_hz: float = 0.0
        high_hz: float = 1.0

        def __post_init__(self) -> None:
            if self.low_hz > self.high_hz:
                raise ValueError(f"low_hz is {self.low_hz};\n it is below high_hz = {self.high_hz}")

        def __call__(self, ping: Ping) -> Detections:
            return Detections(ping.seq, ping.stamp_ns)

    assert complaints(Band, "low: 1\nhigh_hz: 2\nlow_hz: 3") == [
        "g.yaml:3: node 'n': low_hz is 3.0; it is below high_hz = 2.0"
    ]
    # a default is to blame as well: then the node's own line, or the one that was given
    assert complaints(Band, "low: 1\nlow_hz: 3")[0].startswith("g.yaml:2: ")
    assert complaints(Band, "low: 1\nhigh_hz: -1")[0].startswith("g.yaml:2: ")


@pytest.mark.parametrize(
    "error", [ValueError(""), ZeroDivisionError("by zero"), TypeError("no"), OSError("gone")]
)
def test_any_exception_of_a_class_is_one_line(error: Exception) -> None:
    @dataclass
    class Fragile:
        def __post_init__(self) -> None:
            raise error

        def __call__(self, ping: Ping) -> None:
            pass

    assert complaints(Fragile, "") == [f"g.yaml:99: node 'n': {error or 'ValueError'}"] or str(error) == ""


NAMES = ["model_config", "json", "copy", "schema", "validate", "model_fields", "construct", "dict"]


@pytest.mark.parametrize("name", [*NAMES, "parameter_x", "_x", "__x", "model_", "class_", "parameter_"])
def test_a_parameter_may_have_a_name_that_pydantic_uses(name: str) -> None:
    def call(self: Any, ping: Ping) -> Detections:
        return Detections(ping.seq, ping.stamp_ns)

    cls: type = dataclass(type("Odd", (), {"__annotations__": {name: int}, name: 3, "__call__": call}))
    result = checked(cls, f"{name}: 4")
    assert (result.arguments, result.problems) == ({name: 4}, ())
    assert complaints(cls, f"{name}: x") == [f"g.yaml:1: node 'n': parameter '{name}' is \"x\"; it takes int"]
    assert checked(cls, "").arguments == {}


@dataclass
class Inner:
    model_config: int = 1
    json: str = "a"
    parameter_copy: int = 2


def test_nested_dataclasses_may_have_such_names_too() -> None:
    @dataclass
    class Outer:
        inner: Inner = field(default_factory=Inner)

        def __call__(self, ping: Ping) -> None:
            pass

    text = "inner: {model_config: 4, json: b, parameter_copy: 5}"
    assert checked(Outer, text).arguments == {"inner": Inner(4, "b", 5)}
    assert len(complaints(Outer, "inner: {model_config: '4', json: 1, copy: 5}")) >= 2


@dataclass
class HasArray:
    table: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def __call__(self, ping: Ping) -> None:
        pass


class Plain:
    pass


@dataclass
class HasClass:
    plain: Plain | None = None

    def __call__(self, ping: Ping) -> None:
        pass


@pytest.mark.parametrize("cls", [HasArray, HasClass])
def test_a_parameter_that_no_graph_can_express_is_the_plugins_fault(cls: type) -> None:
    with pytest.raises(PluginError, match=r"kind 'every' has a parameter that a graph cannot express"):
        checked(cls, "")


def test_a_default_that_is_not_given_is_not_checked_again() -> None:
    @dataclass
    class Odd:
        hook: Callable[[], int] | None = None

        def __call__(self, ping: Ping) -> None:
            pass

    assert checked(Odd, "").arguments == {}
    assert len(complaints(Odd, "hook: x")) >= 1


def test_paths_of_a_source_lie_beside_the_file_that_names_them(tmp_path: Path) -> None:
    document = parse(
        "path: a.csv\npaths: [b.csv, /c.csv]\ngate: {probability: 1, table: d.csv}", "g", [], folder=tmp_path
    )
    result = check(describe(Every), document.mapping, "n", "g")
    assert result.arguments["path"] == tmp_path / "a.csv"
    assert result.arguments["paths"] == (tmp_path / "b.csv", Path("/c.csv"))
    assert result.arguments["gate"] == Gate(1.0, table=tmp_path / "d.csv")


def test_paths_of_a_sink_wait_for_the_folder_of_the_run(tmp_path: Path) -> None:
    @dataclass
    class Writer:
        path: Path = Path("out.csv")

        def __call__(self, tracks: Tracks) -> None:
            pass

    document = parse("path: a/b.csv", "g", [], folder=tmp_path)
    result = check(describe(Writer), document.mapping, "n", "g")
    assert result.arguments == {"path": Path("a/b.csv")}
    assert resolve(result.arguments, tmp_path) == {"path": tmp_path / "a/b.csv"}


@pytest.mark.parametrize(
    ("annotation", "text"),
    [
        (int, "int"),
        (Path, "Path"),
        (Gate, "Gate"),
        (tuple[float, float], "tuple[float, float]"),
        (tuple[Path, ...], "tuple[Path, ...]"),
        (Literal["a", 1], "Literal['a', 1]"),
        (float | None, "float | None"),
        (Path | None, "Path | None"),
    ],
)
def test_a_type_is_named_as_written(annotation: Any, text: str) -> None:
    assert type_name(annotation) == text


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["probability", "x", "0"]), inner, max_size=3)
    ),
    max_leaves=5,
)


def wrapped(data: Any) -> Value:
    if isinstance(data, dict):
        return Value("g.yaml:5", {name: wrapped(one) for name, one in data.items()})
    return Value("g.yaml:5", [wrapped(one) for one in data] if isinstance(data, list) else data)


@settings(max_examples=500, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.dictionaries(st.sampled_from([*Every.__dataclass_fields__, "json", ""]), values, max_size=3))
def test_any_values_give_arguments_or_problems_and_never_raise(document: dict[str, Any]) -> None:
    written = {name: wrapped(one) for name, one in document.items()}
    result = check(describe(Every, "every"), written, "n", "g.yaml:1")
    assert bool(result.problems) != (set(result.arguments) == set(document))
    for problem in result.problems:
        assert problem.what.startswith("node 'n': ")
        assert "\n" not in str(problem)
