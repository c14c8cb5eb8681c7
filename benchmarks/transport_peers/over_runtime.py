"""The runtime on our link: two nodes of a graph, hosted as in a run; what it costs beside the link alone."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.transport_peers.over_link import Array, Block, Taker, failed, graph, link, window
from benchmarks.transport_peers.over_zenoh import session
from benchmarks.transport_peers.rig import Setting, Tally
from fls_flow.runtime.run import Run
from fls_flow.runtime.terms import Options, Pace, Share

__all__ = ["receive", "send"]


class _Source(Array):
    """Gives the messages of a measurement."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting

    def __call__(self) -> Iterator[Block]:
        index = 0
        for item in self._setting.messages():
            if isinstance(item, float):
                time.sleep(item)
            else:
                yield Block(index, index, item)
                index += 1


class _Taker(Taker):
    """Counts what it gets."""

    def __init__(self, tally: Tally) -> None:
        self._tally, self._more = tally, True

    def __call__(self, block: Block) -> None:
        if self._more and not self._tally.take(block.cells):
            self._more = False
            self._tally.save()  # the sender ends when it finds this


def send(setting: Setting) -> None:
    """Host the source."""
    _host(setting, "source", _Source(setting), setting.wait_ready, listen=True)


def receive(setting: Setting, tally: Tally) -> None:
    """Host a taker."""
    _host(setting, f"taker-{tally.index}", _Taker(tally), lambda: setting.ready(tally.index), listen=False)


def _host(setting: Setting, name: str, instance: Any, met: Callable[[], None], *, listen: bool) -> None:
    with session(setting, listen=listen) as opened, tempfile.TemporaryDirectory() as out:
        own = link(opened, setting, name)
        takers = tuple(f"taker-{index}" for index in range(setting.readers))
        share = Share(frozenset({name}), own, Pace(window(setting), False), failed, takers)
        run = Run(graph(setting), Options(), out=Path(out), instances={name: instance}, share=share)
        while own.unmatched():
            time.sleep(0.005)
        met()
        run.start()
        while not own.idle():
            time.sleep(0.005)
        own.close()
