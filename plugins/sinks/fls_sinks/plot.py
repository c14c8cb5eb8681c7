"""Draw chosen pings with what was found in them."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from fls_flow import BeamMask, Classes, Detections, InputError, Ping, Tracks, Truth, Wakes, hookimpl
from fls_sinks.picture import Look, drawn
from fls_sinks.scene import History, Scene

__all__ = ["Plot"]

Colormap = Literal["bone", "copper", "gray", "inferno", "viridis"]
FORMATS = (".png", ".pdf", ".svg")
MAX_PANELS = 12
_LOG = logging.getLogger(__name__)


@dataclass
class Plot:
    """A picture of the fan with detections, wakes, tracks, their trails, ellipses and ids.

    It is written whole when the run ends, one panel per chosen ping. The last ping stands in for chosen
    pings that never came.
    """

    path: Path = Path("tracks.png")
    pings: tuple[int, ...] = ()  # `seq` of the pings to draw; none: the last one
    trail_pings: int = 1000  # how far back trails reach
    dynamic_range_db: float = 40.0
    gate_probability: float = 0.99  # of the error ellipses
    colormap: Colormap = "bone"
    dpi: int = 110
    _chosen: dict[int, Scene] = field(default_factory=dict, init=False, repr=False)
    _last: Scene | None = field(default=None, init=False, repr=False)
    _history: History = field(init=False, repr=False)
    _closed: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if self.path.suffix.lower() not in FORMATS:
            raise ValueError(f"path must end in {', '.join(FORMATS)}, not {self.path}")
        if len(set(self.pings)) > MAX_PANELS:
            raise ValueError(f"pings takes at most {MAX_PANELS}, not {len(set(self.pings))}")
        if self.trail_pings < 1:
            raise ValueError(f"trail_pings must be 1 or more, not {self.trail_pings}")
        if not 1.0 < self.dynamic_range_db <= 200.0:
            raise ValueError(f"dynamic_range_db must lie between 1 and 200, not {self.dynamic_range_db}")
        if not 0.0 < self.gate_probability < 1.0:
            raise ValueError(f"gate_probability must lie between 0 and 1, not {self.gate_probability}")
        if self.colormap not in get_args(Colormap):
            raise ValueError(f"colormap must be one of {', '.join(get_args(Colormap))}, not {self.colormap}")
        if not 30 <= self.dpi <= 600:
            raise ValueError(f"dpi must lie between 30 and 600, not {self.dpi}")
        self._history = History(self.trail_pings)

    def __call__(
        self,
        ping: Ping,
        detections: Detections | None = None,
        wakes: Wakes | None = None,
        tracks: Tracks | None = None,
        beam_mask: BeamMask | None = None,
        truth: Truth | None = None,
        classes: Classes | None = None,
    ) -> None:
        """Remember what there is to draw; nothing is written yet."""
        if self._last is None and not self._chosen:
            self._refuse_to_replace()
        if tracks is not None:
            self._history.add(tracks)
        wanted = {seq for seq in self.pings if seq not in self._chosen}
        if self.pings and not wanted:
            return
        scene = Scene.of(ping, detections, wakes, tracks, beam_mask, truth, classes)
        if ping.seq in wanted:
            self._chosen[ping.seq] = self._with_trails(scene)
            scene = self._chosen[ping.seq]
        self._last = scene

    def close(self) -> None:
        """Write the picture; without any ping it says so."""
        if self._closed:
            return
        self._closed = True
        self._refuse_to_replace()
        scenes = self._scenes()
        if not scenes:
            _LOG.warning("%s shows no ping: none came", self.path)
        look = Look(self.dynamic_range_db, self.gate_probability, self.colormap, self.dpi)
        part = self.path.with_name(f".{self.path.stem}-{os.getpid()}.part{self.path.suffix}")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            drawn(scenes, look).savefig(part)
            part.replace(self.path)
        except OSError as err:
            raise InputError(f"{self.path}: cannot be written ({err.strerror or err})") from err
        finally:
            part.unlink(missing_ok=True)

    def snapshot(self) -> dict[str, Any]:
        """What would be drawn now."""
        return {
            "chosen": [scene.snapshot() for scene in self._chosen.values()],
            "last": None if self._last is None else self._last.snapshot(),
            "history": self._history.snapshot(),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        chosen = [Scene.restored(entry) for entry in snapshot["chosen"]]
        self._chosen = {scene.seq: scene for scene in chosen}
        self._last = None if snapshot["last"] is None else Scene.restored(snapshot["last"])
        self._history.restore(snapshot["history"])

    def _scenes(self) -> list[Scene]:
        scenes = list(self._chosen.values())
        missing = [seq for seq in self.pings if seq not in self._chosen]
        if missing:
            _LOG.warning("%s: no ping with seq %s came", self.path, ", ".join(map(str, missing)))
        if self._last is not None and (missing or not self.pings) and self._last.seq not in self._chosen:
            scenes.append(self._with_trails(self._last))
        return scenes

    def _with_trails(self, scene: Scene) -> Scene:
        ids, positions = self._history.trail(scene.pose)
        return replace(scene, trail_id=ids, trail_m=positions)

    def _refuse_to_replace(self) -> None:
        if self.path.exists():
            raise InputError(f"{self.path}: exists already; choose another path, or move it away")


@hookimpl
def fls_node() -> type[Plot]:
    """Return the node of kind `plot`."""
    return Plot
