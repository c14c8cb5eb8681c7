from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from fls_flow import BeamMask, Detections, Ping, Tracks
from fls_flow.catalog import Catalog
from fls_flow.errors import GraphError
from fls_flow.graph import Graph, load


@dataclass
class Box:
    near_m: float = 1.0
    far_m: float = 9.0


@dataclass
class Sonar:
    seed: int = 0
    path: Path | None = None
    name: str = ""
    box: Box = field(default_factory=Box)

    def __call__(self) -> Iterator[Ping]:
        yield from ()


class Noise(NamedTuple):
    beam_mask: BeamMask
    detections: Detections


@dataclass
class NoiseBeams:
    def __call__(self, ping: Ping) -> Noise:
        raise NotImplementedError


@dataclass
class Cfar:
    pfa: float = 1e-4
    guard: int = 3

    def __call__(self, ping: Ping, noisy: BeamMask | None = None) -> Detections:
        raise NotImplementedError


@dataclass
class Peaks:
    pfa: float = 1e-4

    def __call__(self, ping: Ping) -> Detections:
        raise NotImplementedError


@dataclass
class Hungry:
    def __call__(self, ping: Ping, mask: BeamMask) -> Detections:
        raise NotImplementedError


@dataclass
class Tracker:
    gate: float = 9.0

    def __call__(self, detections: Detections) -> Tracks:
        raise NotImplementedError


@dataclass
class Csv:
    path: Path = Path("tracks.csv")

    def __call__(self, tracks: Tracks) -> None:
        pass


KINDS = {
    "sonar": Sonar,
    "noise-beams": NoiseBeams,
    "cfar": Cfar,
    "peaks": Peaks,
    "hungry": Hungry,
    "tracker": Tracker,
    "csv": Csv,
}
BASE = """\
graph: chain
nodes:
  sonar: {use: sonar, with: {seed: 7}}
  noise: {use: noise-beams, in: {ping: sonar}}
  cfar: {use: cfar, in: {ping: sonar, noisy: noise.beam_mask}, with: {pfa: 0.01, guard: 2}}
  tracker: {use: tracker, in: {detections: cfar}}
  out: {use: csv, in: {tracks: tracker}}
"""

Loaded = Callable[..., Graph]
Mistakes = Callable[..., list[str]]


@pytest.fixture
def loaded(tmp_path: Path) -> Loaded:
    def load_over_base(text: str = "base: base.yaml\n", **options: Any) -> Graph:
        (tmp_path / "base.yaml").write_text(BASE, encoding="utf-8")
        (tmp_path / "g.yaml").write_text(text, encoding="utf-8")
        return load(tmp_path / "g.yaml", catalog=Catalog(KINDS), **options)

    return load_over_base


@pytest.fixture
def mistakes(loaded: Loaded, tmp_path: Path) -> Mistakes:
    def find_in(text: str = "base: base.yaml\n", **options: Any) -> list[str]:
        with pytest.raises(GraphError) as caught:
            loaded(text, **options)
        return [str(one).replace(f"{tmp_path}/", "") for one in caught.value.problems]

    return find_in


def names(graph: Graph) -> list[str]:
    return [node.name for node in graph.nodes]


def child(nodes: str) -> str:
    return f"graph: child\nbase: base.yaml\nnodes:\n{nodes}\n"


def test_a_graph_may_be_its_base_alone(loaded: Loaded) -> None:
    graph = loaded()
    assert (graph.name, names(graph)) == ("chain", ["sonar", "noise", "cfar", "tracker", "out"])
    assert graph.notes == ()


def test_parameters_and_wires_merge_by_key(loaded: Loaded) -> None:
    graph = loaded(child("  cfar: {with: {guard: 5}, in: {noisy: noise}}\n  out: {on_error: skip}"))
    assert graph.name == "child"
    assert graph.node("cfar").arguments == {"pfa": 0.01, "guard": 5}
    assert [str(wire) for wire in graph.node("cfar").inputs] == ["sonar.ping", "noise.beam_mask"]
    assert graph.node("out").on_error == "skip"


def test_a_swap_keeps_what_fits_and_names_what_falls_away(loaded: Loaded) -> None:
    for graph in (loaded(child("  cfar: {use: peaks}")), loaded(use=["cfar=peaks"])):
        assert names(graph) == ["sonar", "cfar", "tracker", "out"]
        assert graph.node("cfar").arguments == {"pfa": 0.01}
        assert graph.notes == (
            "node 'cfar': input 'noisy' falls away; 'peaks' has none",
            "node 'noise' falls away; nothing takes its outputs any more",
            "node 'cfar': parameter 'guard' falls away; 'peaks' has none",
        )


