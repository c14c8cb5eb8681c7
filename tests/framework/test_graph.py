from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fls_flow import BeamMask, Detections, Message, NavState, Ping, Tracks
from fls_flow.catalog import Catalog
from fls_flow.errors import FlsFlowError, GraphError, UserError
from fls_flow.graph import Graph, find, load


@dataclass
class Sonar:
    seed: int = 0
    path: Path | None = None

    def __call__(self) -> Iterator[Ping]:
        yield from ()


@dataclass
class Navigation:
    def __call__(self) -> Iterator[NavState]:
        yield from ()


class Noise(NamedTuple):
    beam_mask: BeamMask
    detections: Detections


@dataclass
class NoiseBeams:
    def __call__(self, ping: Ping) -> Noise:
        raise NotImplementedError


class Both(NamedTuple):
    near: Detections
    far: Detections


@dataclass
class Split:
    def __call__(self, ping: Ping) -> Both:
        raise NotImplementedError


@dataclass
class Cfar:
    pfa: float = 1e-4
    mode: Literal["cell", "order"] = "cell"

    def __post_init__(self) -> None:
        if not 0.0 < self.pfa < 1.0:
            raise ValueError(f"pfa is {self.pfa}; it lies between 0 and 1")

    def __call__(self, ping: Ping, noisy: BeamMask | None = None, tracks: Tracks | None = None) -> Detections:
        raise NotImplementedError


@dataclass
class Stabilise:
    def __call__(self, ping: Ping, nav: tuple[NavState, ...] = ()) -> Ping:
        raise NotImplementedError


@dataclass
class Tracker:
    gate: float
    _tracks: list[int] = field(default_factory=list, init=False, repr=False)

    def __call__(self, detections: Detections, extra: Detections | None = None) -> Tracks:
        raise NotImplementedError


@dataclass
class Resumable(Tracker):
    def snapshot(self) -> dict[str, Any]:
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        pass


@dataclass(frozen=True, eq=False)
class Depth:
    seq: int
    stamp_ns: int
    depth_m: float  # no default: no empty one


@dataclass
class Sounder:
    def __call__(self, ping: Ping) -> Depth:
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class LoudPing(Ping):
    level_db: float = 0.0


@dataclass
class Amplifier:
    def __call__(self, ping: Ping) -> LoudPing:
        raise NotImplementedError


@dataclass
class Limiter:
    def __call__(self, ping: LoudPing) -> Ping:
        raise NotImplementedError


@dataclass
class Loose:
    def __call__(self, tracks: Tracks | None = None, detections: Detections | None = None) -> None:
        pass


@dataclass
class Csv:
    path: Path = Path("tracks.csv")

    def __call__(self, tracks: Tracks) -> None:
        pass


@dataclass
class Recorder:
    path: Path = Path("all.mcap")

    def __call__(self, **ports: Message) -> None:
        pass


KINDS = {
    "sonar": Sonar,
    "navigation": Navigation,
    "noise-beams": NoiseBeams,
    "split": Split,
    "cfar": Cfar,
    "stabilise": Stabilise,
    "tracker": Tracker,
    "resumable": Resumable,
    "sounder": Sounder,
    "amplifier": Amplifier,
    "limiter": Limiter,
    "loose": Loose,
    "csv": Csv,
    "recorder": Recorder,
}
HEAD = """\
graph: chain
nodes:
  sonar: {use: sonar}
"""
TAIL = """\
  tracker: {use: tracker, in: {detections: cfar}, with: {gate: 9}}
  out: {use: csv, in: {tracks: tracker}}
"""
CFAR = "  cfar: {use: cfar, in: {ping: sonar}}\n"
GOOD = HEAD + CFAR + TAIL

Loaded = Callable[..., Graph]
Mistakes = Callable[..., list[str]]


@pytest.fixture
def loaded(tmp_path: Path) -> Loaded:
    def load_text(text: str, **options: Any) -> Graph:
        path = tmp_path / "g.yaml"
        path.write_text(text, encoding="utf-8")
        return load(path, catalog=Catalog(KINDS), **options)

    return load_text


