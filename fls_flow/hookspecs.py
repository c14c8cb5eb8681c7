"""The whole plugin surface: one hook, which gives the node class of a kind."""

from __future__ import annotations

import pluggy

__all__ = ["PROJECT", "fls_node", "hookimpl", "hookspec"]

PROJECT = "fls_flow"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def fls_node() -> type:  # type: ignore[empty-body]  # a specification has no body
    """Return the dataclass whose fields are the parameters and whose `__call__` has the ports."""
