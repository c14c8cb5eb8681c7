"""Scores of what a run found against what was there."""

from __future__ import annotations

from fls_flow.evaluate.files import Files, find
from fls_flow.evaluate.scores import Scores, Settings, score

__all__ = ["Files", "Scores", "Settings", "find", "score"]