@pytest.fixture
def mistakes(loaded: Loaded, tmp_path: Path) -> Mistakes:
    """The problems of a graph, its file shortened to the line: `4: node ...`."""

    def find_in(text: str, **options: Any) -> list[str]:
        with pytest.raises(GraphError) as caught:
            loaded(text, **options)
        return [str(one).removeprefix(f"{tmp_path}/g.yaml:") for one in caught.value.problems]

    return find_in


def test_a_good_graph_is_in_an_order_in_which_nobody_waits_in_vain(loaded: Loaded) -> None:
    head, *lines = HEAD.splitlines(keepends=True), *reversed((CFAR + TAIL).splitlines(keepends=True))
    graph = loaded("".join([*head, *lines]))
    assert [node.name for node in graph.nodes] == ["sonar", "cfar", "tracker", "out"]
    assert (graph.name, graph.clock, graph.sinks, graph.streams) == ("chain", "sonar", ("out",), ())
    assert graph.node("tracker").arguments == {"gate": 9.0}
    assert str(graph.node("tracker").inputs[0]) == "cfar.detections"
    assert graph.notes == ()


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        # kinds
        ("{use: cfra, in: {ping: sonar}}", "node 'cfar': unknown kind 'cfra'; did you mean 'cfar'?"),
        ("{use: CFAR, in: {ping: sonar}}", "node 'cfar': unknown kind 'CFAR'; did you mean 'cfar'?"),
        ("{use: zzz, in: {ping: sonar}}", "node 'cfar': unknown kind 'zzz'; fls-flow plugins lists the installed ones"),
        ("{in: {ping: sonar}}", "node 'cfar' has no 'use'; name its kind"),
        ("{use: [cfar], in: {ping: sonar}}", "node 'cfar': 'use' is [\"cfar\"]; it names a kind"),
        ("{use: null, in: {ping: sonar}}", "node 'cfar': 'use' is null; it names a kind"),
        ("cfar", "node 'cfar' is \"cfar\"; it is a mapping, for example {use: cfar}"),
        ("[cfar]", "node 'cfar' is [\"cfar\"]; it is a mapping, for example {use: KIND}"),
        ("", "node 'cfar' is null; it is a mapping, for example {use: KIND}"),
        ("{use: cfar, in: {ping: sonar}, wiht: {pfa: 0.1}}", "node 'cfar' has no key 'wiht'; did you mean 'with'?"),
        ("{ues: cfar, in: {ping: sonar}}", "node 'cfar' has no key 'ues'; did you mean 'use'?"),
        ("{use: cfar, inn: {ping: sonar}}", "node 'cfar' has no key 'inn'; did you mean 'in'?"),
        ("{use: cfar, in: {ping: sonar}, zzz: 1}", "node 'cfar' has no key 'zzz'; it has use, with, in, on_error"),
        # ports
        ("{use: cfar}", "node 'cfar': input 'ping' (Ping) is not wired; 'cfar' needs it"),
        ("{use: cfar, in: }", "node 'cfar': input 'ping' (Ping) is not wired; 'cfar' needs it"),
        ("{use: cfar, in: sonar}", "node 'cfar': 'in' is \"sonar\"; it maps names to values"),
        ("{use: cfar, in: [sonar]}", "node 'cfar': 'in' is [\"sonar\"]; it maps names to values"),
        ("{use: cfar, in: {pign: sonar}}", "node 'cfar': kind 'cfar' has no input 'pign'; did you mean 'ping'?"),
        ("{use: cfar, in: {ping: sonar, zzz: sonar}}", "node 'cfar': kind 'cfar' has no input 'zzz'; it has ping, noisy, tracks"),
        ("{use: cfar, in: {ping: sonra}}", "node 'cfar': input 'ping': the graph has no node 'sonra'; did you mean 'sonar'?"),
        ("{use: cfar, in: {ping: sonar.pong}}", "node 'cfar': input 'ping' takes Ping; node 'sonar' has no output 'pong'; did you mean 'ping'?"),
        ("{use: cfar, in: {ping: sonar.a.b}}", "node 'cfar': input 'ping' takes Ping; node 'sonar' has no output 'a.b'; it gives ping (Ping)"),
        ("{use: cfar, in: {ping: tracker}}", "node 'cfar': input 'ping' takes Ping; node 'tracker' has no output that fits: it gives tracks (Tracks)"),
        ("{use: cfar, in: {ping: tracker.tracks}}", "node 'cfar': input 'ping' takes Ping, but 'tracker.tracks' gives Tracks"),
        ("{use: cfar, in: {ping: out}}", "node 'cfar': input 'ping' takes Ping; node 'out' has no output that fits: it gives nothing"),
        ("{use: cfar, in: {ping: }}", "node 'cfar': input 'ping' is null; write NODE or NODE.OUTPUT"),
        ("{use: cfar, in: {ping: 7}}", "node 'cfar': input 'ping' is 7; write NODE or NODE.OUTPUT"),
        ("{use: cfar, in: {ping: [sonar]}}", "node 'cfar': input 'ping' is [\"sonar\"]; write NODE or NODE.OUTPUT"),
        ("{use: cfar, in: {ping: sonar.}}", "node 'cfar': input 'ping' is \"sonar.\"; write NODE or NODE.OUTPUT"),
        ("{use: cfar, in: {ping: .ping}}", "node 'cfar': input 'ping' is \".ping\"; write NODE or NODE.OUTPUT"),
        # modes
        ("{use: cfar, in: {ping: sonar@prevoius}}", "node 'cfar': input 'ping' has the suffix '@prevoius'; did you mean 'previous'?"),
        ("{use: cfar, in: {ping: sonar@}}", "node 'cfar': input 'ping' has the suffix '@'; it is @previous or @time"),
        ("{use: cfar, in: {ping: sonar@previous}}", "node 'cfar': input 'ping' takes no @previous: it is annotated Ping, not Ping | None"),
        ("{use: cfar, in: {ping: sonar@time}}", "node 'cfar': input 'ping' takes no @time: it is annotated Ping, not tuple[Ping, ...]"),
        # parameters
        ("{use: cfar, in: {ping: sonar}, with: {pfaa: 0.1}}", "node 'cfar': kind 'cfar' has no parameter 'pfaa'; did you mean 'pfa'?"),
        ("{use: cfar, in: {ping: sonar}, with: {pfa: '0.1'}}", "node 'cfar': parameter 'pfa' is \"0.1\"; it takes float"),
        ("{use: cfar, in: {ping: sonar}, with: {pfa: 2}}", "node 'cfar': pfa is 2.0; it lies between 0 and 1"),
        ("{use: cfar, in: {ping: sonar}, with: {mode: cells}}", "node 'cfar': parameter 'mode' is \"cells\"; it takes Literal['cell', 'order']; did you mean 'cell'?"),
        ("{use: cfar, in: {ping: sonar}, with: 3}", "node 'cfar': 'with' is 3; it maps names to values"),
        # errors
        ("{use: cfar, in: {ping: sonar}, on_error: ignore}", "node 'cfar': on_error is \"ignore\"; it is stop or skip"),
        ("{use: cfar, in: {ping: sonar}, on_error: }", "node 'cfar': on_error is null; it is stop or skip"),
        ("{use: cfar, in: {ping: sonar}, on_error: {a: b}}", "node 'cfar': on_error is {\"a\": \"b\"}; it is stop or skip"),
        # keys and tags
        ("{use: cfar, use: cfar, in: {ping: sonar}}", "duplicate key 'use', first at "),
        ("{use: cfar, in: {ping: sonar}, with: {pfa: !f 0.1}}", "the tag !f is not allowed; write plain values"),
    ],
)  # fmt: skip
def test_one_mistake_is_one_problem_with_line_node_and_hint(
    line: str, complaint: str, mistakes: Mistakes
) -> None:
    (found,) = mistakes(f"{HEAD}  cfar: {line}\n{TAIL}")
    assert found.startswith(f"4: {complaint}")


