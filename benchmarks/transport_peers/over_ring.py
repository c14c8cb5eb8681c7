"""Our ring, its descriptors over Zenoh, lossless: at most eight messages are with their readers at a time."""

from __future__ import annotations

import time

import msgspec
import numpy as np
import zenoh

from benchmarks.transport_peers.over_zenoh import publisher, session
from benchmarks.transport_peers.rig import Bytes, Setting, Tally
from fls_flow.links.ring import Arena, Descriptor, Slot, Window

__all__ = ["publish", "receive", "send", "subscribe"]

CREDIT = 8
SMALL = 32 << 10  # up to here bytes over Zenoh are as fast


def send(setting: Setting) -> None:
    """Copy each array into a slot, once for all readers, and send its descriptor."""
    with session(setting, listen=True) as opened:
        publish(opened, setting)


def publish(opened: zenoh.Session, setting: Setting) -> None:
    """The same over a session that is there."""
    declared, arena = publisher(opened, setting), Arena(f"fls-{setting.key}")
    try:
        for item in setting.messages():
            if isinstance(item, float):
                time.sleep(item)
            elif item.size <= SMALL:
                declared.put(b"B" + item.tobytes())
            else:
                slot = _slot(arena, item.size, (1 << setting.readers) - 1)
                np.copyto(np.frombuffer(slot.view, np.uint8), item)
                declared.put(b"D" + msgspec.msgpack.encode(slot.descriptor))
    finally:
        arena.close()


def _slot(arena: Arena, size: int, readers: int) -> Slot:
    """A slot when there is credit: the readers' flags in the table are the acknowledgements."""
    while arena.leased() >= CREDIT:
        time.sleep(50e-6)
    slot = arena.place(size, readers)
    if slot is None:
        raise RuntimeError("/dev/shm has no room for eight messages")
    return slot


def receive(setting: Setting, tally: Tally) -> None:
    """Open each descriptor."""
    with session(setting, listen=False) as opened:
        subscribe(opened, setting, tally)


def subscribe(opened: zenoh.Session, setting: Setting, tally: Tally) -> None:
    """The same over a session that is there."""
    window = Window()

    def array(payload: bytes) -> Bytes:
        if payload[:1] == b"B":
            return np.frombuffer(payload, np.uint8, offset=1)
        return window.open(Descriptor(*msgspec.msgpack.decode(payload[1:])), tally.index)

    subscriber = opened.declare_subscriber(setting.key, zenoh.handlers.FifoChannel(256))
    setting.ready(tally.index)
    while tally.take(array(subscriber.recv().payload.to_bytes())):
        pass