def test_what_the_child_itself_writes_must_fit(mistakes: Mistakes) -> None:
    assert mistakes(child("  cfar: {use: peaks, with: {guard: 3}, in: {noisy: noise}}")) == [
        "g.yaml:4: node 'cfar': kind 'peaks' has no input 'noisy'; it has ping",
        "g.yaml:4: node 'cfar': kind 'peaks' has no parameter 'guard'; it has pfa",
    ]


def test_swapping_to_the_same_kind_changes_nothing(loaded: Loaded) -> None:
    assert loaded(use=["cfar=cfar"]).digest == loaded().digest


def test_the_last_of_two_swaps_counts_and_inherits_from_the_file(loaded: Loaded) -> None:
    graph = loaded(child("  cfar: {use: peaks}"), use=["cfar=hungry", "cfar=cfar"])
    assert graph.node("cfar").arguments == {"pfa": 0.01, "guard": 2}
    assert graph.notes == ()


def test_a_port_that_a_swap_leaves_unwired_is_an_error_where_the_swap_stands(mistakes: Mistakes) -> None:
    assert mistakes(use=["cfar=hungry"]) == [
        "--use cfar=hungry: node 'cfar': input 'mask' (BeamMask) is not wired; 'hungry' needs it"
    ]
    assert mistakes(child("  cfar:\n    with: {}\n    use: hungry")) == [
        "g.yaml:6: node 'cfar': input 'mask' (BeamMask) is not wired; 'hungry' needs it"
    ]


def test_null_removes_a_node_its_wires_and_who_gave_to_it_alone(loaded: Loaded) -> None:
    graph = loaded(child("  noise: null"))
    assert names(graph) == ["sonar", "cfar", "tracker", "out"]
    assert graph.notes == ("node 'cfar': input 'noisy' falls away with node 'noise'",)

    graph = loaded(child("  tracker: {in: {detections: noise}}\n  cfar: null"))
    assert names(graph) == ["sonar", "noise", "tracker", "out"]
    graph = loaded(
        child("  cfar: null\n  peaks: {use: peaks, in: {ping: sonar}}\n  tracker: {in: {detections: peaks}}")
    )
    assert names(graph) == ["sonar", "peaks", "tracker", "out"]
    assert graph.notes == ("node 'noise' falls away; nothing takes its outputs any more",)


def test_a_giver_falls_away_when_its_last_wire_is_overridden(loaded: Loaded) -> None:
    graph = loaded(child("  tracker: {in: {detections: noise}}"))
    assert names(graph) == ["sonar", "noise", "tracker", "out"]
    assert graph.notes == ("node 'cfar' falls away; nothing takes its outputs any more",)


def test_null_unwires_an_optional_input(loaded: Loaded) -> None:
    graph = loaded(child("  cfar: {in: {noisy: null}}"))
    assert names(graph) == ["sonar", "cfar", "tracker", "out"]
    assert graph.notes == ("node 'noise' falls away; nothing takes its outputs any more",)


@pytest.mark.parametrize(
    ("nodes", "complaints"),
    [
        ("  cfar: null", ["g.yaml:4: node 'tracker': input 'detections' (Detections) is not wired; 'tracker' needs it"]),
        ("  sonar: null", [
            "g.yaml:4: node 'noise': input 'ping' (Ping) is not wired; 'noise-beams' needs it",
            "g.yaml:4: node 'cfar': input 'ping' (Ping) is not wired; 'cfar' needs it",
        ]),
        ("  cfar: {in: {noisy: noise}}\n  noise: null",
         ["g.yaml:4: node 'cfar': input 'noisy': the graph has no node 'noise'; it has sonar, cfar, tracker, out"]),
        ("  nosie: null", ["g.yaml:4: the base has no node 'nosie' to remove; did you mean 'noise'?"]),
        ("  cfar: {in: {ping: null}}", ["base.yaml:5: node 'cfar': input 'ping' (Ping) is not wired; 'cfar' needs it"]),
        ("  cfar: {in: {nosiy: null}}", [
            "g.yaml:4: node 'cfar': kind 'cfar' has no input 'nosiy'; did you mean 'noisy'?",
            "g.yaml:4: node 'cfar': input 'nosiy' is null; write NODE or NODE.OUTPUT",
        ]),
        ("  cfra: {with: {pfa: 0.1}}", ["g.yaml:4: node 'cfra' has no 'use'; name its kind"]),
        ("  cfar: {with: {pfa: null}}", ["g.yaml:4: node 'cfar': parameter 'pfa' is null; it takes float"]),
    ],
)  # fmt: skip
def test_mistakes_in_an_override_are_found_in_the_child(
    nodes: str, complaints: list[str], mistakes: Mistakes
) -> None:
    assert mistakes(child(nodes)) == complaints