@pytest.mark.parametrize(
    ("lines", "complaints"),
    [
        (
            CFAR + TAIL + "  spare: {use: cfar, in: {ping: sonar}}\n",
            ["7: node 'spare' is unused: its outputs reach no sink; wire them or remove it"],
        ),
        (CFAR + TAIL + "  other: {use: sonar}\n", ["7: node 'other' is unused: its outputs reach no sink"]),
        (
            "  other: {use: sonar}\n  cfar: {use: cfar, in: {ping: other}}\n" + TAIL
            + "  all: {use: recorder, in: {ping: sonar}}\n",
            ["3: two clocks: 'other' and 'sonar'; take one of them by @time"],
        ),
        (
            CFAR + TAIL + "  nav: {use: navigation}\n  all: {use: recorder, in: {nav: nav}}\n",
            ["7: two clocks: 'sonar' and 'nav'; take one of them by @time"],
        ),
        (
            "  nav: {use: navigation}\n  flat: {use: stabilise, in: {ping: sonar, nav: nav}}\n"
            "  cfar: {use: cfar, in: {ping: flat}}\n" + TAIL,
            ["5: node 'flat': input 'nav' takes a stream: write nav@time"],
        ),
        (
            "  flat: {use: stabilise, in: {ping: sonar, nav: cfar@time}}\n"
            "  cfar: {use: cfar, in: {ping: flat}}\n" + TAIL,
            [
                "4: node 'flat': input 'nav' takes @time from a source alone; 'cfar' is no source",
                "4: node 'flat': input 'nav' takes NavState; node 'cfar' has no output that fits",
            ],
        ),
        (
            "  a: {use: stabilise, in: {ping: b}}\n  b: {use: stabilise, in: {ping: c}}\n"
            "  c: {use: stabilise, in: {ping: a}}\n  cfar: {use: cfar, in: {ping: sonar, tracks: tracker}}\n"
            + TAIL + "  all: {use: recorder, in: {ping: c}}\n",
            [
                "4: a cycle without @previous: a -> c -> b -> a; mark one of its wires @previous",
                "7: a cycle without @previous: cfar -> tracker -> cfar; mark one of its wires @previous",
            ],
        ),
        (
            CFAR + TAIL + "  self: {use: stabilise, in: {ping: self}}\n  all: {use: recorder, in: {ping: self}}\n",
            ["7: a cycle without @previous: self -> self; mark one of its wires @previous"],
        ),
        (CFAR + TAIL.replace("out: {use: csv, in: {tracks: tracker}}", ""), ["1: the graph has no sink; add one"]),
        (
            CFAR + TAIL + "  again: {use: csv, in: {tracks: tracker}, with: {path: ./x/../tracks.csv}}\n",
            ["7: node 'again' writes 'tracks.csv', and so does node 'out'; give one another path"],
        ),
        (CFAR + TAIL + "  idle: {use: loose}\n", ["7: node 'idle' has no plain input, so nothing tells it when"]),
        (CFAR + TAIL + "  idle: {use: recorder}\n", ["7: node 'idle' has no plain input, so nothing tells it when"]),
        (
            CFAR + TAIL + "  idle: {use: loose, in: {tracks: tracker@previous}}\n",
            ["7: node 'idle' has no plain input, so nothing tells it when to fire; wire one without @"],
        ),
        (
            CFAR.replace("use: cfar", "on_error: skip, use: cfar") + TAIL.replace("use: tracker", "on_error: skip, use: tracker"),
            ["5: node 'tracker': on_error: skip needs snapshot() and restore() in kind 'tracker', which keeps state"],
        ),
        (
            CFAR + TAIL + "  deep: {use: sounder, in: {ping: sonar}, on_error: skip}\n  all: {use: recorder, in: {d: deep}}\n",
            ["7: node 'deep': on_error: skip needs an empty Depth; give its depth_m a default"],
        ),
        (
            "  split: {use: split, in: {ping: sonar}}\n" + TAIL.replace("cfar", "split"),
            ["5: node 'tracker': input 'detections' takes Detections; node 'split' has several outputs that fit, "
             "name one: it gives near (Detections), far (Detections)"],
        ),
        (
            "  noise: {use: noise-beams, in: {ping: sonar}}\n" + TAIL.replace("cfar", "noise.beam_mask"),
            ["5: node 'tracker': input 'detections' takes Detections, but 'noise.beam_mask' gives BeamMask; "
             "'noise.detections' fits"],
        ),
        (CFAR + TAIL.replace("with:", "width:"), ["5: node 'tracker' has no key 'width'; did you mean 'with'?"]),
        (CFAR + TAIL.replace(", with: {gate: 9}", ""), ["5: node 'tracker': parameter 'gate' is missing; kind 'tracker' needs it"]),
        (CFAR + TAIL.replace("tracker:", "track er:").replace("tracks: tracker", "tracks: track er"), ["5: node name 'track er': it is of letters"]),
        (CFAR + TAIL.replace("out:", "1out:"), ["6: node name '1out': it is of letters, digits, - and _, beginning with a letter"]),
        (CFAR + TAIL + "  cfar: {use: zzz}\n", ["7: duplicate key 'cfar', first at "]),
    ],
)  # fmt: skip
def test_mistakes_between_nodes(lines: str, complaints: list[str], mistakes: Mistakes) -> None:
    found = mistakes(HEAD + lines)
    assert len(found) == len(complaints)
    for line, complaint in zip(found, complaints, strict=True):
        assert line.startswith(complaint)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "1: a graph file is a mapping with the keys graph and nodes"),
        ("- a\n", "1: a graph file is a mapping"),
        ("just words\n", "1: a graph file is a mapping"),
        ("graph: g\n", "1: 'nodes' is missing; name the nodes of the graph there"),
        ("graph: g\nnodes:\n", "2: 'nodes' is a mapping of names to nodes"),
        ("graph: g\nnodes: [a]\n", "2: 'nodes' is a mapping of names to nodes"),
        ("graph: g\nnodes: {}\n", "1: the graph has no nodes"),
        (GOOD.replace("graph: chain\n", ""), "1: 'graph' is missing; name it, for example graph: g"),
        (GOOD.replace("chain", "a/b"), '1: graph is "a/b"; its name is of letters, digits, - and _'),
        (GOOD.replace("chain", "[x]"), '1: graph is ["x"]; its name is of letters'),
        (GOOD + "ndoes: {}\n", "7: a graph has no key 'ndoes'; did you mean 'nodes'?"),
        ("graph: g\nnodes: {all: {use: recorder, in: {x: all}}}\n", "2: node 'all': input 'x' takes any message; node 'all'"),
    ],
)  # fmt: skip
def test_mistakes_of_the_whole_file(text: str, complaint: str, mistakes: Mistakes) -> None:
    (found,) = mistakes(text)
    assert found.startswith(complaint)


