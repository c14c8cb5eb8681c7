"""ezmsg (PyPI `ezmsg`): asyncio, shared memory on one host, lossless by leases of 32 buffers."""

from __future__ import annotations

import asyncio

import ezmsg.core as ez
import numpy as np
from ezmsg.core.graphserver import GraphServer

from benchmarks.transport_peers.rig import Setting, Tally

__all__ = ["receive", "send"]


def send(setting: Setting) -> None:
    """Publish each array."""
    server = GraphServer()
    server.start(("127.0.0.1", 0))
    setting.say_address(":".join(map(str, server.address)))
    asyncio.run(_send(setting, server.address))
    server.stop()


async def _send(setting: Setting, address: tuple[str, int]) -> None:
    async with ez.GraphContext(address, auto_start=False) as context:
        # Left to grow by itself, the shared memory of ezmsg 3.9 stops the subscriber for good.
        room = max(step.size for step in setting.steps) + (64 << 10)
        publisher = await context.publisher(setting.key, host="127.0.0.1", buf_size=room)
        await asyncio.to_thread(setting.wait_ready)
        await asyncio.sleep(0.3)
        for item in setting.messages():
            if isinstance(item, float):
                await asyncio.sleep(item)
            else:
                await publisher.broadcast(item)


def receive(setting: Setting, tally: Tally) -> None:
    """Take each array without a copy."""
    host, port = setting.address().split(":")
    asyncio.run(_receive(setting, tally, (host, int(port))))


async def _receive(setting: Setting, tally: Tally, address: tuple[str, int]) -> None:
    async with ez.GraphContext(address, auto_start=False) as context:
        subscriber = await context.subscriber(setting.key)
        setting.ready(tally.index)
        more = True
        while more:
            async with subscriber.recv_zero_copy() as message:
                more = tally.take(np.asarray(message))
                del message  # it lies in shared memory, which could not be closed
        tally.save()
