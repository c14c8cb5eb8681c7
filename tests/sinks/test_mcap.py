"""The sink `mcap`: a channel per port, whatever is wired to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from fls_flow import Detections, InputError, Tracks
from fls_flow.recording import Recording
from fls_flow.testing import check_node
from fls_sinks.mcap import Mcap


def tracks(n):
    return Tracks(n, n * 10, [n], [1], np.zeros((1, 4)), np.eye(4)[None], [1], [1])


def test_each_port_is_a_channel_named_after_it(tmp_path):
    sink = Mcap(tmp_path / "run.mcap", chunk_pings=3)
    for n in range(5):
        sink(mine=tracks(n), echoes=Detections(n, n * 10))
    sink.close()
    recording = Recording(tmp_path / "run.mcap")
    assert {name: topic.messages for name, topic in recording.topics().items()} == {"mine": 5, "echoes": 5}
    assert recording.message_type("mine") is Tracks
    with (tmp_path / "run.mcap").open("rb") as file:
        found = [(channel.topic, record.log_time) for _, channel, record in make_reader(file).iter_messages()]
    assert found == [(topic, n * 10) for n in range(5) for topic in ("echoes", "mine")]


def test_nothing_is_made_before_the_first_ping_and_nothing_replaced(tmp_path):
    path = tmp_path / "run.mcap"
    sink = Mcap(path)
    assert not path.exists()
    path.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        sink(tracks=tracks(0))
    assert path.read_text() == "mine"


def test_a_run_without_pings_leaves_a_recording_all_the_same(tmp_path):
    Mcap(tmp_path / "run.mcap").close()
    assert Recording(tmp_path / "run.mcap").topics() == {}


def test_memory_does_not_grow_with_the_recording(tmp_path):
    """What waits for its chunk is written at the latest after `chunk_pings`."""
    sink = Mcap(tmp_path / "run.mcap", chunk_pings=2)
    sizes = []
    for n in range(6):
        sink(tracks=tracks(n))
        sizes.append((tmp_path / "run.mcap").stat().st_size)
    assert sizes[0] < sizes[1] == sizes[2] < sizes[3] == sizes[4] < sizes[5]
    sink.close()


def test_bad_parameters_are_named():
    with pytest.raises(ValueError, match="chunk_pings must be at least 1, not 0"):
        Mcap(chunk_pings=0)


def test_the_node_keeps_the_contract():
    check_node("mcap")
    check_node(
        Mcap(Path("run.mcap")), [{"tracks": tracks(n), "echoes": Detections(n, n * 10)} for n in range(4)]
    )
