"""What the progress bar says before and after the first ping."""

from __future__ import annotations

import io

from rich.console import Console

from fls_flow.console import progress


def shown(*counts: int) -> str:
    text = io.StringIO()
    with progress(Console(file=text, force_terminal=True, width=120), 10, shown=True) as count:
        for pings in counts:
            count(pings)
    return text.getvalue().rpartition("\r")[2]  # the bar as it was last drawn


def test_until_the_first_ping_it_says_why_nothing_moves() -> None:
    assert "starting (a first run compiles)" in shown()
    assert "starting (a first run compiles)" in shown(0)


def test_then_it_counts_pings() -> None:
    last = shown(0, 1, 7)
    assert "starting" not in last
    assert "pings" in last
    assert "7/10" in last
