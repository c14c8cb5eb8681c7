"""Raw zenoh-python between two peers: over TCP alone, or with its default, shared memory from 3 kB on."""

from __future__ import annotations

import json
import socket
import time
from typing import Any

import numpy as np
import zenoh

from benchmarks.transport_peers.rig import Setting, Tally

__all__ = ["publish", "publisher", "receive", "send", "session", "subscribe"]


def session(setting: Setting, listen: bool) -> zenoh.Session:
    """A peer that listens on a free port of this host, or one connected to it."""
    if listen:
        with socket.create_server(("127.0.0.1", 0)) as free:
            setting.say_address(f"tcp/127.0.0.1:{free.getsockname()[1]}")
    config = zenoh.Config()
    values: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": [setting.address()] if listen else [],
        "connect/endpoints": [] if listen else [setting.address()],
        "scouting/multicast/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
    }
    if setting.variant.startswith("tcp"):
        values["transport/shared_memory/enabled"] = False
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def publisher(opened: zenoh.Session, setting: Setting) -> zenoh.Publisher:
    """A lossless publisher, when all receivers listen."""
    declared = opened.declare_publisher(setting.key, congestion_control=zenoh.CongestionControl.BLOCK)
    setting.wait_ready()
    while not declared.matching_status.matching:  # type: ignore[attr-defined]  # its stub says bool
        time.sleep(0.005)
    time.sleep(0.2)  # "matching" says that there is one, not that all are there
    return declared


def send(setting: Setting) -> None:
    """Put the bytes of each array."""
    with session(setting, listen=True) as opened:
        publish(opened, setting)


def publish(opened: zenoh.Session, setting: Setting) -> None:
    """The same over a session that is there."""
    declared = publisher(opened, setting)
    for item in setting.messages():
        if isinstance(item, float):
            time.sleep(item)
        else:
            declared.put(item.tobytes())


def receive(setting: Setting, tally: Tally) -> None:
    """Take each payload as an array."""
    with session(setting, listen=False) as opened:
        subscribe(opened, setting, tally)


def subscribe(opened: zenoh.Session, setting: Setting, tally: Tally) -> None:
    """The same over a session that is there."""
    subscriber = opened.declare_subscriber(setting.key, zenoh.handlers.FifoChannel(256))
    setting.ready(tally.index)
    while tally.take(np.frombuffer(subscriber.recv().payload.to_bytes(), np.uint8)):
        pass
