"""Two topics between the same two processes, over one session: a reader of the first sleeps for seconds.

The `variant` is the module that carries the first topic; the second are messages of 1 kB over Zenoh.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable
from dataclasses import replace

from benchmarks.transport_peers import over_zenoh
from benchmarks.transport_peers.rig import Setting, Step, Tally

__all__ = ["other", "receive", "send"]


def other(setting: Setting) -> Setting:
    """The second topic: as long as the first lasts, with its stall."""
    seconds = setting.steps[0].count / setting.steps[0].rate_hz + setting.stall_s + 1.0
    steps = (Step(1024, int(100 * seconds), 100.0, limit_s=60.0),)
    return replace(
        setting, key=f"{setting.key}-other", folder=setting.folder / "other", steps=steps, stall_s=0.0
    )


def send(setting: Setting) -> None:
    """Publish both, each in its thread."""
    carrier = importlib.import_module(f"benchmarks.transport_peers.{setting.variant}")
    with over_zenoh.session(setting, listen=True) as opened:
        _both(
            lambda: carrier.publish(opened, setting),
            lambda: over_zenoh.publish(opened, other(setting)),
        )


def receive(setting: Setting, tally: Tally) -> None:
    """Receive both, each in its thread."""
    carrier = importlib.import_module(f"benchmarks.transport_peers.{setting.variant}")
    second = Tally(other(setting), 0)
    with over_zenoh.session(setting, listen=False) as opened:
        _both(
            lambda: carrier.subscribe(opened, setting, tally),
            lambda: over_zenoh.subscribe(opened, second.setting, second),
            second.save,
        )


def _both(
    first: Callable[[], None], second: Callable[[], None], last: Callable[[], None] | None = None
) -> None:
    thread = threading.Thread(target=first)
    thread.start()
    second()
    if last is not None:
        last()
    thread.join()
