"""CPU times of methods that are measured side by side."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

__all__ = ["cell", "ratio", "timed"]

Times = Mapping[str, list[float]]


def timed(
    methods: Mapping[str, Callable[[], object]], rounds: int, *, least_s: float = 2e-3
) -> dict[str, list[float]]:
    """CPU s of the thread per call of each method, a value per round.

    Rounds are interleaved: each times every method in turn, so that what slows the machine for a while slows
    all. A method is repeated within its round until that takes some `least_s`; its first call, which may
    compile, does not count.
    """
    repeats = {name: _repeats(method, least_s) for name, method in methods.items()}
    times: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(rounds):
        for name, method in methods.items():
            began = time.thread_time()
            for _ in range(repeats[name]):
                method()
            times[name].append((time.thread_time() - began) / repeats[name])
    return times


def _repeats(method: Callable[[], object], least_s: float) -> int:
    method()
    began = time.thread_time()
    method()
    return max(1, round(least_s / max(time.thread_time() - began, 1e-7)))


def ratio(times: Times, name: str, over: str = "ours") -> float:
    """How many times as long a method takes as another: the median of the rounds' ratios."""
    return statistics.median(a / b for a, b in zip(times[name], times[over], strict=True))


def cell(times: Times, name: str) -> str:
    """A method's median in ms, and in brackets how many times ours that is."""
    return f"{1e3 * statistics.median(times[name]):.3f} ({ratio(times, name):.2f})"
