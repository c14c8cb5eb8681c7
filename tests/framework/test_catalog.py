import json
import os
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from fls_flow import BeamMask, Detections, Features, Message, NavState, Ping, Tracks
from fls_flow.catalog import Catalog, InPort, OutPort, Parameter, describe, suggest
from fls_flow.errors import PluginError


class Two(NamedTuple):
    detections: Detections
    beam_mask: BeamMask


@dataclass(frozen=True, eq=False)
class CTDSample:
    seq: int
    stamp_ns: int
    depth_m: float = 0.0


@dataclass(frozen=True, eq=False)
class LoudPing(Ping):
    """A message that adds to another."""

    level_db: float = 0.0


@dataclass
class Everything:
    """Has all kinds of ports."""

    gate: float
    name: str = "x"
    table: tuple[int, ...] = field(default_factory=lambda: (1, 2))
    _count: int = field(default=0, init=False, repr=False)

    def __call__(
        self,
        ping: Ping,
        tracks: Tracks | None,
        mask: BeamMask | None = None,
        nav: tuple[NavState, ...] = (),
        *,
        anything: Message,
    ) -> Two:
        raise NotImplementedError

    def snapshot(self) -> dict[str, Any]:
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        pass


def test_ports_and_parameters_come_from_the_annotations() -> None:
    kind = describe(Everything)
    assert kind.inputs == (
        InPort("ping", Ping),
        InPort("tracks", Tracks, nullable=True),
        InPort("mask", BeamMask, optional=True, nullable=True),
        InPort("nav", NavState, optional=True, stream=True),
        InPort("anything", Message),
    )
    assert kind.outputs == (OutPort("detections", Detections), OutPort("beam_mask", BeamMask))
    assert kind.parameters == (
        Parameter("gate", float, True),
        Parameter("name", str, False, "x"),
        Parameter("table", tuple[int, ...], False, (1, 2)),
    )
    assert (kind.bundle, kind.source, kind.takes_any) == (Two, False, None)
    assert (kind.stateful, kind.restorable, kind.role) == (True, True, "detector")
    assert kind.input("nav") == kind.inputs[3]
    assert kind.input("zzz") is None
    assert kind.output("zzz") is None


def returning(hint: Any, **inputs: Any) -> type:
    """A node class whose `__call__` has these annotations."""
    names = "".join(f", {name}" for name in inputs)
    space: dict[str, Any] = {}
    exec(f"def __call__(self{names}): ...", space)
    space["__call__"].__annotations__ = {**inputs, "return": hint}
    return dataclass(type("Made", (), {"__call__": space["__call__"]}))


@pytest.mark.parametrize(
    ("cls", "role", "outputs"),
    [
        (returning(Iterator[Ping]), "source", ["ping"]),
        (returning(Iterable[CTDSample]), "source", ["ctd_sample"]),
        (returning(Generator[NavState, None, None]), "source", ["nav_state"]),
        (returning(Iterator[Two]), "source", ["detections", "beam_mask"]),
        (returning(None, tracks=Tracks), "sink", []),
        (returning(Tracks, detections=Detections), "tracker", ["tracks"]),
        (returning(Detections, ping=Ping), "detector", ["detections"]),
        (returning(Features, tracks=Tracks), "features", ["features"]),
        (returning(Ping, ping=Ping), "filter", ["ping"]),
        (returning(LoudPing, ping=Ping), "filter", ["loud_ping"]),
    ],
)
def test_the_role_follows_from_the_signature(cls: type, role: str, outputs: list[str]) -> None:
    kind = describe(cls)
    assert (kind.role, [port.name for port in kind.outputs]) == (role, outputs)


def test_a_sink_may_take_any_ports() -> None:
    @dataclass
    class Recorder:
        def __call__(self, ping: Ping, **ports: Message) -> None:
            pass

    kind = describe(Recorder, "recorder")
    assert (kind.role, kind.takes_any, [port.name for port in kind.inputs]) == ("sink", Message, ["ping"])
    assert kind.input("whatever") == InPort("whatever", Message)


def test_a_call_may_be_inherited() -> None:
    @dataclass
    class More(Everything):
        extra: int = 0

    assert [one.name for one in describe(More).parameters] == ["gate", "name", "table", "extra"]


