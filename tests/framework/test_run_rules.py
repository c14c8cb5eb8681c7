"""The rules of a run, each as a small graph that would break without it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from fls_flow import Detections, Message, NavState, Ping, Tracks, Truth, wire
from fls_flow import graph as graphs
from fls_flow.catalog import Catalog
from fls_flow.runtime import Options, Report, Run

MS = 1_000_000


def ping(seq: int, stamp_ns: int, value: float = 0.0) -> Ping:
    return Ping(seq, stamp_ns, np.full((4, 3), value, np.float32), np.arange(1.0, 5.0), np.arange(3.0) - 1)


@dataclass
class Sonar:
    """Pings whose numbers gap and repeat."""

    pings: int = 12
    period_ms: float = 100.0

    def __call__(self) -> Iterator[Ping]:
        for n in range(self.pings):
            yield ping(3 * (n // 2), int(n * self.period_ms * MS), n)

    def __len__(self) -> int:
        return self.pings


class Both(NamedTuple):
    ping: Ping
    truth: Truth


@dataclass
class Simulator:
    pings: int = 3
    apart: bool = False

    def __call__(self) -> Iterator[Both]:
        for n in range(self.pings):
            yield Both(ping(n, n), Truth(n + self.apart, n))


@dataclass
class Nav:
    """Stamps in ms, as listed."""

    stamps_ms: tuple[int, ...] = ()

    def __call__(self) -> Iterator[NavState]:
        for n, stamp in enumerate(self.stamps_ms):
            yield NavState(n, stamp * MS)


@dataclass
class Detector:
    """Counts what it has seen, so that a lost or repeated firing shows."""

    fail_at: int = -1
    sleep_s: float = 0.0
    seen: int = field(default=0, init=False, repr=False)

    def __call__(
        self, ping: Ping, nav: tuple[NavState, ...] = (), tracks: Tracks | None = None
    ) -> Detections:
        self.seen += 1
        if self.seen - 1 == self.fail_at:
            raise ValueError("no echo today")
        time.sleep(self.sleep_s)
        before = -1.0 if tracks is None else float(tracks.seq)
        value = [float(ping.amplitude[0, 0]), before, self.seen, *(one.stamp_ns / MS for one in nav)]
        return Detections.of(
            ping, range_m=value, bearing_rad=np.zeros(len(value)), amplitude=np.zeros(len(value))
        )

    def snapshot(self) -> dict[str, Any]:
        return {"seen": self.seen}

    def restore(self, state: dict[str, Any]) -> None:
        self.seen = state["seen"]


@dataclass
class Tracker:
    def __call__(self, detections: Detections) -> Tracks:
        return Tracks(detections.seq, detections.stamp_ns)


@dataclass
class Sink:
    sleep_s: float = 0.0

    def __call__(self, **ports: Message) -> None:
        time.sleep(self.sleep_s)


LOOP = """
graph: loop
nodes:
  sonar: {use: sonar}
  det: {use: detector, in: {ping: sonar, tracks: trk@previous}}
  trk: {use: tracker, in: {detections: det}}
  out: {use: sink, in: {tracks: trk}}
"""
STREAM = """
graph: stream
nodes:
  sonar: {use: sonar}
  nav: {use: nav}
  det: {use: detector, in: {ping: sonar, nav: nav@time}}
  out: {use: sink, in: {det: det}}