DOZEN = """\
graph: chain
nodes:
  sonar:
    use: sonar
    with:
      seed: seven
  other: {use: sonar}
  noise: {use: noise-beam, in: {ping: sonar}}
  cfar:
    use: cfar
    in:
      pign: sonar
      noisy: noise.beam_mask
      tracks: tracker@previuos
    with:
      pfa: 3
      mdoe: cell
  tracker:
    use: tracker
    in: {detections: cfar}
    on_error: skip
  a: {use: stabilise, in: {ping: b}}
  b: {use: stabilise, in: {ping: a}}
  all: {use: recorder, in: {ping: b, more: other.pong}}
  spare: {use: cfar, in: {ping: sonar}}
  out:
    use: csv
    use: csv
    in: {tracks: tracker.track}
ndoes: {}
"""


def test_a_dozen_mistakes_are_reported_at_once_in_the_order_of_the_file(mistakes: Mistakes) -> None:
    expected = [
        "6: node 'sonar': parameter 'seed' is \"seven\"; it takes int",
        "8: node 'noise': unknown kind 'noise-beam'; did you mean 'noise-beams'?",
        "12: node 'cfar': kind 'cfar' has no input 'pign'; did you mean 'ping'?",
        "14: node 'cfar': input 'tracks' has the suffix '@previuos'; did you mean 'previous'?",
        "17: node 'cfar': kind 'cfar' has no parameter 'mdoe'; did you mean 'mode'?",
        "18: node 'tracker': parameter 'gate' is missing; kind 'tracker' needs it",
        "21: node 'tracker': on_error: skip needs snapshot() and restore() in kind 'tracker', which keeps state",
        "22: a cycle without @previous: a -> b -> a; mark one of its wires @previous",
        "24: node 'all': input 'more' takes any message; node 'other' has no output 'pong'; did you mean 'ping'?",
        "25: node 'spare' is unused: its outputs reach no sink; wire them or remove it",
        "28: duplicate key 'use', first at ",
        "29: node 'out': input 'tracks' takes Tracks; node 'tracker' has no output 'track'; did you mean 'tracks'?",
        "30: a graph has no key 'ndoes'; did you mean 'nodes'?",
    ]  # fmt: skip
    found = mistakes(DOZEN)
    assert [line[: len(want)] for line, want in zip(found, expected, strict=True)] == expected


