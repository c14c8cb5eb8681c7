import contextlib
import math
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fls_flow.document import MAX_BYTES, MAX_DEPTH, MAX_VALUES, Value, parse, plain, read, shown
from fls_flow.errors import FlsFlowError, GraphError, Problem

GOOD = """\
graph: chain
nodes:
  sonar: {use: surface-scene, with: {sequence: [1, 2.5, "x"], seed: 7}}
  cfar: &c {use: rayleigh-cfar, in: {ping: sonar.ping, tracks: tracker@previous}}
  tracker:
    use: jpda   # a comment
    in:
      detections: cfar
"""


def parsed(text: str) -> Any:
    problems: list[Problem] = []
    document = plain(parse(text, "g.yaml", problems))
    assert problems == []
    return document


def complaints(text: str) -> list[str]:
    problems: list[Problem] = []
    try:
        parse(text, "g.yaml", problems)
    except GraphError as error:
        return [str(one) for one in error.problems]
    return [str(one) for one in problems]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("-12", -12),
        ("+3", 3),
        ("0777", 777),  # octal in YAML 1.1 only
        ("0o17", 15),
        ("0x1F", 31),
        ("1e-6", 1e-6),  # text in YAML 1.1
        ("1.0e-5", 1e-5),
        (".5", 0.5),
        ("+.5e3", 500.0),
        ("1.", 1.0),
        ("-.inf", -math.inf),
        (".inf", math.inf),
        ("true", True),
        ("False", False),
        ("~", None),
        ("null", None),
        ("", None),
        ("on", "on"),
        ("yes", "yes"),
        ("no", "no"),
        ("1:30", "1:30"),  # no sexagesimal numbers
        ("1_000", "1_000"),
        ("0b11", "0b11"),
        ("2024-01-01", "2024-01-01"),
        ("-_", "-_"),
        ("12e", "12e"),
        ("'7'", "7"),
        ('"true"', "true"),
        ("=", "="),
    ],
)
def test_scalars_follow_the_core_schema_of_yaml_1_2(text: str, value: Any) -> None:
    found = parsed(f"a: {text}")["a"]
    assert found == value
    assert type(found) is type(value)


def test_nan_is_a_number() -> None:
    assert math.isnan(parsed("a: .nan")["a"])


@pytest.mark.parametrize("text", ["9" * 5000, "0x" + "f" * 6000, "1e400", "-1e999"])
def test_a_number_beyond_measure_stays_text(text: str) -> None:
    assert parsed(f"a: {text}") == {"a": text}


@pytest.mark.parametrize(
    "tag", ["!foo", "!!python/object/apply:os.system", "!!binary", "!!float", "!<tag:x>"]
)
def test_a_tag_is_refused_once_and_its_value_read_as_if_plain(tag: str) -> None:
    problems: list[Problem] = []
    document = parse(f"a: 1\nb: {tag} 3", "g.yaml", problems)
    assert plain(document) == {"a": 1, "b": 3}
    assert [one.where for one in problems] == ["g.yaml:2"]
    assert "is not allowed" in problems[0].what


def test_tags_of_keys_lists_and_mappings_are_refused() -> None:
    found = complaints("!x a: 1\nb: !!set {p, q}\nc: !!python/tuple [1]\nd: !!omap []")
    assert [line.split(": the tag ")[0] for line in found] == [f"g.yaml:{line}" for line in (1, 2, 3, 4)]


def test_a_tag_runs_nothing(tmp_path: Path) -> None:
    trace = tmp_path / "ran"
    complaints(f"a: !!python/object/apply:pathlib.Path.touch [{trace}]")
    assert not trace.exists()


def test_every_value_stands_where_its_key_stands() -> None:
    document = parse("a: 1\nb:\n  c:\n    - x\n    - y\n  d: {e:\n    5}\n", "g.yaml", [])
    b = document.mapping["b"]
    assert b.where == "g.yaml:2"
    assert b.mapping["c"].where == "g.yaml:3"
    assert [one.where for one in b.mapping["c"].data] == ["g.yaml:4", "g.yaml:5"]
    assert b.mapping["d"].mapping["e"].where == "g.yaml:6"


def test_an_alias_stands_where_it_is_used() -> None:
    document = parse("a: &x {p: 1}\nb: *x\n", "g.yaml", [])
    assert document.mapping["b"].where == "g.yaml:2"
    assert plain(document) == {"a": {"p": 1}, "b": {"p": 1}}


def test_an_anchor_may_be_used_again_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert parsed("a: &x 1\nb: &x 2\nc: *x") == {"a": 1, "b": 2, "c": 2}


def test_duplicate_keys_name_the_first_place_also_when_nested() -> None:
    assert complaints("a:\n  b: 1\n  c: 2\n  b: 3\na: 4\n1: x\n'1': y\n") == [
        "g.yaml:4: duplicate key 'b', first at g.yaml:2",
        "g.yaml:5: duplicate key 'a', first at g.yaml:1",
        "g.yaml:7: duplicate key '1', first at g.yaml:6",
    ]