"""
KINDS: dict[str, type] = {
    "detector": Detector,
    "nav": Nav,
    "simulator": Simulator,
    "sink": Sink,
    "sonar": Sonar,
    "tracker": Tracker,
}

Both_ = tuple[Report, dict[str, list[Any]]]


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., Both_]:
    """Run a graph text; gives the report and what the tapped outputs gave, with their indices."""

    def start(text: str, *taps: str, kinds: dict[str, type] | None = None, **given: Any) -> Both_:
        settings = {name: given.pop(name) for name in list(given) if name in Options.__dataclass_fields__}
        path = tmp_path / "graph.yaml"
        path.write_text(text)
        graph = graphs.load(path, catalog=Catalog({**KINDS, **(kinds or {})}), set_=given.pop("set_", ()))
        seen: dict[str, list[Any]] = {name: [] for name in taps}
        keep = {
            tuple(name.split(".")): lambda index, message, name=name: seen[name].append((index, message))
            for name in taps
        }
        return Run(graph, Options(**settings), out=tmp_path, taps=keep, **given).start(), seen

    return start


SCHEDULES = pytest.mark.parametrize("in_order", [True, False], ids=["in-order", "threads"])


# --- numbers -------------------------------------------------------------------------------------


@SCHEDULES
def test_firings_are_numbered_densely_whatever_seq_does(run, in_order):
    report, seen = run(LOOP, "trk.tracks", in_order=in_order)
    assert [index for index, _ in seen["trk.tracks"]] == list(range(12))
    assert [tracks.seq for _, tracks in seen["trk.tracks"]] == [0, 0, 3, 3, 6, 6, 9, 9, 12, 12, 15, 15]
    assert report.status == "finished"
    assert report.pings == 12


def test_threads_and_in_order_give_the_same_bits(run):
    def bits(in_order: bool) -> list[bytes]:
        _, seen = run(LOOP, "det.detections", in_order=in_order, set_=["sonar.pings=60"])
        return [wire.encode(message) for _, message in seen["det.detections"]]

    assert bits(in_order=True) == bits(in_order=False)


# --- @previous -----------------------------------------------------------------------------------


@SCHEDULES
def test_previous_is_none_at_first_and_then_the_last_pings_value(run, in_order):
    _, seen = run(LOOP, "det.detections", in_order=in_order, set_=["sonar.pings=6"])
    assert [detections.range_m[1] for _, detections in seen["det.detections"]] == [-1, 0, 0, 3, 3, 6]


# --- clock and streams ---------------------------------------------------------------------------


@SCHEDULES
def test_samples_come_once_up_to_the_first_at_or_after_the_ping(run, in_order):
    stamps = "nav.stamps_ms=[0, 30, 60, 90, 120, 130, 350, 700, 710]"
    report, seen = run(STREAM, "det.detections", in_order=in_order, set_=["sonar.pings=6", stamps])
    got = [list(detections.range_m[3:]) for _, detections in seen["det.detections"]]
    #       0 ms  100 ms              200 ms      300 ms  400 ms  500 ms
    assert got == [[0], [30, 60, 90, 120], [130, 350], [], [700], []]
    assert report.counts["nav"].fired == 8, "a replayed stream runs no further than the newest ping needs"


@SCHEDULES
def test_samples_whose_stamp_does_not_increase_are_dropped_and_counted(run, in_order):
    settings = ["sonar.pings=2", "nav.stamps_ms=[0, 50, 50, 20, 100]"]
    report, seen = run(STREAM, "det.detections", in_order=in_order, set_=settings)
    assert [list(one.range_m[3:]) for _, one in seen["det.detections"]] == [[0], [50, 100]]
    assert report.counts["nav"].dropped == 2


@SCHEDULES
@pytest.mark.parametrize("stamps", [(), (0, 10), (250,)])
def test_a_stream_that_ends_early_gives_what_is_there(run, in_order, stamps):
    settings = ["sonar.pings=5", f"nav.stamps_ms={list(stamps)}"]
    report, seen = run(STREAM, "det.detections", in_order=in_order, set_=settings)
    assert report.pings == 5
    given = [stamp for _, detections in seen["det.detections"] for stamp in detections.range_m[3:]]
    assert given == list(stamps)


@dataclass
class DeadNav:
    """A live link on which nothing comes."""

    live: bool = True
    _closed: threading.Event = field(default_factory=threading.Event, init=False, repr=False)

    def __call__(self) -> Iterator[NavState]:
        self._closed.wait(20.0)
        yield from ()

    def close(self) -> None:
        self._closed.set()


@SCHEDULES
def test_a_dead_navigation_link_never_silences_detection(run, in_order):
    kinds = {"nav": DeadNav}
    settings = ["sonar.pings=3", "sonar.period_ms=50"]
    report, seen = run(
        STREAM, "det.detections", kinds=kinds, in_order=in_order, rate=1.0, set_=settings, stream_wait_s=0.02
    )
    assert report.pings == len(seen["det.detections"]) == 3
    assert report.samples_taken["det"]["nav"] == [0, 0, 0]


@SCHEDULES
def test_a_replay_repeats_how_many_samples_each_ping_of_the_live_run_got(run, in_order):
    taken = {"det": {"nav": [0, 2, 0, 1]}}
    settings = ["sonar.pings=4", "nav.stamps_ms=[0, 30, 60, 90, 120, 350, 351, 352]"]
    _, seen = run(STREAM, "det.detections", in_order=in_order, set_=settings, samples_taken=taken)
    assert [list(one.range_m[3:]) for _, one in seen["det.detections"]] == [[], [0, 30], [], [60]]


def test_all_ports_of_a_source_fire_together(run):
    text = """