def test_a_mistake_in_the_base_is_found_in_the_base(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(BASE.replace("pfa: 0.01", "pfa: x"))
    (tmp_path / "g.yaml").write_text("base: base\nnodes:\n  out: {with: {pth: a.csv}}\n")
    with pytest.raises(GraphError) as caught:
        load(tmp_path / "g.yaml", catalog=Catalog(KINDS))
    assert [one.where.removeprefix(f"{tmp_path}/") for one in caught.value.problems] == [
        "base.yaml:5",
        "g.yaml:3",
    ]


def test_a_chain_of_bases(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "one.yaml").write_text(BASE.replace("seed: 7", "path: a.npz"))
    (tmp_path / "two.yaml").write_text("base: deep/one\nnodes:\n  noise: null\n  cfar: {with: {pfa: 0.2}}\n")
    (tmp_path / "three.yaml").write_text(
        "graph: three\nbase: two.yaml\nnodes:\n  noise: {use: noise-beams, in: {ping: sonar}}\n"
        "  cfar: {in: {noisy: noise}, with: {guard: 1}}\n"
    )
    graph = load(tmp_path / "three.yaml", catalog=Catalog(KINDS))
    assert graph.node("cfar").arguments == {"pfa": 0.2, "guard": 1}
    assert graph.node("sonar").arguments == {
        "path": tmp_path / "deep" / "a.npz"
    }  # beside the file that says so
    assert len(graph.node("cfar").inputs) == 2


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("base: g.yaml\n", "g.yaml:1: 'g.yaml' is its own base"),
        ("base: loop.yaml\n", "loop.yaml:1: 'g.yaml' is its own base"),
        ("graph: c\nbase: none.yaml\nnodes: {cfar: {with: {pfa: 0.1}}}\n", "g.yaml:2: base none.yaml: no such graph file"),
        ("base: bsae\n", "g.yaml:1: base bsae: no such graph file; did you mean 'base'?"),
        ("base: [a]\n", 'g.yaml:1: \'base\' is ["a"]; it names a graph file'),
        ("base: null\n", "g.yaml:1: 'base' is null; it names a graph file"),
        ("base: .\n", "g.yaml:1: base .: is a folder"),
        ("base: broken.yaml\n", "broken.yaml:3: is not YAML"),
        (f"base: {'x' * 5000}\n", "g.yaml:1: base xxx"),
    ],
)  # fmt: skip
def test_a_base_that_cannot_be_read_is_one_problem(
    text: str, complaint: str, tmp_path: Path, mistakes: Mistakes
) -> None:
    (tmp_path / "loop.yaml").write_text("base: g.yaml\n")
    (tmp_path / "broken.yaml").write_text("graph: g\nnodes: [\n")
    (found,) = mistakes(text)
    assert found.startswith(complaint)


def test_a_long_chain_of_bases_ends(tmp_path: Path) -> None:
    for number in range(200):
        (tmp_path / f"g{number}.yaml").write_text(f"base: g{number + 1}.yaml\n")
    with pytest.raises(GraphError, match="more than 32 bases"):
        load(tmp_path / "g0.yaml", catalog=Catalog(KINDS))


@pytest.mark.parametrize(
    ("setting", "node", "arguments"),
    [
        ("cfar.pfa=1e-5", "cfar", {"pfa": 1e-5, "guard": 2}),
        ("cfar.pfa= 0.5 # half", "cfar", {"pfa": 0.5, "guard": 2}),
        ("sonar.seed=0x10", "sonar", {"seed": 16}),
        ("sonar.name=on", "sonar", {"seed": 7, "name": "on"}),
        ("sonar.name='7'", "sonar", {"seed": 7, "name": "7"}),
        ("sonar.name=a=b: c", "sonar", None),
        ("sonar.name=a=b", "sonar", {"seed": 7, "name": "a=b"}),
        ("sonar.name='a: b'", "sonar", {"seed": 7, "name": "a: b"}),
        ("sonar.name=", "sonar", None),
        ("sonar.name=''", "sonar", {"seed": 7, "name": ""}),
        ("sonar.path=null", "sonar", {"seed": 7, "path": None}),
        ("sonar.box.far_m=20", "sonar", {"seed": 7, "box": Box(1.0, 20.0)}),
        ("sonar.box={near_m: 2, far_m: 3}", "sonar", {"seed": 7, "box": Box(2.0, 3.0)}),
        ("sonar.path=a.npz", "sonar", {"seed": 7, "path": Path.cwd() / "a.npz"}),
    ],
)
def test_set_takes_a_yaml_value(setting: str, node: str, arguments: Any, loaded: Loaded) -> None:
    if arguments is None:
        with pytest.raises(GraphError, match=r"parameter 'name' is .*; it takes str"):
            loaded(set_=[setting])
    else:
        assert loaded(set_=[setting]).node(node).arguments == arguments