def test_the_first_of_two_values_counts() -> None:
    assert plain(parse("a: 1\na: 2", "g.yaml", [])) == {"a": 1}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a: 1\n---\nb: 2\n", "g.yaml:2: begins a second document; a graph file holds one"),
        (
            "a: 1\nb:\n\t- 2\n",
            "g.yaml:3: is not YAML: found character '\\t' that cannot start any token; use spaces",
        ),
        ("a: *nope\n", "g.yaml:1: is not YAML: found undefined alias 'nope'"),
        ("a: [1,\n", "g.yaml:"),
        ("x: &d {a: 1}\ny:\n  <<: *d\n", "g.yaml:3: merge keys (<<) are not allowed; write the keys out"),
        ("# about\n\n%YAML 1.1\n---\na: on\n", "g.yaml:3: directives (%YAML, %TAG) are not allowed"),
        ("%YAML 1.3\n---\na: 1\n", "g.yaml:1: directives"),
        ("\n? [1, 2]\n: 3\n", "g.yaml:2: a key is a list or a mapping; use a word"),
        ('a: "\\0"\n', "g.yaml:1: text holds NUL or half a surrogate pair; remove it"),
        ('a: "\\ud800"\n', "g.yaml:1: text holds NUL or half a surrogate pair; remove it"),
        ('a: "\\U00110000"\n', "g.yaml: is not YAML: ValueError"),
        ("a: \x07\n", "g.yaml: is not YAML: unacceptable character #x0007"),
    ],
)
def test_what_is_no_plain_yaml_is_refused_with_its_line(text: str, complaint: str) -> None:
    found = complaints(text)
    assert len(found) == 1
    assert found[0].startswith(complaint)


def test_problems_so_far_are_kept_when_reading_cannot_go_on() -> None:
    found = complaints("a: 1\na: 2\nb: {<<: 3}\n")
    assert [line.split(": ")[0] for line in found] == ["g.yaml:2", "g.yaml:3"]


def test_depth_is_bounded_also_through_aliases_and_beyond_recursion() -> None:
    assert parsed("a: " + "[" * (MAX_DEPTH - 1) + "]" * (MAX_DEPTH - 1))
    assert complaints("a: " + "[" * 40 + "]" * 40) == ["g.yaml:1: has more than 32 levels: not a graph file"]
    assert complaints("a: &x [*x]") == ["g.yaml:1: has more than 32 levels: not a graph file"]
    assert complaints("[" * 20_000) == ["g.yaml: is nested too deep: not a graph file"]


def test_aliases_cannot_multiply_without_bound() -> None:
    laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
    laughs += "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 9))
    (found,) = complaints(laughs)
    assert found.endswith(f"has more than {MAX_VALUES} values (aliases count): not a graph file")


def test_a_long_value_is_shown_short() -> None:
    assert shown(Value("x", "y" * 10_000)).endswith("y...")
    assert len(shown(Value("x", "y" * 10_000))) == 80
    assert shown(parse('[1, null, true, "a b", {k: 1.5}]', "", [])) == '[1, null, true, "a b", {"k": 1.5}]'
    assert "\n" not in shown(Value("x", "two\nlines"))


@pytest.mark.parametrize("content", [b"", b"# nothing\n", b"---\n", b"\xef\xbb\xbf", b"\r\n\r\n"])
def test_an_empty_file_is_an_empty_document(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "g.yaml"
    path.write_bytes(content)
    document = read(path, [])
    assert (document.data, document.folder) == (None, tmp_path.resolve())
    assert document.where.rpartition(":")[0] == str(path)


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_byte_order_marks_and_line_ends_change_nothing(tmp_path: Path, newline: str, mark: str) -> None:
    path = tmp_path / "g.yaml"
    path.write_bytes((mark + GOOD.replace("\n", newline)).encode())
    document = read(path, [])
    assert plain(document) == parsed(GOOD)
    assert document.mapping["nodes"].mapping["tracker"].where == f"{path}:5"


def test_a_file_that_is_not_utf8_says_where(tmp_path: Path) -> None:
    path = tmp_path / "g.yaml"
    path.write_bytes("graph: küste".encode("latin-1"))
    with pytest.raises(GraphError, match=r"g\.yaml: is not UTF-8 text \(byte 8\); save it as UTF-8"):
        read(path, [])


def test_a_huge_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "g.yaml"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # sparse
    with pytest.raises(GraphError, match=f"is larger than {MAX_BYTES} bytes"):
        read(path, [])


def test_a_folder_or_a_missing_file_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="cannot be read: Is a directory"):
        read(tmp_path, [])
    with pytest.raises(GraphError, match="cannot be read: No such file"):
        read(tmp_path / "none.yaml", [])


def test_a_fifo_does_not_hang_a_check(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "g.yaml")
    command = [sys.executable, "-m", "fls_flow.cli", "check", "g.yaml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("error: g.yaml: no such graph file")


def only_our_errors(text: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with contextlib.suppress(FlsFlowError):
            assert "\n" not in shown(parse(text, "g.yaml", []))


@settings(max_examples=1000, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.one_of(st.text(max_size=60), st.text("{}[]:,-?&*!|>%@`'\"#\n\t ab1<.~=\\", max_size=40)))
def test_no_text_raises_anything_else(text: str) -> None:
    only_our_errors(text)


@settings(max_examples=1000, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    st.integers(0, len(GOOD)),
    st.integers(0, 30),
    st.one_of(
        st.text(max_size=5),
        st.sampled_from(["\t", "<<: ", "&c ", "*c", "!x ", "- ", "? ", "---\n", "%YAML 1.1\n"]),
    ),
)
def test_no_mutation_of_a_good_file_raises_anything_else(at: int, cut: int, insert: str) -> None:
    only_our_errors(GOOD[:at] + insert + GOOD[at + cut :])