graph: both
nodes:
  sim: {use: simulator}
  out: {use: sink, in: {ping: sim.ping, truth: sim.truth}}
"""
    report, seen = run(text, "sim.ping", "sim.truth")
    assert [index for index, _ in seen["sim.ping"]] == [index for index, _ in seen["sim.truth"]] == [0, 1, 2]
    report, _ = run(text, set_=["sim.apart=true"])
    assert "'sim' failed at index 0: it answered seq 1 to the ping seq 0" in str(report.error)


# --- window --------------------------------------------------------------------------------------


@dataclass
class Gauge:
    """How many pings are between the source and the sink."""

    most: int = 0
    inside: int = 0
    lock: Any = field(default_factory=threading.Lock)

    def enter(self) -> None:
        with self.lock:
            self.inside += 1
            self.most = max(self.most, self.inside)

    def leave(self) -> None:
        with self.lock:
            self.inside -= 1


@pytest.mark.parametrize("window", [1, 3, 8])
def test_no_more_than_the_window_is_in_flight_and_nothing_is_lost(run, window):
    gauge = Gauge()

    class Counted:
        def __call__(self) -> Iterator[Ping]:
            for n in range(30):
                gauge.enter()
                yield ping(n, n)

    class Slow:
        def __call__(self, **ports: Message) -> None:
            time.sleep(0.002)
            gauge.leave()

    report, _ = run(LOOP, window=window, instances={"sonar": Counted(), "out": Slow()})
    assert report.pings == 30
    # the source is asked for a ping only when there is room for it
    assert gauge.most == window


def test_a_fast_branch_waits_for_the_slowest_sink(run):
    text = LOOP + "  raw: {use: sink, in: {ping: sonar}, with: {sleep_s: 0.003}}\n"
    report, _ = run(text, window=2, set_=["sonar.pings=40"])
    assert report.pings == 40
    assert report.counts["raw"].fired == report.counts["out"].fired == 40


# --- live ----------------------------------------------------------------------------------------


def test_a_paced_replay_sheds_whole_pings_at_the_source_and_keeps_the_newest(run):
    settings = ["sonar.pings=20", "sonar.period_ms=5", "out.sleep_s=0.05"]
    report, seen = run(LOOP, "det.detections", rate=1.0, set_=settings)
    shed = report.counts["sonar"].shed
    values = [detections.range_m[0] for _, detections in seen["det.detections"]]
    assert shed > 5
    assert len(values) == 20 - shed == report.pings
    assert values[-1] == 19, "the newest ping is kept"
    assert values == sorted(values)
    assert [index for index, _ in seen["det.detections"]] == list(range(20 - shed)), (
        "a shed ping has no index"
    )
    assert report.counts["out"].fired == 20 - shed, "never a half-processed ping"


def test_a_paced_replay_keeps_the_pace_of_the_recording(run):
    began = time.monotonic()
    report, _ = run(LOOP, rate=2.0, set_=["sonar.pings=5", "sonar.period_ms=100"])
    assert time.monotonic() - began >= 4 * 0.1 / 2.0
    assert report.pings == 5
    assert report.counts["sonar"].shed == 0


@dataclass
class LiveSonar:
    """Pings until it is closed; blocks in between, as a socket does."""

    live: bool = True
    _closed: threading.Event = field(default_factory=threading.Event, init=False, repr=False)

    def __call__(self) -> Iterator[Ping]:
        for n in range(3):
            yield ping(n, n)
        self._closed.wait(30.0)

    def close(self) -> None:
        self._closed.set()


@SCHEDULES
def test_stopping_ends_a_live_source_that_blocks(run, tmp_path, in_order):
    path = tmp_path / "live.yaml"
    path.write_text(LOOP)
    graph = graphs.load(path, catalog=Catalog({**KINDS, "sonar": LiveSonar}))
    fired = threading.Event()
    one = Run(graph, Options(in_order=in_order), on_finished=lambda pings: fired.set() if pings else None)
    threading.Thread(target=lambda: (fired.wait(10), one.stop())).start()
    began = time.monotonic()
    report = one.start()
    assert report.status == "interrupted"
    assert report.pings >= 1
    assert time.monotonic() - began < 5.0
    assert not [thread for thread in threading.enumerate() if thread.name == "sonar-feed"]


# --- end -----------------------------------------------------------------------------------------


@SCHEDULES
@pytest.mark.parametrize("pings", [0, 1, 2])
def test_short_inputs_end_cleanly(run, in_order, pings):
    report, _ = run(LOOP, in_order=in_order, set_=[f"sonar.pings={pings}"])
    assert report.status == "finished"
    assert {name: counts.fired for name, counts in report.counts.items()} == dict.fromkeys(
        report.counts, pings
    )


# --- answers -------------------------------------------------------------------------------------


@dataclass
class Mute:
    def __call__(self, ping: Ping) -> Detections:
        return None  # type: ignore[return-value]


@dataclass
class WrongSeq:
    def __call__(self, ping: Ping) -> Detections:
        return Detections(ping.seq + 1, ping.stamp_ns)


@dataclass
class WrongStamp:
    def __call__(self, ping: Ping) -> Detections:
        return Detections(ping.seq, 0)


@dataclass
class WrongType:
    def __call__(self, ping: Ping) -> Detections:
        return ping  # type: ignore[return-value]


@dataclass
class Writes:
    def __call__(self, ping: Ping) -> Detections:
        ping.amplitude[0, 0] = 9.0
        return Detections(ping.seq, ping.stamp_ns)


@SCHEDULES
@pytest.mark.parametrize(
    ("kind", "cause"),
    [
        (Mute, "it answered None, not Detections"),
        (WrongSeq, "it answered seq 1 to the ping seq 0; copy it from the input"),
        (WrongStamp, "it answered stamp_ns 0 to a ping of 100000000; copy it from the input"),
        (WrongType, "it answered Ping, not Detections"),
        (Writes, "ValueError: assignment destination is read-only"),
    ],
)
def test_an_answer_that_breaks_the_contract_ends_the_run(run, in_order, kind, cause):
    text = """
