"""dora-rs (PyPI `dora-rs` and `dora-rs-cli`): nodes of a dataflow that `dora run` starts."""

from __future__ import annotations

import time

import numpy as np
import pyarrow as pa
from dora import Node

from benchmarks.transport_peers.rig import Setting, Tally

__all__ = ["receive", "send"]


def send(setting: Setting) -> None:
    """Send each array as an Arrow array."""
    node = Node()
    setting.wait_ready()
    time.sleep(0.3)
    for item in setting.messages():
        if isinstance(item, float):
            time.sleep(item)
        else:
            node.send_output("array", pa.array(item))


def receive(setting: Setting, tally: Tally) -> None:
    """Take each input as an array, without a copy."""
    node = Node()
    setting.ready(tally.index)
    more = True
    while more:
        event = node.next()
        if event is None or event["type"] == "STOP":
            break
        if event["type"] == "INPUT":
            more = tally.take(np.asarray(event["value"].to_numpy(zero_copy_only=True)))
    tally.save()
