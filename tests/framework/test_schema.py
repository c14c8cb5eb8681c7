"""The JSON Schemas of graph and deployment files: what is sound fits, what is misspelt does not, types are those of `check`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from jsonschema import Draft202012Validator

from fls_flow import Detections, Message, NavState, Ping, parameters
from fls_flow.catalog import Catalog, describe
from fls_flow.deploy import schema as deployment_schemas
from fls_flow.deploy import settings
from fls_flow.deploy.read import KEYS as DEPLOYMENT_KEYS
from fls_flow.document import parse, plain, read
from fls_flow.graph import schema as schemas

ROOT = Path(__file__).parents[2]
CATALOG = Catalog()
SHIPPED = sorted([*(ROOT / "graphs").glob("*.yaml"), *(ROOT / "examples").rglob("*.yaml")])


@dataclass
class Gate:
    probability: float
    margin_m: float = 0.5


@dataclass
class Every:
    """Takes everything."""

    needed: int
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
    unbounded: float = float("inf")
    _state: int = field(default=0, init=False, repr=False)

    def __call__(
        self, ping: Ping, nav: tuple[NavState, ...] = (), before: Detections | None = None
    ) -> Detections:
        return Detections(ping.seq, ping.stamp_ns)


@dataclass
class Sonar:
    def __call__(self) -> Iterator[Ping]:
        yield from ()


@dataclass
class Anything:
    def __call__(self, **ports: Message) -> None:
        return None


@pytest.fixture(scope="module")
def shipped() -> Draft202012Validator:
    return validator([CATALOG.load(name) for name in CATALOG.names()])


@pytest.fixture(scope="module")
def own() -> Draft202012Validator:
    kinds = {"every": Every, "sonar": Sonar, "anything": Anything}
    return validator([describe(cls, name) for name, cls in kinds.items()])


def validator(kinds: list[Any]) -> Draft202012Validator:
    document = json.loads(json.dumps(schemas.schema(kinds), allow_nan=False))
    Draft202012Validator.check_schema(document)
    return Draft202012Validator(document)


def written(text: str) -> Any:
    return plain(parse(text, "g.yaml", []))


# --- graphs --------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_graph_fits(shipped: Draft202012Validator, path: Path) -> None:
    document = plain(read(path, []))
    assert [error.message for error in shipped.iter_errors(document)] == []


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_none_fits_with_a_letter_more_in_any_name(shipped: Draft202012Validator, path: Path) -> None:
    document = plain(read(path, []))
    uses = {name: node for name, node in document["nodes"].items() if node is not None and "use" in node}
    for name, node in uses.items():
        kind = CATALOG.load(node["use"])
        spoilt = [("use", f"{node['use']}x"), ("usex", node["use"])]
        spoilt += [("with", {**node["with"], f"{key}x": 1}) for key in node.get("with", {})]
        if kind.takes_any is None:
            spoilt += [("in", {**node.get("in", {}), f"{key}x": "a"}) for key in node.get("in", {})]
        spoilt += [("in", {**node["in"], key: f"{wire}@beforex"}) for key, wire in node.get("in", {}).items()]
        for key, value in spoilt:
            wrong = {"base": "other", "nodes": {name: {**node, key: value}}}
            assert not shipped.is_valid(wrong), wrong


WHOLE = "graph: g\nnodes:\n  s: {use: sonar}\n  n: {use: every, in: {ping: s}, with: {needed: 1}}"


@pytest.mark.parametrize(
    "text",
    [
        WHOLE,
        WHOLE + "\n  out: {use: anything, in: {p: s.ping, q: n.detections}, on_error: skip}",
        WHOLE.replace("ping: s}", "ping: s, nav: s@time, before: n@previous}"),
        WHOLE.replace("ping: s}", "ping: s, before: n}"),
        "base: other\nnodes: {n: {with: {anything: 1}}, gone: null, m: {use: every, in: {nav: null}}}",
        "base: other",
        "base: other\ngraph: mine\nnodes: {n: {in: {x: y.z@time}}, m: {with: null}}",
    ],
)
def test_what_is_written_well_fits(own: Draft202012Validator, text: str) -> None:
    assert [error.message for error in own.iter_errors(written(text))] == []


@pytest.mark.parametrize(
    ("text", "where", "says"),
    [
        (WHOLE.replace("use: sonar", "use: sonnar"), "nodes.s.use", "'sonnar' is not one of"),
        (WHOLE.replace("needed: 1", "needed: 1, wholle: 2"), "nodes.n.with", "'wholle' was unexpected"),
        (WHOLE.replace("{needed: 1}", "{whole: 1}"), "nodes.n.with", "'needed' is a required property"),
        (WHOLE.replace(", with: {needed: 1}", ""), "nodes.n", "'with' is a required property"),
        (WHOLE.replace("in: {ping: s}, ", ""), "nodes.n", "'in' is a required property"),
        (WHOLE.replace("ping: s}", "pings: s}"), "nodes.n.in", "'pings' was unexpected"),
        (WHOLE.replace("ping: s}", "ping: s@time}"), "nodes.n.in.ping", "does not match"),
        (WHOLE.replace("ping: s}", "ping: s@previous}"), "nodes.n.in.ping", "does not match"),
        (WHOLE.replace("ping: s}", "ping: s, nav: s}"), "nodes.n.in.nav", "does not match"),
        (WHOLE.replace("ping: s}", "ping: s, before: n@time}"), "nodes.n.in.before", "does not match"),
        (WHOLE.replace("ping: s}", "ping: null}"), "nodes.n.in.ping", "None is not of type 'string'"),
        (WHOLE.replace("ping: s}", "ping: 7}"), "nodes.n.in.ping", "7 is not of type 'string'"),
        (WHOLE.replace("{use: sonar}", "{}"), "nodes.s", "'use' is a required property"),
        (WHOLE.replace("{use: sonar}", "null"), "nodes.s", "None is not of type 'object'"),
        (WHOLE.replace("{use: sonar}", "{use: sonar, wiht: {}}"), "nodes.s", "'wiht' was unexpected"),
        (WHOLE.replace("{use: sonar}", "{use: sonar, on_error: go}"), "nodes.s.on_error", "is not one of"),
        (WHOLE.replace("  s:", "  s x:"), "nodes", "'s x' does not match"),
        (WHOLE.replace("graph: g", "graph: 7"), "graph", "7 is not of type 'string'"),
        (WHOLE.replace("graph: g\n", ""), "", "'graph' is a required property"),
        ("graph: g", "", "'nodes' is a required property"),
        (WHOLE + "\nnode: {}", "", "'node' was unexpected"),
        ("base: o\nnodes: {n: {use: every, with: {wholle: 1}}}", "nodes.n.with", "'wholle' was unexpected"),
    ],
)
def test_what_is_wrong_is_found_where_it_stands(
    own: Draft202012Validator, text: str, where: str, says: str
) -> None:
    found = [leaf for error in own.iter_errors(written(text)) for leaf in leaves(error)]
    told = [(".".join(map(str, error.absolute_path)), error.message) for error in found]
    assert any(place == where and says in message for place, message in told), told


def leaves(error: Any) -> list[Any]:
    return [error, *(one for inner in error.context for one in leaves(inner))]


# --- parameters ----------------------------------------------------------------------------------


VALUES = (
    "7", "1.5", "1e-6", "-3", "123456789012345678901234567890", ".inf", "true", "null", "on", "'7'",
    "2024-01-01", "robust", "papers", "3", "'3'", "[]", "[1]", "[1, 2]", "[1, 2.5]", "[1, x]", "[1, 2, 3]",
    "{}", "{a: b}", "{probability: 0.5}", "{probability: 1, margin_m: 2}", "{probability: x}",
    "{probability: 0.5, marginn_m: 1}", "{margin_m: 1}", "[{probability: 0.5}]", "[{probability: x}]", "[0.5]",
)  # fmt: skip


@pytest.mark.parametrize("name", [one.name for one in describe(Every).parameters])
def test_a_value_fits_a_parameter_where_check_takes_it(own: Draft202012Validator, name: str) -> None:
    kind = describe(Every, "every")
    for value in VALUES:
        given = f"{name}: {value}" if name == "needed" else f"{{needed: 1, {name}: {value}}}"
        document = parse(given, "g.yaml", [])
        taken = parameters.check(kind, document.mapping, "n", "g.yaml").problems == ()
        graph = {"graph": "g", "nodes": {"n": {"use": "every", "in": {"ping": "s"}, "with": plain(document)}}}
        assert own.is_valid(graph) == taken, value


def test_defaults_and_words_are_there_to_be_shown(own: Draft202012Validator) -> None:
    (case,) = [
        one["then"]["properties"]["with"]
        for one in own.schema["$defs"]["node"]["allOf"]
        if one["if"]["properties"]["use"]["const"] == "every"
    ]
    assert case["description"] == "Takes everything."
    given = case["properties"]
    assert given["choice"]["default"] == "paper"
    assert given["gate"]["default"] == {"probability": 0.9, "margin_m": 0.5}
    assert given["maybe"]["default"] is None
    assert given["path"] == {"type": "string", "description": "Path", "default": "x.csv"}
    assert "default" not in given["needed"]
    assert "default" not in given["unbounded"], "JSON has no infinity"
    assert "_state" not in given


# --- deployments ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def deployments() -> Draft202012Validator:
    document = json.loads(json.dumps(deployment_schemas.schema(), allow_nan=False))
    Draft202012Validator.check_schema(document)
    return Draft202012Validator(document)


@pytest.mark.parametrize("path", sorted((ROOT / "deployments").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_deployment_fits(deployments: Draft202012Validator, path: Path) -> None:
    assert [error.message for error in deployments.iter_errors(plain(read(path, [])))] == []


def test_the_schema_has_the_keys_that_deployments_have(deployments: Draft202012Validator) -> None:
    top, host = deployments.schema["properties"], deployments.schema["$defs"]["host"]["properties"]
    assert tuple(top) == DEPLOYMENT_KEYS
    assert tuple(host) == settings.KEYS == tuple(top["zenoh"]["anyOf"][0]["properties"])
    assert tuple(host["tls"]["anyOf"][0]["properties"]) == settings.TLS_KEYS
    assert tuple(host["access_control"]["anyOf"][0]["properties"]) == settings.ACCESS_KEYS


@pytest.mark.parametrize(
    ("text", "fits"),
    [
        ("deployment: d", True),
        ("deployment: d\nhosts: {a: [x], b: null}\nzenoh: {a: {listen: null}, b: null, open: true}", True),
        ("deployment: d\nwindow: null\nlost_after_s: 1", True),
        ("deployment: 7", False),
        ("window: 8", False),
        ("deployment: d\nwindow: 0", False),
        ("deployment: d\nwindov: 8", False),
        ("deployment: d\nhosts: {a b: [x]}", False),
        ("deployment: d\nqos: {x -> y: newest}", False),
        ("deployment: d\nlost_after_s: 0", False),
        ("deployment: d\ncontrol: 1", False),
        ("deployment: d\nthreads: {a: many}", False),
        ("deployment: d\nzenoh: {listen: [http/x:1]}", False),
        ("deployment: d\nzenoh: {a: {lisen: []}}", False),
        ("deployment: d\nzenoh: {tls: {cas: a}}", False),
        ("deployment: d\nzenoh: {user: 'a:b'}", False),
        ("deployment: d\nzenoh: {open: 1}", False),
    ],
)
def test_what_a_deployment_may_hold(deployments: Draft202012Validator, text: str, fits: bool) -> None:
    assert deployments.is_valid(written(text)) is fits


# --- the command ---------------------------------------------------------------------------------


def command(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fls_flow.cli", "schema", *words],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_the_command_prints_what_the_catalogue_knows(shipped: Draft202012Validator) -> None:
    done = command("--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\n") == 1
    assert json.loads(done.stdout) == shipped.schema
    done = command("deployment")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout) == deployment_schemas.schema()


def test_a_kind_that_cannot_be_loaded_is_told_and_left_out(tmp_path: Path) -> None:
    (tmp_path / "torn.py").write_text("raise ImportError('no such sonar')")
    (tmp_path / "torn-1.0.dist-info").mkdir()
    (tmp_path / "torn-1.0.dist-info" / "METADATA").write_text("Name: torn\nVersion: 1.0\n")
    (tmp_path / "torn-1.0.dist-info" / "entry_points.txt").write_text("[fls_flow]\ntorn = torn\n")
    done = command(PYTHONPATH=str(tmp_path))
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("note: kind 'torn' of torn 1.0 (torn) cannot be imported: ImportError")
    uses = json.loads(done.stdout)["$defs"]["node"]["properties"]["use"]["enum"]
    assert "torn" not in uses
    assert "surface-scene" in uses