graph: broken
nodes:
  sonar: {use: sonar}
  det: {use: broken, in: {ping: sonar}}
  out: {use: sink, in: {det: det}}
"""
    report, _ = run(text, kinds={"broken": kind}, in_order=in_order)
    assert report.status == "failed"
    assert str(report.error).startswith("node 'det' failed at ping seq 0 (index ")
    assert cause in str(report.error)


@SCHEDULES
def test_an_exception_ends_the_run_and_what_came_before_it_goes_through(run, in_order):
    report, seen = run(LOOP, "trk.tracks", in_order=in_order, set_=["det.fail_at=5"])
    assert str(report.error) == "node 'det' failed at ping seq 6 (index 5): ValueError: no echo today"
    assert [index for index, _ in seen["trk.tracks"]] == [0, 1, 2, 3, 4]
    assert report.counts["out"].fired == report.pings == 5


@SCHEDULES
def test_a_node_that_exits_ends_the_run_and_not_the_program(run, in_order):
    class Exits:
        def __call__(self, ping: Ping, tracks: Tracks | None = None) -> Detections:
            raise SystemExit(5)

    report, _ = run(LOOP, in_order=in_order, instances={"det": Exits()})
    assert str(report.error) == "node 'det' failed at ping seq 0 (index 0): SystemExit: 5"


@SCHEDULES
def test_an_exception_in_a_source_names_it(run, in_order):
    class Breaks:
        def __call__(self) -> Iterator[Ping]:
            yield ping(0, 0)
            raise OSError("the cable is cut")

    report, _ = run(LOOP, in_order=in_order, instances={"sonar": Breaks()})
    assert str(report.error) == "node 'sonar' failed at index 1: OSError: the cable is cut"
    assert report.counts["out"].fired == 1


@SCHEDULES
def test_skip_answers_empty_restores_the_state_and_counts(run, in_order):
    text = LOOP.replace("{use: detector,", "{use: detector, on_error: skip,")
    report, seen = run(text, "det.detections", in_order=in_order, set_=["det.fail_at=5", "sonar.pings=5"])
    assert report.counts["det"].failed == 0
    # the state is as before the ping: the sixth call fails again and again, and is never counted
    report, seen = run(text, "det.detections", in_order=in_order, set_=["det.fail_at=5", "sonar.pings=9"])
    assert report.status == "finished"
    assert report.counts["det"].failed == 4
    assert [len(detections) for _, detections in seen["det.detections"]] == [3] * 5 + [0] * 4


def test_every_node_is_closed_once_whatever_happens(run):
    closed: list[str] = []

    class Closing:
        def __call__(self, **ports: Message) -> None:
            raise RuntimeError("disk full")

        def close(self) -> None:
            closed.append("out")

    report, _ = run(LOOP, instances={"out": Closing()})
    assert closed == ["out"]
    assert "disk full" in str(report.error)


def test_an_error_while_closing_is_reported(run):
    class Closing:
        def __call__(self, **ports: Message) -> None: ...

        def close(self) -> None:
            raise OSError("disk\nfull")

    report, _ = run(LOOP, instances={"out": Closing()})
    assert str(report.error) == "node 'out' failed: while closing: OSError: disk full"


# --- arrays --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plain:
    """A third party's message that does nothing for itself."""

    seq: int
    stamp_ns: int
    values: Any = None


