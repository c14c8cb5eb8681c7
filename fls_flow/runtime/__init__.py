"""Hosts nodes on links: when they fire, in which order, how far ahead, and how a run ends."""

from fls_flow.runtime.folder import RunFolder, describe
from fls_flow.runtime.run import Run
from fls_flow.runtime.terms import Options, Pace, Report, Share, finished_pings, holders, pace_of, pings_of

__all__ = [
    "Options",
    "Pace",
    "Report",
    "Run",
    "RunFolder",
    "Share",
    "describe",
    "finished_pings",
    "holders",
    "pace_of",
    "pings_of",
]
