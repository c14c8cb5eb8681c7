"""`multiprocessing` between two processes: bytes through a pipe (a Unix socket), lossless."""

from __future__ import annotations

import time
from contextlib import suppress
from multiprocessing.connection import Client, Listener

import numpy as np

from benchmarks.transport_peers.rig import Setting, Tally

__all__ = ["receive", "send"]

KEY = b"benchmark"


def send(setting: Setting) -> None:
    """Send the bytes of each array to every receiver."""
    path = str(setting.folder / "socket")
    with Listener(path, "AF_UNIX", authkey=KEY) as listener:
        setting.say_address(path)
        pipes = [listener.accept() for _ in range(setting.readers)]
        with suppress(BrokenPipeError):  # the receivers have ended
            for item in setting.messages():
                if isinstance(item, float):
                    time.sleep(item)
                    continue
                for pipe in pipes:
                    pipe.send_bytes(item.data)


def receive(setting: Setting, tally: Tally) -> None:
    """Take each message as an array."""
    with Client(setting.address(), "AF_UNIX", authkey=KEY) as pipe:
        while tally.take(np.frombuffer(pipe.recv_bytes(), np.uint8)):
            pass
        tally.save()