@dataclass
class MakesPlain:
    def __call__(self, ping: Ping) -> Plain:
        return Plain(ping.seq, ping.stamp_ns, np.zeros(3))


def test_arrays_are_read_only_also_in_messages_of_third_parties(run):
    text = """
graph: plain
nodes:
  sonar: {use: sonar}
  plain: {use: plain, in: {ping: sonar}}
  out: {use: sink, in: {any: plain}}
"""
    _, seen = run(text, "plain.plain", kinds={"plain": MakesPlain})
    assert not any(message.values.flags.writeable for _, message in seen["plain.plain"])


# --- bits ----------------------------------------------------------------------------------------


def test_numerical_libraries_run_one_thread_each(run):
    from threadpoolctl import threadpool_info

    threads: list[int] = []

    class Looks:
        def __call__(self, **ports: Message) -> None:
            np.ones((8, 8)) @ np.ones((8, 8))
            threads.extend(pool["num_threads"] for pool in threadpool_info())

    run(LOOP, instances={"out": Looks()}, set_=["sonar.pings=1"])
    assert threads
    assert set(threads) == {1}


# --- stop ----------------------------------------------------------------------------------------


@SCHEDULES
def test_a_stop_finishes_what_is_in_flight(tmp_path, in_order):
    path = tmp_path / "graph.yaml"
    path.write_text(LOOP)
    graph = graphs.load(path, catalog=Catalog(KINDS), set_=["sonar.pings=100000"])
    one: list[Run] = []
    one.append(
        Run(
            graph,
            Options(in_order=in_order),
            on_finished=lambda pings: one[0].stop() if pings >= 20 else None,
        )
    )
    report = one[0].start()
    assert report.status == "interrupted"
    fired = {name: counts.fired for name, counts in report.counts.items()}
    assert set(fired.values()) == {report.pings}
    assert 20 <= report.pings < 60


def test_a_node_that_hangs_is_named_and_ends_the_run(tmp_path):
    path = tmp_path / "graph.yaml"
    path.write_text(LOOP)
    release = threading.Event()

    class Hangs:
        def __call__(self, ping: Ping, tracks: Tracks | None = None) -> Detections:
            if ping.seq == 3:
                release.wait(20.0)
            return Detections(ping.seq, ping.stamp_ns)

    graph = graphs.load(path, catalog=Catalog(KINDS))
    report = Run(graph, Options(grace_s=0.1, deadline_s=0.3), instances={"det": Hangs()}).start()
    release.set()
    assert report.status == "failed"
    assert str(report.error) == "node 'det' failed at index 2: no answer for 0.3 s"
    assert report.counts["out"].fired == 2


def test_a_node_that_hangs_does_not_hold_up_a_stop(tmp_path):
    path = tmp_path / "graph.yaml"
    path.write_text(LOOP)
    release = threading.Event()

    class Hangs:
        def __call__(self, ping: Ping, tracks: Tracks | None = None) -> Detections:
            if ping.seq:
                release.wait(20.0)
            return Detections(ping.seq, ping.stamp_ns)

    graph = graphs.load(path, catalog=Catalog(KINDS))
    one = Run(graph, Options(grace_s=0.2), instances={"det": Hangs()})
    threading.Timer(0.3, one.stop).start()
    began = time.monotonic()
    report = one.start()
    assert time.monotonic() - began < 5.0
    assert report.status == "interrupted"
    release.set()
