"""Draw the chips of tracks over time, with the outlines and the features of their objects."""

from __future__ import annotations

import dataclasses
import logging
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fls_features.chip_messages import Chips, Regions
from fls_features.sheet import Shown, Strip, drawn
from fls_flow import Classes, Features, InputError, hookimpl

__all__ = ["ChipSheet"]

FORMATS = (".png", ".pdf", ".svg")
MAX_CELLS = 400
_LOG = logging.getLogger(__name__)


@dataclass
class ChipSheet:
    """A row of chips for each of the tracks that gave the most, evenly over their time.

    The outline is that of the region, where it was kept; under a chip stand the features that `show` names,
    by default the first four that come; beside a row the track's last label. The sheet is written whole when
    the run ends.
    """

    path: Path = Path("chips.png")
    tracks: int = 8
    chips_per_track: int = 10
    show: tuple[str, ...] = ()
    _strips: dict[int, Strip] = field(default_factory=dict, init=False, repr=False)
    _labels: dict[int, str] = field(default_factory=dict, init=False, repr=False)
    _names: tuple[str, ...] = field(default=(), init=False, repr=False)
    _start_ns: int | None = field(default=None, init=False, repr=False)
    _closed: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if self.path.suffix.lower() not in FORMATS:
            raise ValueError(f"path must end in {', '.join(FORMATS)}, not {self.path}")
        for name in ("tracks", "chips_per_track"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        if self.tracks * self.chips_per_track > MAX_CELLS:
            raise ValueError(
                f"tracks {self.tracks} times chips_per_track {self.chips_per_track} is over {MAX_CELLS}"
            )
        self._names = tuple(self.show)

    def __call__(
        self,
        chips: Chips,
        regions: Regions,
        features: Features | None = None,
        classes: Classes | None = None,
    ) -> None:
        """Remember what there is to draw; nothing is written yet."""
        if not np.array_equal(chips.track_id, regions.track_id):
            raise ValueError("regions are not of these chips; wire both from the same chips")
        if self._start_ns is None:
            self._refuse_to_replace()
            self._start_ns = chips.stamp_ns
        if features is not None and features.names and not self._names:
            self._names = features.names[:4]
        if classes is not None:
            self._label(classes)
        values = {} if features is None else self._values(features)
        time_s = (chips.stamp_ns - self._start_ns) * 1e-9
        for n, track_id in enumerate(chips.track_id.tolist()):
            row = values.get(track_id, (math.nan,) * len(self._names))
            strip = self._strips.setdefault(track_id, Strip(self.chips_per_track))
            strip.add(_shown(chips, regions, n, time_s, row))

    def _label(self, classes: Classes) -> None:
        chance = classes.posterior.max(axis=1, initial=0.0)
        for track_id, label, p in zip(
            classes.track_id.tolist(), classes.label.tolist(), chance.tolist(), strict=True
        ):
            if 0 <= label < len(classes.names):
                self._labels[track_id] = f"{classes.names[label]} {p:.2f}"

    def _values(self, features: Features) -> dict[int, tuple[float, ...]]:
        """The shown features of each described track."""
        known = [features.names.index(name) if name in features.names else -1 for name in self._names]
        return {
            track_id: tuple(math.nan if at < 0 else row[at] for at in known)
            for track_id, row in zip(features.track_id.tolist(), features.values.tolist(), strict=True)
        }

    def close(self) -> None:
        """Write the sheet; without any chip it says so."""
        if self._closed:
            return
        self._closed = True
        self._refuse_to_replace()
        rows = self.rows()
        if not rows:
            _LOG.warning("%s shows no chip: none came", self.path)
        part = self.path.with_name(f".{self.path.stem}-{os.getpid()}.part{self.path.suffix}")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            drawn(rows, self._names, self.chips_per_track).savefig(part)
            part.replace(self.path)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror or error})") from error
        finally:
            part.unlink(missing_ok=True)

    def rows(self) -> list[tuple[str, Strip]]:
        """What is drawn: title and strip of the tracks that gave the most chips so far."""
        longest = sorted(self._strips, key=lambda one: (-self._strips[one].count, one))[: self.tracks]
        return [(f"track {one}\n{self._labels.get(one, '')}", self._strips[one]) for one in sorted(longest)]

    def _refuse_to_replace(self) -> None:
        if self.path.exists():
            raise InputError(f"{self.path}: exists already; choose another path, or move it away")

    def snapshot(self) -> dict[str, Any]:
        """What would be drawn now."""
        strips = [
            {
                "track": track,
                "count": strip.count,
                "stride": strip.stride,
                "shown": [dataclasses.asdict(one) for one in strip.shown],
            }
            for track, strip in self._strips.items()
        ]
        labels = [[track, text] for track, text in self._labels.items()]
        return {"strips": strips, "labels": labels, "names": list(self._names), "start_ns": self._start_ns}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._strips = {
            one["track"]: Strip(
                self.chips_per_track, one["count"], one["stride"], [_restored(part) for part in one["shown"]]
            )
            for one in snapshot["strips"]
        }
        self._labels = dict(snapshot["labels"])
        self._names, self._start_ns = tuple(snapshot["names"]), snapshot["start_ns"]


def _shown(chips: Chips, regions: Regions, n: int, time_s: float, values: tuple[float, ...]) -> Shown:
    mask = (
        regions.mask[n] & regions.kept[n] if n < len(regions) else np.zeros(chips.amplitude.shape[1:], bool)
    )
    bearing = np.degrees(chips.bearing_rad[n])
    return Shown(
        time_s,
        chips.amplitude[n].copy(),
        mask,
        (float(chips.range_m[n, 0]), float(chips.range_m[n, -1])),
        (float(bearing[0]), float(bearing[-1])),
        values,
    )


def _restored(part: dict[str, Any]) -> Shown:
    return Shown(
        part["time_s"],
        np.array(part["amplitude"]),
        np.array(part["mask"]),
        tuple(part["range_m"]),
        tuple(part["bearing_deg"]),
        tuple(part["values"]),
    )


@hookimpl
def fls_node() -> type[ChipSheet]:
    """Return the node of kind `chip-sheet`."""
    return ChipSheet
