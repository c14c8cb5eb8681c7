"""Hosts nodes on links: when they fire, in which order, how far ahead, and how a run ends."""

from fls_flow.runtime.folder import RunFolder, describe
from fls_flow.runtime.run import Options, Report, Run

__all__ = ["Options", "Report", "Run", "RunFolder", "describe"]