Untyped = namedtuple("Untyped", ["ping"])


class Empty(NamedTuple):
    pass


class Half(NamedTuple):
    ping: Ping
    total: int


class Nowhere(NamedTuple):
    ping: "NoSuchClass"  # type: ignore[name-defined]  # noqa: F821 -- meant to be unresolvable


@pytest.mark.parametrize(
    ("cls", "complaint"),
    [
        (returning(list[Ping]), "has no inputs, so it is a source: let __call__ return Iterator"),
        (returning(Ping), "has no inputs, so it is a source"),
        (returning(Iterator), "has no inputs, so it is a source"),
        (returning(None), "has no inputs, so it is a source"),
        (returning(Iterator[None]), "has neither inputs nor outputs"),
        (returning(int, ping=Ping), "returns int; it returns a message, a NamedTuple of messages or None"),
        (returning(Detections | None, ping=Ping), "returns .*Detections | None; it returns a message"),
        (returning(tuple[Ping, Detections], ping=Ping), "returns tuple"),
        (returning(Message, ping=Ping), "returns Message; it returns a message"),
        (returning(Untyped, ping=Ping), "the output 'ping' is not annotated with a message class"),
        (returning(Empty, ping=Ping), "returns Empty, which has no fields"),
        (returning(Half, ping=Ping), "the output 'total' is not annotated with a message class"),
        (returning(Nowhere, ping=Ping), "has an annotation that cannot be resolved: name 'NoSuchClass'"),
        (
            returning(None, ping="NoSuchClass"),
            "has an annotation that cannot be resolved: name 'NoSuchClass'",
        ),
        (returning(None, ping=int), "the input 'ping' is annotated int; it takes a message class X"),
        (returning(None, ping=Any), "the input 'ping' is annotated"),
        (returning(None, ping=Ping | Tracks), "the input 'ping' is annotated"),
        (returning(None, ping=Ping | Tracks | None), "the input 'ping' is annotated"),
        (returning(None, ping=tuple[Ping, Tracks]), "the input 'ping' is annotated"),
        (returning(None, ping=list[Ping]), "the input 'ping' is annotated"),
        (returning(None, ping=None), "the input 'ping' is annotated"),
    ],
)
def test_a_signature_that_no_graph_can_wire_is_refused(cls: type, complaint: str) -> None:
    with pytest.raises(PluginError, match=complaint) as caught:
        describe(cls, "made")
    assert "kind 'made'" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_shapes_of_calls_that_no_graph_can_wire_are_refused() -> None:
    @dataclass
    class Star:
        def __call__(self, *pings: Ping) -> None:
            pass

    @dataclass
    class Positional:
        def __call__(self, ping: Ping, /) -> None:
            pass

    @dataclass
    class Unannotated:
        def __call__(self, ping) -> None:  # type: ignore[no-untyped-def]  # that is the point
            pass

    @dataclass
    class Silent:
        def __call__(self, ping: Ping):  # type: ignore[no-untyped-def]  # that is the point
            pass

    @dataclass
    class Streams:
        def __call__(self, **ports: tuple[Ping, ...]) -> None:
            pass

    @dataclass
    class NoCall:
        pass

    @dataclass
    class Raises:
        table: list[int] = field(default_factory=lambda: [1 // 0])

        def __call__(self, ping: Ping) -> None:
            pass

    class NoDataclass:
        def __call__(self, ping: Ping) -> None:
            pass

    def function(ping: Ping) -> None:
        pass

    for wrong, complaint in {
        Star: "inputs have names; '*pings' has none, use '**pings'",
        Positional: "'ping' is positional-only; remove the '/' after it",
        Unannotated: "annotate the input 'ping' with its message class",
        Silent: "annotate what __call__ returns (None for a sink)",
        Streams: "annotate '**ports' with a message class or Message",
        NoCall: "has no __call__",
        Raises: "the default of 'table' raised ZeroDivisionError",
        NoDataclass: "is not a dataclass",
        function: "is not a dataclass",
    }.items():
        with pytest.raises(PluginError) as caught:
            Catalog({"wrong": wrong}).load("wrong")  # type: ignore[dict-item]  # one is no class, on purpose
        assert complaint in str(caught.value)
        assert "kind 'wrong'" in str(caught.value)


def test_a_class_in_the_catalog_hides_an_installed_kind_of_that_name() -> None:
    catalog = Catalog({"rayleigh-cfar": Everything})
    assert catalog.load("rayleigh-cfar").cls is Everything
    assert catalog.names().count("rayleigh-cfar") == 1


def test_suggestions_are_near_or_absent() -> None:
    assert suggest("rayleigh_cfar", ["rayleigh-cfar", "jpda"]) == "; did you mean 'rayleigh-cfar'?"
    assert suggest("zzz", ["rayleigh-cfar"]) == ""
    assert suggest("", []) == ""


# --- installed distributions, each made of a module and its metadata ---------------------------------

PLUGIN = """
from collections.abc import Iterator
from dataclasses import dataclass
from fls_flow import Detections, Ping, hookimpl

@dataclass
class Peaks:
    def __call__(self, ping: Ping) -> Detections:
        return Detections(ping.seq, ping.stamp_ns)
"""
HOOK = """
@hookimpl
def fls_node() -> type[Peaks]:
    return Peaks
"""
Install = Callable[..., None]
Python = Callable[[str], Any]


@pytest.fixture
def install(tmp_path: Path) -> Install:
    """Lay a distribution into a folder as an installer would."""

    def lay(distribution: str, kinds: dict[str, str], metadata: str | None = None, **modules: str) -> None:
        info = tmp_path / f"{distribution.replace('-', '_')}-1.2.dist-info"
        info.mkdir()
        lines = [f"{kind} = {module}" for kind, module in kinds.items()]
        (info / "entry_points.txt").write_text("\n".join(["[fls_flow]", *lines]))
        if metadata is None:
            metadata = f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.2\n"
        if metadata:
            (info / "METADATA").write_text(metadata)
        for name, text in modules.items():
            (tmp_path / f"{name}.py").write_text(text)

    return lay


@pytest.fixture
def python(tmp_path: Path) -> Python:
    """Run code with these distributions installed; gives what it leaves in `result`."""

    def run(code: str) -> Any:
        script = "import json, sys\nfrom fls_flow.catalog import Catalog\nfrom fls_flow.errors import *\n"
        script += f"{code}\nprint('RESULT', json.dumps(result))"
        env = {**os.environ, "PYTHONPATH": str(tmp_path)}
        done = subprocess.run(
            [sys.executable, "-c", script], env=env, capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.rpartition("RESULT ")[2])

    return run


LOAD_ALL = """
result = {}
for name in %r:
    try:
        result[name] = Catalog().load(name).cls.__name__
    except PluginError as error:
        result[name] = str(error)
"""


def test_listing_kinds_imports_no_plugin(install: Install, python: Python) -> None:
    install("acme-sonar", {"acme-peaks": "acme_peaks", "acme-boom": "acme_boom"}, acme_boom="1 / 0")
    result = python(
        "names = Catalog().names()\n"
        "loaded = [m for m in sys.modules if m.startswith(('acme', 'fls_s', 'fls_d', 'fls_t'))]\n"
        "heavy = [m for m in ('cv2', 'scipy', 'numba', 'matplotlib') if m in sys.modules]\n"
        "result = [names, loaded, heavy]"
    )
    names, loaded, heavy = result
    assert {"acme-peaks", "acme-boom", "rayleigh-cfar", "jpda"} <= set(names)
    assert (loaded, heavy) == ([], [])


def test_a_kind_of_another_distribution_is_loaded_with_its_origin(install: Install, python: Python) -> None:
    install("acme-sonar", {"acme-peaks": "acme_peaks"}, acme_peaks=PLUGIN + HOOK)
    result = python(
        "kind = Catalog().load('acme-peaks')\n"
        "one = kind.listing\nresult = [kind.name, kind.role, one.distribution, one.version, one.module]"
    )
    assert result == ["acme-peaks", "detector", "acme-sonar", "1.2", "acme_peaks"]


def test_a_broken_plugin_hurts_only_who_uses_it(install: Install, python: Python) -> None:
    modules = {
        "acme_good": PLUGIN + HOOK,
        "acme_boom": "raise RuntimeError('two\\nlines')",
        "acme_exit": "import sys\nsys.exit(3)",
        "acme_syntax": "def (",
        "acme_nohook": PLUGIN,
        "acme_unmarked": PLUGIN + HOOK.replace("@hookimpl", ""),
        "acme_misspelt": PLUGIN + HOOK.replace("fls_node", "fls_nodes"),
        "acme_argument": PLUGIN + HOOK.replace("fls_node()", "fls_node(config)"),
        "acme_raises": PLUGIN + HOOK.replace("return Peaks", "raise KeyError('x')"),
        "acme_none": PLUGIN + HOOK.replace("return Peaks", "return None"),
        "acme_instance": PLUGIN + HOOK.replace("return Peaks", "return Peaks()"),
        "acme_plain": PLUGIN.replace("@dataclass", "") + HOOK,
    }
    kinds = {name.replace("_", "-"): name for name in modules} | {"acme-none-such": "acme_none_such"}
    install("acme-sonar", {**kinds, "acme-attribute": "acme_good:none"}, **modules)
    result = python(LOAD_ALL % [*kinds, "acme-attribute"])
    assert result.pop("acme-good") == "Peaks"
    expected = {
        "acme-boom": "cannot be imported: RuntimeError: two lines; mend or uninstall it",
        "acme-exit": "cannot be imported: SystemExit: 3; mend or uninstall it",
        "acme-syntax": "cannot be imported: SyntaxError: ",
        "acme-nohook": "has no `@hookimpl def fls_node()` that returns a class",
        "acme-unmarked": "has no `@hookimpl def fls_node()` that returns a class",
        "acme-misspelt": "has a wrong hook: ",
        "acme-argument": "has a wrong hook: ",
        "acme-raises": "fls_node() raised KeyError: 'x'",
        "acme-none": "has no `@hookimpl def fls_node()` that returns a class",
        "acme-instance": "has no `@hookimpl def fls_node()` that returns a class",
        "acme-none-such": "cannot be imported: ModuleNotFoundError: No module named 'acme_none_such'",
        "acme-attribute": "cannot be imported: AttributeError: ",
        "acme-plain": "is not a dataclass",
    }
    assert result.keys() == expected.keys()
    for name, complaint in expected.items():
        assert complaint in result[name]
        assert f"kind '{name}'" in result[name]
        assert "acme-sonar 1.2 (acme_" in result[name] or name == "acme-plain"
        assert "\n" not in result[name]


def test_a_kind_that_two_distributions_claim_names_both(install: Install, python: Python) -> None:
    install("acme-sonar", {"peaks": "acme_peaks", "acme": "acme_peaks"}, acme_peaks=PLUGIN + HOOK)
    install("beta-sonar", {"peaks": "beta_peaks"}, beta_peaks=PLUGIN + HOOK)
    result = python(
        LOAD_ALL % ["peaks", "acme"]
        + "result['twice'] = [o.distribution for o in Catalog().listings() if o.kind == 'peaks']"
    )
    assert result["peaks"] == (
        "kind 'peaks' is claimed by acme-sonar 1.2 (acme_peaks) and beta-sonar 1.2 (beta_peaks); uninstall one of them"
    )
    assert result["acme"] == "Peaks"
    assert result["twice"] == ["acme-sonar", "beta-sonar"]


def test_a_distribution_without_metadata_does_not_stop_the_listing(install: Install, python: Python) -> None:
    install("bare", {"bare-peaks": "bare_peaks"}, metadata="", bare_peaks=PLUGIN + HOOK)
    install("other", {"bare-peaks": "bare_peaks"})
    result = python(LOAD_ALL % ["bare-peaks"] + "result['n'] = len(Catalog().listings())")
    assert "other 1.2 (bare_peaks) and unknown unknown (bare_peaks)" in result["bare-peaks"]
    assert result["n"] > 2


def test_an_unknown_kind_is_told_from_the_near_one() -> None:
    with pytest.raises(PluginError, match="unknown kind 'rayleigh_cfar'; did you mean 'rayleigh-cfar'"):
        Catalog().load("rayleigh_cfar")
    with pytest.raises(PluginError, match="unknown kind 'zzz'; fls-flow plugins lists the installed ones"):
        Catalog().load("zzz")
