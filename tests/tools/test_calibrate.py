"""`fls-flow calibrate`: the graph that it writes has the false-alarm rate that was wished for."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose

from fls_flow import Detections, Ping
from fls_flow import graph as graphs
from fls_flow.catalog import Catalog
from fls_flow.cli import cli
from fls_flow.errors import UserError
from fls_flow.testing import run_graph
from fls_flow.tools.calibrate import calibratable, calibrate
from fls_flow.tools.calibrate_stretch import Stretch, targets_of

SHAPE = (250, 16)
GRAPH = """
graph: harbour
nodes:
  sonar: {use: polar-npz, with: {path: clutter.npz}}
  cfar:  {use: KIND, in: {ping: sonar, tracks: tracker@previous}, with: {pfa: 1.0e-3, guard_m: 0.2, reference_m: 0.4}}
  tracker: {use: jpda, in: {detections: cfar}}
  csv:   {use: track-csv, in: {tracks: tracker}, with: {path: tracks.csv}}
"""


def write_clutter(path, seed, pings=40, *, shape=1.2, gain=1.0, echo=None):
    """Weibull clutter (shape 2 would be Rayleigh), with or without a strong echo at a place."""
    rng = np.random.default_rng(seed)
    image = (20.0 * gain * rng.weibull(shape, (pings, *SHAPE))).astype(np.float32)
    if echo is not None:
        image[:, echo[0] : echo[0] + 4, echo[1]] = 3000.0
    np.savez(
        path,
        image=image,
        range_m=1.0 + 0.05 * np.arange(SHAPE[0]),
        bearing_rad=np.deg2rad(np.linspace(-30.0, 30.0, SHAPE[1])),
        fps=10.0,
    )


@pytest.fixture
def harbour(tmp_path, monkeypatch):
    """A folder with a graph and a recording of its clutter."""
    monkeypatch.chdir(tmp_path)
    write_clutter(tmp_path / "clutter.npz", 1)
    (tmp_path / "harbour.yaml").write_text(GRAPH.replace("KIND", "rayleigh-cfar"))
    return tmp_path


def fls_flow(*words):
    done = CliRunner().invoke(cli, ["calibrate", *map(str, words)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done


def false_alarms(graph, recording):
    """Per cell and ping, in a recording that no scale was fitted to."""
    found = run_graph(graph, collect=["cfar.detections"], set_=[f"sonar.path={recording}"])["cfar.detections"]
    return sum(map(len, found)) / (len(found) * SHAPE[0] * SHAPE[1])


@pytest.mark.parametrize("kind", ["rayleigh-cfar", "os-cfar", "log-cfar"])
def test_the_graph_that_it_writes_has_the_rate_on_another_recording(harbour, kind):
    write_clutter("other.npz", 2)
    words = ("harbour.yaml", "clutter.npz", "--use", f"cfar={kind}", "--json")
    document = json.loads(fls_flow(*words, "--pfa", 1e-3, "-o", "new.yaml").stdout)
    assert (document["node"], document["kind"], document["pings"]) == ("cfar", kind, 40)
    assert document["after"]["low"] < 1e-3 < document["after"]["high"]
    expected = 1e-3 if kind == "log-cfar" else 2e-3
    assert (document["before"]["rate"] > expected) == (kind != "log-cfar")
    rate = false_alarms("new.yaml", "other.npz")
    assert 0.7e-3 < rate < 1.4e-3
    assert graphs.load("new.yaml").node("cfar").kind.name == kind


def test_in_the_clutter_that_a_detector_is_made_for_the_scale_is_one(harbour):
    write_clutter("rayleigh.npz", 3, shape=2.0)
    graph = graphs.load("harbour.yaml", set_=["sonar.path=rayleigh.npz"])
    found = calibrate(graph, pfa=1e-3)
    assert_allclose(found.threshold_scale, 1.0, rtol=0.05)
    assert abs(math.log(found.threshold_scale)) < 4.0 * found.scale_sd
    assert found.point.before.low < 1e-3 < found.point.before.high
    assert found.now == found.point.before  # the graph wishes for the same
    again = graphs.load("harbour.yaml", set_=["sonar.path=rayleigh.npz", "cfar.threshold_scale=1.2"])
    scaled = calibrate(again, pfa=1e-3)
    assert scaled.now.rate < 0.3e-3
    assert scaled.threshold_scale == found.threshold_scale


def test_the_rate_is_that_of_pings_that_the_scale_has_not_seen(harbour):
    """A tail that grows heavier half way: the scale is right for the first half, and the rate tells."""
    halves = []
    for seed, shape in ((5, 2.0), (6, 1.2)):
        write_clutter("half.npz", seed, 20, shape=shape)
        halves.append(dict(np.load("half.npz")))
    for order, calmer in (((0, 1), True), ((1, 0), False)):
        image = np.concatenate([halves[n]["image"] for n in order])
        np.savez("changing.npz", **(halves[0] | {"image": image}))
        found = calibrate(graphs.load("harbour.yaml", set_=["sonar.path=changing.npz"]), pfa=1e-3)
        assert (found.threshold_scale < 1.1) == calmer
        assert (found.point.after.rate > 4e-3) == calmer
        assert (found.point.after.rate < 0.3e-3) == (not calmer)


def test_pings_before_the_stretch_do_not_count(harbour):
    write_clutter("late.npz", 8)
    late = dict(np.load("late.npz"))
    loud = late["image"][:10].copy()
    loud[:, 50:54] = 3000.0
    np.savez("whole.npz", **(late | {"image": np.concatenate([loud, late["image"]])}))
    whole, alone = (
        graphs.load("harbour.yaml", set_=[f"sonar.path={name}.npz"]) for name in ("whole", "late")
    )
    found, expected = (
        calibrate(whole, pfa=1e-3, stretch=Stretch(pings=(10, None))),
        calibrate(alone, pfa=1e-3),
    )
    assert found.threshold_scale == expected.threshold_scale
    assert found.point.after == expected.point.after


def test_cells_without_data_stay_without_in_a_stretch():
    valid = np.ones((4, 3), bool)
    valid[2, 1] = False
    ping = Ping(0, 1, np.ones((4, 3), np.float32), np.arange(1.0, 5.0), np.array([-0.1, 0.0, 0.1]), valid)
    cleared = Stretch(range_m=(0.0, 3.5)).cleared(ping)
    valid[3] = False
    assert cleared.valid.tolist() == valid.tolist()
    assert Stretch().cleared(ping) is ping


def test_beams_that_differ_are_told_apart(harbour):
    """Every other beam has a heavier tail."""
    rng = np.random.default_rng(4)
    image = 20.0 * rng.weibull(np.where(np.arange(SHAPE[1]) % 2, 1.2, 2.0), (80, *SHAPE))
    tables = dict(np.load("clutter.npz")) | {"image": image.astype(np.float32)}
    np.savez("uneven.npz", **tables)
    words = ("harbour.yaml", "uneven.npz", "--pfa", 1e-3, "--set", "cfar.guard_beams=0", "--json")
    one = json.loads(fls_flow(*words, "-o", "one.yaml").stdout)
    many = json.loads(fls_flow(*words, "-o", "many.yaml", "--per-beam").stdout)
    assert isinstance(one["threshold_scale"], float)
    scale = np.array(many["threshold_scale"])
    assert scale.shape == (SHAPE[1],)
    assert scale[1::2].min() > 1.2 * scale[::2].max()
    for name, level in (("one.yaml", False), ("many.yaml", True)):
        out = harbour / name.removesuffix(".yaml")
        found = run_graph(name, collect=["cfar.detections"], set_=["sonar.path=uneven.npz"], out=out)[
            "cfar.detections"
        ]
        beams = np.concatenate(
            [np.searchsorted(tables["bearing_rad"], one.bearing_rad - 1e-9) for one in found]
        )
        share = np.mean(beams % 2)
        assert (0.4 < share < 0.6) == level, share


def test_too_short_a_stretch_is_refused_with_what_is_needed(harbour):
    with pytest.raises(UserError, match=r"cannot be counted in \d+ cells.*3e\+07 cells, some 15\d{3} pings"):
        calibrate(graphs.load("harbour.yaml"), pfa=1e-6)
    with pytest.raises(UserError, match="too far for a tail fit too"):
        calibrate(graphs.load("harbour.yaml"), pfa=1e-9, extrapolate=True)


def test_a_fitted_tail_comes_with_its_uncertainty(harbour):
    graph = graphs.load("harbour.yaml", use=["cfar=log-cfar"])
    found = calibrate(graph, pfa=1e-6, extrapolate=True)
    assert found.extrapolated
    assert 0.01 < found.scale_sd < 0.5
    assert abs(math.log(found.threshold_scale)) < 4.0 * found.scale_sd  # exact in Weibull clutter: 1
    assert found.point.after.alarms < 5
    assert found.point.after.high >= 3.0 / found.point.after.cells


def test_masked_targets_are_no_false_alarms(harbour):
    write_clutter("target.npz", 1, echo=(100, 8))
    x = 1.0 + 0.05 * 101.5
    bearing = np.deg2rad(np.linspace(-30.0, 30.0, SHAPE[1]))[8]
    rows = [f"{seq},{seq * 100_000_000},1,{x * np.cos(bearing)},{x * np.sin(bearing)}" for seq in range(40)]
    (harbour / "truth.csv").write_text("seq,stamp_ns,target_id,x_m,y_m\n" + "\n".join(rows) + "\n")
    graph = graphs.load("harbour.yaml", set_=["sonar.path=target.npz"])
    plain = calibrate(graph, pfa=1e-3)
    masked = calibrate(
        graph, pfa=1e-3, stretch=Stretch(targets=targets_of(harbour / "truth.csv"), radius_m=0.3)
    )
    clean = calibrate(graphs.load("harbour.yaml"), pfa=1e-3)
    assert plain.threshold_scale > 1.5 * clean.threshold_scale
    assert_allclose(masked.threshold_scale, clean.threshold_scale, rtol=0.02)
    near = calibrate(graph, pfa=3e-3, stretch=Stretch(range_m=(0.0, 5.0)))
    assert_allclose(
        near.threshold_scale, calibrate(graphs.load("harbour.yaml"), pfa=3e-3).threshold_scale, rtol=0.15
    )
    assert near.point.after.cells < 0.4 * clean.point.after.cells


def test_what_learns_has_learnt_before_the_stretch_begins(harbour):
    text = GRAPH.replace("KIND", "rayleigh-cfar").replace("in: {ping: sonar,", "in: {ping: still,")
    text = text.replace(
        "  cfar:", "  still: {use: clutter-map, in: {ping: sonar}, with: {warm_up_pings: 8}}\n  cfar:"
    )
    (harbour / "still.yaml").write_text(text)
    found = calibrate(graphs.load("still.yaml"), pfa=8e-4, stretch=Stretch(pings=(8, 28)))
    assert found.pings == 20
    with pytest.raises(UserError, match="cannot be counted"):  # the clutter map's first pings decide nothing
        calibrate(graphs.load("still.yaml", set_=["sonar.first=8"]), pfa=8e-4, stretch=Stretch(pings=(0, 20)))


def test_few_pings_are_split_by_beams(harbour):
    found = calibrate(graphs.load("harbour.yaml"), pfa=3e-3, stretch=Stretch(pings=(0, 6)))
    whole = calibrate(graphs.load("harbour.yaml"), pfa=3e-3)
    assert found.pings == 6
    assert 8_000 < found.point.after.cells < 16_000
    assert_allclose(found.threshold_scale, whole.threshold_scale, rtol=0.15)


def test_a_plot_and_a_table_for_people(harbour):
    done = fls_flow("harbour.yaml", "--pfa", 1e-2, "--plot", "rates.png", "--no-progress")
    assert "threshold_scale" in done.stdout
    assert "as the graph is" in done.stdout
    assert "calibrated" in done.stdout
    assert (harbour / "rates.png").read_bytes().startswith(b"\x89PNG")
    text = (harbour / "calibrated.yaml").read_text()
    assert "# cfar (rayleigh-cfar) for a false-alarm rate of 0.01" in text
    assert "base: 'harbour.yaml'" in text


def test_the_table_fits_a_narrow_terminal(harbour):
    words = ["calibrate", "harbour.yaml", "--pfa", "1e-3", "--per-beam", "--no-progress"]
    done = CliRunner().invoke(cli, words, env={"COLUMNS": "80"})
    rows = [line.split() for line in done.stdout.splitlines()]
    assert all(len(line) <= 80 for line in done.stdout.splitlines())
    (row,) = (row for row in rows if row[0] == "calibrated")
    _, wished, measured, low, _, high, alarms, cells = row
    assert float(wished) == 1e-3
    assert float(low) < float(measured) < float(high)
    assert float(measured) == pytest.approx(int(alarms) / int(cells.replace(",", "")), rel=0.02)


def test_the_overlay_holds_what_it_was_found_with_but_not_the_recording(harbour):
    write_clutter("other.npz", 5)
    fls_flow(
        "harbour.yaml", "other.npz", "--pfa", 1e-2, "--set", "cfar.guard_m=0.3", "-o", "new.yaml", "--json"
    )
    cfar, sonar = (graphs.load("new.yaml").node(name) for name in ("cfar", "sonar"))
    assert cfar.arguments["guard_m"] == 0.3
    assert cfar.arguments["pfa"] == 1e-2
    assert cfar.arguments["reference_m"] == 0.4
    assert sonar.arguments["path"].name == "clutter.npz"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--pfa", 2), "--pfa 2: a rate of false alarms"),
        (("--node", "cfr"), "--node cfr: the graph has no such node; it can calibrate cfar"),
        (("--node", "tracker"), "--node tracker: kind 'jpda' lacks threshold_ratio()"),
        (("--pings", "3"), "--pings 3: write it as A:B"),
        (("--pings", "5:15", "--per-beam"), "--per-beam: takes at least 20 pings, not 10"),
        (("--pings", "15:5"), "--pings 15:5: holds no ping"),
        (("--pings", "0:100"), "--pings 0:100: the recording ends after 40 pings"),
        (("--range-m", "1:2:3"), "--range-m 1:2:3: write it as A:B"),
        (("--range-m", "900:"), "decides no cell"),
        (("--mask", "harbour.yaml"), "--mask harbour.yaml: holds no known columns"),
        (("--mask-radius-m", 0), "--mask-radius-m 0.0: must be positive"),
        (("-o", "clutter.npz"), "--out clutter.npz: is there already"),
        (("--plot", "clutter.npz"), "--plot clutter.npz: is there already"),
        (("--use", "cfar=threshold-centroids"), "has no detector that can be calibrated"),
        (("--set", "sonar.mount.position_m=[1,0,0]", "--set", "cfar.pfa.x=1"), "cfar"),
    ],
)
def test_mistakes_are_one_line_each(harbour, words, text):
    with pytest.raises(UserError, match=text.replace("(", r"\(").replace(")", r"\)")):
        fls_flow("harbour.yaml", "--no-progress", *words)
    assert not (harbour / "calibrated.yaml").exists()


def test_a_source_of_unknown_length_needs_the_stretch(harbour):
    text = GRAPH.replace("KIND", "rayleigh-cfar").replace(
        "polar-npz, with: {path: clutter.npz}", "surface-scene"
    )
    (harbour / "scene.yaml").write_text(text)
    with pytest.raises(UserError, match="plays no file"):
        fls_flow("scene.yaml", "clutter.npz")


@dataclass
class Loud:
    """A detector from outside: cells above a multiple of the ping's root mean square."""

    pfa: float = 1e-3
    threshold_scale: float | tuple[float, ...] = 1.0

    def __call__(self, ping: Ping) -> Detections:
        rows, beams = np.nonzero(self.threshold_ratio(ping) > np.asarray(self.threshold_scale))
        return Detections.of(
            ping,
            range_m=ping.range_m[rows],
            bearing_rad=ping.bearing_rad[beams],
            amplitude=ping.amplitude[rows, beams],
        )

    def threshold_ratio(self, ping: Ping) -> np.ndarray:
        x = ping.amplitude.astype(float)
        return x / np.sqrt(-np.log(self.pfa) * np.mean(x * x))


def test_a_detector_from_outside_is_calibrated_in_the_same_way(harbour):
    catalog = Catalog({"loud": Loud})
    graph = graphs.load("harbour.yaml", use=["cfar=loud"], catalog=catalog)
    found = calibrate(graph, pfa=1e-3)
    assert found.threshold_scale > 1.3
    assert found.point.after.low < 1e-3 < found.point.after.high


def test_two_detectors_need_a_name(harbour):
    text = GRAPH.replace("KIND", "rayleigh-cfar") + "  two: {use: os-cfar, in: {ping: sonar}}\n"
    text += "  other: {use: detection-csv, in: {detections: two}, with: {path: two.csv}}\n"
    (harbour / "two.yaml").write_text(text)
    graph = graphs.load("two.yaml")
    with pytest.raises(UserError, match=r"the graph has 2 detectors to calibrate \(cfar, two\)"):
        calibratable(graph)
    assert calibratable(graph, "two").kind.name == "os-cfar"