def test_a_misspelt_kind_hides_no_other_mistake_of_its_node(mistakes: Mistakes) -> None:
    wrong = "  cfar: {use: cfra, in: {pingg: sonar.ping}, with: {pfaa: 1.0e-3, mode: cel}}\n"
    assert mistakes(HEAD + wrong + TAIL) == [
        "4: node 'cfar': unknown kind 'cfra'; did you mean 'cfar'?",
        "4: node 'cfar': kind 'cfar' has no input 'pingg'; did you mean 'ping'?",
        "4: node 'cfar': parameter 'mode' is \"cel\"; it takes Literal['cell', 'order']; did you mean 'cell'?",
        "4: node 'cfar': kind 'cfar' has no parameter 'pfaa'; did you mean 'pfa'?",
    ]
    assert mistakes(HEAD + CFAR + TAIL.replace("cfar", "cfar.detection").replace("use: tracker", "use: Trackr")) == [
        "5: node 'tracker': unknown kind 'Trackr'; did you mean 'tracker'?",
        "5: node 'tracker': input 'detections' takes Detections; node 'cfar' has no output 'detection'; "
        "did you mean 'detections'?",
    ]  # fmt: skip


def test_of_a_kind_that_nobody_knows_the_wires_are_checked(mistakes: Mistakes) -> None:
    wrong = "  cfar: {use: zzz, in: {a: sonra, b: sonar.pnig, c: 5, d: sonar, e: tracker@previous}, with: {x: 1}}\n"
    assert mistakes(HEAD + wrong + TAIL) == [
        "4: node 'cfar': unknown kind 'zzz'; fls-flow plugins lists the installed ones",
        "4: node 'cfar': input 'a': the graph has no node 'sonra'; did you mean 'sonar'?",
        "4: node 'cfar': input 'b'; node 'sonar' has no output 'pnig'; did you mean 'ping'?",
        "4: node 'cfar': input 'c' is 5; write NODE or NODE.OUTPUT",
    ]


