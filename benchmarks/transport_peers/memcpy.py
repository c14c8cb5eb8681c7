"""One copy in one process: what no transport that copies can go below."""

from __future__ import annotations

import time

import numpy as np

from benchmarks.transport_peers.rig import Setting, Tally

__all__ = ["receive", "send"]


def send(setting: Setting) -> None:
    """Copy each array to one of eight places."""
    tally = Tally(setting, 0)
    places = np.zeros((8, max(1024, *(step.size for step in setting.steps))), np.uint8)
    count = 0
    for item in setting.messages():
        if isinstance(item, float):
            time.sleep(item)
            continue
        place = places[count % 8, : item.size]
        np.copyto(place, item)
        count += 1
        if not tally.take(place):
            tally.save()


def receive(setting: Setting, tally: Tally) -> None:
    """Nothing: there is one process."""
