"""`multiprocessing.shared_memory`, eight places in turn, and a Zenoh message of 1 kB.

Nothing keeps a place from being written while it is read: what arrives is torn when the sender is not paced.
The least that such a scheme can cost.
"""

from __future__ import annotations

import struct
import time
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory

import numpy as np
import zenoh

from benchmarks.transport_peers.over_zenoh import publisher, session
from benchmarks.transport_peers.rig import Setting, Tally

__all__ = ["receive", "send"]

PLACES, SMALL = 8, 1024
HEAD = struct.Struct("<II")


def send(setting: Setting) -> None:
    """Copy each array to the next place, and say where."""
    room = max(SMALL, *(step.size for step in setting.steps))
    shared = SharedMemory(setting.key, create=True, size=PLACES * room)
    places = np.frombuffer(shared.buf or b"", np.uint8).reshape(PLACES, room)
    places[:] = 0
    try:
        with session(setting, listen=True) as opened:
            declared = publisher(opened, setting)
            count = 0
            for item in setting.messages():
                if isinstance(item, float):
                    time.sleep(item)
                    continue
                places[count % PLACES, : item.size] = item
                declared.put(HEAD.pack(count % PLACES, item.size).ljust(SMALL, b"\0"))
                count += 1
    finally:
        del places
        shared.close()
        shared.unlink()


def receive(setting: Setting, tally: Tally) -> None:
    """Look at each place that is named."""
    with session(setting, listen=False) as opened:
        shared = SharedMemory(setting.key)
        resource_tracker.unregister(shared._name, "shared_memory")  # type: ignore[attr-defined]  # else it is unlinked here
        room = max(SMALL, *(step.size for step in setting.steps))
        places = np.frombuffer(shared.buf or b"", np.uint8)
        subscriber = opened.declare_subscriber(setting.key, zenoh.handlers.FifoChannel(256))
        setting.ready(tally.index)
        more = True
        while more:
            place, size = HEAD.unpack_from(subscriber.recv().payload.to_bytes())
            more = tally.take(places[place * room : place * room + size])
        del places
        shared.close()