@pytest.mark.parametrize(
    ("one", "other", "complaint"),
    [
        ("run.json", "b", "'out' writes 'run.json', which is the run's own; give it another path"),
        ("x/../run.log", "b", "'out' writes 'run.log', which is the run's own; give it another path"),
        (
            "a.csv",
            "a.csv/b.csv",
            "'a.csv/b.csv', and node 'out' writes 'a.csv'; 'a.csv' cannot be a file and",
        ),
        (
            "a.csv/b.csv",
            "a.csv",
            "'a.csv', and node 'out' writes 'a.csv/b.csv'; 'a.csv' cannot be a file and",
        ),
    ],
)
def test_sinks_do_not_write_over_each_other_or_the_run(
    one: str, other: str, complaint: str, mistakes: Mistakes
) -> None:
    two = f"  two: {{use: csv, in: {{tracks: tracker}}, with: {{path: {other}}}}}\n"
    tail = TAIL.replace("tracks: tracker}}", f"tracks: tracker}}, with: {{path: {one}}}}}")
    assert [line for line in mistakes(HEAD + CFAR + tail + two) if complaint in line]


def test_two_sinks_may_share_a_folder(loaded: Loaded) -> None:
    two = "  two: {use: csv, in: {tracks: tracker}, with: {path: all/b.csv}}\n"
    tail = TAIL.replace("tracks: tracker}}", "tracks: tracker}, with: {path: all}}")  # which may be a folder
    assert loaded(HEAD + CFAR + tail + two).sinks == ("out", "two")