def test_settings_add_up_and_the_last_counts(loaded: Loaded) -> None:
    graph = loaded(set_=["sonar.box.near_m=2", "sonar.box.far_m=3", "sonar.box.far_m=4", "cfar.guard=9"])
    assert graph.node("sonar").arguments["box"] == Box(2.0, 4.0)
    assert graph.node("cfar").arguments == {"pfa": 0.01, "guard": 9}


def test_a_setting_is_for_the_kind_that_was_swapped_in(loaded: Loaded, mistakes: Mistakes) -> None:
    assert loaded(use=["cfar=peaks"], set_=["cfar.pfa=0.5"]).node("cfar").arguments == {"pfa": 0.5}
    assert mistakes(use=["cfar=peaks"], set_=["cfar.guard=1"]) == [
        "--set cfar.guard=1: node 'cfar': kind 'peaks' has no parameter 'guard'; it has pfa"
    ]


@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        ("cfra.pfa=1", "the graph has no node 'cfra'; did you mean 'cfar'?"),
        ("zzz.pfa=1", "the graph has no node 'zzz'; it has sonar, noise, cfar, tracker, out"),
        ("cfar.pfaa=1", "node 'cfar': kind 'cfar' has no parameter 'pfaa'; did you mean 'pfa'?"),
        ("cfar.pfa=x", "node 'cfar': parameter 'pfa' is \"x\"; it takes float"),
        ("cfar.pfa.x=1", "node 'cfar': parameter 'pfa' is {\"x\": 1}; it takes float"),
        (
            "sonar.box.middle=1",
            "node 'sonar': kind 'sonar' has no parameter 'box.middle'; it has near_m, far_m",
        ),
        ("sonar.box.far_m=x", "node 'sonar': parameter 'box' is {\"far_m\": \"x\"}; it takes Box"),
        ("cfar=1", "write it as --set NODE.PARAMETER=VALUE"),
        ("cfar.pfa", "write it as --set NODE.PARAMETER=VALUE"),
        ("cfar..pfa=1", "write it as --set NODE.PARAMETER=VALUE"),
        (".pfa=1", "the graph has no node ''; it has sonar, noise, cfar, tracker, out"),
        ("", "write it as --set NODE.PARAMETER=VALUE"),
        ("cfar.pfa=[1", "is not YAML: expected ',' or ']', but got '<stream end>'"),
        ("cfar.pfa=!x 0.1", "the tag !x is not allowed; write plain values"),
        ("cfar.pfa=@", "is not YAML: found character '@' that cannot start any token"),
    ],
)
def test_a_wrong_setting_names_the_option(option: str, complaint: str, mistakes: Mistakes) -> None:
    assert mistakes(set_=[option]) == [f"--set {option}: {complaint}"]


@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        ("cfra=peaks", "the graph has no node 'cfra'; did you mean 'cfar'?"),
        ("cfar=peeks", "node 'cfar': unknown kind 'peeks'; did you mean 'peaks'?"),
        ("cfar", "write it as --use NODE=KIND"),
        ("cfar=", "write it as --use NODE=KIND"),
        ("=peaks", "write it as --use NODE=KIND"),
    ],
)
def test_a_wrong_swap_names_the_option(option: str, complaint: str, mistakes: Mistakes) -> None:
    assert mistakes(use=[option]) == [f"--use {option}: {complaint}"]


def test_mistakes_in_file_and_options_come_together(mistakes: Mistakes) -> None:
    found = mistakes(child("  cfar: {with: {pfa: x}}"), use=["zzz=peaks"], set_=["sonar.seed=x"])
    assert sorted(line.split(": ")[0] for line in found) == [
        "--set sonar.seed=x",
        "--use zzz=peaks",
        "g.yaml:4",
    ]


def test_loading_twice_gives_the_same_notes_and_graph(loaded: Loaded) -> None:
    text = child("  noise: null\n  sonar: {with: {seed: 1}}")
    assert loaded(text).notes == loaded(text).notes
    assert loaded(text).digest == loaded(text).digest
