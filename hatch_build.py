"""Carry the graphs and the recordings that they play in the wheel.

An editable install reads them from the checkout instead, so that it never serves stale copies.
"""

from __future__ import annotations

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SHIPPED = {
    folder: f"fls_flow/_shipped/{folder}"
    for folder in ("graphs", "deployments", "models", "tests/golden/didson")
}


class ShipGraphs(BuildHookInterface):  # type: ignore[type-arg]  # hatchling's generic has no public parameter
    """Add `graphs/` and its recordings to every wheel that is not editable."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by hatchling before it packs."""
        if version != "editable":
            build_data["force_include"].update(SHIPPED)