def test_block_style_points_at_the_line_of_the_key(mistakes: Mistakes) -> None:
    text = "graph: g\nnodes:\n  sonar:\n    # why\n    use: sonar\n  out:\n    use: recorder\n"
    assert [line.split(":")[0] for line in mistakes(text)] == ["3", "6"]


def test_optional_inputs_stay_unwired_and_feedback_takes_previous(loaded: Loaded) -> None:
    graph = loaded(HEAD + "  cfar: {use: cfar, in: {ping: sonar, tracks: tracker@previous}}\n" + TAIL)
    assert [(wire.port, wire.mode) for wire in graph.node("cfar").inputs] == [
        ("ping", "now"),
        ("tracks", "previous"),
    ]


def test_an_input_that_is_never_given_plainly_may_come_plainly_too(loaded: Loaded) -> None:
    noise = "  noise: {use: noise-beams, in: {ping: sonar}}\n"
    graph = loaded(HEAD + noise + "  cfar: {use: cfar, in: {ping: sonar, noisy: noise}}\n" + TAIL)
    assert str(graph.node("cfar").inputs[1]) == "noise.beam_mask"


def test_a_message_of_a_subclass_fits_and_one_of_the_base_does_not(
    loaded: Loaded, mistakes: Mistakes
) -> None:
    loud = "  loud: {use: amplifier, in: {ping: sonar}}\n"
    graph = loaded(HEAD + loud + CFAR.replace("sonar", "loud") + TAIL)
    assert str(graph.node("cfar").inputs[0]) == "loud.loud_ping"
    (found,) = mistakes(
        HEAD + "  soft: {use: limiter, in: {ping: sonar}}\n" + CFAR.replace("sonar", "soft") + TAIL
    )
    assert found.startswith(
        "4: node 'soft': input 'ping' takes LoudPing; node 'sonar' has no output that fits"
    )


def test_a_stream_enters_by_time(loaded: Loaded) -> None:
    lines = "  nav: {use: navigation}\n  flat: {use: stabilise, in: {ping: sonar, nav: nav@time}}\n"
    graph = loaded(HEAD + lines + CFAR.replace("sonar", "flat") + TAIL)
    assert (graph.clock, graph.streams) == ("sonar", ("nav",))


def test_the_clock_cannot_be_a_stream_as_well(mistakes: Mistakes) -> None:
    lines = "  nav: {use: navigation}\n  flat: {use: stabilise, in: {ping: sonar, nav: nav@time}}\n"
    sinks = "  all: {use: recorder, in: {nav: nav, ping: flat}}\n"
    found = mistakes("graph: g\nnodes:\n  sonar: {use: sonar}\n" + lines + sinks)
    assert "two clocks" in found[0] or "taken by @time as well" in found[0]
    assert all(line.startswith("4: ") for line in found)


