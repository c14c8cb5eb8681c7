"""A bad network between two TCP endpoints: `python proxy.py TARGET_PORT --delay-s 0.05 --mbit 20 --cut-s 1`.

Listens on a free port of loopback and prints "ready" and that port. When its input ends, it prints what went
through as JSON and ends. Every direction of every connection is delayed and limited on its own; all
connections are cut at intervals around `--cut-s`.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import sys
from dataclasses import asdict, dataclass, field

CHUNK = 16 << 10
IN_FLIGHT = 64  # chunks on their way; beyond, the sender waits as on a full link


@dataclass
class Proxy:
    target: int
    delay_s: float
    bytes_per_s: float
    connections: int = 0
    cuts: int = 0
    bytes_there: int = 0
    bytes_back: int = 0
    _writers: set[asyncio.StreamWriter] = field(default_factory=set)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Join a connection with one to the target, until either ends."""
        try:
            there, back = await asyncio.open_connection("127.0.0.1", self.target)
        except OSError:
            writer.transport.abort()
            return
        self.connections += 1
        self._writers |= {writer, back}
        ways = [self._way(reader, back, "bytes_there"), self._way(there, writer, "bytes_back")]
        tasks = [asyncio.ensure_future(way) for way in ways]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            for one in (writer, back):
                self._writers.discard(one)
                one.transport.abort()

    async def _way(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, counter: str) -> None:
        """Pass on what is read, late and slowly."""
        waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(IN_FLIGHT)
        arriving = asyncio.ensure_future(self._arrive(reader, waiting))
        try:
            while not (arriving.done() and waiting.empty()):
                due, chunk = await waiting.get()
                await asyncio.sleep(due - asyncio.get_running_loop().time())
                setattr(self, counter, getattr(self, counter) + len(chunk))
                writer.write(chunk)
                await writer.drain()
                if not chunk:
                    return
        finally:
            arriving.cancel()

    async def _arrive(
        self, reader: asyncio.StreamReader, waiting: asyncio.Queue[tuple[float, bytes]]
    ) -> None:
        free = 0.0
        chunk = b"-"
        while chunk:
            try:
                chunk = await reader.read(CHUNK)
            except OSError:
                chunk = b""
            free = max(asyncio.get_running_loop().time(), free) + len(chunk) / self.bytes_per_s
            await waiting.put((free + self.delay_s, chunk))

    async def cut(self, every_s: float) -> None:
        """Cut all connections now and then."""
        chance = random.Random(7)
        while True:
            await asyncio.sleep(every_s * chance.uniform(0.7, 1.3))
            self.cuts += bool(self._writers)
            for writer in self._writers:
                writer.transport.abort()


async def main(words: argparse.Namespace) -> None:
    proxy = Proxy(words.target, words.delay_s, words.mbit * 1e6 / 8)
    server = await asyncio.start_server(proxy.serve, "127.0.0.1", 0)
    sys.stdout.write(f"ready\n{server.sockets[0].getsockname()[1]}\n")
    sys.stdout.flush()
    cutting = asyncio.ensure_future(proxy.cut(words.cut_s)) if words.cut_s else None
    await asyncio.to_thread(sys.stdin.read)
    if cutting is not None:
        cutting.cancel()
    proxy._writers.clear()
    said = {name: value for name, value in asdict(proxy).items() if not name.startswith("_")}
    sys.stdout.write(json.dumps(said) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("target", type=int)
    parser.add_argument("--delay-s", type=float, default=0.05)
    parser.add_argument("--mbit", type=float, default=20.0)
    parser.add_argument("--cut-s", type=float, default=0.0)
    asyncio.run(main(parser.parse_args()))