@pytest.mark.parametrize("kind", ["resumable", "csv"])
def test_skip_is_for_nodes_that_can_be_put_back(kind: str, loaded: Loaded) -> None:
    tail = TAIL.replace("use: tracker", "use: resumable, on_error: skip")
    skipping = loaded(HEAD + CFAR.replace("use: cfar", "on_error: skip, use: cfar") + tail)
    assert [node.on_error for node in skipping.nodes] == ["stop", "skip", "skip", "stop"]


def test_skip_is_not_for_sources(mistakes: Mistakes) -> None:
    (found,) = mistakes(GOOD.replace("{use: sonar}", "{use: sonar, on_error: skip}"))
    assert found.startswith("3: node 'sonar': on_error: skip is not for a source")


def test_an_aliased_mistake_is_reported_at_every_use_and_once_each(mistakes: Mistakes) -> None:
    text = HEAD + "  cfar: {use: cfar, in: {ping: sonar}, with: &w {pfa: x}}\n" + TAIL
    text += "  again: {use: cfar, in: {ping: sonar}, with: *w}\n  all: {use: recorder, in: {d: again}}\n"
    assert len(mistakes(text)) == 2


def test_a_large_graph_is_checked_in_reasonable_time(loaded: Loaded) -> None:
    chain = "".join(f"  n{k}: {{use: stabilise, in: {{ping: n{k + 1}}}}}\n" for k in range(400))
    graph = loaded(
        HEAD + chain + "  n400: {use: stabilise, in: {ping: sonar}}\n  all: {use: recorder, in: {p: n0}}\n"
    )
    assert [node.name for node in graph.nodes[:3]] == ["sonar", "n400", "n399"]


def test_the_digest_is_of_what_is_computed(loaded: Loaded) -> None:
    first = loaded(GOOD).digest
    assert loaded("# about\n" + GOOD.replace("gate: 9", "gate: 9.0")).digest == first
    assert loaded(GOOD.replace("gate: 9", "gate: 8")).digest != first


@pytest.mark.parametrize("name", ["", "none", "x" * 5000, "a\0b", "no/such/folder", "surface_obstcale"])
def test_no_such_graph_is_one_line(name: str) -> None:
    with pytest.raises(UserError, match=r": no such graph file; ") as caught:
        load(name)
    assert "\n" not in str(caught.value)


def test_a_near_name_is_suggested_and_a_shipped_graph_is_found(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="did you mean 'surface_obstacle'"):
        find("surface_obstcale")
    assert find("surface-obstacle").name == "surface_obstacle.yaml"
    (tmp_path / "graphs").mkdir()
    (tmp_path / "graphs" / "mine.yaml").write_text(GOOD)
    assert find("mine") == tmp_path / "graphs" / "mine.yaml"


def test_a_folder_is_no_graph(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is a folder; name a graph file in it"):
        load(tmp_path)


def test_a_link_to_itself_is_no_graph(tmp_path: Path) -> None:
    (tmp_path / "g.yaml").symlink_to(tmp_path / "g.yaml")
    with pytest.raises(UserError, match="no such graph file"):
        load(tmp_path / "g.yaml")


PIECES = ["{", "}", ": ", "\n", "  ", "in", "@previous", "@time", ".", "null", "&x ", "*x", "tracker", "cfar: ", "1", "[", "use: "]  # fmt: skip


@settings(max_examples=1000, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    st.sampled_from([GOOD, DOZEN]),
    st.integers(0, 700),
    st.integers(0, 25),
    st.sampled_from(PIECES) | st.text(max_size=3),
)
def test_no_mutation_of_a_graph_raises_anything_else(
    tmp_path: Path, text: str, at: int, cut: int, insert: str
) -> None:
    at %= len(text)
    path = tmp_path / "g.yaml"
    path.write_text(text[:at] + insert + text[at + cut :], encoding="utf-8", errors="replace")
    try:
        graph = load(path, catalog=Catalog(KINDS))
    except FlsFlowError as error:
        lines = str(error).splitlines()
    else:
        lines = [graph.clock]
    assert lines
    assert len(lines) == len(set(lines))
